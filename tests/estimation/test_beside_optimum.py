"""Other optima of a fit: those that the data hardly tell from the best, and none that is the best again."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.estimation.beside_optimum import rivals


@pytest.mark.parametrize(("moved", "count"), [((0.3, -0.2), 0), ((0.3, 0.8), 1)])
def test_the_same_optimum_reached_less_exactly_is_no_other_one(moved, count):
    """A start that ended 0.4 % beside the optimum, lower by 0.0002 of chi-squared, was an optimum of its own."""
    names = ["a", "b"]
    search = SimpleNamespace(
        problem=SimpleNamespace(nv=2),
        pmap=SimpleNamespace(free=names),
        coordinates=SimpleNamespace(of=lambda v: v),
    )
    size = np.array([0.1, 2.0])
    errors = SimpleNamespace(v=np.zeros(2), covariance=SimpleNamespace(matrix=np.diag(size**2)))
    place = dict(zip(names, (size * moved).tolist(), strict=True))
    end = SimpleNamespace(status="converged", apart="a +30 %", cost=9.9998, values=place)
    found = rivals(search, SimpleNamespace(cost=10.0), errors, [end])
    assert len(found) == count
    assert all("at a cost 0 higher" in one.text for one in found)
