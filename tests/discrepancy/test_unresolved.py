"""Corners of the user's own laws that no fit resolves: what they leave is not called a missing effect."""

import importlib
from types import SimpleNamespace as stub

import pytest

from casadi_engine.deadline import Deadline
from casadi_engine.discrepancy.verdict_words import next_step
from casadi_engine.discrepancy.wording import UNRESOLVED
from casadi_engine.estimation.corner_widths import ROUNDED

module = importlib.import_module("casadi_engine.discrepancy.repair")  # the function has the same name


def unresolved(monkeypatch, *, verdict="unnamed", told=True, per_sample=1.3, felt=900.0):
    """Why there is no answer, for 1000 samples of some chi-squared, and corners that are felt by so much."""
    friction = stub(width="pivot.coulomb_friction.width")
    parameters = {friction.width: stub(value=0.1)}
    fit = stub(
        messages=(f"{ROUNDED} (...)",) if told else (), model=stub(effects=(friction,)), parameters=parameters
    )
    asked = []

    def felt_by(own, widths):
        asked.append(dict(widths))
        return felt

    monkeypatch.setattr(module, "felt_by", felt_by)
    gap = stub(chi2_per_sample=per_sample, samples=1000)
    made = stub(null_fit=fit, verdict=verdict, gaps=stub(estimation_before=stub(gap=gap)))
    deadline = Deadline()
    with deadline:
        return module._Job._unresolved(stub(deadline=deadline), made), asked


def test_a_gap_that_corners_may_make_is_no_missing_effect(monkeypatch):
    why, asked = unresolved(monkeypatch)
    assert asked == [{"pivot.coulomb_friction.width": 0.1}]
    assert "whether anything is missing cannot be told" in why
    assert "chi-squared by 9e+02" in why


@pytest.mark.parametrize(
    "other", [{"verdict": "named"}, {"told": False}, {"per_sample": 3.0}, {"felt": 100.0}], ids=str
)
def test_every_other_gap_is(monkeypatch, other):
    assert unresolved(monkeypatch, **other)[0] is None


def test_the_next_step_is_to_keep_the_corners():
    assert "sharp=True" in next_step(stub(status=UNRESOLVED))
