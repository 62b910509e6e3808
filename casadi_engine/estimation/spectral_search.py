"""The search for a linear model's parameters in the band of frequencies in which they act.

A band that holds most of the parameters' Fisher information is searched first; where that ends, all bins are looked
at once, and those above the band enter by their quadratic there while the search goes on to its end. What is found
so is the start of the fit on all samples, whose own steps then have next to nothing left to do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Evaluate, Minimum, Squares, minimise
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.spectral import LONG, Response, SpectralRecord

Array = NDArray[np.float64]
Priors = Callable[[Array], tuple[float, Array, Array, Array]]

# Share of the information in any direction of the parameters that bins above the band may hold.
LEFT_OUT = 0.05
# Bands that are compared, from one to the next; the lowest has this share of the bins.
_STEP, _LOWEST = 2**0.5, 1 / 128
# A direction with less information than this share of an entry's own is not determined: rounding.
_BLIND = 1e-12
# Fall of half chi-squared that ends the search, and that which ends it on the band alone; bands tried.
_FALL, _COARSE, _BANDS = 1e-5, 1e-2, 4
# Looks at all bins, and the move in squared standard errors after which another is taken.
_ROUNDS, _MOVED = 3, 0.1
# Damping where the search goes on with all bins: it is close to the optimum.
_NEAR = 1e-5


@dataclass(frozen=True)
class Found:
    """Where a search in the band ended.

    minimum : v (nv,), with the band's squares and those above it by their quadratic; information : (nv, nv) of all bins
    hertz, kept, bins : the band, its number of bins and that of all; share : of the information above it
    """

    minimum: Minimum
    information: Array
    hertz: float
    kept: int
    bins: int
    share: float

    def __str__(self) -> str:
        if self.kept == self.bins:
            return f"all {self.bins} frequency bins"
        return (
            f"{self.kept} of {self.bins} frequency bins, up to {self.hertz:.4g} Hz; the others by their quadratic "
            f"({100 * self.share:.2g} % of the information)"
        )


class SpectralSearch:
    """Minimises half the summed squares of all records, and priors, over v (nv,) within bounds."""

    def __init__(
        self,
        records: list[RecordTerm],
        priors: Priors,
        low: Array,
        high: Array,
        longest: Callable[[Array], Array],
    ) -> None:
        """longest : (nv,) longest change of each unknown in one step from v."""
        self._records = [SpectralRecord(record) for record in records]
        self._priors = priors
        self._limits: dict[str, Any] = {"low": low, "high": high, "longest": longest}
        self._hertz: float | None = None  # of the band
        self._above = 0.0  # cost above it at the first start
        self._first: tuple[Array, Array, Array] | None = None  # products at the point that was asked for last

    def weigh(self, sigma: Array) -> None:
        """Divide the outputs by these standard deviations (ny,)."""
        for record in self._records:
            if not np.array_equal(record.sigma, sigma):
                record.sigma, self._first = sigma, None

    def release(self) -> None:
        """Give back the memory of long records' spectra until they are asked for again."""
        for record in self._records:
            record.release()

    def squares(self, v: Array, hertz: float = np.inf) -> Squares | None:
        """The problem at v on the bins below a frequency; None where the model cannot be evaluated."""
        cost, gradient, _, matrix = self._priors(v)
        gradient, matrix = gradient.copy(), matrix.copy()
        common: dict[tuple[int, int, int], Response] = {}
        with np.errstate(all="ignore"):
            for record in self._records:
                try:
                    gram = _gram(record, v, record.below(hertz), common)
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
                own = record.record.active
                cost += 0.5 * float(gram[0, 0])
                gradient[own] += gram[1:, 0]
                matrix[np.ix_(own, own)] += gram[1:, 1:]
        return Squares(cost, gradient, matrix) if np.isfinite(cost) and np.isfinite(matrix).all() else None

    def whole(self, v: Array) -> Array | None:
        """Products (1 + nv, 1 + nv) of residual and Jacobian in all bins; None where the model cannot be evaluated."""
        with np.errstate(all="ignore"):
            try:
                found = self._ladder(v)[1][-1]
            except (FloatingPointError, np.linalg.LinAlgError):
                return None
        return found if np.isfinite(found).all() else None

    def _ladder(self, v: Array) -> tuple[Array, Array]:
        """Frequencies (e,), each a band's, and the products in the bins below them at v."""
        if self._first is None or not np.array_equal(self._first[0], v):
            top = max(record.hertz[-1] for record in self._records)
            edges = top * _STEP ** np.arange(np.ceil(np.log(_LOWEST) / np.log(_STEP)), 1)
            edges[-1] = np.inf
            self._first = (v.copy(), edges, self.grams(v, edges))
        return self._first[1:]

    def grams(self, v: Array, edges: Array) -> Array:
        """Products (e, 1 + nv, 1 + nv) of residual and Jacobian in the bins below each of the edges, and of priors."""
        cost, gradient, _, matrix = self._priors(v)
        priors = np.block([[2 * cost, gradient], [gradient[:, None], matrix]])
        found = np.repeat(priors[None], len(edges), axis=0)
        common: dict[tuple[int, int, int], Response] = {}
        for record in self._records:
            if record.size > LONG:
                entries = np.append(0, 1 + record.record.active)
                stops = [record.below(edge).stop for edge in edges]
                parts = dict(zip(sorted(set(stops)), record.gram(v, sorted(set(stops))), strict=True))
                for e, stop in enumerate(stops):
                    found[e][np.ix_(entries, entries)] += parts[stop]
                continue
            columns, free = record.columns(v, record.below(np.inf), common)
            rows = np.concatenate([free, columns])
            rows = rows.reshape(len(rows), len(record.sigma), -1)
            entries = np.append(0, 1 + record.record.active)
            own = np.ix_(entries, entries)
            total, at, r = np.zeros((len(rows), len(rows))), 0, len(free)
            for e, edge in enumerate(edges):
                stop = 2 * record.below(edge).stop
                part = np.ascontiguousarray(rows[..., at:stop]).reshape(len(rows), -1)
                total += part @ part.T
                at = max(at, stop)
                spring = total[:r, :r] + _BLIND * np.eye(r)
                found[e][own] += total[r:, r:] - total[r:, :r] @ np.linalg.solve(spring, total[:r, r:])
        return found

    def band(self, v: Array) -> float:
        """The lowest frequency above which bins hold little of the information at v."""
        edges, grams = self._ladder(v)
        if not np.diag(grams[-1])[1:].all():
            raise FloatingPointError("a parameter has no slope here")
        shares = [largest_share(grams[-1, 1:, 1:], part[1:, 1:]) for part in grams]
        chosen = int(np.argmax(np.array(shares) <= LEFT_OUT))
        self._above = 0.5 * float(grams[-1, 0, 0] - grams[chosen, 0, 0])
        return float(edges[chosen])

    def run(self, v: Array, *, steps: int, stop: Callable[[float], bool]) -> Found | None:
        """The optimum that a search from v leads to, or None where there is nothing to evaluate.

        stop : sees the cost before every step, that above the band as it was at first; True ends the search
        """
        with np.errstate(all="ignore"):
            try:
                hertz = self.band(v) if self._hertz is None else self._hertz
            except (FloatingPointError, np.linalg.LinAlgError):
                return None
        done = 0
        for tried in range(_BANDS):
            found = self._in_band(v, hertz, max(steps - done, 1), _from_the_second(stop) if tried else stop)
            if found is None:
                return None
            done += found.minimum.steps
            found = replace(found, minimum=replace(found.minimum, steps=done))
            if not found.minimum.converged or found.share <= 2 * LEFT_OUT:
                break
            v, hertz = found.minimum.x, 2 * hertz
        self._hertz = hertz
        return found

    def _in_band(self, v: Array, hertz: float, steps: int, stop: Callable[[float], bool]) -> Found | None:
        known: list[tuple[Array, Squares | None]] = []

        def below(at: Array) -> Squares | None:
            if not known or not np.array_equal(known[0][0], at):
                known[:] = [(at, self.squares(at, hertz))]
            return known[0][1]

        kept, bins = sum(r.below(hertz).stop for r in self._records), sum(r.size for r in self._records)
        first = minimise(
            below, v, fall=_COARSE if kept < bins else _FALL, steps=steps,
            stop=lambda cost: stop(cost + self._above), **self._limits,
        )  # fmt: skip
        if first is None:
            return None
        if not first.converged or kept == bins:
            return Found(first, first.squares.matrix, hertz, kept, bins, 0.0)
        last, left, found = first, steps - first.steps, None
        for _ in range(_ROUNDS):
            whole, part, at = self.squares(last.x), below(last.x), last.x
            if whole is None or part is None:
                return None
            goal = _with_rest(below, _difference(whole, part), at)
            near = minimise(
                goal, at, fall=_FALL, steps=max(left, 1), damping=_NEAR,
                stop=_from_the_second(stop), **self._limits,
            )  # fmt: skip
            if near is None:
                return None
            left -= near.steps
            last = Minimum(near.x, near.squares, steps - left, near.converged)
            share = largest_share(whole.matrix, part.matrix)
            found = Found(last, whole.matrix, hertz, kept, bins, share)
            moved = near.x - at
            if not near.converged or moved @ whole.matrix @ moved < _MOVED:
                break
        return found


def _gram(
    record: SpectralRecord, v: Array, part: slice, common: dict[tuple[int, int, int], Response]
) -> Array:
    """Products (1 + na, 1 + na) of residual and Jacobian in some bins."""
    if part.stop > LONG:
        return np.asarray(record.gram(v, [part.stop])[0])
    columns, _ = record.columns(v, part, common)
    return np.asarray(columns @ columns.T)


def _from_the_second(stop: Callable[[float], bool]) -> Callable[[float], bool]:
    """The same, but for the point at which a search goes on, which was seen before."""
    seen: list[float] = []

    def later(cost: float) -> bool:
        seen.append(cost)
        return len(seen) > 1 and stop(cost)

    return later


def largest_share(whole: Array, part: Array) -> float:
    """The largest share of the information ``whole`` (n, n) in a direction that ``part`` of it lacks."""
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values, vectors = np.linalg.eigh(whole / np.outer(size, size))
    known = values > _BLIND
    turn = vectors[:, known] / np.sqrt(values[known]) / size[:, None]
    return float(np.linalg.eigvalsh(turn.T @ (whole - part) @ turn).max(initial=0.0))


def _difference(one: Squares, other: Squares) -> Squares:
    return Squares(one.cost - other.cost, one.gradient - other.gradient, one.matrix - other.matrix)


def _with_rest(below: Evaluate, rest: Squares, at: Array) -> Evaluate:
    """The problem on a band, and that above it by its quadratic about a point."""

    def goal(x: Array) -> Squares | None:
        found, moved = below(x), x - at
        if found is None:
            return None
        bent = rest.matrix @ moved
        cost = found.cost + rest.cost + float(rest.gradient @ moved + 0.5 * moved @ bent)
        return Squares(cost, found.gradient + rest.gradient + bent, found.matrix + rest.matrix)

    return goal
