"""Sensors behind a filter that the library lacks: of a higher order than a lag, or a lag behind a delay.

A lag with more than all of its signal stands for such a filter, and for a delay, which has one number fewer and wins by
that where it is the truth. Where it is far more probable than the delay or lag that was named, the sensor has dynamics
of its own that no effect of the library is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.exchanged_units import LAG
from casadi_engine.discrepancy.repaired import FoundEffect, Unknown
from casadi_engine.discrepancy.tried import Key, Tried

_OWN = ("sensor_delay", LAG)
# Logarithm of the largest odds that are told.
_MOST = 50.0


def behind_a_filter(
    found: Sequence[FoundEffect], key: Key, pool: Mapping[Key, Tried], filters: Mapping[Key, Tried]
) -> Unknown | None:
    """What to say of a sensor whose delay or lag is far less probable than a lag that none has; None elsewhere.

    key : of the structure that was found; pool, filters : structures, and those with such lags
    """
    for one in found:
        if one.name not in _OWN or key not in pool:
            continue
        others = frozenset(member for member in key if member[1] != one.at or member[0] not in _OWN)
        other = filters.get(others | {(LAG, one.at)})
        if other is None or other.log < pool[key].log + math.log(FACTOR):
            continue
        odds = math.exp(min(other.log - pool[key].log, _MOST))
        words = f"{one.at} answers with dynamics of its own that the library lacks, as behind a filter of higher order"
        return Unknown(words, {}, one.at, odds=odds)
    return None
