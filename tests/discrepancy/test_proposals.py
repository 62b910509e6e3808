"""Which candidates the scores ask for."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy.proposals import proposals


@pytest.mark.parametrize("drop", [20.0, 1e20, np.inf])
def test_the_best_stands_for_itself_however_large_its_drop_is(drop):
    """Data without noise make a drop that a little less is not told from."""
    scores = SimpleNamespace(
        drop=np.array([drop, drop, 3.0]),
        correlation=np.array([[1, 1, 0.1], [1, 1, 0.1], [0.1, 0.1, 1]]),
        testable=np.ones(3, dtype=bool),
        statistic=np.sqrt([drop, drop, 3.0]),
    )
    candidates = [
        SimpleNamespace(key=("effect", str(k)), source=SimpleNamespace(effect=SimpleNamespace(nuisance={})))
        for k in range(3)
    ]
    screened = SimpleNamespace(scores=scores, candidates=candidates, significant=[1, 0])
    assert proposals(screened) == [0]
