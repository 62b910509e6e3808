"""Sums of squares of a search in the frequency domain: differences, shares, and what a step foretells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Evaluate, Minimum, Squares

Array = NDArray[np.float64]

# A direction with less information than this share of an entry's own is not determined: rounding.
BLIND = 1e-12


def scaled(minimum: Minimum, share: float) -> Minimum:
    one = minimum.squares
    squares = Squares(share * one.cost, share * one.gradient, share * one.matrix)
    return replace(minimum, squares=squares)


def foretold(squares: Squares) -> Squares:
    """The squares with the cost to which one Gauss-Newton step would lower them."""
    step = np.linalg.lstsq(squares.matrix, squares.gradient, rcond=BLIND)[0]
    return replace(squares, cost=squares.cost - 0.5 * float(squares.gradient @ step))


class Told:
    """``stop``, which is asked once about a point at which one search ends and the next one begins."""

    def __init__(self, stop: Callable[[float], bool]) -> None:
        self._stop, self._same, self._ended = stop, False, False

    def __call__(self, cost: float) -> bool:
        if not self._same:
            self._ended = self._stop(cost)
        self._same = False
        return self._ended

    def again(self) -> None:
        """The next point is the last one."""
        self._same = True


def largest_share(whole: Array, part: Array) -> float:
    """The largest share of the information ``whole`` (n, n) in a direction that ``part`` of it lacks."""
    if not np.isfinite(whole).all():  # nothing is known there
        return 1.0
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values, vectors = np.linalg.eigh(whole / size / size[:, None])
    known = values > BLIND
    turn = vectors[:, known] / np.sqrt(values[known]) / size[:, None]
    return float(np.linalg.eigvalsh(turn.T @ (whole - part) @ turn).max(initial=0.0))


def difference(one: Squares, other: Squares) -> Squares:
    return Squares(one.cost - other.cost, one.gradient - other.gradient, one.matrix - other.matrix)


def with_rest(below: Evaluate, rest: Squares, at: Array) -> Evaluate:
    """The problem on a band, and that above it by its quadratic about a point."""

    def goal(x: Array) -> Squares | None:
        found, moved = below(x), x - at
        if found is None:
            return None
        bent = rest.matrix @ moved
        cost = found.cost + rest.cost + float(rest.gradient @ moved + 0.5 * moved @ bent)
        return Squares(cost, found.gradient + rest.gradient + bent, found.matrix + rest.matrix)

    return goal
