"""A fit without effects that is lost, and where predictions over short pieces lead instead."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.deadline import TimeUp
from casadi_engine.discrepancy import lost_fit as module
from casadi_engine.discrepancy.lost_fit import explained, found_again, likelihood
from casadi_engine.discrepancy.screening import screen_in_turn
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.followed import not_followed


def fit(share=50.0, size=1.0, *, converged=True):
    """A fit that follows a share of its output, and leaves a residual of that size, with a hole."""
    e = size * np.where(np.arange(40) == 7, np.nan, np.cos(np.arange(40)))
    return SimpleNamespace(
        converged=converged,
        fit_percent={"run": {"y": {"simulation": share}, "z": {"simulation": None}}},
        traces={"run": {"y": SimpleNamespace(residual=e)}},
    )


@pytest.mark.parametrize(("share", "lost"), [(69.0, True), (71.0, False), (-3.0, True)])
def test_a_fit_that_leaves_a_third_of_an_output_is_lost(share, lost):
    assert not_followed(fit(share)) == ({"run/y": share} if lost else {})


def test_the_likelihood_is_that_of_the_noise_that_is_left():
    assert likelihood(fit(size=0.5)) - likelihood(fit(size=1.0)) == pytest.approx(39 * np.log(2))


@pytest.mark.parametrize(
    ("size", "converged", "taken"), [(0.5, True, True), (0.5, False, False), (2.0, True, False)]
)
def test_what_follows_the_data_better_is_taken(monkeypatch, size, converged, taken):
    given, first, other = {}, fit(), fit(size=size, converged=converged)
    monkeypatch.setattr(module, "estimate", lambda **options: given.update(options) or other)
    found = found_again(first, 1e4, {"model": "model", "starts": 4, "neighbours": 2, "seed": 3})
    assert (found is other) == taken
    assert given == {"model": "model", "starts": 1, "neighbours": 0, "seed": 3, "approach": "prediction"}


@pytest.mark.parametrize("fault", [TimeUp, EstimationError, FloatingPointError])
def test_a_search_that_leads_nowhere_changes_nothing(monkeypatch, fault):
    def fails(**_):
        raise fault("no start") if fault is not TimeUp else fault

    monkeypatch.setattr(module, "estimate", fails)
    first = fit()
    assert found_again(first, 1e4, {}) is first


@pytest.mark.slow
def test_a_frame_of_another_resonance_is_found_again():
    """A frame on a pendulum's spring behind a lag, of which a gyro sees the rate alone: direct starts leave half."""
    b = ce.Blueprint("frame")
    inertia = b.parameter("J", 0.0077, unit="kg m2", min=5e-4, max=0.3)
    k, c = (
        b.parameter("k", 0.51, unit="N m/rad", min=0.01, max=10),
        b.parameter("c", 0.017, unit="N m s/rad", min=0, max=1),
    )
    lag = b.parameter("tau", 0.048, unit="s", min=0.005, max=1)
    angle, rate, torque = (
        b.state("angle", unit="rad"),
        b.state("rate", unit="rad/s", scale=5),
        b.state("torque", unit="N m"),
    )
    slot = b.port("frame", "inertia", {"speed": rate}, unit="N m")
    b.ode("angle", rate)
    b.ode("rate", (torque - k * angle.sin() - c * rate + slot) / inertia)
    b.ode("torque", (b.input("u", unit="N m") - torque) / lag)
    b.output("gyro", rate, unit="rad/s", scale=5)
    t, rng = np.arange(800) * 0.015, np.random.default_rng(5)
    u = 0.12 * np.repeat(rng.normal(size=40), 20)

    def slope(time, x):
        drive = np.interp(time, t, u)
        return [x[1], (x[2] - 0.354 * np.sin(x[0]) - 0.0139 * x[1]) / 0.01437, (drive - x[2]) / 0.092]

    x = solve_ivp(slope, (0, t[-1]), [0, 0, 0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.015).y
    gyro = x[1] + 0.1 * np.std(x[1]) * rng.normal(size=t.size)
    data = ce.Experiment.from_arrays("run", time=t, units={"u": "N m", "gyro": "rad/s"}, u=u, gyro=gyro)
    found = ce.repair(b.model(), data, progress=False)
    assert found.verdict == "nothing missing"
    assert found.fit.values["k"] / found.fit.values["J"] == pytest.approx(0.354 / 0.01437, rel=0.05)


def test_a_gap_that_one_effect_explains_is_no_lost_fit():
    """A constant pull of most of the motion: one step explains it; a sine of no effect's is explained by none."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 8, 0.02)
    force = 3 * np.sin(2 * t)
    fits = []
    for pull in (4.0 + 0 * t, 4 * np.sin(11 * t)):
        run = solve_ivp(
            lambda s, x, pull=pull: (np.interp(s, t, force + pull) - 0.5 * x) / 2.0,
            (0, t[-1]), [0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=0.02,
        )  # fmt: skip
        speed = run.y[0] + 0.01 * rng.standard_normal(len(t))
        units = {"T": "N m", "omega": "rad/s"}
        data = ce.Experiment.from_arrays("r", time=t, units=units, T=force, omega=speed)
        pars = ce.one_inertia().parameters()
        for name, value in {"J_eng": 2.0, "C_eng": 0.5}.items():
            pars.fix(name, value)
        fits.append(ce.estimate(ce.one_inertia(), data, parameters=pars, progress=False))
    found = [explained(screen_in_turn(fit, ["constant_torque", "quadratic_drag"])) for fit in fits]
    assert found == [True, False]
