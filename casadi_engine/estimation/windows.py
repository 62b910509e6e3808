"""The fit over a horizon: windows of a record, each with an initial state of its own that is projected out.

A record is cut into short shooting intervals, which are integrated side by side whatever the horizon is. A window is a
run of them: their states follow from that at its start, to first order, and the gaps between them close step by step
(multiple shooting with condensing, Bock & Plitt 1984; its lifted form, Albersmeyer & Diehl 2010). The states at the
starts of the windows are projected out of every step (Golub & Pereyra 1973), so that only the parameters are left,
however many windows there are. A short horizon has few and wide valleys; one window of the whole record is the
simulation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.constraints import Priors
from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.estimation.starts import run_through
from casadi_engine.model import Model

Array = NDArray[np.float64]

# Weak spring on every state of a window, as a share of the largest slope in any of them, for changes in proportion to
# the states: it keeps those that nothing is known of.
_SPRING = 1e-6
# Share of the squared residuals that closing the gaps may change for the cost to count, and evaluations to come there.
_OPEN, _CLOSINGS = 0.1, 4
# What gaps may add to the squared residuals of a run, and evaluations to come there.
_NOTHING, _STEPS = 1e-4, 12
# Intervals of a window from which it is chained in blocks: fewer are as fast one by one.
_BLOCK = 16


@dataclass(frozen=True)
class Condensed:
    """A record's windows at one point: what their residuals follow, to first order, from the states at their starts.

    gaps : what closing the gaps changes the residuals by, as a share of these, squared
    slopes : (M, K, n + nz + 1) of the weighted residuals of M intervals by the window's start and the active
    parameters, and the residual itself with the gaps closed; chain : (M, n, n + nz + 1) of the intervals' starts
    change : (W, n, nz + 1) of the windows' starts that serve best, by the parameters and constant
    starts : (W,) number of each window's first interval; squares : (nz + 1, nz + 1) of all, the states projected out
    """

    slopes: Array
    chain: Array
    change: Array
    starts: NDArray[np.intp]
    squares: Array
    gaps: float

    def moved(self, nodes: Array, step: Array) -> Array:
        """The intervals' starts (M, n) after a step (nz,) of the active parameters, gaps closed to first order."""
        n = nodes.shape[1]
        own = self.change[:, :, :-1] @ step + self.change[:, :, -1]
        sizes = np.diff(np.append(self.starts, len(nodes)))
        each = np.repeat(own, sizes, axis=0)
        found = np.einsum("mij,mj->mi", self.chain[:, :, :n], each) + self.chain[:, :, n:-1] @ step
        return np.asarray(nodes + found + self.chain[:, :, -1])


def condense(record: RecordTerm, point: RecordPoint, nodes: Array, count: int) -> Condensed:
    """The windows of about ``count`` intervals each at a point."""
    m, n = record.plan.m, record.n
    windows = max(1, round(m / count))
    starts = np.floor(np.linspace(0, m, windows + 1)[:-1]).astype(np.intp)
    slopes, chain = _chained(record, point, nodes, starts)
    grams = np.add.reduceat(slopes.transpose(0, 2, 1) @ slopes, starts, axis=0)
    own = grams[:, :n, :n]
    own[:, range(n), range(n)] += _springs(own, nodes, of_effects(record.model))
    size = np.sqrt(np.einsum("wii->wi", own))
    scaled = own / (size[:, :, None] * size[:, None, :])
    mixed = grams[:, :n, n:] / size[:, :, None]
    inside = np.linalg.solve(scaled, mixed)
    squares = (grams[:, n:, n:] - mixed.transpose(0, 2, 1) @ inside).sum(axis=0)
    left, total = slopes[:, :, -1] - point.r.T, float(squares[-1, -1])
    gaps = float(np.sum(left**2)) / max(total, 1e-300)
    return Condensed(slopes, chain, -inside / size[:, :, None], starts, squares, gaps)


def _springs(own: Array, nodes: Array, added: list[int]) -> Array:
    """(W, n) of the springs on the states at the windows' starts, by the information (W, n, n) of them: a share of the
    largest of a state, each by how large that state is, whatever its unit. Where an effect's own state begins may do
    what something else does too, as the place of a spring and an offset: those (added) count by their scale, or they
    would go far away along a valley that has no end.

    nodes : (M, n)
    """
    size = sizes_of(nodes)
    size[added] = 1.0
    most = (np.einsum("wii->wi", own) * size**2).max(axis=1, keepdims=True)
    return np.asarray(_SPRING**2 * most / size**2 + 1e-300)


@lru_cache(maxsize=64)
def of_effects(model: Model) -> list[int]:
    """Numbers of the states that effects have brought with them."""
    stems = tuple(f"{one.at}_{one.effect.name}_" for one in model.effects)
    return [k for k, state in enumerate(model.states) if stems and state.name.startswith(stems)]


def sizes_of(nodes: Array) -> Array:
    """(n,) root mean squares of states (M, n); 1 of those that are zero."""
    size = np.sqrt(np.mean(np.square(nodes), axis=0))
    return np.where(np.isfinite(size) & (size > 0), size, 1.0)


def simulated(
    records: Sequence[RecordTerm], v: Array, nodes: Sequence[Array]
) -> tuple[list[Array], list[Array], list[RecordPoint]]:
    """One run of each record from its first state: weighted residuals (M, K), intervals' starts (M, n) and points.

    nodes : (M, n) near the run; the gaps between the intervals close step by step
    Raises FloatingPointError where they do not.
    """
    residuals, starts, points = [], [], []
    for record, at in zip(records, nodes, strict=True):
        for _ in range(_STEPS):
            point = record.evaluate(v, at)
            slopes, chain = _chained(record, point, at, np.zeros(1, np.intp))
            left = slopes[:, :, -1] - point.r.T
            if float(np.sum(left**2)) <= _NOTHING:
                break
            at = at + chain[:, :, -1]
        else:
            raise FloatingPointError("the gaps between the intervals do not close")
        residuals.append(slopes[:, :, -1])
        starts.append(at)
        points.append(point)
    return residuals, starts, points


def _chained(
    record: RecordTerm, point: RecordPoint, nodes: Array, starts: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Slopes of the residuals and of the intervals' starts; see ``Condensed``."""
    m, n, nz = record.plan.m, record.n, len(record.active)
    path, js = point.path, point.js
    steps = np.zeros((m, n, n + nz + 1))  # what an interval does to the start of the next one, and adds to it
    steps[:, :, :n] = path.end_s
    steps[:, :, n:-1] = path.end_z.transpose(2, 1, 0)
    steps[:-1, :, -1] = path.end.T[:-1] - nodes[1:]
    chain = chained(steps, starts)
    wide = js.transpose(1, 0, 2) if js.ndim == 3 else np.broadcast_to(js, (m, *js.shape))
    slopes = (wide * record.weight.T[:, :, None]) @ chain
    slopes[:, :, n:-1] += point.jz.transpose(2, 1, 0)
    slopes[:, :, -1] += point.r.T
    return slopes, chain


def chained(steps: Array, starts: NDArray[np.intp]) -> Array:
    """The start of each interval by that of its window: (m, n, n + p), of which the last p columns are what was added
    on the way.

    In blocks of as many intervals as there are blocks in the longest window: all blocks go on at once, and then one
    after the other takes up where the one before ended.

    steps : (m, n, n + p) of each interval; starts : (w,) first intervals of the windows
    """
    m, n, _ = steps.shape
    sizes = np.diff(np.append(starts, m))
    longest = int(sizes.max())
    if longest <= _BLOCK:
        return _one_by_one(steps, starts, sizes)
    length = math.isqrt(longest)
    counts = -(-sizes // length)  # blocks of each window
    first = np.cumsum(counts) - counts
    number = np.arange(int(counts.sum()))
    blocks = np.repeat(starts, counts) + length * (number - np.repeat(first, counts))
    lengths = np.diff(np.append(blocks, m))
    inside = _one_by_one(steps, blocks, lengths)
    last = blocks + lengths - 1
    whole = steps[last, :, :n] @ inside[last]
    whole[:, :, n:] += steps[last, :, n:]
    heads = np.repeat(_one_by_one(whole, first, counts), lengths, axis=0)
    chain = inside[:, :, :n] @ heads
    chain[:, :, n:] += inside[:, :, n:]
    return chain


def _one_by_one(steps: Array, starts: NDArray[np.intp], sizes: NDArray[np.intp]) -> Array:
    """See ``chained``; as many turns as the longest of the windows has intervals."""
    n = steps.shape[1]
    chain = np.zeros_like(steps)
    chain[starts, :, :n] = np.eye(n)
    for k in range(1, int(sizes.max())):
        at = starts[sizes > k] + k
        chain[at] = steps[at - 1, :, :n] @ chain[at - 1]
        chain[at, :, n:] += steps[at - 1, :, n:]
    return chain


@dataclass(frozen=True)
class Place:
    """A point of the search: parameters v (nv,), each record's intervals' starts (M, n), its windows, the squares."""

    v: Array
    nodes: tuple[Array, ...]
    records: tuple[Condensed, ...]
    squares: Squares

    @property
    def gaps(self) -> float:
        """By how much closing the gaps may change the cost: the square of what it does to first order."""
        return sum(own.gaps * float(own.squares[-1, -1]) for own in self.records)

    @property
    def open(self) -> float:
        """The largest share of a record's squared residuals that closing its gaps changes."""
        return max(own.gaps for own in self.records)


class Windows:
    """Least squares in the parameters alone, over one horizon; ``here`` is the best point so far.

    counts : intervals of a window of each record; nodes : (M, n) where the search for the states begins
    """

    def __init__(
        self,
        records: Sequence[RecordTerm],
        priors: Priors,
        counts: Sequence[int],
        nodes: Sequence[Array],
    ) -> None:
        self.records, self.priors, self.counts = list(records), priors, list(counts)
        self.here: Place | None = None
        self._nodes = tuple(nodes)
        self.evaluations = 0

    def __call__(self, v: Array) -> Squares | None:
        """The problem at v (nv,), or None where the model cannot be evaluated; states from the best point so far."""
        here = self.here
        if here is not None and np.array_equal(v, here.v):
            return here.squares
        nodes = self._nodes
        if here is not None:
            nodes = self._moved(here, v)
        found = self._at(v, nodes)
        if found is not None and found.open >= _OPEN:
            # with its gaps closed one in forty of these is none to refuse: a shorter step is asked for
            if here is not None and found.squares.cost >= here.squares.cost:
                return found.squares
            found = self._joined(found)
        if found is None:
            return None
        if here is None or found.squares.cost < here.squares.cost:
            self.here = found
        return found.squares

    @property
    def best(self) -> Place:
        """The best point so far."""
        assert self.here is not None  # a search has begun
        return self.here

    @property
    def gaps(self) -> float:
        """By how much closing the gaps at the best point may change the cost."""
        return self.best.gaps

    def closed(self) -> float:
        """Close the gaps at the best point by one more evaluation there, or by a run; how much the cost has changed."""
        here = self.best
        found = self._at(here.v, self._moved(here, here.v))
        if found is None or (found.open >= _OPEN and found.gaps >= here.gaps):
            found = self._run(here)
        if found is None:
            return np.inf
        self.here = found
        return abs(found.squares.cost - here.squares.cost)

    def closed_at(self, v: Array, most: float) -> Squares | None:
        """The squares at the best point with its gaps closed, where that is v and its gaps are larger than ``most``."""
        if not np.array_equal(v, self.best.v) or self.gaps <= most or not np.isfinite(self.closed()):
            return None
        return self.best.squares

    def _joined(self, begun: Place) -> Place:
        """The same parameters with the gaps closed, by steps as long as these close them: where corners bound the
        states they may lead far away from a run that is close by."""
        found = begun
        for _ in range(_CLOSINGS):
            there = self._at(found.v, self._moved(found, found.v))
            if there is None or there.gaps >= found.gaps:
                break
            found = there
            if found.open < _OPEN:
                return found
        run = self._run(begun)
        return found if run is None else min(run, found, key=lambda one: one.squares.cost + one.gaps)

    def _run(self, here: Place) -> Place | None:
        """The same parameters where every window is a run from its first state; None where there is none."""
        try:
            nodes = tuple(
                run_through(record, here.v, at, own.starts)
                for record, at, own in zip(self.records, here.nodes, here.records, strict=True)
            )
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return None
        return self._at(here.v, nodes) if all(np.isfinite(at).all() for at in nodes) else None

    def _moved(self, here: Place, v: Array) -> tuple[Array, ...]:
        """The intervals' starts at v from a point near by, with the states that serve best there."""
        step = v - here.v
        return tuple(
            own.moved(at, step[record.active])
            for record, own, at in zip(self.records, here.records, here.nodes, strict=True)
        )

    def _at(self, v: Array, nodes: tuple[Array, ...]) -> Place | None:
        self.evaluations += 1
        size = len(v)
        cost, gradient, _, matrix = self.priors.evaluate(v)
        gradient, matrix, condensed = gradient.copy(), matrix.copy(), []
        for record, at, count in zip(self.records, nodes, self.counts, strict=True):
            try:
                point = record.evaluate(v, at)
                own = condense(record, point, at, count)
            except (FloatingPointError, np.linalg.LinAlgError, ModelError):
                return None
            active, squares = record.active, own.squares
            cost += 0.5 * float(squares[-1, -1])
            gradient[active] += squares[:-1, -1]
            matrix[np.ix_(active, active)] += squares[:-1, :-1]
            condensed.append(own)
        if not (np.isfinite(cost) and np.isfinite(gradient).all() and np.isfinite(matrix).all()):
            return None
        return Place(
            np.array(v), nodes, tuple(condensed), Squares(cost, gradient, matrix.reshape(size, size))
        )
