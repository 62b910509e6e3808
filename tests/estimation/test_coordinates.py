"""The solver's coordinates: sizes of parameters whose start says nothing of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.scales import sized
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


def test_a_warm_start_gives_its_own_sizes_where_they_are_larger():
    """A drag of 0.0077 beside a start of 2.8e-22 was 2.7e19 of its scale: its search left the optimum for another."""
    given = Parameters([
        Parameter("drag", value=2.8e-22, unit="1", min=0.0),
        Parameter("offset", value=3.0, unit="1"),
        Parameter("other", value=0.0, unit="1"),
        Parameter("lost", value=2.0, unit="1"),
    ])  # fmt: skip
    pmap = compile(given, ("drag", "offset", "other", "lost"), ("run",))
    warm = SimpleNamespace(values={"drag": 0.0077, "offset": -0.1, "lost": np.nan})
    assert sized(pmap, warm).scale == pytest.approx([0.0077, 3.0, 1.0, 2.0])
    assert sized(pmap, None) is pmap
