"""Errors of a fit in coloured noise, against closed forms and a Monte Carlo study of their own."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.coloured_errors import coloured_errors, with_coloured_errors
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel
from casadi_engine.discrepancy.null_model import null_model

COUNT, SIGMA, MEMORY = 400, 0.1, 0.8
TIME = np.arange(COUNT) * 0.05


def line():
    """y = a u + b with an idle state."""
    made = ce.Blueprint("line")
    a, b = made.parameter("a", 0.5), made.parameter("b", 0.1)
    rest, u = made.state("rest"), made.input("u")
    made.ode("rest", -rest)
    made.output("y", a * u + b)
    return made.model()


def fitted(seed=0, memory=MEMORY, kept=None):
    u = np.sin(2 * np.pi * 0.4 * TIME)
    noise = lfilter([SIGMA], [1, -memory], np.random.default_rng(seed).standard_normal(COUNT + 200))[200:]
    y = 1.5 * u + 0.3 + noise
    if kept is not None:
        y[~kept] = np.nan
    record = ce.Experiment.from_arrays("r", time=TIME, inputs=("u",), units={"u": "1", "y": "1"}, u=u, y=y)
    return ce.estimate(line(), record, initial={"rest": 0.0}, errors="quadratic", progress=False)


def noise_of(memory=MEMORY):
    colour = Colour((np.ones(1), np.array([1.0, -memory])), np.array([1 / (1 - memory**2), 1.0]))
    return NoiseModel({"y": SIGMA}, {("r", "y"): colour}, {}, "estimated")


def closed_form(columns, kept, memory=MEMORY):
    lag = np.abs(np.subtract.outer(np.flatnonzero(kept), np.flatnonzero(kept)))
    covariance = SIGMA**2 * memory**lag / (1 - memory**2)
    root = np.linalg.pinv(columns[kept])
    return np.sqrt(np.diag(root @ covariance @ root.T))


@pytest.mark.parametrize("holes", [False, True])
def test_errors_are_those_of_least_squares_in_coloured_noise(holes):
    kept = np.ones(COUNT, dtype=bool)
    if holes:
        kept[100:140] = kept[250] = False
    fit = fitted(kept=kept)
    told, words = with_coloured_errors(fit, null_model(fit), noise_of())
    columns = np.stack([np.sin(2 * np.pi * 0.4 * TIME), np.ones(COUNT)], axis=1)
    # the fit's own level counts in its white errors, and so in what they are multiplied with
    level = fit.noise["y"][0]
    white = level * np.sqrt(np.diag(np.linalg.inv(columns[kept].T @ columns[kept])))
    np.testing.assert_allclose([fit.stderr["a"], fit.stderr["b"]], white, rtol=1e-3)
    expected = closed_form(columns, kept)
    np.testing.assert_allclose([told.stderr["a"], told.stderr["b"]], expected, rtol=0.02)
    assert "times those of white noise" in words
    direct = coloured_errors(null_model(fit), {"y": level}, noise_of())
    np.testing.assert_allclose([direct["a"], direct["b"]], expected, rtol=0.02)
    np.testing.assert_allclose(
        np.sqrt(np.diag(told.covariance)), [told.stderr["a"], told.stderr["b"]], rtol=1e-9
    )


def test_white_noise_leaves_a_fit_as_it_is():
    fit = fitted(memory=0.0)
    assert with_coloured_errors(fit, null_model(fit), NoiseModel({"y": SIGMA})) == (fit, "")
    assert with_coloured_errors(fit, null_model(fit), noise_of(1e-3)) == (fit, "")


def test_no_error_gets_smaller():
    fit = fitted()
    told, _ = with_coloured_errors(fit, null_model(fit), noise_of(-0.8))
    assert told.stderr["a"] >= fit.stderr["a"]
    assert told.stderr["b"] >= fit.stderr["b"]


@pytest.mark.slow  # the closed form stands above
def test_they_cover_the_truth():
    own = []
    for seed in range(60):
        fit = fitted(seed)
        told, _ = with_coloured_errors(fit, null_model(fit), noise_of())
        own.append([abs(fit.values["b"] - 0.3) / one.stderr["b"] for one in (fit, told)])
    white, coloured = np.mean(np.array(own) < 1.96, axis=0)
    assert white < 0.65
    assert 0.88 < coloured <= 1


@pytest.mark.slow
def test_noise_that_is_larger_than_stated_widens_the_errors_of_a_repair():
    """Stated ten times too small: the errors of what is found are those that an estimated level gives."""
    rng = np.random.default_rng(1)
    t = np.arange(0, 12, 0.03)
    force = 5 * np.sin(0.9 * t) + 3 * np.sin(2.3 * t + 1)
    run = solve_ivp(
        lambda s, v: (np.interp(s, t, force) - 0.5 * v - 1.0 * np.tanh(v / 1e-4)) / 2.0,
        (0, t[-1]), [1.0], t_eval=t, method="LSODA", rtol=1e-8, max_step=0.01,
    )  # fmt: skip
    speed = run.y[0] + 0.03 * rng.standard_normal(len(t))
    data = ce.Experiment.from_arrays("a", time=t, units={"T": "N m", "omega": "rad/s"}, T=force, omega=speed)
    found = [
        ce.repair(ce.one_inertia(), data, effects=["coulomb_friction"], noise=noise, starts=1, progress=False)
        for noise in (None, ce.Noise(omega=0.003))
    ]
    free, stated = (one.effects[0].amplitude for one in found)
    assert stated.value == pytest.approx(free.value, abs=0.2 * free.stderr)
    low, high = stated.interval or (stated.value - 2 * stated.stderr, stated.value + 2 * stated.stderr)
    assert high - low == pytest.approx(4 * free.stderr, rel=0.3)
    assert any(
        words.startswith("the standard errors count with the noise that is left")
        for words in found[1].messages
    )
