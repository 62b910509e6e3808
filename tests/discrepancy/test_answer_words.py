"""What an answer says where the time was up before anything was found."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy import answer_words
from casadi_engine.discrepancy.answer_words import untold
from casadi_engine.discrepancy.repaired import MORE_THAN_NOISE, UNTOLD


def search(significant):
    screened = SimpleNamespace(
        significant=significant,
        candidates=[
            SimpleNamespace(effect="viscous_friction", port="hub"),
            SimpleNamespace(effect="drag", port="rim"),
        ],
        scores=SimpleNamespace(statistic=np.array([0.3, -80.84])),
        threshold=3.841,
    )
    return SimpleNamespace(
        refits=None, pool={"best": None}, best="best", null=SimpleNamespace(screened=screened)
    )


@pytest.mark.parametrize(
    ("more", "significant", "said"),
    [
        (True, [1], MORE_THAN_NOISE),
        (False, [], UNTOLD),
        (
            False,
            [1],
            "of the tests of single effects that of drag at rim has |z| = 80.8, beyond 3.84; the time was up before "
            "effects were compared",
        ),
    ],
)
def test_what_single_tests_say_is_told_where_nothing_else_is(monkeypatch, more, significant, said):
    monkeypatch.setattr(answer_words, "leaves_more", lambda refits, best: more)
    assert untold(search(significant)) == said
