"""A delay that leaves out what no structure describes is doubted at the top of the answer."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy.lost_beginning import with_lost_beginning
from casadi_engine.discrepancy.wording import HINT


@dataclass(frozen=True)
class Answer:
    effects: tuple = ("a delay",)
    options: dict = field(default_factory=dict)


def found_with(residual, lost):
    index = np.arange(len(residual))
    record = SimpleNamespace(
        name="swing", residual={"angle": residual}, index={"angle": index}, time={"angle": 0.01 * index}
    )
    null = SimpleNamespace(records=(record,))
    return SimpleNamespace(
        lost={("swing", "angle"): np.arange(lost)}, beside=(SimpleNamespace(null=null), None)
    )


@pytest.mark.parametrize(("held", "lost", "doubted"), [(30.0, 48, True), (30.0, 0, False), (1.0, 48, False)])
def test_what_is_wrong_with_the_beginning_is_pointed_at(held, lost, doubted):
    residual = np.random.default_rng(4).normal(size=500)
    residual[:30] *= held
    found = with_lost_beginning(Answer(), found_with(residual, lost))
    assert (HINT in found.options) == doubted
    if doubted:
        words = found.options[HINT]
        assert words.startswith(
            "Angle of swing from 0 to 0.47 s, which a sensor that late shows nothing of, holds 9"
        )
        assert "repair again without that part" in words


def test_where_nothing_is_late_or_a_doubt_stands_there_already_it_stays():
    residual = np.r_[np.full(20, 40.0), np.ones(100)]
    late = found_with(residual, 20)
    assert with_lost_beginning(Answer(), None) == Answer()
    assert with_lost_beginning(Answer(), SimpleNamespace(beside=None)) == Answer()
    assert with_lost_beginning(Answer(effects=()), late) == Answer(effects=())
    known = Answer(options={HINT: "Look at the sign"})
    assert with_lost_beginning(known, late) is known
    assert HINT in with_lost_beginning(Answer(), late).options
