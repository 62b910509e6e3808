"""The model that comes nearest of an answer without a name, in result.json."""

from dataclasses import replace

from casadi_engine.discrepancy.repaired import Nearest
from casadi_engine.report.repaired import content


def test_the_nearest_model_is_stored_with_the_gap_that_it_leaves(unnamed, repaired):
    after = repaired.gaps.estimation_after.gap
    stored = content(replace(unnamed, nearest=Nearest(("drag at load",), repaired.fit, after)))["nearest"]
    assert stored == {
        "effects": ["drag at load"],
        "values": dict(repaired.fit.values),
        "rmse": dict(after.rmse),
        "rmse_fresh": None,
    }
    both = replace(unnamed, nearest=Nearest(("drag at load",), repaired.fit, after, after))
    assert content(both)["nearest"]["rmse_fresh"] == dict(after.rmse)
    assert content(unnamed)["nearest"] is None
