"""The one test of linearity, on its own and where a model's form hangs on it."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import casadi_engine as ce
from casadi_engine.effects import CoulombFriction, LoadStep
from casadi_engine.model import Blueprint
from casadi_engine.model.linearity import affine_parts, is_affine
from casadi_engine.simulation.split import split
from tests.model.random_expressions import expressions

X, Y, U, P = (ca.SX.sym(name) for name in "xyup")
INSIDE, OUTSIDE = ca.vertcat(X, Y), U
REPEATABLE = settings(max_examples=200, deadline=None, derandomize=True)

AFFINE = {
    "sums": 2 * X - P * Y + 3,
    "the same in both branches": ca.if_else(P > 0, X, -Y),
    "a jump of parameters": ca.sign(P) * X + ca.floor(P),
    "nothing of it": ca.SX(4),
}
KNOWN_REST = {
    "a jump of channels": P * X + ca.sign(U),
    "a remainder of channels": Y + ca.fmod(U, 1),
    "a channel": X + U**2,
}
NEITHER = {
    "sign": ca.sign(X),
    "floor": X + ca.floor(Y),
    "ceil": ca.ceil(X),
    "comparison": X < Y,
    "equality": X == Y,
    "not": ca.logic_not(X),
    "and": ca.logic_and(X, U > 0),
    "constants": ca.if_else(X > 0, 1.0, -1.0),
    "affine branches": ca.if_else(X > 0, X, 2 * X),
    "a condition that is a number": ca.if_else(Y, 1.0, 2.0),
    "remainder": ca.fmod(X, 1.0),
    "nearest remainder": ca.remainder(Y, 1.0),
    "sign of another": ca.copysign(2.0, X),
    "size with a sign": ca.copysign(X, 2.0),
    "table": ca.pw_const(X, ca.DM([0]), ca.DM([1, 2])),
    "line": ca.pw_lin(X, ca.DM([0, 1, 2]), ca.DM([0, 1, 3])),
    "conditional": ca.conditional(Y, [1, 2], 3),
    "heaviside": ca.heaviside(X),
    "ramp": ca.ramp(X),
    "angle": ca.atan2(X, 1.0),
    "least": ca.fmin(X, Y),
    "size": ca.fabs(X),
    "length": ca.hypot(X, 1.0),
    "erf": ca.erf(X),
    "product": X * Y,
    "a factor of channels": U * X,
    "a jump of channels as a factor": ca.sign(U) * X,
    "a channel's switch": ca.if_else(U > 0, X, 0),
}


@pytest.mark.parametrize("name", AFFINE)
def test_affine_expressions(name):
    assert is_affine(AFFINE[name], INSIDE, OUTSIDE)


@pytest.mark.parametrize("name", KNOWN_REST)
def test_what_is_affine_but_for_a_known_rest(name):
    assert not is_affine(KNOWN_REST[name], INSIDE, OUTSIDE)
    assert affine_parts(KNOWN_REST[name], INSIDE, OUTSIDE) is not None


@pytest.mark.parametrize("name", NEITHER)
def test_expressions_that_are_not_affine(name):
    expression = ca.SX(NEITHER[name])
    assert affine_parts(expression, INSIDE, OUTSIDE) is None
    assert not is_affine(expression, INSIDE, OUTSIDE)
    assert affine_parts(ca.vertcat(X, expression), INSIDE, OUTSIDE) is None


POINT = st.lists(st.floats(-2, 2, width=16), min_size=4, max_size=4)


@REPEATABLE
@given(expressions([X, Y, U, P]), POINT)
def test_slope_and_rest_give_the_expression(expression, point):
    parts = affine_parts(expression, INSIDE, OUTSIDE)
    if parts is None:
        return
    symbols = ca.vertcat(X, Y, U, P)
    found, expected = ca.Function("f", [symbols], [parts[0] @ INSIDE + parts[1], expression])(point)
    assert float(found) == pytest.approx(float(expected), rel=1e-12, abs=1e-12)


def shaft(torque, *, port=False):
    """J dw/dt = torque, with J = 0.5; as an ode or as a law."""
    b = Blueprint("shaft")
    w, friction = b.state("w", unit="rad/s"), b.parameter("Tf", 0.2, unit="N m")
    slot = b.port("axis", "inertia", {"speed": w})
    b.ode("w", (slot + (0 if port else torque(w, friction))) / 0.5)
    if port:
        b.law("axis", torque(w, friction))
    b.output("w", w, unit="rad/s")
    return b.model()


BRAKES = {
    "sign": lambda w, friction: -friction * ca.sign(w),
    "branches": lambda w, friction: ca.if_else(w > 0, -friction, friction),
}
RUN = ce.Experiment.from_arrays("run", time=np.arange(21) * 0.05, units={"w": "rad/s"}, w=np.zeros(21))


@pytest.mark.parametrize("port", [False, True])
@pytest.mark.parametrize("name", BRAKES)
def test_dry_friction_runs_a_shaft_down(name, port):
    model = shaft(BRAKES[name], port=port)
    assert (model.linear is None) is not port
    assert [switch.kind for switch in model.jumps] == ["jump"]
    if port:
        assert not model.laws.is_zero()
    speed = ce.simulate(model, RUN, initial={"w": 1.0})["w"]
    np.testing.assert_allclose(speed.values, 1 - 0.2 / 0.5 * speed.time, rtol=1e-12)
    parts = split(model)
    assert parts is None or parts.model.has_slot_laws


def test_a_sharp_effect_brakes_too():
    free = shaft(lambda w, friction: 0 * w)
    model = free.with_effect(CoulombFriction(), at="axis", values={"torque": 0.2}, sharp=True)
    assert model.linear is not None
    assert not model.laws.is_zero()
    speed = ce.simulate(model, RUN, initial={"w": 1.0})["w"]
    np.testing.assert_allclose(speed.values, 1 - 0.2 / 0.5 * speed.time, rtol=1e-12)


def test_a_step_in_time_is_a_drive():
    """A jump that depends on time alone leaves the model linear."""
    model = shaft(lambda w, friction: -w).with_effect(
        LoadStep(), at="axis", values={"torque": 0.2}, sharp=True
    )
    assert model.linear is not None
    assert not model.has_slot_laws
    assert len(model.drives) == 1


def test_outputs_that_jump_in_a_state_leave_no_linear_core():
    b = Blueprint("encoder")
    w = b.state("w")
    b.ode("w", -w)
    b.output("counts", ca.floor(10 * w))
    model = b.model()
    assert model.linear is None
    assert split(model) is None
    counts = ce.simulate(model, ce.Experiment.from_arrays(
        "run", time=np.arange(21) * 0.1, units={"counts": "1"}, counts=np.zeros(21)
    ), initial={"w": 1.04})["counts"]  # fmt: skip
    np.testing.assert_array_equal(counts.values, np.floor(10.4 * np.exp(-counts.time)))
