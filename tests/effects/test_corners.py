"""How sharp corners are in fits: by the motion of the records, not by a typical size."""

import numpy as np
import pytest

from casadi_engine import effects, two_mass
from casadi_engine.effects.corners import narrow
from casadi_engine.model.port_view import PortView

TIME = np.arange(2000) * 1e-3


def view_of(at, course):
    """A port of the two-mass model whose signals take these courses: signal -> (N,)."""
    model = two_mass()
    port = model.ports[at]
    known = [(port.signals[name], values) for name, values in course.items()]

    def courses(signal):
        return [next(values for symbol, values in known if symbol.element_hash() == signal.element_hash())]

    return PortView(model, port, courses)


@pytest.mark.parametrize("size", [0.02, 2.0, 200.0])
def test_a_width_follows_the_change_at_the_passages(size):
    swing = size * np.sin(2 * np.pi * 3 * TIME)
    change = 2 * size * 2 * np.pi * 3e-3  # over two samples where it passes zero
    assert narrow([swing], 1e3 * size) == pytest.approx(0.25 * change, rel=0.06)
    assert narrow([swing], 1e-6 * size) == 1e-6 * size  # never wider than the wide one
    # a signal that stays away does not feel the corner; neither does one that is not there
    assert narrow([swing + 2 * size], 0.3) == 0.3
    assert narrow([], 0.3) == narrow([np.full(9, np.nan)], 0.3) == narrow([np.zeros(50)], 0.3) == 0.3


def test_a_width_is_not_less_than_the_integrator_can_follow():
    slow = 1e-6 * np.sin(2 * np.pi * TIME)
    jump = np.where(TIME < 1, slow, 5.0 * (TIME - 1) / 1e-3)
    assert narrow([jump], 100.0) == pytest.approx(5.0 / 16, rel=0.05)


def test_friction_is_narrowed_by_the_motion_at_its_port_unless_its_width_was_given():
    slow = view_of("load", {"speed": 2 * np.sin(2 * np.pi * 3 * TIME)})
    fast = view_of("load", {"speed": 120 + 2 * np.sin(2 * np.pi * 3 * TIME)})
    for effect in (effects.CoulombFriction(), effects.StribeckFriction(), effects.QuadraticDrag()):
        assert effect.narrowed(slow).width == pytest.approx(0.019, abs=0.001)
        share = 1.0 if effect.name == "quadratic_drag" else 0.25  # a kink alone is not felt any sharper
        assert effect.narrowed(slow, 0.25).width == pytest.approx(0.019 * share, abs=0.0003)
        assert effect.narrowed(fast).width == 0.5
        given = type(effect)(width=0.7)
        assert given.narrowed(slow) is given
    # a flow of 6e-5 m3/s that keeps its sign, of a state without a scale: a width of 0.005 made a line of its square
    small = view_of("load", {"speed": 6e-5 + 1e-5 * np.sin(2 * np.pi * 3 * TIME)})
    assert effects.QuadraticDrag().narrowed(small).width == pytest.approx(0.005 * 7e-5, rel=0.02)
    # a coupling's twist rate that is the same motion has the same width
    twisted = view_of("coupling", {"twist_rate": 2 * np.sin(2 * np.pi * 3 * TIME)})
    assert effects.CoulombFriction().narrowed(twisted).width == effects.CoulombFriction().narrowed(slow).width
    assert effects.ConstantTorque().narrowed(slow) == effects.ConstantTorque()


def test_a_play_is_rounded_and_tested_by_the_torque_in_the_coupling():
    stiffness = {"K_el": 1992.0}
    for peak in (0.7, 60.0, 7e3):
        twist = peak / 1992.0 * np.sin(2 * np.pi * 3 * TIME)
        view = view_of("coupling", {"twist": twist, "stiffness": np.full(len(TIME), 1992.0)})
        made = effects.Backlash().fitted(view, None, stiffness)
        largest = made.torques[-1]
        assert peak / 1.5 < largest < 1.5 * peak
        assert made.width is None
        assert made.most == pytest.approx(4 * peak / 1992.0, rel=0.5)  # twice the span of the twist
        assert made.amplitude.max == made.most
        np.testing.assert_allclose(made.sizes(view, stiffness), np.array(made.torques) / 1992.0)
        assert 0 < made.narrowed(view).width <= largest / 128
        assert made.narrowed(view, 0.25).width == pytest.approx(made.narrowed(view).width / 4)
    assert effects.Backlash().amplitude.max == np.inf
    given = effects.Backlash(width=0.3, torques=(1.0,), most=0.5)
    assert given.fitted(view, None, stiffness) == given.narrowed(view) == given


def test_fading_speeds_out_of_reach_are_not_tested():
    grids = {"fading": (10.0, 40.0, 90.0)}
    near = view_of("load", {"speed": 100 + 20 * np.sin(TIME)})
    reached = [one["fading"] for one in effects.StribeckFriction().choices(near, grids)]
    assert reached == [40.0, 90.0]
    still = view_of("load", {"speed": TIME - 1.0})
    assert len(effects.StribeckFriction().choices(still, grids)) == 3
    assert len(effects.StribeckFriction().choices(effects.port_view(two_mass(), "load"), grids)) == 3


def test_friction_that_keeps_nine_tenths_of_itself_is_dry_friction():
    plain = effects.StribeckFriction()
    slow = view_of("load", {"speed": 45.0 * np.sin(TIME)})
    made = plain.fitted(slow, None, {})
    low, high = made.nuisance["fading"].ends()
    assert low == pytest.approx(45.0 / 100, rel=0.05)
    assert np.exp(-((45.0 / high) ** 2)) == pytest.approx(0.9, abs=0.03)
    fast = view_of("load", {"speed": 120.0 + 5 * np.sin(TIME)})
    assert plain.fitted(fast, None, {}).span == (40.0, 380.0)
    assert plain.fitted(effects.port_view(two_mass(), "load"), None, {}) is plain
    given = effects.StribeckFriction(span=(1.0, 9.0))
    assert given.fitted(slow, None, {}) is given
    assert given.nuisance["fading"].ends(magnitude=100.0) == (1.0, 9.0)
