"""An estimate at its bound may be inside by as much as its own error: the errors of the others have to know of it."""

import numpy as np
import pytest
from scipy.signal import lfilter

import casadi_engine as ce

SIGMA, COUNT = 0.1, 60


def plane(high=10.0, low=0.0):
    """y = a u1 + b u2 with two inputs that are nearly alike; the state is idle."""
    made = ce.Blueprint("plane")
    a, b = (
        made.parameter("a", min(0.5, (low + high) / 2), min=low, max=high),
        made.parameter("b", 1.0, min=-10, max=10),
    )
    rest = made.state("rest")
    first, second = made.input("u1"), made.input("u2")
    made.ode("rest", -rest)
    made.output("y", a * first + b * second)
    return made.model()


def inputs(alike=0.95):
    rng = np.random.default_rng(5)
    second = rng.standard_normal(COUNT)
    first = alike * second + np.sqrt(1 - alike**2) * rng.standard_normal(COUNT)
    return first, second


def fit_of(seed, a, *, b=1.0, sigma=SIGMA, **bounds):
    first, second = inputs()
    y = a * first + b * second + sigma * np.random.default_rng(seed).standard_normal(COUNT)
    record = ce.Experiment.from_arrays(
        "r",
        time=np.arange(COUNT) * 0.1,
        inputs=("u1", "u2"),
        units=dict.fromkeys(("u1", "u2", "y"), "1"),
        u1=first,
        u2=second,
        y=y,
    )
    return ce.estimate(
        plane(**bounds),
        record,
        noise=ce.Noise(y=SIGMA),
        initial={"rest": 0.0},
        errors="quadratic",
        progress=False,
    )


def own_errors():
    """(2, 2) covariance of (a, b) without bounds."""
    columns = np.stack(inputs(), axis=1)
    return SIGMA**2 * np.linalg.inv(columns.T @ columns)


def test_the_error_beside_a_bound_is_that_without_it_where_the_bound_is_within_chance():
    fit = next(f for f in (fit_of(seed, 0.0) for seed in range(50)) if f.estimates["a"].at_bound == "min")
    assert fit.estimates["b"].stderr == pytest.approx(np.sqrt(own_errors()[1, 1]), rel=1e-3)


def test_a_narrow_range_counts_as_an_error_of_its_own():
    width = 1e-3
    fit = fit_of(0, 0.0, low=0.02, high=0.02 + width)
    assert fit.estimates["a"].at_bound
    _, second = inputs()
    assert fit.estimates["b"].stderr == pytest.approx(SIGMA / np.linalg.norm(second), rel=1e-2)


def test_data_that_pull_far_beyond_a_bound_leave_the_error_with_the_bound():
    fit = fit_of(0, -1.0)
    assert fit.estimates["a"].at_bound == "min"
    _, second = inputs()
    assert fit.estimates["b"].stderr == pytest.approx(SIGMA / np.linalg.norm(second), rel=1e-6)


def test_nothing_is_known_beside_a_bound_that_alone_tells_two_apart():
    made = ce.Blueprint("twins")
    a, b = made.parameter("a", 1.0, min=1.0), made.parameter("b", 1.0)
    rest, u = made.state("rest"), made.input("u")
    made.ode("rest", -rest)
    made.output("y", a * u + b * u)
    rng = np.random.default_rng(0)
    u = rng.standard_normal(COUNT)
    y = 0.5 * u + SIGMA * rng.standard_normal(COUNT)
    record = ce.Experiment.from_arrays(
        "r", time=np.arange(COUNT) * 0.1, inputs=("u",), units={"u": "1", "y": "1"}, u=u, y=y
    )
    fit = ce.estimate(made.model(), record, noise=ce.Noise(y=SIGMA), initial={"rest": 0.0}, progress=False)
    assert all(one.stderr is None for one in fit.estimates.values())


@pytest.mark.slow  # the error that does stands above
def test_errors_cover_the_truth_where_an_estimate_ends_at_its_bound():
    fits = [fit_of(seed, 0.5 * np.sqrt(own_errors()[0, 0])) for seed in range(80)]
    there = [fit for fit in fits if fit.estimates["a"].at_bound == "min"]
    assert len(there) > 15  # of some 25
    within = [abs(f.estimates["b"].value - 1.0) < 1.96 * f.estimates["b"].stderr for f in there]
    assert np.mean(within) > 0.9  # 0.65 by the errors that hold at the bound


def test_in_coloured_noise_the_errors_beside_a_bound_are_those_without_it():
    """What is at its bound takes a part of a slow noise with it, as it does where nothing bounds it. Without it the
    others took more with every round than was there: errors grew by a factor of 1e21."""
    rng, count = np.random.default_rng(3), 400

    def slow():
        return np.sqrt(1 - 0.9**2) * lfilter([1.0], [1.0, -0.9], rng.standard_normal(count + 200))[200:]

    second = slow()
    first = 0.999 * second + np.sqrt(1 - 0.999**2) * slow()
    columns = np.stack([first, second], axis=1)
    white = SIGMA * np.sqrt(np.linalg.inv(columns.T @ columns)[0, 0])
    noises = (SIGMA * slow() for _ in range(100))
    # below its bound, and within what chance does there in white noise
    noise = next(one for one in noises if -1.5 * white < np.linalg.lstsq(columns, one)[0][0] < -0.3 * white)
    channels = {"u1": first, "u2": second, "y": second + noise}
    units = dict.fromkeys(channels, "1")
    record = ce.Experiment.from_arrays(
        "r", time=np.arange(count) * 0.1, inputs=("u1", "u2"), units=units, **channels
    )
    known = {"noise": ce.Noise(y=SIGMA), "initial": {"rest": 0.0}, "progress": False}
    bound, free = (ce.estimate(plane(low=low), record, **known) for low in (0.0, -100.0))
    assert bound.estimates["a"].at_bound == "min"
    assert free.own_noise["b"] > 2
    errors = [fit.estimates["b"].stderr or fit.estimates["b"].quadratic for fit in (bound, free)]
    assert errors[0] == pytest.approx(errors[1], rel=0.05)
    assert bound.own_noise["b"] == pytest.approx(free.own_noise["b"], rel=0.05)
    assert bound.own_noise["a"] == 1.0
