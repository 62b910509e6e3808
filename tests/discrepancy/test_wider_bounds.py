"""A bound that is wrong is told as a bound, whatever effect takes its place."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.wider_bounds import with_free_starts, with_wider_bounds
from casadi_engine.discrepancy.wording import BOUNDS, STARTS, first_words

NOISE = ce.Noise(omega=0.02)


def record(seed=1, cubic=0.0):
    """One inertia on a damper of 0.5 N m s/rad, and a cube of its speed."""
    t = np.arange(0, 20, 0.02)
    torque = 2 + np.sin(1.3 * t) + np.sin(0.4 * t)

    def rate(time, w):
        return (np.interp(time, t, torque) - 0.5 * w - cubic * w**3) / 0.8

    w = solve_ivp(rate, (0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=0.02).y[0]
    y = w + 0.02 * np.random.default_rng(seed).standard_normal(len(t))
    return ce.Experiment.from_arrays("a", time=t, units={"T": "N m", "omega": "rad/s"}, T=torque, omega=y)


def model():
    b = ce.Blueprint("wheel")
    torque = b.input("T", unit="N m")
    inertia = b.parameter("J", 1.0, unit="kg m2", min=0.1, max=10)
    c = b.parameter("c", 0.7, unit="N m s/rad", min=0, max=10)
    w = b.state("w", unit="rad/s")
    b.ode("w", (torque - c * w + b.port("wheel", "inertia", {"speed": w})) / inertia)
    b.output("omega", w, unit="rad/s")
    return b.model()


def parameters(**bounds):
    found = model().parameters()
    for name, (low, high) in bounds.items():
        found[name].set(low if low else high, min=low, max=high)
    return found


def answered(pars, data, verdict="unnamed"):
    fit = ce.estimate(model(), data, parameters=pars, noise=NOISE, progress=False)
    made = ce.repair(model(), data, parameters=pars, noise=NOISE, effects=["constant_torque"], progress=False)
    return replace(made, null_fit=fit, fit=fit, effects=(), verdict=verdict, options={})


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"c": (1.0, 10.0)}, r"c rests on its bound of 1 N m s/rad: with .*c = 0\.(49|50)\d* N m s/rad"),
        ({"J": (0.1, 0.3)}, r"J rests on its bound of 0.3 kg m2: with J = 0\.(79|80)\d* kg m2"),
    ],
)
def test_a_bound_that_keeps_the_truth_out_is_said_first(bounds, words):
    pars = parameters(**bounds)
    made = with_wider_bounds(answered(pars, record()), pars, NOISE, {})
    said = first_words(made)[0]
    assert "without any effect follows" in said
    assert re.search(words, said), said
    assert "look at the bounds first" in str(made)


def test_a_bound_without_which_nothing_is_better_is_no_cause():
    """What is missing grows with the cube of speed: no damping does that."""
    pars = parameters(c=(1.0, 1.3))
    made = with_wider_bounds(answered(pars, record(cubic=0.3)), pars, NOISE, {})
    assert BOUNDS not in made.options


def test_signs_are_no_bounds_to_widen_and_a_model_that_fits_has_none():
    pars = parameters()
    made = answered(pars, record())
    assert with_wider_bounds(made, pars, NOISE, {}) is made  # nothing rests
    assert with_wider_bounds(replace(made, verdict="nothing missing"), pars, NOISE, {}).options == {}
    zero = SimpleNamespace(at_bound="min", unit="1")
    resting = replace(made, null_fit=replace(made.null_fit, estimates={"c": zero}))
    assert with_wider_bounds(resting, pars, NOISE, {}) is resting


def test_first_states_that_were_given_wrong_are_said_first():
    """A start at 3 rad/s in place of 0 was an unknown torque of the speed."""
    made = ce.repair(
        model(),
        record(),
        noise=NOISE,
        effects=["constant_torque", "quadratic_drag"],
        initial={"w": 3.0},
        progress=False,
    )
    said = first_words(made)[0]
    assert said.startswith("The initial states were given: with w = ")
    assert "look at the initial states that were given" in str(made)


def test_first_states_that_are_right_or_were_found_are_no_cause():
    data, pars = record(cubic=0.02), parameters()
    made = answered(pars, data)
    for initial in (None, {"w": 0.0}):
        assert STARTS not in with_free_starts(made, pars, NOISE, {"initial": initial}).options
