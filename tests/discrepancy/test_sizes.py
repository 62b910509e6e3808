"""An effect whose size may be zero, or rests on a bound, is confirmed by nothing."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.withdrawal import held_to_sizes
from casadi_engine.estimation.fit import Estimate


@dataclass(frozen=True)
class Answer:
    effects: tuple
    confirmed: bool | None = True
    messages: tuple[str, ...] = ()


def effect(value, error, side=False):
    amplitude = Estimate(value, error, "N m", side, None, fixed=False)
    return SimpleNamespace(name="coulomb_friction", at="shaft", amplitude=amplitude)


@pytest.mark.parametrize(
    ("size", "confirmed"),
    [(effect(2.0, 0.1), True), (effect(1.6e7, 2.5e7), None), (effect(2604.0, None, "max"), None)],
)
def test_a_size_that_may_be_zero_or_is_at_a_bound_confirms_nothing(size, confirmed):
    found = held_to_sizes(Answer((size,)))
    assert found.confirmed is confirmed
    assert len(found.messages) == (confirmed is None)
    for words in found.messages:
        assert (
            "coulomb_friction at shaft, whose size may be zero within its errors, or is at a bound" in words
        )
