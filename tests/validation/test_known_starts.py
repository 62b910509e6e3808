"""A fresh record of which the measurement gives no first states to begin at: those of the fit's records are taken."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import EstimationError


def cell():
    """A flow battery: what is in the tank no output shows, and without it the cell runs empty in a simulation."""
    b = ce.Blueprint("cell")
    volume = b.parameter("V", 5e-4, unit="m3", min=5e-5, max=5e-3)
    current = b.input("I", unit="A")
    inside, tank = b.state("c", unit="mol/m3"), b.state("c_tank", unit="mol/m3")
    b.ode("c", (5 * current / 96485 + 1.4e-5 * (tank - inside)) / volume)
    b.ode("c_tank", 1.4e-5 * (inside - tank) / 5e-3)
    charge = inside / 1500
    b.output("U", 0.25 * ca.log(charge / (1 - charge)) + 0.05 * current, unit="V")
    return b.model()


def record(name, seed):
    """By SciPy, the current joined by lines."""
    rng = np.random.default_rng(seed)
    time = np.arange(450) * 8.0
    current = rng.uniform(-28, 30, 450)[(time / 250).astype(int)]

    def rate(t, x):
        flow = 1.4e-5 * (x[1] - x[0])
        return [(5 * np.interp(t, time, current) / 96485 + flow) / 4e-4, -flow / 5e-3]

    run = solve_ivp(rate, (0, time[-1]), [750, 750], t_eval=time, rtol=1e-8, atol=1e-6, max_step=8)
    charge = run.y[0] / 1500
    shown = 0.25 * np.log(charge / (1 - charge)) + 0.05 * current + 0.005 * rng.standard_normal(450)
    return ce.Experiment.from_arrays(name, time=time, units={"I": "A", "U": "V"}, I=current, U=shown)


@pytest.fixture(scope="module")
def fit():
    return ce.estimate(cell(), record("run", 1), progress=False)


def test_without_a_fit_there_is_nowhere_to_begin():
    with pytest.raises(EstimationError, match="cannot be evaluated at the start values"):
        ce.estimate(cell(), record("fresh", 2), progress=False)


def test_what_was_seen_is_said_where_no_parameter_is_free():
    known = cell().parameters()
    known.fix("V", 4e-4)
    with pytest.raises(
        EstimationError, match="seen: no free parameter, and first states as the measurement gives"
    ):
        ce.estimate(cell(), record("fresh", 2), parameters=known, progress=False)


def test_a_fit_is_validated_from_the_first_states_of_its_own_records(fit):
    """It was an error whose "seen" was empty."""
    checked = ce.validate(fit, record("fresh", 2))
    assert checked.passed
    assert checked.records["fresh"]["U"].rmse == pytest.approx(0.005, rel=0.1)


def test_and_so_it_is_simulated(fit):
    data = record("fresh", 2)
    run = ce.simulate(fit, data)
    assert np.std(run["U"].values - data["U"].values) == pytest.approx(0.005, rel=0.1)


def test_where_no_record_of_the_fit_begins_either_the_fault_stays(fit, monkeypatch):
    import casadi_engine.estimation.known_starts as module

    monkeypatch.setattr(module, "_or_none", lambda find, start: None)
    with pytest.raises(EstimationError, match="cannot be evaluated at the start values"):
        ce.validate(fit, record("fresh", 2))
