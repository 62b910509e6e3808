"""Laws whose corners are rounded themselves: contacts that give way before they slide, valves that open over a range.

Corners are sharpened as long as the data feel it. Where sharper ones leave more, the width is a number of the law: it
is sought where chi-squared is least, and what it may be off by counts in the errors of all other numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from casadi_engine.discrepancy.arrived import Arrived

# Refit with another share of the motion's widths, from where one arrived; None where it fails.
Refitted = Callable[[float, Arrived], Arrived | None]

# Looks to both sides at most, each of two refits; by how much a next one may still better chi-squared, in units of what
# a sample leaves.
_LOOKS, _ENOUGH = 6, 0.25


def best_width(
    refitted: Refitted, share: float, there: Arrived, unit: float, most: float
) -> tuple[float, Arrived]:
    """The share of widths, no more than ``most``, at which a refit leaves least, and where it arrived.

    share, there : one that leaves less than a fourth of it does; unit : chi-squared that a sample leaves
    """
    step = 1.0
    for _ in range(_LOOKS):
        near = {side: _settled(refitted, min(share * 2 ** (side * step), most), there) for side in (-1, 1)}
        costs = {side: math.inf if one is None else one.cost for side, one in near.items()}
        side = min(costs, key=costs.__getitem__)
        better = near[side]
        if better is not None and better.cost < there.cost:
            share, there = min(share * 2 ** (side * step), most), better
            continue
        bend = 0.5 * (costs[-1] + costs[1]) - there.cost
        if not math.isfinite(bend) or bend <= 0:
            break
        vertex = step * (costs[-1] - costs[1]) / (4 * bend)
        if bend * (vertex / step) ** 2 < _ENOUGH * unit:
            break
        at = min(share * 2**vertex, most)
        better = _settled(refitted, at, there)
        if better is not None and better.cost < there.cost:
            share, there = at, better
        step /= 2
    return share, there


def moved_by_width(refitted: Refitted, share: float, there: Arrived, unit: float) -> dict[str, float]:
    """Parameter -> what it moves by with a width that is off by its standard error; {} where that cannot be told."""
    ends = [_settled(refitted, share * factor, there) for factor in (0.5, 2.0)]
    sharp, wide = ends
    if sharp is None or wide is None:
        return {}
    bend = 0.5 * (sharp.cost + wide.cost) - there.cost
    if bend <= 0:
        return {}
    error = min(math.sqrt(unit / bend), 1.0)  # of the width's logarithm to the base 2
    return {
        name: 0.5 * error * abs(wide.values[name] - value)
        for name, value in sharp.values.items()
        if name in wide.values
    }


def _settled(refitted: Refitted, share: float, there: Arrived) -> Arrived | None:
    found = refitted(share, there)
    return found if found is not None and found.settled else None
