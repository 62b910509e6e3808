"""A first fit that no integrator follows with corners as sharp as they are begins with wide ones."""

from types import SimpleNamespace as stub

import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation import corner_widths as module
from casadi_engine.estimation.corner_widths import FACTOR, ROUNDED, WIDER, from_wide_corners

WIDTH = "shaft.coulomb_friction.width"


def sliding():
    """A mass with dry friction, whose width is the model's own."""
    b = ce.Blueprint("slide")
    m, v, f = b.parameter("m", 1.0, unit="kg"), b.state("v", unit="m/s"), b.input("F", unit="N")
    shaft = b.port("shaft", "inertia", {"speed": v}, unit="N")
    b.ode("v", (f + shaft) / m)
    b.output("speed", v, unit="m/s")
    return b.model().with_effect(ce.effects.CoulombFriction(), at="shaft")


def failing(cause):
    fault = EstimationError("the model cannot be evaluated", seen="no", allowed="numbers", cure="none")
    fault.__cause__ = cause
    return fault


class Fits:
    """Fits that are made, by the widths of their corners over that of the model; the sharpest that can be followed."""

    def __init__(self, model, followed, cause):
        self.own, self.followed, self.cause, self.made = model.parameters()[WIDTH].value, followed, cause, []

    def __call__(self, changes):
        parameters = changes.get("parameters")
        share = 1.0 if parameters is None else parameters[WIDTH].value / self.own
        self.made.append(round(share, 6))
        if share < self.followed * 0.999:
            raise failing(self.cause)
        return stub(parameters=parameters, messages=())


def arguments(model):
    return {"model": model, "parameters": model.parameters()}


@pytest.fixture(autouse=True)
def _plain(monkeypatch):
    monkeypatch.setattr(module, "replace", lambda fit, **changed: stub(**(vars(fit) | changed)))


def test_a_fit_that_can_be_made_is_the_only_one():
    model = sliding()
    fits = Fits(model, 0.0, FloatingPointError())
    from_wide_corners(fits, fits, arguments(model))
    assert fits.made == [1.0]


@pytest.mark.parametrize(("followed", "said"), [(4.0, True), (FACTOR**WIDER, True)])
def test_corners_are_as_sharp_as_can_be_followed(followed, said):
    model = sliding()
    fits = Fits(model, followed, FloatingPointError())
    found = from_wide_corners(fits, fits, arguments(model))
    assert fits.made[:2] == [1.0, FACTOR**WIDER]
    assert found.parameters[WIDTH].value == pytest.approx(followed * fits.own)
    assert found.messages[0].startswith(ROUNDED) is said


def test_the_way_may_lead_to_those_that_failed_at_first():
    model = sliding()
    first = iter([failing(FloatingPointError())])

    def begun(changes):
        for fault in first:
            raise fault
        return stub(parameters=changes["parameters"], messages=())

    again = lambda changes: stub(parameters=changes["parameters"], messages=())  # noqa: E731
    found = from_wide_corners(begun, again, arguments(model))
    assert found.parameters[WIDTH].value == pytest.approx(model.parameters()[WIDTH].value)
    assert found.messages == ()


@pytest.mark.parametrize("cause", [None, ValueError("other")])
def test_what_fails_for_another_reason_fails(cause):
    model = sliding()
    fits = Fits(model, 1e9, cause)
    with pytest.raises(EstimationError, match="cannot be evaluated"):
        from_wide_corners(fits, fits, arguments(model))
    assert fits.made == [1.0]
