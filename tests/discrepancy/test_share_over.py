"""A fit without effects whose share of a short time is over before it arrives."""

from dataclasses import replace

import casadi_engine as ce
from casadi_engine.discrepancy.first_fit import continued
from casadi_engine.discrepancy.verdict_words import next_step
from casadi_engine.discrepancy.wording import SHARE_OVER


def test_more_time_is_what_helps_not_other_starts(shaft):
    """It was told to look at start values and bounds, and to give more starts, which take longer still."""
    data = shaft.data(n=600)
    found = ce.repair(
        shaft.model, data, effects=["coulomb_friction"], starts=1, max_iterations=1, progress=False
    )
    assert "more starts" in next_step(found)
    late = replace(found, status=f"the fit without effects has {SHARE_OVER}")
    assert next_step(late) == "give it more time, budget=..., or start values that are nearer"


def test_it_goes_on_from_where_it_was(shaft):
    data = shaft.data(n=600)
    given = {"model": shaft.model, "data": data, "progress": False, "starts": 4, "enough": "white", "jobs": 1}
    short = ce.estimate(shaft.model, data, max_iterations=1, progress=False)
    assert not short.converged
    later = continued(short, given, 60.0)
    assert later is not None
    assert later.converged
    assert continued(short, given | {"max_iterations": 1}, 60.0) is None
