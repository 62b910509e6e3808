"""Constraints that no values within the bounds meet, found when a search has not ended at an optimum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.constraints import ParameterConstraints

Array = NDArray[np.float64]

# A violation, in units of the constraint's magnitude, that counts as one; evaluations of the search for the least.
_VIOLATED, _MOST = 1e-6, 200


def unreachable(
    constraints: ParameterConstraints, starts: Sequence[Array], low: Array, high: Array
) -> list[str]:
    """In words, the constraints that cannot be met within the bounds on v, as far as searches from ``starts`` tell.

    Each search lowers the summed squares of all violations; what is left of the least is what the constraints, taken
    together, cannot avoid. Empty if they can be met.
    """
    if not constraints.count:
        return []
    best: tuple[float, Array] | None = None
    for start in starts:
        found = _least(constraints, np.clip(start, low, high), low, high)
        if found is not None and (best is None or found[0] < best[0]):
            best = found
        if best is not None and best[0] == 0.0:
            return []
    return [] if best is None else _words(constraints, best[1])


def _least(
    constraints: ParameterConstraints, v: Array, low: Array, high: Array
) -> tuple[float, Array] | None:
    """The least summed squares of the violations that a search from v finds, and the values (nc,) there."""
    from scipy.optimize import least_squares

    open_ = low < high

    def whole(part: Array) -> Array:
        full = v.copy()
        full[open_] = part
        return full

    def violation(part: Array) -> Array:
        value = constraints.evaluate(whole(part))[0]
        return np.maximum(constraints.lower - value, 0.0) - np.maximum(value - constraints.upper, 0.0)

    def slope(part: Array) -> Array:
        value, jacobian = constraints.evaluate(whole(part))
        wrong = (value < constraints.lower) | (value > constraints.upper)
        return np.where(wrong[:, None], -jacobian[:, open_], 0.0)

    try:
        if not open_.any() or not violation(v[open_]).any():
            value = constraints.evaluate(v)[0]
            return float(np.square(violation(v[open_])).sum()), value
        # a start on a bound has no room to move: least_squares wants it inside
        inside = np.clip(v[open_], np.nextafter(low[open_], np.inf), np.nextafter(high[open_], -np.inf))
        found = least_squares(
            violation, inside, slope, (low[open_], high[open_]), x_scale="jac", max_nfev=_MOST
        )
        value = constraints.evaluate(whole(found.x))[0]
    except (
        FloatingPointError,
        np.linalg.LinAlgError,
        ModelError,
        ValueError,
    ):  # no such mode, or no number, there
        return None
    left = violation(found.x)
    return float(np.square(left[np.abs(left) > _VIOLATED]).sum()), value


def _words(constraints: ParameterConstraints, value: Array) -> list[str]:
    words = []
    for k, label in enumerate(constraints.labels):
        for limit, gap, side in (
            (constraints.lower[k], constraints.lower[k] - value[k], "at least"),
            (constraints.upper[k], value[k] - constraints.upper[k], "at most"),
        ):
            if gap > _VIOLATED:
                size = constraints.scale[k]
                words.append(
                    f"{label} (the closest is {value[k] * size:.5g}, wanted {side} {limit * size:.5g})"
                )
    return words
