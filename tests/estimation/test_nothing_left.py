"""Where the first start leaves white noise alone, no other start is made."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation import nothing_left as module

SIGMA = 0.02


def oscillator():
    b = ce.Blueprint("oscillator")
    u = b.input("u", unit="N")
    k, c = (
        b.parameter("k", 3.0, unit="N/m", min=0.1, max=40),
        b.parameter("c", 0.5, unit="N s/m", min=0, max=5),
    )
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    b.ode("x", v)
    b.ode("v", u - k * x - c * v * (1 + x * x))
    b.output("x", x, unit="m")
    return b.model()


def record(seed=1, *, cube=0.0, sigma=SIGMA):
    t = np.arange(0, 30, 0.05)
    push = np.sin(1.2 * t) + 0.7 * np.sin(0.45 * t + 1)

    def rate(time, y):
        return [y[1], np.interp(time, t, push) - 4 * y[0] - 0.4 * y[1] * (1 + y[0] ** 2) - cube * y[0] ** 3]

    x = solve_ivp(rate, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.05).y[0]
    x = x + sigma * np.random.default_rng(seed).standard_normal(len(t))
    return ce.Experiment.from_arrays("a", time=t, units={"u": "N", "x": "m"}, u=push, x=x)


def starts(fit):
    return sum(one.starts for one in fit.optima)


def fitted(data, enough="white", **options):
    return ce.estimate(oscillator(), data, starts=3, enough=enough, progress=False, **options)


def test_a_white_residual_is_enough():
    data = record()
    fit, every = fitted(data), fitted(data, "all")
    assert (starts(fit), starts(every)) == (1, 3)
    assert fit.cost == pytest.approx(every.cost, abs=1e-6)
    assert fit.values == pytest.approx(every.values, rel=1e-5)


@pytest.mark.parametrize(
    ("data", "options"),
    [
        (record(cube=3.0), {}),  # what is left is no noise
        (record(), {"noise": ce.Noise(x=0.5 * SIGMA)}),  # more than there should be
        (record(sigma=1.0), {}),  # most of the output: it may be the answer to something
    ],
    ids=["coloured", "louder", "large"],
)
def test_what_may_be_explained_is_looked_for_by_all_starts(data, options):
    assert starts(fitted(data, **options)) == 3


def test_only_known_words_say_when_it_is_enough():
    with pytest.raises(EstimationError, match=r"enough is not.*seen: .much.; allowed: .all. or .white."):
        fitted(record(), "much")


def test_one_start_is_one():
    assert starts(ce.estimate(oscillator(), record(), enough="white", progress=False)) == 1


def test_a_repair_of_a_model_that_lacks_nothing_fits_it_once():
    made = ce.repair(
        oscillator(), record(3), progress=False, effects=["sensor_gain"], noise=ce.Noise(x=SIGMA)
    )
    assert made.verdict == "nothing missing"
    assert starts(made.null_fit) == 1


def test_a_start_that_ended_where_there_are_no_numbers_leaves_the_word_to_the_others(monkeypatch):
    """A repair ended in a traceback there."""
    attempt = SimpleNamespace(
        solution=SimpleNamespace(status="converged"), pending=False, run=True, sigma=np.ones(1)
    )
    search = SimpleNamespace(_weigh=lambda sigma: None)

    def lost(search, attempt):
        raise FloatingPointError("the model's state is not finite here")

    monkeypatch.setattr(module, "own_noise", lost)
    assert module.nothing_left(search, attempt) is False
