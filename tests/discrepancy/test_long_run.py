"""White noise as strong as coloured noise along a direction, against brute force."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.long_run import coloured_power, long_run_noise
from casadi_engine.discrepancy.noise_model import fitted_colour
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.search import proposals


def slow_noise(seed, count, rho):
    """First-order autoregression (count,) of unit variance."""
    rng = np.random.default_rng(seed)
    out = rng.standard_normal(count)
    for k in range(1, count):
        out[k] = rho * out[k - 1] + np.sqrt(1 - rho**2) * out[k]
    return out


def test_power_along_a_direction_is_that_of_the_covariance():
    rho, count = 0.8, 300
    e = slow_noise(1, 200_000, rho)
    colour = fitted_colour(e, np.arange(len(e)), len(e))
    rng = np.random.default_rng(2)
    columns = np.column_stack([np.ones(count), rng.standard_normal(count), np.arange(count) > 100])
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    brute = np.einsum("ik,ij,jk->k", columns, rho**lag, columns)
    assert coloured_power(colour, columns, np.arange(count), count) == pytest.approx(brute, rel=0.05)


def test_missing_samples_count_at_their_times():
    e = slow_noise(1, 200_000, 0.8)
    colour = fitted_colour(e, np.arange(len(e)), len(e))
    pair = np.ones((2, 1))
    near = coloured_power(colour, pair, np.array([0, 1]), 100)[0]
    far = coloured_power(colour, pair, np.array([0, 90]), 100)[0]
    assert near == pytest.approx(2 + 2 * 0.8, rel=0.02)
    assert far == pytest.approx(2, abs=0.05)


def record(seed, count, friction, rho):
    time = np.arange(count) * 0.01
    torque = 10 * np.sin(1.5 * time) + 6 * np.sin(4.1 * time)
    exp = ce.Experiment.from_arrays("run", time=time, units={"T": "N m"}, T=torque)
    model = ce.one_inertia()
    if friction:
        values = {"torque": friction}
        model = model.with_effect(ce.effects.CoulombFriction(), at="engine", values=values)
    run = ce.simulate(model, exp, initial={"omega_eng": 0.0})["omega"].values
    units = {"T": "N m", "omega": "rad/s"}
    measured = run + 0.05 * slow_noise(seed, count, rho)
    return ce.Experiment.from_arrays("run", time=time, units=units, T=torque, omega=measured)


def test_the_level_holds_for_the_scores_and_leaves_independent_samples():
    rho, count = 0.9, 2000
    fit = ce.estimate(
        ce.one_inertia(), record(3, count, 0, rho), noise=ce.Noise(omega="estimate"), progress=False
    )
    white = screen(fit, colour=False, alpha=0.999)
    picked = [k for k in white.order if "friction" in white.candidates[k].effect][:2]
    noise, samples = long_run_noise(white, picked, null_model(fit), 3)
    # at most (1 + rho)/(1 - rho) = 19 times the variance, at frequency 0
    assert 0.05 < noise.sigma["omega"] < 0.05 * np.sqrt(19) * 1.3
    assert count / 19 / 1.5 - 3 < samples < count


def test_a_large_effect_that_colours_its_own_residual_is_proposed():
    data = record(5, 2000, 0.5, 0.9)
    null = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega="estimate"), progress=False)
    assert screen(null).noise.colour
    white = screen(null, colour=False)
    proposed = [white.candidates[k].key for k in proposals(white)]
    assert ("coulomb_friction", "engine") in proposed


@pytest.mark.slow
def test_a_large_effect_that_colours_its_own_residual_is_named():
    data = record(5, 2000, 0.5, 0.9)
    found = ce.repair(ce.one_inertia(), data, noise=ce.Noise(omega="estimate"), starts=1, progress=False)
    assert any((m.name, m.at) == ("coulomb_friction", "engine") for m in found.effects[0].members)
    assert found.effects[0].amplitude.value == pytest.approx(0.5, rel=0.3)
