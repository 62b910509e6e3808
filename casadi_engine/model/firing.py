"""Firing order and firing offsets of a four-stroke engine (one cycle is 4π rad of crank angle)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from types import MappingProxyType
from typing import Any

from casadi_engine.errors import ModelError

CYCLE = 4 * math.pi

# Above that it is a slip of the pen, and the model would take minutes to write down.
_MOST_CYLINDERS = 64

# The orders in common use; any other is given by the user.
USUAL_ORDERS: Mapping[int, tuple[int, ...]] = MappingProxyType(
    {
        1: (1,),
        2: (1, 2),
        3: (1, 3, 2),
        4: (1, 3, 4, 2),
        5: (1, 2, 4, 5, 3),
        6: (1, 5, 3, 6, 2, 4),
        8: (1, 8, 4, 3, 6, 5, 7, 2),
        10: (1, 10, 9, 4, 3, 6, 5, 8, 7, 2),
        12: (1, 7, 5, 11, 3, 9, 6, 12, 2, 8, 4, 10),
    }
)


def check_cylinders(cylinders: object, least: int = 1) -> None:
    """Raise ModelError unless `cylinders` is a whole number from `least` up to what an engine has."""
    if (
        not isinstance(cylinders, Integral)
        or isinstance(cylinders, bool)
        or not least <= int(cylinders) <= _MOST_CYLINDERS
    ):
        raise ModelError(
            "the number of cylinders is not acceptable",
            seen=repr(cylinders),
            allowed=f"a whole number, {least} or more"
            if least == 1
            else "0 for a torque channel, or 1 or more",
            cure="give cylinders=4, for instance",
        )


def as_tuple(given: object, what: str) -> tuple[Any, ...]:
    """The elements of a sequence that is no text, or ModelError."""
    if isinstance(given, Iterable) and not isinstance(given, (str, bytes, Mapping)):
        return tuple(given)
    raise ModelError(
        f"{what} is not a sequence",
        seen=repr(given),
        allowed="a tuple or list of numbers",
        cure="leave it out",
    )


def firing_offsets(
    cylinders: int,
    *,
    order: Sequence[int] | None = None,
    offsets: Sequence[float] | None = None,
) -> tuple[float, ...]:
    """Return the crank angle of each cylinder's combustion TDC within the cycle [rad], cylinder 1 first.

    cylinders : number of cylinders, 1 or more
    order : the cylinders in the order in which they fire, from cylinder 1; default the usual one. They fire
        evenly, 4π/cylinders apart.
    offsets : (cylinders,) rad, cylinder by cylinder, for uneven firing: 0 for cylinder 1, each in [0, 4π).
        Given an `order` as well, the two must agree.

    Raises ModelError if these do not fit together.

    >>> [round(angle / math.pi, 3) for angle in firing_offsets(4, order=(1, 3, 4, 2))]
    [0.0, 3.0, 1.0, 2.0]
    """
    check_cylinders(cylinders)
    number = int(cylinders)
    checked = None if order is None else _checked_order(number, order)
    if offsets is not None:
        return _checked_offsets(number, checked, offsets)
    along = checked or _usual(number)
    return tuple(CYCLE * along.index(which) / number for which in range(1, number + 1))


def _usual(cylinders: int) -> tuple[int, ...]:
    if cylinders not in USUAL_ORDERS:
        raise ModelError(
            "there is no usual firing order for this number of cylinders",
            seen=cylinders,
            allowed=f"without an order: {', '.join(map(str, USUAL_ORDERS))}",
            cure="give firing_order or firing_offsets",
        )
    return USUAL_ORDERS[cylinders]


def _checked_order(cylinders: int, order: Sequence[int]) -> tuple[int, ...]:
    given = as_tuple(order, "the firing order")
    whole = all(isinstance(number, Integral) and not isinstance(number, bool) for number in given)
    if not whole or given[:1] != (1,) or sorted(given) != list(range(1, cylinders + 1)):
        raise ModelError(
            f"the firing order does not fit {cylinders} cylinders",
            seen=repr(given),
            allowed=f"each number from 1 to {cylinders} once, beginning with 1",
            cure="turn the order round until it begins with cylinder 1",
        )
    return given


def _checked_offsets(
    cylinders: int, order: tuple[int, ...] | None, offsets: Sequence[float]
) -> tuple[float, ...]:
    given = as_tuple(offsets, "the firing offsets")
    given = tuple(float(o) if isinstance(o, Real) and not isinstance(o, bool) else math.nan for o in given)
    good = len(given) == cylinders and all(0 <= offset < CYCLE for offset in given) and given[0] == 0
    if not good:
        raise ModelError(
            f"the firing offsets do not fit {cylinders} cylinders",
            seen=repr(given),
            allowed=f"{cylinders} angles in rad, from 0 up to but without 4π, the first one 0",
            cure="numpy.deg2rad turns degrees into rad; measure from cylinder 1's combustion TDC",
        )
    if order is not None:
        along = [given[number - 1] for number in order]
        if along != sorted(along):
            raise ModelError(
                "the firing offsets contradict the firing order",
                seen=f"order {order}, offsets along it {tuple(round(angle, 4) for angle in along)} rad",
                allowed="offsets that rise along the order",
                cure="give the offsets cylinder by cylinder (1, 2, 3 …), or leave firing_order out",
            )
    return given
