"""What is said where a short time left a score beyond chance and no refit."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.fresh_choice import FreshChoice
from casadi_engine.discrepancy.repaired import Unknown
from casadi_engine.discrepancy.verdict_words import headline


@pytest.mark.parametrize(
    ("p", "stopped", "said"), [(0.004, "budget", "may be"), (1e-9, "budget", "is"), (0.004, "", "is")]
)
def test_a_score_that_chance_may_make_is_no_proof(shaft, p, stopped, said):
    """Nothing was hidden, p was 0.0036 at a level of 0.01, and the headline said that something is missing."""
    found = ce.repair(shaft.model, shaft.data(n=400), effects=["coulomb_friction"], starts=1, progress=False)
    unknown = Unknown("load_step at load scores beyond chance", {"load_step at load": p})
    cut = replace(found, verdict="unnamed", unknown=unknown, stopped=stopped, effects=(), withdrawn=())
    assert headline(cut).startswith(f"something {said} missing")


def test_a_structure_that_stays_unjudged_has_no_word_of_its_first_look(monkeypatch):
    """It was "not held against the fresh data, as the time was up", and "fresh data refuse it" in a note."""
    from casadi_engine.deadline import TimeUp
    from casadi_engine.discrepancy import fresh_choice as module

    class Spared:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return False

    search = SimpleNamespace(
        deadline=SimpleNamespace(spared=lambda seconds: Spared()),
        failed={},
        best=frozenset({("coulomb_friction", "yoke")}),
    )
    choice = FreshChoice(search, SimpleNamespace(), lambda text: None, ["before"])

    def judged(self):
        self.messages += [
            "coulomb_friction at yoke: fresh data refuse it",
            "backlash at rod: fresh data refuse it",
        ]
        raise TimeUp

    monkeypatch.setattr(FreshChoice, "_judged_in_order", judged)
    monkeypatch.setattr(FreshChoice, "_kept", lambda *_: "kept")
    monkeypatch.setattr(module, "way_so_far", lambda search: [SimpleNamespace(effects=())])
    monkeypatch.setattr(module, "key_of", lambda effects: frozenset({("coulomb_friction", "yoke")}))
    assert choice.run() == "kept"
    assert choice.messages == [
        "before",
        "backlash at rod: fresh data refuse it",
        "the fresh data were not looked at to their end, as the time was up",
    ]


def test_of_what_comes_nearest_one_share_is_told():
    """ "which closes 59 % of the squared gap" stood above "explains 84 % of the gap"."""
    from casadi_engine.discrepancy.summary import _told_by

    one = SimpleNamespace(p_value=1e-9, share_explained=0.84, z=6.0)
    assert _told_by(one) == "z = 6.0, p = 1e-09, explains 84 % of the gap"
    assert _told_by(one, nearest=True) == "z = 6.0, p = 1e-09"
