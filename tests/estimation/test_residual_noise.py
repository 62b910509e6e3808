"""Errors that count with the noise as the residuals show it: coloured, larger than stated, robust, with holes."""

import numpy as np
import pytest
from scipy.signal import lfilter

import casadi_engine as ce

TIME = np.arange(400) * 0.02
TORQUE = np.repeat(np.random.default_rng(0).standard_normal(20), 20)


def speed():
    """J dw/dt = T - c w by its closed form, J = 0.5, c = 0.4, from rest; the torque is held between samples."""
    keep = np.exp(-0.4 / 0.5 * 0.02)
    return lfilter([0.0, (1 - keep) / 0.4], [1.0, -keep], TORQUE)


def record(noise, name="run"):
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(
        name, time=TIME, units=units, hold="zero", T=TORQUE, omega=speed() + noise
    )


def coloured(seed, share=0.9, level=0.02):
    """Autoregressive noise of this standard deviation."""
    white = np.random.default_rng(seed).standard_normal(len(TIME) + 500)
    return level * np.sqrt(1 - share**2) * lfilter([1.0], [1.0, -share], white)[500:]


def fitted(data, **options):
    return ce.estimate(ce.one_inertia(), data, **{"progress": False, **options})


def off(fits):
    """Root mean square of the errors of both parameters, in standard errors."""
    truth = {"J_eng": 0.5, "C_eng": 0.4}
    return np.sqrt(
        [np.mean([((f.values[n] - v) / f.stderr[n]) ** 2 for f in fits]) for n, v in truth.items()]
    )


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_estimates_scatter_in_coloured_noise_as_their_errors_say(share):
    records = [record(coloured(seed, share)) for seed in range(25)]
    own = off([fitted(one) for one in records])
    curvature = off([fitted(one, errors="quadratic") for one in records])
    assert ((own > 0.75) & (own < 1.3)).all()  # a seventh by chance
    assert (curvature > 1.4).any()
    assert (curvature > own).all()


def test_white_noise_leaves_the_errors_as_they_are():
    data = record(0.02 * np.random.default_rng(1).standard_normal(len(TIME)))
    own, curvature = fitted(data), fitted(data, errors="quadratic")
    assert own.stderr == curvature.stderr
    assert set(own.own_noise.values()) == {1.0}
    assert own.own_noise.keys() == {"J_eng", "C_eng", "run/omega_eng"}


def test_a_level_stated_too_small_is_made_up_for():
    data = record(0.02 * np.random.default_rng(1).standard_normal(len(TIME)))
    small, right = (fitted(data, noise=ce.Noise(omega=level)) for level in (0.004, 0.02))
    assert small.values["C_eng"] == pytest.approx(right.values["C_eng"], rel=1e-4)
    assert small.own_noise["C_eng"] == pytest.approx(4.57, rel=0.01)
    assert small.stderr["C_eng"] == pytest.approx(right.stderr["C_eng"], rel=0.1)
    assert any("they are up to 4.6 times those of that level" in words for words in small.messages)


def two_records(seed, louder, *, shorter=1):
    """The same motion twice, with noise of 0.02 and of ``louder`` times that; the first in a part of its length."""
    random = np.random.default_rng(seed)
    quiet = record(0.02 * random.standard_normal(400))
    quiet = quiet.between(0.0, TIME[-1] / shorter) if shorter > 1 else quiet
    return quiet, record(louder * 0.02 * random.standard_normal(400), "other")


def test_a_record_that_is_louder_than_stated_widens_the_errors_of_what_it_tells_alone():
    """A damping of each record: with the level of the quiet one stated, that of the loud one has errors of its own."""
    pars = ce.one_inertia().parameters()
    pars.vary_by_experiment("C_eng")
    fit = fitted(two_records(0, 5.0), parameters=pars, noise=ce.Noise(omega=0.02))
    assert fit.own_noise["C_eng@run"] < 1.5  # the inertia is told by both
    assert fit.own_noise["C_eng@other"] == pytest.approx(5.1, rel=0.1)
    (said,) = (text for text in fit.messages if "stated noise level" in text)
    assert said.startswith(
        "the residual of omega is up to 5.04 times (in other) the stated noise level of 0.02"
    )


def test_where_records_tell_the_same_one_level_for_both_makes_right_errors():
    fit = fitted(two_records(0, 5.0))
    (said,) = (text for text in fit.messages if "other records" in text)
    assert said.startswith(
        "the residual of other/omega is 5.1 times as large as that of omega in the other records"
    )
    assert "quieter records count for less than they are worth" in said
    assert fit.own_noise["C_eng"] == pytest.approx(1.0, abs=0.02)


def test_where_the_louder_record_tells_the_most_errors_count_with_its_noise():
    """400 samples of 5 beside 80 of 1: the level of all is 4.6, that of the louder one is 1.09 times it."""
    fit = fitted(two_records(0, 5.0, shorter=5))
    assert 1.04 < fit.own_noise["C_eng"] < 1.13
    few = fitted(
        two_records(0, 1 / 5, shorter=5)
    )  # the short record is the louder one, the long one tells more
    assert any("the residual of run/omega is" in text for text in few.messages)
    assert few.own_noise["C_eng"] == 1.0


@pytest.mark.slow
def test_estimates_of_uneven_records_scatter_as_their_errors_say():
    own = off([fitted(two_records(seed, 5.0, shorter=5)) for seed in range(40)])
    assert ((own > 0.78) & (own < 1.25)).all()  # a ninth by chance


def test_records_of_one_noise_are_hardly_ever_called_uneven():
    told = sum("other records" in " ".join(fitted(two_records(seed, 1.0)).messages) for seed in range(20))
    assert told <= 1


def test_noise_that_is_smaller_than_stated_makes_no_error_smaller():
    data = record(coloured(2, 0.9, 0.001))
    own, curvature = (
        fitted(data, noise=ce.Noise(omega=0.05), errors=errors) for errors in ("checked", "quadratic")
    )
    assert own.stderr["C_eng"] == pytest.approx(curvature.stderr["C_eng"])


def test_holes_outliers_and_several_records_count_too():
    data = record(coloured(3))
    whole = fitted(data).own_noise["C_eng"]
    speeds = data["omega"].values.copy()
    speeds[np.random.default_rng(4).random(len(speeds)) < 0.1] = np.nan
    assert fitted(record(speeds - speed())).own_noise["C_eng"] == pytest.approx(whole, rel=0.25)
    assert fitted(data, loss="huber").own_noise["C_eng"] == pytest.approx(whole, rel=0.25)
    quiet = record(0.02 * np.random.default_rng(5).standard_normal(len(TIME)), "quiet")
    both = fitted([data, quiet]).own_noise
    assert 1.2 < both["C_eng"] < whole
    assert both["run/omega_eng"] > both["quiet/omega_eng"]


def test_a_model_that_is_far_off_has_errors_of_its_own_size():
    """All that is left is one slow arc: the interval is wide and ends, and holds the truth."""
    pars = ce.one_inertia().parameters()
    pars.fix("J_eng", 1.0)
    fit = fitted(record(np.zeros(len(TIME))), parameters=pars)
    low, high = fit.estimates["C_eng"].interval
    assert 0 <= low < 0.4 < high < 1.5
    assert 3 < fit.own_noise["C_eng"] < np.sqrt(len(TIME))


def test_an_interval_by_profile_is_stretched_as_the_error_is():
    """Two standard errors reach the bound: its other end is where these have it."""
    data = record(coloured(8, 0.9, 0.3))
    free = fitted(data).estimates["C_eng"]
    pars = ce.one_inertia().parameters()
    pars["C_eng"].set(0.4, min=free.value - free.stderr)
    fit = fitted(data, parameters=pars)
    one = fit.estimates["C_eng"]
    assert fit.own_noise["C_eng"] > 1.5
    assert one.stderr is None
    assert one.quadratic == pytest.approx(free.stderr, rel=0.02)
    assert one.interval[0] == pytest.approx(free.value - free.stderr)
    assert one.interval[1] - one.value == pytest.approx(1.97 * free.stderr, rel=0.15)
