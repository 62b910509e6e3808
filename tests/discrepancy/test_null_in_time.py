"""The fit without effects where its share of the time is up."""

import importlib
from dataclasses import dataclass
from types import SimpleNamespace as stub

import numpy as np
import pytest

module = importlib.import_module("casadi_engine.discrepancy.repair")  # the function has the same name


@dataclass
class _Ended:
    """A fit as far as it is asked for here."""

    cost: float = 3.0
    converged: bool = True
    messages: tuple[str, ...] = ("as it was",)
    optima: tuple[object, ...] = ()


@pytest.mark.parametrize(
    ("best", "again", "said"),
    [("converged", True, True), ("converged", False, False), ("interrupted", True, False)],
)
def test_a_start_that_had_converged_is_the_fit_where_the_time_was_up_in_another(
    monkeypatch, best, again, said
):
    """Three of four starts of an arm had come to one optimum; there was no answer, for the fourth took too long."""
    asked = []

    def estimate(model, data, **options):
        asked.append(options)
        return _Ended(converged=again)

    monkeypatch.setattr(module, "estimate", estimate)
    optima = (stub(cost=3.0, status=best), stub(cost=np.inf, status="not converged"))
    job = stub(model=None, portion=stub(data=()), parameters=None, deadline=stub(left=10.0))
    fit = _Ended(optima=optima)
    found = module._Job._at_its_end(job, fit, {"noise": None})
    assert (found is not None) is said
    if best == "converged":
        assert asked == [{"parameters": None, "warm": fit, "errors": "quadratic", "noise": None}]
    if said:
        assert found.messages[-1].startswith("the errors of the fit without effects were not checked")
