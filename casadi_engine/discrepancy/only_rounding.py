"""Effects that were added to what rounded corners of others leave.

A law with corners is rounded in a fit, as wide as the motion allows. Where the data feel how wide, what the rounding
leaves looks like a further law of the same signal. Such a one gains no more than sharper corners of the others would.
"""

from __future__ import annotations

from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.station import Station
from casadi_engine.discrepancy.tried import key_of
from casadi_engine.estimation.corner_widths import FELT


def without_what_rounding_leaves(refits: Refits, way: tuple[Station, ...]) -> tuple[Station, ...]:
    """The way to a structure without the last effects that gain less than sharper corners of the others may change."""
    while len(way) > 2:
        fewer, every = (refits.pool.get(key_of(one.effects)) for one in way[-2:])
        if fewer is None or every is None or not refits.path.cornered(fewer.effects):
            break
        felt = refits.path.felt_along(fewer.effects, fewer.arrived)
        if not felt > max(FELT, fewer.arrived.cost - every.arrived.cost):
            break
        way = way[:-1]
    return way
