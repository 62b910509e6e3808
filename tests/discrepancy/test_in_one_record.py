"""An event that happened at another time in one record alone."""

from types import SimpleNamespace as stub

import numpy as np
import pytest

from casadi_engine.discrepancy import in_place as module

KEY = "hull.load_step"


def structure(values):
    amplitude = stub(min=-np.inf, max=np.inf)
    candidate = stub(size=None, source=stub(effect=stub(amplitude=amplitude)))
    member = stub(key=KEY, amplitude=f"{KEY}.torque", candidate=candidate)
    return stub(arrived=stub(values=values)), member


def over_time(monkeypatch, costs):
    """Chi-squared (K,) over the times 10, 20, 30 and 40 of each record."""
    times = np.array([10.0, 20.0, 30.0, 40.0])

    def each(refits, tried, one):
        del refits, tried
        for record, cost in costs.items():
            yield record, f"{one.key}.time@{record}", times, np.array(cost)

    monkeypatch.setattr(module, "in_each_record", each)
    return stub(refitter=stub(data=[stub(name=record) for record in costs]))


VALUES = {f"{KEY}.torque": -5.0, f"{KEY}.time@one": 30.2, f"{KEY}.time@two": 29.8}


def test_it_is_refitted_there_and_stays_in_the_other(monkeypatch):
    refits = over_time(monkeypatch, {"one": [0.0, -1.0, -90.0, -3.0], "two": [0.0, -500.0, -90.0, -3.0]})
    found = module._in_one_record(refits, *structure(VALUES))
    assert found.times == {"time": {"one": 30.2, "two": 20.0}}
    assert found.start == -5.0


@pytest.mark.parametrize("costs", [[0.0, -90.5, -90.0, -3.0], []])
def test_one_that_is_no_better_elsewhere_is_left(monkeypatch, costs):
    refits = over_time(monkeypatch, {"one": [0.0, -1.0, -90.0, -3.0], "two": costs or [0.0, 0.0, -1.0, 0.0]})
    assert module._in_one_record(refits, *structure(VALUES)) is None


def test_one_record_is_no_matter_of_this(monkeypatch):
    refits = over_time(monkeypatch, {"one": [0.0, -500.0, -90.0, -3.0]})
    assert module._in_one_record(refits, *structure(VALUES)) is None
