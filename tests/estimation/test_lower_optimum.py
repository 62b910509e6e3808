"""A search that ends in a higher optimum goes on from where a profile came below it."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.estimation.lower_optimum import Place, from_lower_places

PLACE = Place({"a": 1.0}, {"r": {"x": 0.0}}, {"y": (0.1, False)})


def fit(cost, *, lower=None, converged=True, sigma=0.1, estimated=False):
    trace = SimpleNamespace(mask=np.ones(50, dtype=bool))
    return SimpleNamespace(
        innovations=None, cost=cost, lower=lower, converged=converged,
        noise={"y": (sigma, estimated)}, traces={"r": {"y": trace}}
    )  # fmt: skip


@pytest.mark.parametrize(
    ("found", "taken"),
    [
        (fit(40.0), True),
        (fit(49.95), False),
        (fit(40.0, converged=False), True),
        (fit(47.0, converged=False), False),
    ],
)
def test_what_is_lower_takes_its_place(found, taken):
    first, asked = fit(50.0, lower=PLACE), []

    def again(changed):
        asked.append(changed["warm"])
        return found

    assert from_lower_places(first, again) is (found if taken else first)
    assert asked == [PLACE]


def test_levels_that_are_estimated_count_by_their_likelihood():
    first = fit(48.0, lower=PLACE, sigma=0.2, estimated=True)
    found = fit(48.0, sigma=0.1, estimated=True)
    assert from_lower_places(first, lambda _: found) is found


def test_nothing_is_searched_where_no_profile_came_below():
    first = fit(50.0)
    assert from_lower_places(first, None) is first
