"""What of a model joins its linear core, and what is left as laws."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.effects.protocol import Amplitude, Effect
from casadi_engine.model import Blueprint
from casadi_engine.simulation.split import split
from tests.model.random_expressions import expressions


def mass(law, *, rate=None, output=None):
    """A mass with a slot for ``law`` (q, v, u, t, k) and perhaps an equation and an output of its own kind."""
    b = Blueprint("mass")
    q, v, u, k = b.state("q"), b.state("v"), b.input("u"), b.parameter("k", 2.0)
    z = b.state("z") if rate is not None else None
    slot = b.port("spring", "coupling", {"stretch": q})
    b.ode("q", v)
    b.ode("v", u - q + slot)
    if rate is not None:
        b.ode("z", rate(q, v, z, b.time))
    b.output("y", q if output is None else output(q, v, slot))
    if law is not None:
        b.law("spring", law(q, v, u, b.time, k))
    return b.model()


def rates(parts, x, u=0.7, t=0.3, p=2.0):
    """The split model's rates by its core and laws."""
    inner, core = parts.model, parts.core
    value = ca.Function("value", [inner.x, inner.u, inner.t, inner.p], [
        core.A @ inner.x + core.B @ inner.drive_expressions + core.G @ parts.laws + core.e
    ])  # fmt: skip
    return np.array(value(x, u, t, p)).ravel()


KINDS = {
    # law, slots left, drives of the split model
    "affine": (lambda q, v, u, t, k: -k * v + 0.5, 0, 1),
    "known": (lambda q, v, u, t, k: k * u**2, 0, 2),
    "affine and known": (lambda q, v, u, t, k: -k * v + ca.sin(u), 0, 2),
    "known in time": (lambda q, v, u, t, k: k * ca.sin(t) * u**2, 1, 1),
    "affine and known in time": (lambda q, v, u, t, k: -k * v + ca.sin(t), 1, 1),
    "nonlinear": (lambda q, v, u, t, k: -k * q**3, 1, 1),
    "affine with a factor of time": (lambda q, v, u, t, k: ca.sin(t) * q, 1, 1),
    "nonlinear and known": (lambda q, v, u, t, k: -(q**3) + u, 1, 1),
}


@pytest.mark.parametrize("name", KINDS)
def test_simple_laws_join_the_core_and_the_rates_stay_the_same(name):
    law, slots, drives = KINDS[name]
    model = mass(law)
    parts = split(model)
    assert (int(parts.model.w.numel()), len(parts.model.drives)) == (slots, drives)
    assert parts.model.has_slot_laws == bool(slots)
    x = np.array([0.4, -1.2])
    whole = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
    np.testing.assert_allclose(rates(parts, x), np.array(whole(x, 0.7, 0.3, 2.0)).ravel(), rtol=1e-14)


def test_an_equation_that_is_not_affine_gets_a_slot_and_keeps_its_linear_part():
    model = mass(None, rate=lambda q, v, z, t: v - 3 * z - z**3 + ca.sin(t))
    assert model.linear is None
    parts = split(model)
    np.testing.assert_array_equal(np.array(ca.evalf(ca.densify(parts.core.A)))[2], [0, 1, -3])
    law = ca.Function("law", [parts.model.x, parts.model.u, parts.model.t, parts.model.p], [parts.laws])
    assert float(law([9, 9, 0.5], 0, 0.3, 2.0)) == pytest.approx(-(0.5**3) + np.sin(0.3))
    whole = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
    x = np.array([0.4, -1.2, 0.5])
    np.testing.assert_allclose(rates(parts, x), np.array(whole(x, 0.7, 0.3, 2.0)).ravel(), rtol=1e-14)


def test_an_equation_whose_linear_part_is_infinite_is_all_law():
    parts = split(mass(None, rate=lambda q, v, z, t: -ca.sqrt(z)))
    np.testing.assert_array_equal(np.array(ca.evalf(ca.densify(parts.core.A)))[2], [0, 0, 0])
    x = np.array([0.4, -1.2, 0.25])
    assert rates(parts, x)[2] == -0.5


def test_a_law_and_an_equation_that_is_not_affine_go_together():
    law = lambda q, v, u, t, k: -k * q**3  # noqa: E731
    model = mass(law, rate=lambda q, v, z, t: v - z * ca.fabs(v))
    parts = split(model)
    assert parts.core.G.shape == (3, 2)
    whole = ca.Function("ode", [model.x, model.u, model.t, model.p], [model.closed_ode])
    x = np.array([0.4, -1.2, 0.5])
    np.testing.assert_allclose(rates(parts, x), np.array(whole(x, 0.7, 0.3, 2.0)).ravel(), rtol=1e-14)


def test_models_without_a_useful_core_have_no_split():
    b = Blueprint("duffing")
    q, v = b.state("q"), b.state("v")
    b.ode("q", v)
    b.ode("v", -q - q**3)
    b.output("q", q)
    assert split(b.model()) is None  # half of its equations
    assert split(mass(None, output=lambda q, v, slot: q**2)) is None
    tank = Blueprint("tank")
    level = tank.state("level")
    tank.ode("level", tank.input("inflow") - ca.sqrt(level))
    tank.output("level", level)
    assert split(tank.model()) is None


def test_what_outputs_show_of_channels_and_time_becomes_a_drive():
    b = Blueprint("toothed")
    w, u, e = b.state("w"), b.input("u"), b.parameter("e", 0.1)
    b.ode("w", u - w)
    b.output("plain", w)
    b.output("toothed", 2 * w)
    model = b.model()
    # Blueprints keep channels out of outputs; effects at sensors put them in.
    model = replace(model, output_expressions=ca.vertcat(w, 2 * w + e * ca.sin(model.t) * model.u))
    assert model.linear is None
    parts = split(model)
    inner = parts.model
    assert [drive.name for drive in inner.drives] == ["u", "shown_toothed"]
    assert not inner.has_slot_laws
    shown = ca.Function("shown", [inner.x, inner.u, inner.t, inner.p], [
        parts.core.C @ inner.x + parts.core.D @ inner.drive_expressions
    ])  # fmt: skip
    np.testing.assert_allclose(
        np.array(shown(1.5, 0.7, 0.3, 0.1)).ravel(), [1.5, 3 + 0.1 * np.sin(0.3) * 0.7], rtol=1e-14
    )


def test_an_output_that_multiplies_a_state_with_a_channel_has_no_split():
    model = mass(None)
    assert split(replace(model, output_expressions=model.x[0] * ca.sin(model.t))) is None


SYMBOLS = [ca.SX.sym(name) for name in ("q", "v", "u", "t", "k")]
POINT = st.lists(st.floats(-2, 2, width=16), min_size=5, max_size=5)
REPEATABLE = settings(max_examples=30, deadline=None, derandomize=True)


def put(expression, *values):
    """A random expression in a model's own symbols."""
    return ca.substitute(expression, ca.vertcat(*SYMBOLS), ca.vertcat(*values))


def train(ode, law, effect, output, *, drive=0):
    """Four states, so that the equation and the effect leave a linear core; everything else is as given."""
    b = Blueprint("train")
    q, v, r, s = (b.state(name) for name in "qvrs")
    u, k, t = b.input("u"), b.parameter("k", 2.0), b.time
    known = b.drive("known", put(drive, 0, 0, u, t, k))
    slot = b.port("spring", "inertia", {"speed": v, "q": q})
    b.ode("q", v)
    b.ode("v", known - q + slot)
    b.ode("r", q - r + slot)
    b.ode("s", -s + put(ode, q, v, known, t, k))
    b.law("spring", put(law, q, v, u, t, k))
    b.output("y", q + put(output, q, v, known, 0, k))
    model = b.model()

    class Anything(Effect):
        name, attaches, amplitude = "anything", ("inertia",), Amplitude("size")

        def law(self, port, p, math):
            return p.size * put(effect, port.q, port.speed, model.u, port.time, model.p)

    return model.with_effect(Anything(), at="spring", values={"size": 1.5}, sharp=True)


@REPEATABLE
@given(*[expressions(SYMBOLS) for _ in range(5)], POINT)
def test_a_split_model_has_the_closed_equations_whatever_jumps(ode, law, effect, output, drive, point):
    model = train(ode, law, effect, output, drive=drive)
    q, v, u, t, k = point
    x, p = [q, v, 0.3, -0.4], [k, 1.5]
    symbols = [model.x, model.u, model.t, model.p]
    shown = replace(model, outputs=model.states, output_expressions=model.x)
    for one in (model, shown):
        parts = split(one)
        if parts is None:
            continue
        inner, core = parts.model, parts.core
        d = ca.substitute(inner.drive_expressions, inner.p, model.p)
        made = [
            core.A @ inner.x + core.B @ d + core.G @ parts.laws + core.e,
            core.C @ inner.x + core.D @ d + core.c,
        ]
        found = ca.Function("split", symbols, made)(x, u, t, p)
        expected = ca.Function("closed", symbols, [one.closed_ode, one.closed_outputs])(x, u, t, p)
        for one_found, one_expected in zip(found, expected, strict=True):
            np.testing.assert_allclose(one_found, one_expected, rtol=1e-12, atol=1e-12)


@REPEATABLE
@given(*[expressions(SYMBOLS) for _ in range(2)], POINT)
def test_a_linear_core_is_the_model_whatever_jumps(ode, output, point):
    model = train(ode, 0, 0, output)
    core = model.linear
    if core is None:
        return
    q, v, u, t, k = point
    symbols = [model.x, model.u, model.t, model.p]
    d = model.drive_expressions
    found = ca.Function(
        "core", symbols, [core.A @ model.x + core.B @ d + core.e, core.C @ model.x + core.D @ d + core.c]
    )
    bare = replace(model, laws=ca.SX.zeros(1, 1))
    expected = ca.Function("closed", symbols, [bare.closed_ode, bare.closed_outputs])
    point = [q, v, 0.3, -0.4], u, t, [k, 1.5]
    for one_found, one_expected in zip(found(*point), expected(*point), strict=True):
        np.testing.assert_allclose(one_found, one_expected, rtol=1e-12, atol=1e-12)


def test_the_expressions_of_these_tests_leave_a_split_more_often_than_not():
    seen = {"split": 0, "not": 0}

    @settings(max_examples=30, deadline=None, derandomize=True, database=None)
    @given(*[expressions(SYMBOLS) for _ in range(4)])
    def count(ode, law, effect, drive):
        seen["split" if split(train(ode, law, effect, 0, drive=drive)) is not None else "not"] += 1

    count()
    assert seen["split"] > seen["not"]
