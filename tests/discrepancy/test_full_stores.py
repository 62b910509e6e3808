"""Storages that would begin with a content that nothing there has are no answer."""

from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy.full_stores import is_overfull


@pytest.mark.parametrize(
    ("content", "reach", "overfull"),
    [(20.0, 15.0, False), (400.0, 15.0, False), (-500.0, 15.0, True), (1e7, 15.0, True), (1e7, 0.0, False)],
)
def test_a_content_far_beyond_what_is_ever_stored_there_is_none(content, reach, overfull):
    """A membrane whose pores block had been a storage behind its cake, of 1e9 times what that has, "confirmed"."""
    effect = stub(first=20.0, reach=reach)
    one = stub(candidate=stub(port="cake", effect="hidden_storage", source=stub(effect=effect)))
    initial = {"run": {"cake": 0.01, "cake_hidden_storage_stored": content}}
    assert is_overfull([one], initial) == overfull
    assert not is_overfull([one], {"run": {"cake": 1e9}})
    assert not is_overfull([], initial)
