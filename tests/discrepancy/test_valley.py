"""Refits that end in a valley along which the data tell nothing: where there, the priors say."""

from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy.refits import _no_better


def ended(cost, **values):
    return stub(cost=cost, values=values)


@pytest.mark.parametrize(
    ("one", "known", "no_better"),
    [
        (ended(10.0, R=1.0), ended(9.8, R=4.0), True),  # above it by more than refits are off
        (ended(9.85, R=1.0), ended(9.8, R=4.0), False),  # as low, elsewhere: its evidence decides
        (ended(9.8, R=4.0, L=0.1), ended(9.8, R=4.01, L=0.1), True),  # the same end
        (ended(9.79, R=4.0), ended(9.8, R=4.01), False),  # lower
        (ended(9.8, R=4.0, more=1.0), ended(9.8, R=4.0), False),  # with a number that the other has not
        (ended(9.8, R=0.0), ended(9.8, R=0.0), True),
    ],
)
def test_another_end_of_a_valley_may_be_more_probable(one, known, no_better):
    assert _no_better(one, known) is no_better
