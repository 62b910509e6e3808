"""A load that begins in the record of the search, and acts in all of the fresh one or begins in it too."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.unseen_events import held_to_seen_events


@dataclass(frozen=True)
class Answer:
    gaps: object
    confirmed: bool | None = True
    messages: tuple[str, ...] = ()


def answer(time):
    fit = SimpleNamespace(
        data=[SimpleNamespace(name="fresh", span=(0.0, 10.0))], values={"shaft.load_step.time": time}
    )
    return Answer(SimpleNamespace(validation_after=SimpleNamespace(fits=(fit,))))


def step(*, placed=True):
    candidate = SimpleNamespace(effect="load_step", port="shaft")
    return SimpleNamespace(placed=placed, key="shaft.load_step", candidate=candidate)


@pytest.mark.parametrize(
    ("time", "confirmed"), [(0.0, None), (3.0, True), (10.0, None), (float("inf"), None)]
)
def test_an_event_is_confirmed_where_it_happens(time, confirmed):
    found = held_to_seen_events(answer(time), [step()])
    assert found.confirmed is confirmed
    assert [words.startswith("in the fresh data load_step at shaft acts") for words in found.messages] == [
        True
    ] * (confirmed is None)


def test_what_is_no_event_stays_confirmed():
    assert held_to_seen_events(answer(0.0), [step(placed=False)]).confirmed
