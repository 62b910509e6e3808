"""Corners of the user's own laws that no fit resolves: what they leave is not called a missing effect."""

import importlib
from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy.verdict_words import next_step
from casadi_engine.discrepancy.wording import UNRESOLVED
from casadi_engine.estimation.corner_widths import ROUNDED

module = importlib.import_module("casadi_engine.discrepancy.repair")  # the function has the same name


def felt(monkeypatch, *, told=True):
    """What corners are felt by, and of which widths that was asked."""
    friction, jump = stub(width="pivot.coulomb_friction.width"), stub(width="v.jump.width")
    parameters = {friction.width: stub(value=0.1), jump.width: stub(value=0.2)}
    model = stub(effects=(friction, stub(width="")), corners=(jump,))
    fit = stub(messages=(f"{ROUNDED} (...)",) if told else (), model=model, parameters=parameters)
    asked = []

    def felt_by(own, widths):
        asked.append(dict(widths))
        return 900.0

    monkeypatch.setattr(module, "felt_by", felt_by)
    return module._Job._felt_by_corners(stub(), fit), asked


def test_corners_are_asked_for_where_the_fit_says_that_they_are_felt(monkeypatch):
    assert felt(monkeypatch) == (900.0, [{"pivot.coulomb_friction.width": 0.1, "v.jump.width": 0.2}])
    assert felt(monkeypatch, told=False) == (0.0, [])


def unresolved(*, verdict="unnamed", per_sample=1.3, corners=900.0):
    """Why there is no answer, for 1000 samples of some chi-squared, and corners that are felt by so much."""
    gap = stub(chi2_per_sample=per_sample, samples=1000)
    made = stub(verdict=verdict, gaps=stub(estimation_before=stub(gap=gap)))
    return module._Job._unresolved(stub(felt=corners), made)


def test_a_gap_that_corners_may_make_is_no_missing_effect():
    why = unresolved()
    assert "whether anything is missing cannot be told" in why
    assert "chi-squared by 9e+02" in why


@pytest.mark.parametrize(
    "other",
    [{"verdict": "named"}, {"per_sample": 3.0}, {"corners": 100.0}, {"corners": 0.0, "per_sample": 0.9}],
    ids=str,
)
def test_every_other_gap_is(other):
    assert unresolved(**other) is None


def test_the_next_step_is_to_keep_the_corners():
    assert "sharp=True" in next_step(stub(status=UNRESOLVED))
