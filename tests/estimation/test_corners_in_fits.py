"""Friction in fits of records that stop and start again: no creep that the data would see, or a word about it.

The truth is an event-driven shaft in closed form: under constant torques its speed is made of straight lines, and it
sticks at 0 while the torque is below Tf.
"""

import importlib
import re
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.corner_widths import (
    FELT,
    Motion,
    cost_along,
    follow_motion,
    paths_of,
    with_widths,
)
from casadi_engine.estimation.integration import SHIFT

estimate = importlib.import_module("casadi_engine.estimation.estimate")  # the function has the same name
J, TF = 0.1, 2.0
TORQUE, WIDTH = "axis.coulomb_friction.torque", "axis.coulomb_friction.width"
# until when [s] which torque acts [N m]: held, run up, stop, held the other way, run up, through 0 and on
SCHEDULE = ((1.0, 1.0), (1.5, 3.0), (2.2, 0.0), (2.7, -1.5), (3.0, -3.5), (3.4, 2.6), (4.0, 0.5))


def sticking(time):
    """The speed of the shaft from rest, straight line by straight line."""
    speed, now, v = np.zeros_like(time), 0.0, 0.0
    for end, torque in SCHEDULE:
        while now < end - 1e-12:
            if v == 0.0 and abs(torque) <= TF:
                slope, stop = 0.0, end
            else:
                slope = (torque - np.sign(v or torque) * TF) / J
                stop = min(end, now - v / slope) if v * slope < 0 else end
            here = (time >= now) & (time <= stop)
            speed[here] = v + slope * (time[here] - now)
            v = 0.0 if stop < end else v + slope * (stop - now)
            now = stop
    return speed


def shaft(scale=1.0):
    b = ce.Blueprint("shaft")
    inertia, w = b.parameter("J", J, unit="kg m2", vary=False), b.state("w", unit="rad/s", scale=scale)
    slot = b.port("axis", "inertia", {"speed": w})
    b.ode("w", (b.input("T", unit="N m") + slot) / inertia)
    b.output("speed", w, unit="rad/s")
    return b.model()


def record(rate, sigma, seed=0, speed=sticking):
    time = np.arange(round(4 * rate) + 1) / rate
    torque = np.zeros_like(time)
    for end, value in reversed(SCHEDULE):
        torque[time < end - 1e-9] = value
    torque[-1] = SCHEDULE[-1][1]
    noisy = speed(time) + sigma * np.random.default_rng(seed).standard_normal(len(time))
    units = {"T": "N m", "speed": "rad/s"}
    return ce.Experiment.from_arrays("run", time=time, units=units, hold="zero", T=torque, speed=noisy)


def told(fit):
    """By how many standard errors the fit says that its corners may have moved it: 0.5 where it says nothing."""
    found = [re.search(r"off by about ([\d.e+]+) standard errors", text) for text in fit.messages]
    return next((float(one.group(1)) for one in found if one), FELT**0.5)


@pytest.fixture(scope="module")
def fits():
    """rate [Hz] -> the fit of data without noise, at a stated level: what is off is the corner."""

    @cache
    def of(rate):
        model = shaft(scale=100.0).with_effect(
            ce.effects.CoulombFriction(), at="axis", values={"torque": 1.8}
        )
        assert model.parameters()[WIDTH].value == 0.5
        noise = ce.Noise(speed=0.01)
        return ce.estimate(model, record(rate, 1e-9), noise=noise, progress=False, errors="quadratic")

    return of


def test_the_closed_form_is_what_scipy_finds_event_by_event():
    def rest(t, w):
        return w[0]

    rest.terminal = True
    now, w, found = 0.0, 0.0, []
    for end, torque in SCHEDULE:
        while now < end:
            if w == 0.0 and abs(torque) <= TF:
                now = end
                break
            side = np.sign(w) if w else np.sign(torque)
            rest.direction = -side
            run = solve_ivp(
                lambda t, w, side=side, torque=torque: [(torque - side * TF) / J],
                (now, end), [w], events=rest, rtol=1e-10, atol=1e-12,
            )  # fmt: skip
            now, w = run.t[-1], 0.0 if run.status == 1 else run.y[0, -1]
        found.append(w)
    ends = np.array([end for end, _ in SCHEDULE])
    np.testing.assert_allclose(sticking(ends), found, atol=1e-8)
    assert np.count_nonzero(found) == 3


@pytest.mark.parametrize("rate", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_friction_that_holds_is_found_within_what_the_fit_says(fits, rate):
    fit = fits(rate)
    found = fit.estimates[TORQUE]
    assert fit.converged
    assert found.stderr < 3e-4
    assert abs(found.value - TF) <= told(fit) * found.stderr
    assert abs(found.value - TF) < 1e-3 * TF
    # at rest it creeps by less than the noise shows, wherever it is held
    time = np.arange(round(4 * rate) + 1) / rate
    resting = (sticking(time) == 0) & (np.abs(time - 0.5) < 0.4)
    creep = np.abs(fit.traces["run"]["speed"].simulated[resting])
    assert creep.max() < 0.005
    assert fit.estimates[WIDTH].fixed
    assert fit.values[WIDTH] == fit.parameters[WIDTH].value <= 0.006


@pytest.mark.slow
def test_finer_samples_let_the_corner_be_sharper(fits):
    assert fits(1000).values[WIDTH] < fits(100).values[WIDTH] / 5
    assert abs(fits(1000).values[TORQUE] - TF) < 1.2e-4  # one and a half standard errors


def test_a_given_or_fixed_width_stays_and_one_that_no_record_passes_keeps_its_default():
    data = record(100, 0.01)
    noise = ce.Noise(speed=0.01)
    given = shaft().with_effect(ce.effects.CoulombFriction(width=0.05), at="axis", values={"torque": 1.8})
    assert WIDTH not in given.parameter_names
    model = shaft(100.0).with_effect(ce.effects.CoulombFriction(), at="axis", values={"torque": 1.8})
    for change in ("fix", "set"):
        pars = model.parameters()
        if change == "fix":
            pars.fix(WIDTH)
        else:
            pars[WIDTH].set(0.2)
        fit = ce.estimate(model, data, parameters=pars, noise=noise, progress=False)
        assert fit.values[WIDTH] == pars[WIDTH].value
    away = record(100, 0.01, speed=lambda t: 90 - TF / J * t)  # only slides, with no torque from outside
    channels = {"T": np.zeros(len(away["T"].time)), "speed": away["speed"].values}
    away = ce.Experiment.from_arrays(
        "run", time=away["T"].time, units={"T": "N m", "speed": "rad/s"}, hold="zero", **channels
    )
    fit = ce.estimate(model, away, noise=noise, progress=False)
    assert fit.values[WIDTH] == 0.5
    assert abs(fit.values[TORQUE] - TF) < 3 * fit.stderr[TORQUE]
    assert not any("corners" in text for text in fit.messages)
    paths = paths_of(fit), paths_of(fit, moved={WIDTH: 0.01})
    assert cost_along(fit, paths[0]) == pytest.approx(cost_along(fit, paths[1]), abs=1e-6)


@pytest.mark.slow  # test_moved_jumps.py fits through events
@pytest.mark.parametrize("rate", [100, pytest.param(400, marks=pytest.mark.slow)])
def test_the_law_as_it_is_holds_the_shaft_and_has_no_bias(rate):
    """A sharp law is fitted through its events: it sticks, and the estimate is right at any rate."""
    model = shaft(scale=100.0).with_effect(
        ce.effects.CoulombFriction(), at="axis", values={"torque": 1.5}, sharp=True
    )
    fit = ce.estimate(model, record(rate, 0.01), noise=ce.Noise(speed=0.01), progress=False)
    assert fit.converged
    assert abs(fit.values[TORQUE] - TF) < 3 * fit.stderr[TORQUE]
    assert not any("corner" in text for text in fit.messages)
    time = fit.data[0]["speed"].time
    resting = (time > 0.05) & (time < 0.95)
    assert np.abs(fit.traces["run"]["speed"].simulated[resting]).max() < 1e-9


@pytest.fixture(scope="module")
def swung():
    """A pendulum with friction, and a fit of a short decay by steps that are short where the corner is passed."""
    b = ce.Blueprint("pendulum")
    stiff, q, w = (
        b.parameter("w2", 41.0, min=1),
        b.state("q", unit="rad"),
        b.state("w", unit="rad/s", scale=5),
    )
    slot = b.port("axis", "inertia", {"speed": w, "angle": q})
    b.ode("q", w)
    b.ode("w", slot - stiff * ca.sin(q))
    b.output("y", q, unit="rad")
    model = b.model().with_effect(ce.effects.CoulombFriction(), at="axis", values={"torque": 0.6})
    pars = model.parameters()
    pars[WIDTH].set(0.005, min=0.005)
    time = np.arange(300) * 0.01
    blank = ce.Experiment.from_arrays("swing", time=time, units={"y": "rad"}, y=np.zeros(300))
    run = ce.simulate(model, blank, parameters=pars, initial={"q": 1.0, "w": 0.0})["y"].values
    data = ce.Experiment.from_arrays("swing", time=time, units={"y": "rad"}, y=run)
    pars[WIDTH].set(0.2)
    return model, ce.estimate(model, data, parameters=pars, noise=ce.Noise(y=1e-3), progress=False)


def test_intervals_side_by_side_simulate_other_widths_as_one_run_does(swung):
    _, fit = swung
    motion = Motion(fit, {WIDTH: 0.2})
    assert not motion.whole
    costs = [motion.cost({WIDTH: width}) for width in (0.01, 0.05, 0.2, 0.4)]
    whole = [cost_along(fit, paths_of(fit, moved={WIDTH: width})) for width in (0.01, 0.05, 0.2, 0.4)]
    # steps are as short as 0.02 standard errors ask for
    assert (np.abs(np.subtract(costs, whole)) < 0.01 + 2 * SHIFT * np.sqrt(whole)).all()
    assert abs(costs[0] - costs[2]) > FELT
    (own,), (one,) = motion.paths(), paths_of(fit)
    np.testing.assert_allclose(own.x[0], np.interp(own.grid.time, one.grid.time, one.x[0]), atol=1e-4)


def test_a_fit_whose_motion_cannot_be_simulated_stays_and_says_so(swung, monkeypatch):
    model, fit = swung

    def fails(self):
        raise FloatingPointError("not finite")

    pars = model.parameters()
    fit = replace(fit, parameters=pars)
    monkeypatch.setattr(Motion, "paths", fails)
    found = follow_motion(fit, pars, lambda *_: pytest.fail("a refit"))
    assert found.parameters is fit.parameters
    assert found.messages[1:] == fit.messages
    assert "corners are rounded as they were declared (" in found.messages[0]
    assert "whether the data feel that is not known" in found.messages[0]


def test_corners_stay_as_sharp_as_they_were_made_when_the_time_was_up(monkeypatch):
    model = shaft().with_effect(ce.effects.CoulombFriction(), at="axis", values={"torque": 1.8})
    wide = model.parameters()[WIDTH].value

    def cut(fit, pars, again):
        again(with_widths(pars, {WIDTH: wide / 3}), fit, 2)
        raise TimeUp

    monkeypatch.setattr(estimate, "follow_motion", cut)
    with Deadline(100.0, best=True):
        fit = ce.estimate(model, record(100, 0.01), noise=ce.Noise(speed=0.01), progress=False)
    assert fit.converged
    assert fit.parameters[WIDTH].value == wide / 3
    assert f"the time was up before sharper ones were tried ({WIDTH} = " in fit.messages[0]


def test_errors_that_were_not_looked_at_are_said_to_be_so(monkeypatch):
    """They are looked at once, of the fit with the sharpest corners; where that search fails, ± is of the curvature."""
    plain, looked = estimate._searched, []

    def searched(*arguments, check, **how):
        if check is not None:
            looked.append(check)
            raise EstimationError("the search fails", cure="none")
        return plain(*arguments, check=check, **how)

    monkeypatch.setattr(estimate, "_searched", searched)
    model = shaft(scale=100.0).with_effect(ce.effects.CoulombFriction(), at="axis", values={"torque": 1.8})
    fit = ce.estimate(model, record(100, 0.01), noise=ce.Noise(speed=0.01), progress=False)
    assert fit.converged
    assert len(looked) == 1
    assert sum("were not checked away from it" in words for words in fit.messages) == 1
