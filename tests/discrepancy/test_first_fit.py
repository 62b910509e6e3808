"""The fit without effects in its share of the time, and where none has come to a point by then."""

from types import SimpleNamespace

import pytest

from casadi_engine.deadline import Deadline, TimeUp, ask, late
from casadi_engine.discrepancy import first_fit as module

GIVEN = {"model": None, "max_iterations": 200, "starts": 4}


def _until_late():
    """The clock may be the processor's, which does not count sleep."""
    while not late():
        pass
    ask()


def fit(**changes):
    made = {"converged": True, "innovations": object(), "status": "converged"}
    return SimpleNamespace(**made | changes)


def test_its_share_is_lifted_where_there_is_no_fit_yet(monkeypatch):
    """An arm whose start alone took 19 of 60 s: "the time was up before the model could be evaluated"."""
    tried = []

    def estimate(**given):
        tried.append(given)
        if len(tried) == 1:
            _until_late()
        return fit()

    monkeypatch.setattr(module, "estimate", estimate)
    with Deadline(30.0):
        found, own = module.first_fit(GIVEN, 0.01, patient=True)
    assert found.converged
    assert len(tried) == 2
    assert not own.over


def test_the_end_of_all_time_is_one(monkeypatch):
    def estimate(**_):
        _until_late()

    monkeypatch.setattr(module, "estimate", estimate)
    with pytest.raises(TimeUp), Deadline(0.01):
        module.first_fit(GIVEN, 0.005, patient=True)


@pytest.mark.parametrize(("patient", "status"), [(True, "converged"), (False, module.OUT_OF_ITERATIONS)])
def test_one_that_ran_out_of_iterations_goes_on_where_it_may(monkeypatch, patient, status):
    asked = []

    def estimate(**given):
        asked.append(given)
        warm = given.get("warm")
        return fit() if warm else fit(converged=False, status=module.OUT_OF_ITERATIONS)

    monkeypatch.setattr(module, "estimate", estimate)
    found, _ = module.first_fit(GIVEN, 10.0, patient=patient)
    assert found.status == status
    if patient:
        assert asked[1]["max_iterations"] == 1000
        assert "starts" not in asked[1]
