"""What is so unstable that its errors cannot be held by a number is said, not left to the linear algebra."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.growth import log_growth


@pytest.mark.parametrize("gain", [5.0, -1.0, 1e9])
def test_a_stated_gain_that_makes_the_predictor_unstable(run_up, refused, gain):
    # one inertia: the error of the speed is multiplied by (1 - gain) exp(-C dt/J) at each of 399 steps
    digits = 399 * (np.log10(abs(1 - gain)) - 0.5 * 0.02 / 0.4 / np.log(10))
    with refused(
        EstimationError,
        "the predictor is unstable over the length of the record",
        seen="run_up: a change of its start grows 1e",
        allowed="at most 1e100 times",
        cure="between 0 and 1 for a measured state",
    ) as caught:
        pars = ce.one_inertia().parameters()
        pars["J_eng"].set(0.4)
        pars["C_eng"].set(0.5)
        noise = ce.Noise(omega=0.05, gain=[[gain]])
        ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=noise, interval=10, progress=False)
    grown = float(caught.value.seen.split("grows 1e")[1].split()[0])
    assert grown == pytest.approx(digits, rel=0.03)


def test_a_model_that_runs_away(refused):
    b = ce.Blueprint("runaway")
    a, x, u = b.parameter("a", 1000.0), b.state("x"), b.input("u")
    b.ode("x", a * x + u)
    b.output("y", x)
    time = np.arange(500) * 0.001
    units = {"u": "1", "y": "1"}
    data = ce.Experiment.from_arrays("away", time=time, units=units, u=np.ones(500), y=np.ones(500))
    with refused(
        EstimationError,
        "the model is unstable over the length of the record",
        seen="away",
        cure="shorter records",
    ):
        ce.estimate(b.model(), data, noise=ce.Noise(y=0.1), interval=10, progress=False)


def test_growth_of_shared_and_of_own_transitions_agrees():
    step = np.array([[1.2, 0.1], [0.0, 0.3]])
    shared = log_growth(step[None], 50)
    assert shared == pytest.approx(50 * np.log(1.2), rel=1e-12)
    assert log_growth(np.repeat(step[None], 50, axis=0), 50) == pytest.approx(shared, rel=0.02)


def test_what_vanishes_has_not_grown():
    assert log_growth(np.zeros((1, 2, 2)), 9) < 0
    assert log_growth(np.zeros((9, 2, 2)), 9) == 0.0


def test_a_little_instability_is_no_error(run_up):
    noise = ce.Noise(omega=0.05, gain=[[-0.05]])
    fit = ce.estimate(ce.one_inertia(), run_up(n=100), noise=noise, progress=False)
    assert fit.innovations.radius > 1
    assert np.isfinite(fit.cost)


def test_one_gain_for_records_of_different_rates_is_pointed_out(run_up):
    noise = ce.Noise(omega=0.05, gain=[[0.1]])
    alike = [run_up("a", n=60), run_up("b", n=60, seed=1)]
    other = [alike[0], run_up("b", n=60, step=0.04, seed=1)]
    told = [ce.estimate(ce.one_inertia(), d, noise=noise, progress=False).messages for d in (alike, other)]
    said = [any("sampled every 0.02, 0.04 s" in m for m in messages) for messages in told]
    assert said == [False, True]
