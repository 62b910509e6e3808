"""Initial states of fresh records, whose parameters are those of a fit."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation.single_shots import evaluator
from casadi_engine.estimation.states_first import states_first
from casadi_engine.validation.held import held_on

NOISE = ce.Noise(X_m=0.08, S_m=0.1)


def chemostat():
    b = ce.Blueprint("chemostat")
    mu, ks = b.parameter("mu", 0.4, unit="1/s"), b.parameter("Ks", 0.5, unit="g/L")
    fed, x, s = b.input("D", unit="1/s"), b.state("X", unit="g/L"), b.state("S", unit="g/L")
    rate = mu * s / (ks + s) * x
    b.ode("X", rate - (fed + 0.02) * x)
    b.ode("S", fed * (10 - s) - rate / 0.5)
    b.output("X_m", x, unit="g/L")
    b.output("S_m", s, unit="g/L")
    return b.model()


def grown(seed, scale=1.0):
    """By SciPy, at times that are not equal; what is fed is used up at once when the culture is grown, and is never
    below zero."""
    rng = np.random.default_rng(seed)
    t = np.sort(np.random.default_rng(3).uniform(0.5, 59.5, 45))
    fed_at = np.linspace(0, 60, 121)
    fed = 0.1 + 0.08 * np.sin(0.25 * fed_at)

    def ode(at, y):
        d, rate = np.interp(at, fed_at, fed), 0.4 * y[1] / (0.5 + y[1]) * y[0]
        return [rate - (d + 0.02) * y[0], d * (10 - y[1]) - rate / 0.5]

    y = solve_ivp(ode, (0, 60), [0.2, 9.0], t_eval=t, rtol=1e-9, atol=1e-10, max_step=0.5).y
    return ce.Experiment.from_arrays(
        "r", units={"D": "1/s", "X_m": "g/L", "S_m": "g/L"}, D=(fed_at, fed),
        X_m=(t, scale * y[0] + 0.08 * rng.standard_normal(45)),
        S_m=(t[::2], y[1, ::2] + 0.1 * rng.standard_normal(23)),
    )  # fmt: skip


def fixed():
    pars = chemostat().parameters()
    pars.fix("mu")
    pars.fix("Ks")
    return pars


@pytest.mark.parametrize("seed", [1008, 1010, 1018])
def test_states_are_found_where_long_steps_would_leave_what_a_culture_can_be(seed):
    """Steps of the length of the gaps between samples find the other root of the growth law, below zero: the search
    took a minute and ended at -4.8 g/L."""
    found = ce.estimate(chemostat(), grown(seed), parameters=fixed(), noise=NOISE, progress=False)
    assert found.converged
    assert found.iterations < 20
    assert found.initial["r"]["X"].value == pytest.approx(0.23, abs=0.05)
    assert found.cost / found.n < 1.5


def test_a_record_that_they_cannot_explain_is_searched_as_any_other():
    found = ce.estimate(chemostat(), grown(1, scale=3.0), parameters=fixed(), noise=NOISE, progress=False)
    assert found.cost / found.n > 50


def test_fresh_data_are_judged_from_there():
    fit = ce.estimate(chemostat(), grown(7), noise=NOISE, progress=False)
    held = held_on(fit, grown(1010), noise=NOISE, method="exact")
    assert held.converged
    assert held.cost / held.n < 1.5


def test_steps_that_were_made_shorter_in_vain_are_no_longer_those_of_what_was_known():
    """A sensor that is off is explained by no initial state: the search went on with slopes of other steps, and ended
    in a broadcast that cannot be."""
    search = evaluator(chemostat(), [grown(1010, scale=3.0)], fixed(), NOISE)
    x = search.first_point()
    before = search.problem.at(x)
    assert search.problem.at(x) is before
    assert states_first(search, x) is x
    assert search.problem.at(x) is not before
