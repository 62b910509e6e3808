"""Round numbers for an axis, and their words."""

from __future__ import annotations

import math

from casadi_engine.report.sketch import Limits


def ticks(limits: Limits, scale: str = "linear", *, most: int = 8, threshold: float = 1.0) -> list[float]:
    """Round numbers between two limits, the lower one first.

    >>> ticks((0.0, 0.83), most=5)
    [0.0, 0.2, 0.4, 0.6, 0.8]
    >>> ticks((0.5, 3e3), "log"), ticks((0.5, 30), "log")
    ([1.0, 10.0, 100.0, 1000.0], [0.5, 1.0, 2.0, 5.0, 10.0, 20.0])
    >>> ticks((0, 5e3), "symlog")
    [0.0, 1.0, 10.0, 100.0, 1000.0]
    """
    low, high = limits
    if scale == "linear":
        return _even(low, high, most)
    if scale == "symlog":
        ends = max(abs(low), abs(high)) / threshold
        decades = [threshold * 10.0**k for k in range(0, max(1, math.floor(math.log10(max(ends, 1))) + 1))]
        places = sorted({0.0, *decades, *(-one for one in decades)})
    else:
        first, last = math.ceil(math.log10(low)), math.floor(math.log10(high))
        every = max(1, -(-(last - first + 1) // most))
        parts = (1, 2, 5) if 3 * (math.log10(high) - math.log10(low)) <= most else (1,)
        places = [part * 10.0**k for k in range(first - every, last + 1, every) for part in parts]
    return [place for place in places if low <= place <= high]


def _even(low: float, high: float, most: int) -> list[float]:
    rough = (high - low) / max(most, 1)
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(part * unit for part in (1, 2, 5, 10) if part * unit >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    # Division by a whole number where there is one: 3 * 0.1 would not be 0.3.
    return [k / round(1 / step) if step < 1 else k * step for k in range(first, last + 1)]


def tick_words(places: list[float]) -> list[str]:
    """The numbers in as few digits as tell them apart.

    >>> tick_words([0.0, 0.2, 1.0]), tick_words([1e-7, 1e-6]), tick_words([124.5, 125.0])
    (['0', '0.2', '1'], ['1e-07', '1e-06'], ['124.5', '125'])
    """
    return [f"{place:.10g}" for place in places]
