"""Firing offsets: even and uneven, and the messages when they do not fit."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from casadi_engine.errors import ModelError
from casadi_engine.model.firing import CYCLE, USUAL_ORDERS, firing_offsets


def test_four_cylinders_of_the_thesis():
    pi = math.pi
    assert firing_offsets(4, order=(1, 3, 4, 2)) == pytest.approx((0, 3 * pi, pi, 2 * pi))


@pytest.mark.parametrize("cylinders", USUAL_ORDERS)
def test_usual_orders_fire_evenly(cylinders):
    offsets = firing_offsets(cylinders)
    expected = [CYCLE * step / cylinders for step in range(cylinders)]
    assert offsets[0] == 0
    assert sorted(offsets) == pytest.approx(expected)
    along = [offsets[number - 1] for number in USUAL_ORDERS[cylinders]]
    assert along == sorted(along)


@given(st.integers(1, 16).flatmap(lambda n: st.permutations(range(2, n + 1))))
def test_any_order_gives_its_own_sequence(rest):
    order = (1, *rest)
    offsets = firing_offsets(len(order), order=order)
    assert tuple(sorted(range(1, len(order) + 1), key=lambda k: offsets[k - 1])) == order


def test_uneven_offsets_are_taken_cylinder_by_cylinder():
    uneven = (0.0, math.radians(450))
    assert firing_offsets(2, offsets=uneven) == uneven
    assert firing_offsets(3, order=(1, 3, 2), offsets=(0, 9, 4)) == (0, 9, 4)


@pytest.mark.parametrize("cylinders", [0, -1, 2.0, True, "4"])
def test_number_of_cylinders_must_be_whole(cylinders):
    with pytest.raises(ModelError, match="number of cylinders is not acceptable") as caught:
        firing_offsets(cylinders)
    assert f"seen: {cylinders!r}" in str(caught.value)
    assert "allowed: a whole number, 1 or more; do: give cylinders=4" in str(caught.value)


def test_no_usual_order():
    with pytest.raises(
        ModelError, match=r"no usual firing order for this number of cylinders; seen: 7"
    ) as caught:
        firing_offsets(7)
    assert "do: give firing_order or firing_offsets" in str(caught.value)
    assert len(firing_offsets(7, offsets=[0, 1, 2, 3, 4, 5, 6])) == 7


@pytest.mark.parametrize("order", [(1, 3, 4), (1, 3, 3, 2), (3, 4, 2, 1), ()])
def test_order_must_fit(order):
    with pytest.raises(ModelError, match="firing order does not fit 4 cylinders") as caught:
        firing_offsets(4, order=order)
    assert f"seen: {order!r}" in str(caught.value)
    assert "allowed: each number from 1 to 4 once, beginning with 1" in str(caught.value)


@pytest.mark.parametrize("offsets", [(0.0,), (1.0, 2.0), (0.0, 450.0), (0.0, -1.0), (0.0, math.nan)])
def test_offsets_must_fit(offsets):
    with pytest.raises(ModelError, match="firing offsets do not fit 2 cylinders") as caught:
        firing_offsets(2, offsets=offsets)
    assert f"seen: {offsets!r}" in str(caught.value)
    assert "do: numpy.deg2rad turns degrees into rad" in str(caught.value)


def test_offsets_must_follow_a_given_order():
    with pytest.raises(ModelError, match=r"contradict the firing order; seen: order \(1, 2, 3\)") as caught:
        firing_offsets(3, order=(1, 2, 3), offsets=(0, 9, 4))
    assert "do: give the offsets cylinder by cylinder" in str(caught.value)


@pytest.mark.parametrize("given", [3, None, "1342", {1: 0}, (1, 3, 4, 2.0), (1, "3", 4, 2)])
def test_an_order_of_another_kind(given):
    if given is None:
        assert firing_offsets(4, order=None) == firing_offsets(4)
        return
    with pytest.raises(ModelError, match="the firing order"):
        firing_offsets(4, order=given)


@pytest.mark.parametrize("given", [3, "0123", (0, "1", 2, 3), (0, True, 2, 3)])
def test_offsets_of_another_kind(given):
    with pytest.raises(ModelError, match="the firing offsets"):
        firing_offsets(4, offsets=given)


@pytest.mark.parametrize("cylinders", [65, 10**400])
def test_more_cylinders_than_any_engine_has(cylinders):
    with pytest.raises(ModelError, match="the number of cylinders is not acceptable"):
        firing_offsets(cylinders)
