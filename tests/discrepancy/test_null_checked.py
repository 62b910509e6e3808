"""The errors of the model without effects, where there was no time to check them before the search."""

from dataclasses import replace

import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.checked_errors import with_checked_errors

UNCHECKED = "the errors are those of the curvature at the optimum, and were not checked away from it"


@pytest.fixture(scope="module")
def nothing(shaft):
    return ce.repair(shaft.model, shaft.data(n=600), effects=["coulomb_friction"], starts=1, progress=False)


def forged(found, **changes):
    fit = replace(found.fit, messages=(UNCHECKED,))
    return replace(found, fit=fit, null_fit=fit, messages=(UNCHECKED, "another"), **changes)


def test_where_nothing_is_missing_they_are_checked_in_the_end(nothing):
    assert nothing.verdict == "nothing missing"
    checked = with_checked_errors(forged(nothing), None, {}, in_places=False)
    assert checked.messages == ("another",)
    assert not any("were not checked" in words for words in checked.fit.messages)
    assert checked.fit is checked.null_fit
    assert checked.fit.values == pytest.approx(nothing.fit.values, rel=1e-5)


def test_elsewhere_the_doubt_stays_beside_the_numbers(nothing):
    """Something is missing: no errors of this model describe its numbers, whether they are checked or not."""
    given = forged(nothing, verdict="unnamed")
    assert with_checked_errors(given, None, {}, in_places=False) is given
