"""Effects at one port that work against each other: each does far more by itself than they do together.

What moves an output by many times its own variation, and is taken back by another effect at the same port, is seen in
what is left of the two alone: a difference of two laws bends to many a curve that neither of them is. A small
difference of large numbers is no finding of these numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, inverse
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.refit import Addition

# Share of what the largest of them does by itself below which effects together do next to nothing of it.
_LEFT = 0.1


def work_against_each_other(null: NullModel, effects: Sequence[Addition]) -> bool:
    """True if some of the effects of a structure, at one port, together move the outputs by far less than one of them
    does; null : the structure, linearised where its refit ended."""
    return left_together(null, effects) < _LEFT


def left_together(null: NullModel, effects: Sequence[Addition]) -> float:
    """The least share of what one effect does by itself that some effects at its port do together, 1 at most."""
    least = 1.0
    ports = {one.candidate.port for one in effects}
    for port in ports if len(effects) > len(ports) else ():
        moved = [_moved(null, one) for one in effects if one.candidate.port == port]
        size = [float(np.linalg.norm(own)) for own in moved]
        for count in range(2, len(moved) + 1):
            for some in combinations(range(len(moved)), count):
                most = max(size[k] for k in some)
                together = float(np.linalg.norm(sum(moved[k] for k in some)))
                least = min(least, together / most) if most > 0 else least
    return least


def _moved(null: NullModel, one: Addition) -> Array:
    """What an effect moves all outputs by, in their own variations."""
    own = [k for k, name in enumerate(null.parameters) if name.partition("@")[0] == one.amplitude]
    along = inverse(null.turn)[:, own] @ null.values[own]
    parts = []
    for record in null.records:
        for output, slopes in record.slopes.items():
            varied = float(np.std(record.path.grid.measured[output].values))
            parts.append(slopes[:, : len(along)] @ along / max(varied, 1e-300))
    return np.concatenate(parts)
