"""A field with its jumps held: what counts as a switch, the values on its sides, and the mean that stays on it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from casadi_engine.model import Blueprint
from casadi_engine.simulation.switched_field import Segment, SwitchedField


def field_of(rates, states=1, inputs=0, parameters=None):
    b = Blueprint("switched")
    p = [b.parameter(name, value) for name, value in (parameters or {}).items()]
    x = [b.state(f"x{k}") for k in range(states)]
    u = [b.input(f"u{k}") for k in range(inputs)]
    for k, rate in enumerate(rates(b.time, x, u, p)):
        b.ode(f"x{k}", rate)
    b.output("y", x[0])
    values = np.array(list((parameters or {}).values()))
    return SwitchedField(b.model(), ca.SX(0, 1), ca.SX(ca.DM(values)))


def still(inputs=0):
    return Segment(0.0, np.zeros(inputs), np.zeros(inputs), np.zeros(0)).row


@pytest.mark.parametrize(
    ("rate", "switches"),
    [
        (lambda x, u, t: -x, 0),
        (lambda x, u, t: ca.sign(x), 1),
        (lambda x, u, t: ca.fabs(x), 0),  # corners are the error control's
        (lambda x, u, t: ca.fabs(u) - ca.fmax(u, 0.3), 0),
        (lambda x, u, t: ca.sign(u), 1),
        (lambda x, u, t: ca.fabs(t - 1) * ca.sign(t - 1), 1),  # the same function twice
        (lambda x, u, t: ca.if_else(x > 0, 1, ca.if_else(x < 0, -1, 0)), 1),
        (lambda x, u, t: ca.sign(x) * ca.sign(x - 1), 2),
    ],
)
def test_switches(rate, switches):
    field = field_of(lambda t, x, u, p: [rate(x[0], u[0], t)], inputs=1)
    assert field.switches == switches
    assert set(field.owner.tolist()) == set(range(switches))


def test_the_field_with_the_values_that_hold_is_the_model():
    field = field_of(
        lambda t, x, u, p: [u[0] - p[0] * ca.sign(x[0]) + ca.sin(t)], inputs=1, parameters={"F": 2.0}
    )
    row = Segment(1.0, np.array([3.0]), np.array([0.5]), np.zeros(0)).row
    for x in (-0.7, 0.4):
        place = np.array([x])
        held = field.nodes(place, 3.0, row)
        rate, share, *_ = field.field(())(place, 3.0, row, held, np.zeros_like(held))
        assert rate[0] == pytest.approx(4.0 - 2 * np.sign(x) + np.sin(3.0))
        assert share.size == 0


def test_values_on_both_sides_of_a_switch():
    field = field_of(lambda t, x, u, p: [ca.if_else(x[0] > 0.5, 3, -1)])
    here = field.nodes(np.array([0.5]), 0.0, still())
    (low, below), (high, above) = field.sides(np.array([0.5]), 0.0, still(), here, 0, np.ones(1))
    assert below[0] < 0 < above[0]
    none = np.zeros_like(low)
    rates = [field.field(())(np.array([0.5]), 0.0, still(), b, none)[0][0] for b in (low, high)]
    rising = field.slopes(np.array([0.5]), 0.0, still(), here)[0, 0] > 0
    assert rates == ([-1, 3] if rising else [3, -1])
    at_time = field_of(lambda t, x, u, p: [ca.if_else(t < 2, 5, 7)])
    here = at_time.nodes(np.zeros(1), 2.0, still())
    (low, _), (high, _) = at_time.sides(np.array([0.0]), 2.0, still(), here, 0, np.ones(1))
    g = [at_time.g(np.zeros(1), t, still(), here)[0] for t in (1.9, 2.1)]
    wanted = [5, 7] if g[0] < g[1] else [7, 5]
    rates = [at_time.field(())(np.zeros(1), 2.0, still(), b, none)[0][0] for b in (low, high)]
    assert rates == wanted


def test_a_sliding_mode_is_the_mean_of_both_fields_that_stays_on_the_switch():
    """Dry friction of 2 under a torque of 1.5 on the inertia 0.5, beside a state that goes on: Filippov's mean."""
    field = field_of(
        lambda t, x, u, p: [(1.5 - 2 * ca.sign(x[0])) / 0.5, 10 * ca.sign(x[0]) - x[1]], states=2
    )
    place = np.array([0.0, 0.25])
    here = field.nodes(place, 0.0, still())
    (low, _), (high, _) = field.sides(place, 0.0, still(), here, 0, np.ones(2))
    rate, share, passing, _ = field.field((0,))(place, 0.0, still(), low, high - low)
    assert rate[0] == pytest.approx(0.0, abs=1e-12)
    assert passing[0] == pytest.approx(0.0, abs=1e-12)
    # the friction is 1.5 = 2 * (2 α - 1)
    assert share[0] == pytest.approx(0.875)
    assert rate[1] == pytest.approx(10 * 0.75 - 0.25)
    slope = field.jacobian(place, 0.0, still(), low, high - low, (0,))
    np.testing.assert_allclose(slope, [[0, 0], [0, -1]], atol=1e-12)


def test_slopes_and_jacobian():
    field = field_of(lambda t, x, u, p: [x[1] * ca.sign(x[0] * x[1] - t), -(x[0] ** 2)], states=2)
    place = np.array([2.0, 3.0])
    held = field.nodes(place, 1.0, still())
    slope = field.slopes(place, 1.0, still(), held)[0]
    np.testing.assert_allclose(slope / slope[2] * -1.0, [3, 2, -1])
    found = field.jacobian(place, 1.0, still(), held, np.zeros_like(held), ())
    np.testing.assert_allclose(found, [[0, 1], [-4, 0]])


def test_a_channel_runs_on_its_line():
    row = Segment(2.0, np.array([1.0, -1.0]), np.array([3.0, 0.0]), np.zeros(0)).row
    field = field_of(lambda t, x, u, p: [u[0] + 10 * u[1]], inputs=2)
    none = np.zeros(0)
    assert field.field(())(np.zeros(1), 2.5, row, none, none)[0][0] == pytest.approx(1 + 1.5 - 10)
