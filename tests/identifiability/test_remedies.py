"""Remedies: each is what the full test of the changed question says, and known cases find the known cures."""

from __future__ import annotations

import pytest
from published_models import PK1, PREDATOR, written

import casadi_engine as ce
from casadi_engine.identifiability import identifiability


@pytest.fixture(scope="module")
def crank():
    return ce.crankshaft(reciprocating_speed="measured")


def asked_again(model, remedy, *, inputs, outputs=None):
    """The question with a remedy made by hand, through the public call."""
    parameters, drives = model.parameters(), dict(inputs)
    start, sensors = "free", list(outputs or [variable.name for variable in model.outputs])
    for change in remedy.changes:
        if change.kind == "fix":
            parameters.fix(change.what)
        elif change.kind == "tie":
            parameters.tie(change.what, change.to)
        elif change.kind == "sensor":
            sensors.append(change.what)
        elif change.kind == "start":
            start = change.what
        else:
            drives[change.what] = change.to or "generic"
    return identifiability(model, parameters=parameters, inputs=drives, start=start, outputs=sensors)


@pytest.mark.parametrize("word", ["zero", "constant", "unknown constant", "unknown arbitrary"])
def test_every_remedy_is_confirmed_by_the_public_test(word):
    model = ce.two_mass(reciprocating_speed="measured")
    inputs = {f"T_{k}": "zero" for k in range(1, 5)} | {"T_load": word}
    found = identifiability(model, inputs=inputs)
    assert found.lost
    remedies = found.remedies()
    assert remedies
    for remedy in remedies:
        again = asked_again(model, remedy, inputs=inputs)
        assert set(again.lost) == set(remedy.lost), str(remedy)
        assert not set(remedy.restored) & set(again.lost)


def test_complete_and_cheap_ones_come_first(crank):
    remedies = identifiability(crank, inputs="constant").remedies()
    complete = [remedy.complete for remedy in remedies]
    assert complete == sorted(complete, reverse=True)
    assert remedies[0].complete
    assert remedies[0].changes[0].kind == "drive"


def test_one_excited_torque_restores_what_the_table_says(crank):
    """Rank table: only T_4 excited loses one of 23 directions, so the search must not call it complete."""
    remedies = identifiability(crank, inputs="zero").remedies(most=20)
    by_words = {str(remedy.changes[0]): remedy for remedy in remedies if len(remedy.changes) == 1}
    one = by_words["excite T_1 (now zero)"]
    assert one.complete == identifiability(crank, inputs={"T_1": "generic", "*": "zero"}).passed


def test_a_lost_load_is_measured_or_its_inertia_given(crank):
    found = identifiability(crank, inputs={"T_load": "unknown"}, outputs=["omega", "omega_7"])
    words = [str(remedy) for remedy in found.remedies()]
    assert "measure T_load (now unknown arbitrary): restores it" in words
    assert not any("fix J7" in one for one in words)  # fixing the only lost one restores nothing


def test_scales_are_restored_by_one_known_scale():
    found = identifiability(PK1.model())
    words = {change.sentence for remedy in found.remedies(most=30) for change in remedy.changes}
    assert {f"fix {name} at a value from elsewhere" for name in ("k1", "k2", "s2", "s3")} & words
    assert any(remedy.complete for remedy in found.remedies(most=30))
    prey = identifiability(PREDATOR.model()).remedies(most=20)
    assert {"measure x1 too"} <= {str(remedy.changes[0]) for remedy in prey if remedy.complete}


def test_two_changes_where_one_is_not_enough():
    model = written(
        "two_scales",
        {"x": "u - a*x", "z": "v - c*z"},
        {"y1": "p*q*x", "y2": "r*s*z"},
        parameters="a c p q r s",
        inputs="u v",
    )
    found = identifiability(model)
    assert set(found.lost) == {"p", "q", "r", "s"}
    remedies = found.remedies()
    pairs = [remedy for remedy in remedies if remedy.complete]
    assert pairs
    assert all(len(remedy.changes) == 2 for remedy in pairs)
    kinds = {frozenset(change.what for change in remedy.changes) for remedy in pairs}
    assert frozenset({"p", "r"}) in kinds or frozenset({"q", "s"}) in kinds


def test_nothing_lost_needs_no_remedy():
    found = identifiability(ce.two_mass(reciprocating_speed="measured"))
    assert found.remedies() == ()
    assert "Next: structure allows it" in str(found)
