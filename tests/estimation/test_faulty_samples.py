"""Samples that a sensor made up are named with their place; what lasts, is common or is at rest is not."""

from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.faulty_samples import at_its_limit, stands_still, wild_samples
from casadi_engine.estimation.fit import Trace

T = np.arange(400) * 0.01
T2, NOISE = np.arange(1000.0), 0.08 * np.random.default_rng(0).standard_normal(1000)


@pytest.mark.parametrize(
    ("bend", "limited"),
    [
        (lambda y: np.minimum(y, 0.8), True),
        (lambda y: y, False),
        (
            lambda y: np.round(np.minimum(y, 0.8) / 0.1) * 0.1,
            False,
        ),  # it reads in steps, of which one is the largest
        # a counter's steps of 4/3, written with one decimal
        (lambda y: np.round(np.round(y / 0.133333) * 0.133333, 2), False),
        # it settles on a converter's steps of 0.322, written with two decimals
        (lambda y: np.round(0.322 * np.round((60.18 - 40 * np.exp(-T2 / 150) + NOISE) / 0.322), 2), False),
        (lambda y: np.where(np.arange(len(y)) < 300, 2.0, y), False),  # it rests there once
        (lambda y: np.zeros(len(y)), False),
        (lambda y: np.maximum(y, 0.0), False),  # a machine that stands still now and then
    ],
)
def test_a_limit_is_met_more_than_once_and_is_no_step(bend, limited):
    y = bend(np.sin(0.05 * np.arange(1000)) + 1e-3 * np.random.default_rng(0).standard_normal(1000))
    trace = Trace(np.arange(1000) * 1.0, y, np.ones(1000, bool), y)
    assert (at_its_limit(SimpleNamespace(traces={"run": {"y": trace}})) is not None) == limited


def fit_that_leaves(e):
    n = len(e)
    trace = Trace(np.arange(n) * 1.0, np.asarray(e, float), np.ones(n, bool), np.zeros(n))
    return SimpleNamespace(traces={"run": {"y": trace}}, options={})


def test_tails_that_decide_a_fit_are_said_with_the_loss_that_bounds_them():
    """In 40 of 40 fits there was no word of 5 % of samples that lay 10 to 60 standard deviations out."""
    e = np.random.default_rng(0).standard_normal(400)
    e[[20, 77, 131, 240, 251, 300, 355, 390]] = 60.0
    fit = fit_that_leaves(e)
    assert 'or fit with loss="huber", which bounds what each does' in wild_samples(fit, tails=True)
    assert wild_samples(fit) is None  # no reason to end a repair
    few = np.random.default_rng(0).standard_normal(400)
    few[20] = 400.0
    assert "huber" not in wild_samples(fit_that_leaves(few), tails=True)
    fit.options = {"loss": "huber", "knee": 1.345}
    assert wild_samples(fit, tails=True) is None


def test_the_wild_are_counted_and_the_first_ones_listed():
    e = np.random.default_rng(0).standard_normal(1000)
    e[50:750:100] = 400.0
    said = wild_samples(fit_that_leaves(e))
    assert said.startswith("7 single samples hold")
    assert "y of run at 50, 150, 250, 350, 450 s and 2 more" in said


@pytest.mark.parametrize(
    "e",
    [
        np.random.default_rng(2).standard_normal(2000),
        np.random.default_rng(2).standard_t(3, 2000),
        np.where(np.abs(np.arange(1000) - 500) < 4, 300.0, 1.0)
        * np.random.default_rng(0).standard_normal(1000),
        np.where(np.arange(1000) % 20 == 0, 300.0, 1.0) * np.random.default_rng(0).standard_normal(1000),
        np.zeros(1000),
    ],
    ids=["white", "heavy tails", "an event", "many", "nothing left"],
)
def test_what_lasts_or_is_common_is_not_wild(e):
    assert wild_samples(fit_that_leaves(e)) is None


def test_a_sample_on_the_way_from_one_level_to_another_is_not_wild():
    """A titration passes six units of pH from one sample to the next: a model that is late by half a sample misses that
    one sample alone, and the measurement has no fault."""
    fit = fit_that_leaves(np.random.default_rng(0).standard_normal(1000))
    seen = fit.traces["run"]["y"]
    level = 300.0 * (np.arange(1000) // 100 % 2)
    late = level.copy()
    late[100::100] = 150.0
    fit.traces["run"]["y"] = Trace(seen.time, late + seen.measured, seen.mask, level)
    assert wild_samples(fit) is None
    late[[345, 745]] = 500.0, -300.0
    fit.traces["run"]["y"] = Trace(seen.time, late + seen.measured, seen.mask, level)
    assert "y of run at 345, 745 s" in wild_samples(fit)


def seen(y, simulated):
    trace = Trace(T, y, np.ones(len(T), dtype=bool), simulated)
    return stands_still(SimpleNamespace(traces={"run": {"y": trace}}))


def test_a_sensor_that_stands_still_is_named():
    """A gyro that stood still for half of a record was "an unknown torque that depends on its speed"."""
    motion = 3 * np.sin(2 * np.pi * 0.7 * T)
    y = motion + 0.3 * np.random.default_rng(0).standard_normal(len(T))
    assert seen(y, motion) is None
    y[100:200] = y[100]
    said = seen(y, motion)
    assert f"y of run reads {y[100]:.6g} in all 100 samples from 1 to 1.99 s" in said
    assert 'record.masked("y", keep), keep False there' in said


@pytest.mark.parametrize(("noise", "told"), [(0.3, True), (0.0, False)])
def test_one_long_stay_at_a_limit_is_named_beside_noise(noise, told):
    """Two thirds of a record read 1.2 K exactly, and the fit said no more than that its residual is not white."""
    level = 20.0 * (1 - np.exp(-T))
    y = np.minimum(level + noise * np.random.default_rng(0).standard_normal(len(T)), 12.0)
    trace = Trace(T, y, np.ones(len(T), dtype=bool), np.minimum(level, 12.0))
    said = at_its_limit(SimpleNamespace(traces={"run": {"y": trace}}))
    assert (said is not None) is told
    if told:
        assert said.startswith(f"y of run reads 12 in {int((y == 12).sum())} samples and never more")


def test_a_machine_at_rest_does_not_stand_still_for_its_sensor():
    """Without noise, and in a sensor's steps, a machine that friction holds reads one number too."""
    held = 3 * np.sin(2 * np.pi * 0.7 * np.minimum(T, 1.5))
    moving = 3 * np.sin(2 * np.pi * 0.7 * T)
    assert seen(held, moving) is None
    noisy = held + 0.3 * np.random.default_rng(0).standard_normal(len(T))
    assert seen(np.round(noisy / 0.5) * 0.5, moving) is None
    noisy[150:] = noisy[150]
    assert seen(noisy, held) is None  # nothing moves meanwhile


def test_a_fit_says_first_which_sample_decides_it(run_up):
    """A code for a missing value had made a resistance twice too large, and a fit said no word."""
    good = run_up()
    wild = good["omega"].values.copy()
    wild[200] = -9999.0
    record = ce.Experiment.from_arrays(
        "coded", time=good["omega"].time, units={"T": "N m", "omega": "rad/s"}, hold="zero", T=good["T"].values,
        omega=wild,
    )  # fmt: skip
    fit = ce.estimate(ce.one_inertia(), record, progress=False)
    assert fit.messages[0].startswith(
        "1 single sample holds most of what the model leaves: omega of coded at 4 s"
    )
    assert "It decides the fit" in fit.messages[0]
    assert "Next: look at the data first, as noted above, and fit again" in str(fit)
    assert not any(
        "single sample" in words for words in ce.estimate(ce.one_inertia(), good, progress=False).messages
    )


def test_an_output_without_noise_or_motion_is_told():
    """It had "converged", with a capacity of 4e15."""
    t = np.arange(50) * 0.1
    still = ce.Experiment.from_arrays(
        "still", time=t, units={"T": "N m", "omega": "rad/s"}, T=np.sin(t), omega=0 * t + 3
    )
    fit = ce.estimate(ce.one_inertia(), still, progress=False)
    assert "omega is 3 in all samples, without any noise: nothing can be learnt from that" in fit.messages[0]


def fit_of(y, simulated):
    trace = Trace(np.arange(len(y)) * 1.0, y, np.ones(len(y), bool), simulated)
    return SimpleNamespace(traces={"run": {"y": trace}}, options={})


@pytest.mark.parametrize("row", [1, 3])
def test_a_code_to_which_a_fit_bends_is_named_too(row):
    """Of -9999 in one cell nothing was said: the fit had bent so far that its residual was large everywhere."""
    rng = np.random.default_rng(5)
    y = np.sin(np.arange(200) * 0.1) + 0.02 * rng.standard_normal(200)
    y[30 : 30 + row] = -9999.0
    bent = -800 * np.exp(-np.abs(np.arange(200) - 30) / 5) + 300 * rng.standard_normal(200)
    words = wild_samples(fit_of(y, bent))
    assert words.startswith(f"{row} single sample")
    # a simulation that shows them has found a cause
    assert wild_samples(fit_of(y, y + 0.02 * rng.standard_normal(200))) is None
    # the blows of a machine are many
    many = np.sin(np.arange(200) * 0.1)
    many[::11] = 40.0
    assert wild_samples(fit_of(many, 0 * many)) is None
