"""Friction by the motion on the records: how wide its corners are, and which fading speeds are looked for."""

from functools import partial

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.effects.friction import CoulombFriction, QuadraticDrag, StribeckFriction
from casadi_engine.model.port_view import PortView

SWING = 40 * np.sin(1.5 * 0.01 * np.arange(1000))


def shaft(speed, scale=1.0):
    """The port of a shaft that moved so."""
    b = ce.Blueprint("shaft")
    w, c = b.state("w", unit="rad/s", scale=scale), b.parameter("c", 0.1, unit="1/s")
    b.ode("w", b.port("shaft", "inertia", {"speed": w}) - c * w)
    b.output("w", w, unit="rad/s")
    model = b.model()
    return PortView(model, model.ports["shaft"], partial(lambda course, signal: [course], speed))


def test_a_motion_that_is_larger_than_the_scale_says_has_wider_corners():
    assert (
        CoulombFriction().narrowed(shaft(SWING)).width == CoulombFriction().narrowed(shaft(SWING, 40.0)).width
    )
    assert CoulombFriction().narrowed(shaft(SWING / 1e6)).width < 1e-6


def test_a_corner_shrinks_by_the_share_and_a_kink_stays():
    for effect, factor in ((CoulombFriction(), 4), (StribeckFriction(), 4), (QuadraticDrag(), 1)):
        wide, sharp = (effect.narrowed(shaft(SWING), share).width for share in (1.0, 0.25))
        assert wide / sharp == pytest.approx(factor, rel=0.05)
    assert CoulombFriction(width=0.1).narrowed(shaft(SWING)).width == 0.1


@pytest.mark.parametrize("size", [1e-3, 1.0, 40.0])
def test_fading_speeds_follow_the_motion_and_not_the_scale(size):
    for scale in (1.0, 100.0):
        low, high = StribeckFriction().fitted(shaft(size * SWING / 40, scale), None, {}).span
        assert low == pytest.approx(size / 100, rel=0.05)
        assert high == pytest.approx(3.03 * size, rel=0.05)


def test_fading_speeds_that_a_turning_shaft_never_comes_near_are_left_out():
    low, high = StribeckFriction().fitted(shaft(100 + SWING / 2), None, {}).span
    assert (low, high) == (26.0, 360.0)
    given = StribeckFriction(span=(1.0, 2.0))
    assert given.fitted(shaft(SWING), None, {}) is given
    assert StribeckFriction().fitted(shaft(0 * SWING), None, {}).span is None
