"""Where the gap sits, for gaps put there on purpose."""

from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.localisation import crank_angle, order_powers, where_in_data
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.effects import cycles_of
from casadi_engine.model.port_view import PortView

DATA = Path(__file__).parents[2] / "data"
NOISE = NoiseModel({"omega": 0.1})


@pytest.fixture(scope="module")
def engine():
    data = ce.read_experiment(DATA / "normal_1200rpm.csv.gz", optional=("omega_load",)).cycles(1, 6)
    model = ce.two_mass()
    pars = model.parameters()
    for name in ("J_eng", "J_load", "K_el", "C_el"):
        pars.fix(name)
    start = {data.name: np.array([125.6, 125.6, -0.03])}
    return null_at(model, [data], pars, np.array([pars["C_eng"].value]), start)


def put(with_residual, engine, make, seed=0):
    record = engine.records[0]
    time = record.time["omega"]
    noise = 0.1 * np.random.default_rng(seed).standard_normal(len(time))
    e = noise + make(time, crank_angle(record, time))
    return with_residual(engine, {record.name: {"omega": e}})


def test_a_residual_of_noise_is_nowhere(engine, with_residual):
    found = [where_in_data(put(with_residual, engine, lambda t, a: 0 * t, seed), NOISE) for seed in range(20)]
    assert sum(w is not None for w in found) <= 2


def test_a_burst_is_dated(engine, with_residual):
    first = engine.records[0].time["omega"][0]
    found = where_in_data(
        put(with_residual, engine, lambda t, a: 0.3 * ((t > first + 0.23) & (t < first + 0.27))), NOISE
    )
    assert found.time[0] == pytest.approx(first + 0.23, abs=0.01)
    assert found.time[1] == pytest.approx(first + 0.27, abs=0.01)
    assert found.cycles == (3,)


def test_a_window_of_the_crank_angle_is_found_also_over_zero(engine, with_residual):
    for low, high in ((5.0, 6.5), (12.0, 0.7)):

        def window(t, a, low=low, high=high):
            place = np.mod(a, 4 * np.pi)
            inside = (place > low) & (place < high) if low < high else (place > low) | (place < high)
            return 0.05 * inside

        found = where_in_data(put(with_residual, engine, window), NOISE)
        assert found.crank_angle[0] == pytest.approx(low, abs=0.4)
        assert found.crank_angle[1] == pytest.approx(high, abs=0.4)
        assert found.cycles is None


@pytest.mark.parametrize("order", [0.5, 2.0, 6.5])
def test_an_engine_order_is_named(engine, with_residual, order):
    null = put(with_residual, engine, lambda t, a: 0.02 * np.cos(order * a + 1))
    assert where_in_data(null, NOISE).order == order
    orders, power = order_powers(null.records[0], NOISE)
    count = len(null.records[0].residual["omega"])
    assert power[orders == order][0] == pytest.approx(0.02**2 / 0.01 * count / 2, rel=0.5)


def test_the_record_that_holds_the_gap_is_named(shaft, with_residual):
    null = shaft.null(shaft.data("calm", seed=1), shaft.data("odd", seed=2))
    rng = np.random.default_rng(0)
    e = {
        r.name: {o: rng.standard_normal(400) * s + (r.name == "odd") * 0.1 for o, s in shaft.sigma.items()}
        for r in null.records
    }
    found = where_in_data(with_residual(null, e), NoiseModel(shaft.sigma))
    assert found.record == "odd"
    assert found.excess["odd"] > 0.9
    assert found.order is None
    assert found.crank_angle is None
    assert order_powers(null.records[0], NoiseModel(shaft.sigma)) is None


def test_cycles_of_a_cut_record_keep_their_numbers(with_residual):
    """A burst in cycle 5 of the record is in cycle 5 of its cycles 4 to 8, where a misfire is counted so too."""
    whole = ce.read_experiment(DATA / "normal_1200rpm.csv.gz", optional=("omega_load",))
    data = whole.cycles(4, 8)
    model = ce.two_mass()
    pars = model.parameters()
    for name in ("J_eng", "J_load", "K_el", "C_el"):
        pars.fix(name)
    start = {data.name: np.array([125.6, 125.6, -0.03])}
    cut = null_at(model, [data], pars, np.array([pars["C_eng"].value]), start)
    middle = np.interp(4.5 * 4 * np.pi, whole["theta"].values, whole["theta"].time)
    null = put(with_residual, cut, lambda t, a: 0.3 * (np.abs(t - middle) < 0.02))
    assert where_in_data(null, NOISE).cycles == (5,)
    # A misfire of cylinder 1 in cycle 5 begins at the same angle; the combustion of cycle 4 lies just before the cut.
    view = PortView(model, model.ports["cylinder_1"])
    numbers = dict(zip(model.parameter_names, model.parameter_vector(), strict=True))
    assert cycles_of(view, data, numbers) == (5, 6, 7, 8)
    assert cycles_of(view, whole.cycles(1, 8), numbers)[-4:] == (5, 6, 7, 8)
