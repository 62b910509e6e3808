"""The solver's coordinates: sizes of parameters whose start says nothing of them."""

import numpy as np
import pytest

from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.parameters import Parameter, Parameters
from casadi_engine.parameters.compiled import compile


def test_no_size_is_larger_than_what_the_bounds_allow():
    """A size of 1e12 for a time between 0 and 20 s left bounds that lie rounding apart, and IPOPT crashed on them."""
    given = Parameters([
        Parameter("time", value=19.0, unit="s", min=0.0, max=20.0),
        Parameter("open", value=0.0, unit="1"),
        Parameter("known", value=3.0, unit="1", min=0.0),
    ])  # fmt: skip
    pmap = compile(given, ("time", "open", "known"), ("run",))
    made = Coordinates(pmap, np.array([1e12, 1e12, np.nan]))
    assert made.scale == pytest.approx([20.0, 1e12, 3.0])
    assert made.of(np.array([20.0, 0.0, 3.0])) == pytest.approx([1.0, 0.0, 1.0])
    assert made.values(made.of(np.array([7.0, 5.0, 2.0]))) == pytest.approx([7.0, 5.0, 2.0])
