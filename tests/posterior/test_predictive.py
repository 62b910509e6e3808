"""What a posterior foretells of a record: against the closed form of a decay."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import SimulationError

TIME = np.arange(0, 5, 0.1)


@pytest.fixture(scope="module")
def decay():
    b = ce.Blueprint("decay")
    k, x = b.parameter("k", 1.0, min=0.05, max=10), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    return b.model()


def record(name="a", rate=0.7, measured=True):
    noise = 0.03 * np.random.default_rng(1).standard_normal(len(TIME))
    y = np.exp(-rate * TIME) + noise if measured else np.full(len(TIME), np.nan)
    return ce.Experiment.from_arrays(name, time=TIME, units={"y": "1"}, y=y)


def posterior(model, **options):
    fit = ce.estimate(model, record(), noise=ce.Noise(y=0.03), progress=False, **options)
    return ce.posterior(fit, progress=False)


def test_a_start_that_the_fit_held_is_that_of_every_draw(decay):
    """It was fitted anew for each draw, which took back what the draw changed: bands held 69 % of the truth."""
    post = posterior(decay, initial={"x": 1.0})
    ahead = post.predictive(draws=50, seed=3)
    chosen = np.random.default_rng(3).choice(len(post.values), 50, replace=False)
    np.testing.assert_allclose(ahead.runs["y"], np.exp(-np.outer(post["k"][chosen], ahead.time)), atol=1e-5)
    assert (ahead.runs["y"][:, 0] == pytest.approx(1.0, abs=1e-9)) is True


def test_a_free_start_scatters_as_the_data_leave_it(decay):
    post = posterior(decay)
    ahead = post.predictive(draws=200)
    known = ce.simulate(post.fit, record(), band=True)["y"]
    assert ahead.runs["y"][:, 0].std() == pytest.approx(known.stderr[0], rel=0.2)
    assert ahead.runs["y"][:, -1].std() == pytest.approx(known.stderr[-1], rel=0.25)


def test_a_record_without_outputs_needs_its_start(decay):
    post, empty = posterior(decay, initial={"x": 1.0}), record("b", measured=False)
    with pytest.raises(SimulationError, match="give initial="):
        post.predictive(empty, draws=5)
    ahead = post.predictive(empty, draws=5, initial={"x": 2.0})
    assert ahead.runs["y"][:, 0] == pytest.approx(2.0)


def test_a_fresh_record_is_held_against_the_band_in_the_units_of_the_model():
    """A moisture in % was said to be outside the band at every sample, as it is stored as a share."""
    b = ce.Blueprint("drying")
    k, x = b.parameter("k", 1.0, unit="1/s", min=0.05, max=10), b.state("x", unit="%")
    b.ode("x", -k * x)
    b.output("y", x, unit="%")
    shown = {
        name: 20 * np.exp(-0.7 * TIME) + 0.5 * np.random.default_rng(seed).standard_normal(len(TIME))
        for seed, name in enumerate(("a", "b"))
    }
    first, fresh = (
        ce.Experiment.from_arrays(name, time=TIME, units={"y": "%"}, y=y) for name, y in shown.items()
    )
    fit = ce.estimate(b.model(), first, progress=False)
    ahead = ce.posterior(fit, progress=False).predictive(fresh)
    np.testing.assert_allclose(ahead.measured["y"], shown["b"])
    low, high = ahead.band("y", noise=True)
    assert np.mean((low <= shown["b"]) & (shown["b"] <= high)) > 0.85
