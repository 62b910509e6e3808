"""The torque of combustion: pegged motored traces against made and simulated pressures."""

import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import EffectError
from casadi_engine.model import crankshaft, two_mass
from casadi_engine.model.combustion import Motored, burning, combustion_torque, fit_motored
from casadi_engine.model.crank_slider import torque_factor

DATA = Path(__file__).resolve().parents[2] / "data"
if str(DATA) not in sys.path:
    sys.path.insert(0, str(DATA))

RATIO = 0.043 / 0.145


def test_a_motored_trace_is_found_again_from_its_compression():
    truth = Motored(pressure=0.7e5, exponent=1.36, compression_ratio=12.5)
    angle = np.linspace(-2 * np.pi, 2 * np.pi, 2881)
    pressure = truth.trace(angle, RATIO)
    found = fit_motored(angle, pressure, ratio=RATIO)
    assert found.pressure == pytest.approx(0.7e5, rel=1e-6)
    assert found.exponent == pytest.approx(1.36, rel=1e-6)
    assert found.compression_ratio == pytest.approx(12.5)
    assert truth.trace(np.pi, RATIO) == pytest.approx(0.7e5)
    assert truth.trace(0.0, RATIO) == pytest.approx(0.7e5 * 12.5**1.36)


def test_a_trace_is_found_in_any_cycle_and_through_noise():
    truth = Motored(pressure=0.9e5, exponent=1.32, compression_ratio=10.0)
    angle = np.linspace(40.0, 120.0, 20_000)
    wrapped = np.mod(angle + 2 * np.pi, 4 * np.pi) - 2 * np.pi
    noisy = truth.trace(wrapped, RATIO) + np.random.default_rng(0).normal(0, 300.0, angle.size)
    found = fit_motored(angle, noisy, ratio=RATIO)
    near = np.linspace(-0.6, 0.6, 50)
    np.testing.assert_allclose(found.trace(near, RATIO), truth.trace(near, RATIO), rtol=0.02)


def test_a_record_without_compression_is_refused():
    with pytest.raises(EffectError, match=r"cannot be pegged.*0 samples"):
        fit_motored(np.linspace(0.0, 3.0, 100), np.full(100, 1e5), ratio=RATIO)
    with pytest.raises(EffectError, match="does not rise like a compression"):
        fit_motored(np.linspace(-3.0, 0.0, 500), np.full(500, 1e5), ratio=RATIO)


def test_the_window_is_open_while_valves_are_shut_and_repeats():
    angle = ca.SX.sym("a")
    window = ca.Function("w", [angle], [burning(angle)])
    inside = np.deg2rad([-50, 0, 60, 120])
    outside = np.deg2rad([-130, 190, 300, 360, -300, -200])
    np.testing.assert_allclose(np.array(window(inside)).ravel(), 1.0, atol=2e-3)
    np.testing.assert_allclose(np.array(window(outside)).ravel(), 0.0, atol=2e-3)
    np.testing.assert_allclose(np.array(window(inside + 8 * np.pi)), np.array(window(inside)), atol=1e-12)


@pytest.mark.parametrize("cylinder", [1, 2, 3, 4])
def test_the_combustion_torque_is_what_the_simulator_adds_by_burning(cylinder):
    from simulator import unequal_cylinders
    from simulator.geometry import cylinder_torque
    from simulator.pressure import pressure

    made, c = unequal_cylinders(), cylinder - 1
    angle = np.linspace(-2 * np.pi, 2 * np.pi, 7201)
    shape = (made.intake[c], made.delay[c])
    burned, dead = pressure(angle, 2.5e6, *shape), pressure(angle, 0.0, *shape)
    truth = cylinder_torque(angle, 0.0, burned) - cylinder_torque(angle, 0.0, dead)
    lever = 0.0058 * 0.043 * torque_factor(angle, RATIO)
    motored = fit_motored(angle, burned, ratio=RATIO)
    found = np.array(ca.DM(combustion_torque(ca.DM(angle), burned, lever, RATIO, motored))).ravel()
    overlap = found @ truth / np.sqrt((found @ found) * (truth @ truth))
    assert overlap > 0.9995
    assert found.mean() == pytest.approx(truth.mean(), rel=0.02)
    # the exhaust opens at 160 degrees, and the window shuts at 150: there the two part by a few N m
    assert np.abs(found - truth).max() < 0.05 * np.abs(truth).max()


@pytest.mark.parametrize("model", [two_mass(), crankshaft(), crankshaft(angle="state")])
def test_ports_of_cylinders_have_the_signals_of_the_table(model):
    for port in model.ports:
        if port.kind == "cylinder" and port.name != "cylinders":
            assert {"angle", "speed", "pressure", "gas_torque", "combustion_torque"} <= set(port.signals)
        if port.kind == "inertia":
            assert "speed" in port.signals
        if port.kind == "coupling":
            assert {"twist", "twist_rate", "stiffness"} <= set(port.signals)
        if port.kind == "sensor":
            # the load's speed bends by states alone, the engine's by the pressures too
            assert set(port.signals) - {"bend"} == {"value", "rate"}
        if port.kind == "parameter":
            assert set(port.signals) == {"value", "time"}
    cylinders = model.ports["cylinders"].signals["combustion_torque"]
    single = [model.ports[f"cylinder_{k}"].signals["combustion_torque"] for k in (1, 2, 3, 4)]
    symbols = ca.vertcat(model.x, model.u, model.p)
    rng = np.random.default_rng(0)
    at = np.concatenate(
        [rng.uniform(0, 1, model.x.numel()), rng.uniform(1, 2e6, model.u.numel()), model.parameter_vector()]
    )
    both = ca.Function("s", [symbols], [cylinders, sum(single)])(at)
    assert float(both[0]) == pytest.approx(float(both[1]), rel=1e-12)
