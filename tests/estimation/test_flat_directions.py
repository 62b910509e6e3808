"""What is said of an optimum along directions that the data hardly determine."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.estimation.final_check import _corner
from casadi_engine.estimation.standard_errors import _at_bounds

STEP, PROMISED = 200.0, 2.8


def at_end(cost):
    """A search in one logarithm of which the quadratic asks for a step of a factor of e^200, to gain 2.8."""
    search = SimpleNamespace(
        records=[],
        lower=np.array([-500.0]), upper=np.array([500.0]),
        coordinates=SimpleNamespace(log=np.array([True])),
        loss=None,
        problem=SimpleNamespace(layouts=[], priors=SimpleNamespace(evaluate=lambda v: (0.5 * cost(v[0]),))),
    )  # fmt: skip
    return search, SimpleNamespace(v=np.zeros(1), x=np.zeros(1), step=np.array([STEP]), decrement=PROMISED)


def falling(v):
    """Chi-squared as the quadratic has it."""
    return 100 - PROMISED * (v / STEP) * (2 - v / STEP)


@pytest.mark.parametrize(
    ("cost", "corner"), [(falling, False), (lambda v: 100.0, True), (lambda v: 100 + abs(v), True)]
)
def test_a_step_beyond_all_scales_is_judged_where_slopes_may_hold(cost, corner):
    """Rounding makes it any length where next to nothing is known; what counts is whether its beginning gains."""
    assert _corner(*at_end(cost), []) is corner


def test_a_step_that_promises_what_is_seen_is_no_corner():
    search, errors = at_end(lambda v: 100.0)
    errors.step = np.array([0.5])
    assert _corner(search, errors, []) is False


@pytest.mark.parametrize(("alone", "side"), [(1e-5, "min"), (100.0, False)])
def test_an_estimate_is_put_on_its_bound_only_where_the_data_do_not_tell_it_alone(alone, side):
    """Half a unit from its bound, 100 standard errors wide along with others: to move it alone changes chi-squared by
    its own information."""
    search = SimpleNamespace(
        problem=SimpleNamespace(nv=1, layouts=[]), lower=np.zeros(1), upper=np.array([1e6])
    )
    best = SimpleNamespace(solution=SimpleNamespace(x=np.array([0.5])))
    wide = SimpleNamespace(matrix=np.array([[1e4]]))
    assert _at_bounds(search, best, wide, np.array([1e-2]), np.array([alone])) == [side]
