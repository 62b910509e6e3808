"""What is said of an output that effects make worse."""

from dataclasses import replace

import pytest

from casadi_engine.discrepancy.fresh_misfit import held_to_fresh_data
from casadi_engine.discrepancy.repaired import IN_PART, UNCONFIRMED


@pytest.mark.parametrize(("size", "told"), [(1.2, True), (1.05, False)])
def test_an_output_that_is_further_off_is_told_beside_what_is_confirmed(repaired, size, told):
    """A lag of one sensor was named and confirmed, and what it left of the other output doubled without a word."""
    side = repaired.gaps.estimation_after
    rmse = {"omega": size * repaired.gaps.estimation_before.gap.rmse["omega"]}
    worse = replace(side, gap=replace(side.gap, rmse=rmse))
    held = held_to_fresh_data(replace(repaired, gaps=replace(repaired.gaps, estimation_after=worse)))
    assert held.effects
    words = "the residual of omega is larger with what was found than without it (rmse 0.146 to 0.175): more is missing"
    assert (words in held.messages) == told


@pytest.mark.parametrize(
    ("after", "confirmed", "named"), [(1.2, False, False), (1.05, False, True), (1.2, None, False)]
)
def test_an_output_that_is_further_off_on_fresh_data_is_not_repaired(repaired, after, confirmed, named):
    """A flow into a surge shaft closed half of the flow's gap and left 13 % more of the level's on the fresh day."""
    side = repaired.gaps.validation_after
    size = repaired.gaps.validation_before.gap.rmse["omega"]
    worse = replace(side, gap=replace(side.gap, rmse={"omega": after * size}))
    made = replace(repaired, gaps=replace(repaired.gaps, validation_after=worse), confirmed=confirmed)
    held = held_to_fresh_data(made)
    assert bool(held.effects) == named
    if not named:
        assert held.verdict == "unnamed"
        assert [one.why_withdrawn for one in held.withdrawn] == [IN_PART]
        gaps = replace(made.gaps, gain_per_cycle=replace(made.gaps.gain_per_cycle, confirmed=False))
        held = held_to_fresh_data(replace(made, gaps=gaps))  # the gain is no more than chance makes
        assert [one.why_withdrawn for one in held.withdrawn] == [UNCONFIRMED]
        words = "what it leaves of omega there is more than without it"
        assert held.unknown.sentence.endswith(words)
