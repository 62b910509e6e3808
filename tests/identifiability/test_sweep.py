"""Loss sweeps against closed forms, and Figure 4.6: what the thesis's start does to C_el."""

import math
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.identifiability import loss_sweep
from tests.quick import few

DATA = Path(__file__).resolve().parents[2] / "data"


def run_up(start=0.0):
    time = 0.02 * np.arange(200)
    omega = 4 + (start - 4) * np.exp(-time / 0.8) + 0.05 * np.random.default_rng(0).standard_normal(200)
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "run", time=time, units=units, hold="zero", T=np.full(200, 2.0), omega=omega
    )
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.4)
    pars["C_eng"].set(0.5)
    return time, omega, data, pars


def response(time, inertia, damping, start):
    return 2 / damping + (start - 2 / damping) * np.exp(-damping / inertia * time)


def test_a_known_start_has_the_closed_form():
    time, omega, data, pars = run_up()
    swept = loss_sweep(
        ce.one_inertia(), data, parameters=pars, points=11, span=(0.2, 2), start={"omega_eng": 0.0}
    )
    assert list(swept.values) == ["J_eng", "C_eng"]
    for name in swept.values:
        expected = [
            0.5 * np.mean((omega - response(time, *((v, 0.5) if name == "J_eng" else (0.4, v)), 0.0)) ** 2)
            for v in swept.values[name]
        ]
        np.testing.assert_allclose(swept.loss[name], expected, rtol=1e-8)
    assert swept.start == "known"
    assert swept.samples == 200
    np.testing.assert_allclose(
        swept.at_reference, 0.5 * np.mean((omega - response(time, 0.4, 0.5, 0.0)) ** 2)
    )


def test_a_fitted_start_is_the_best_one_at_every_point():
    time, omega, data, pars = run_up(start=7.0)
    swept = loss_sweep(ce.one_inertia(), data, "J_eng", parameters=pars, points=6, span=(0.5, 2))
    for value, loss in zip(swept.values["J_eng"], swept.loss["J_eng"], strict=True):
        decay = np.exp(-0.5 / value * time)
        rest = omega - 4 * (1 - decay)
        rest = rest - decay * (decay @ rest) / (decay @ decay)
        assert loss == pytest.approx(0.5 * np.mean(rest**2), rel=1e-8)
    held = loss_sweep(ce.one_inertia(), data, "J_eng", parameters=pars, points=6, span=(0.5, 2), start="held")
    assert held.at_reference == pytest.approx(swept.at_reference, rel=1e-9)
    assert (held.loss["J_eng"] >= swept.loss["J_eng"] * (1 - 1e-9)).all()


def test_a_reciprocal_is_swept_from_zero():
    _, _, data, pars = run_up()
    swept = loss_sweep(ce.one_inertia(), data, "1/J_eng", parameters=pars, points=6)
    assert swept.values["1/J_eng"][0] == 0
    assert math.isnan(swept.loss["1/J_eng"][0])
    assert swept.reference["1/J_eng"] == pytest.approx(2.5)
    assert swept.has_minimum("1/J_eng")
    assert "U-shape" in str(swept)


@pytest.fixture(scope="module")
def two_masses():
    return ce.two_mass(reciprocating_speed="measured")


def thesis_start(record):
    """Speeds as measured, twist 0: what the thesis's listing takes as known."""
    speed = float(record["omega"].values[:20].mean())
    return {"omega_eng": speed, "omega_load": speed, "twist": 0.0}


@pytest.mark.parametrize("file", few(["normal_1200rpm", "misfire_1200rpm"], "misfire_1200rpm"))
def test_with_the_start_estimated_all_five_are_u_shaped(two_masses, file):
    record = ce.read_experiment(DATA / f"{file}.csv.gz")
    names = ("1/J_eng", "C_eng", "K_el", "1/J_load", "C_el")
    swept = loss_sweep(two_masses, record, *names, points=11)
    for name in names:
        assert swept.has_minimum(name), name
        assert swept.minimum(name)[0] == pytest.approx(swept.reference[name]), name


def test_the_thesis_start_loses_c_el_and_leaves_its_floor(two_masses):
    """Figure 4.6(e): no minimum of C_el, and a summed loss of about 1e3 where noise alone makes 72."""
    record = ce.read_experiment(DATA / "normal_1200rpm.csv.gz")
    swept = loss_sweep(two_masses, record, "C_el", "1/J_eng", "C_eng", points=11, start=thesis_start(record))
    assert not swept.has_minimum("C_el")
    assert swept.has_minimum("1/J_eng")
    assert swept.has_minimum("C_eng")
    assert 300 < swept.at_reference * swept.samples < 3000
    assert "no minimum in the range" in str(swept)


def test_messages(two_masses):
    _, _, data, pars = run_up()
    model = ce.one_inertia()
    with pytest.raises(
        EstimationError, match="this parameter cannot be swept, for it is not free; seen: 'J'"
    ):
        loss_sweep(model, data, "J", parameters=pars)
    with pytest.raises(EstimationError, match=r"the range of a sweep is not acceptable; seen: \(2, 1\)"):
        loss_sweep(model, data, parameters=pars, span=(2, 1))
    with pytest.raises(EstimationError, match="the range of a sweep is not acceptable; seen: 2"):
        loss_sweep(model, data, parameters=pars, span=2)
    with pytest.raises(EstimationError, match="the start of a sweep is not acceptable; seen: 'rest'"):
        loss_sweep(model, data, parameters=pars, start="rest")
    with pytest.raises(EstimationError, match="run: a loss needs measured outputs; seen: T"):
        loss_sweep(model, data.without("omega"), parameters=pars)
    with pytest.raises(EstimationError, match="points is not acceptable; seen: 2"):
        loss_sweep(model, data, parameters=pars, points=2)
