"""Structures with late sensors, held against the most probable one without."""

from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy import tried as module
from casadi_engine.discrepancy.evidence import Evidence
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Counted, Tried


def test_what_a_late_sensor_cannot_tell_of_it_does_not_explain(monkeypatch):
    """It gains over the other one what it gains by the samples that both tell of: 50 in logarithms, not 90."""
    monkeypatch.setattr(module, "evidence", lambda made, _: Evidence(*made, {}, {}))
    late = Tried((), None, (-10.0, 20.0), None, dict)
    assert (late.cost_by(None).log, late.cost_by(None).cost) == (-10.0, 20.0)
    late.beside = Counted(None, (-100.0, 200.0)), Counted(None, (-60.0, 120.0))
    assert late.cost_by(None).log == pytest.approx(-100.0 + 50.0)
    assert late.cost_by(None).cost == pytest.approx(200.0 - 100.0)


def test_it_is_held_against_the_most_probable_one_without(monkeypatch):
    """Also against a lag with more than all of its signal, which no sensor has: a delay does nearly the same."""
    places = {("run", "y"): [0, 1]}
    lag, dry, failed, filtered = (
        SimpleNamespace(lost={}, failed=name == "failed", log=log, name=name)
        for name, log in (("lag", -30.0), ("dry", -80.0), ("failed", 0.0), ("filter", -20.0))
    )
    late = SimpleNamespace(lost=places, failed=False, log=-5.0, beside=None)
    search = Refits.__new__(Refits)
    search.pool, search.filters = {1: lag, 2: dry, 3: failed, 4: late}, {}
    monkeypatch.setattr(Refits, "_pair", lambda self, one, lost: (one.name, lost))
    search._hold_late([late, lag])
    assert late.beside == ("lag", places)
    assert not hasattr(lag, "beside")
    search.filters = {1: filtered}
    search._hold_late([late])
    assert late.beside == ("filter", places)
