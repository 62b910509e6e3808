"""Starts from far away: predictions over short pieces first, then over longer ones, then the simulation.

A simulation with wrong parameters loses the measurement's phase within a few periods, and its cost then has many
valleys. Over a piece of the record whose initial state is free, the model predicts but a short way ahead: wrong
parameters still show there, and the valleys are few and wide. So the parameters are fitted to many short pieces at
once, each with a state of its own, from several starts; the best goes on to pieces four times as long, and so on up to
the whole record (prediction error first and then simulation error: Retzler, Swevers, Gillis et al. 2022; the states are
projected out of every step as by Golub & Pereyra 1973).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.levenberg_marquardt import Squares, minimise
from casadi_engine.estimation.options import interval_length
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.estimation.windows import sizes_of
from casadi_engine.simulation.propagator import steps_kept

Array = NDArray[np.float64]

# Starts that are looked at beside the given one, within a factor of it, and how many of them are followed.
SCREENED, REACH, FOLLOWED = 63, 20.0, 9
# Steps of a start that is followed, and of the best one for each length; fall that ends them.
_STEPS, _MORE, _FALL = 25, 40, 1e-4
# Share of the cost where a search began from which it goes on with what a fall is there.
_LOWER = 0.5
# Growth of a piece from one length to the next; a piece has at least so many samples for each state.
_GROWTH, _LEAST = 4, 4
# Longest step of a logarithm, or of a number in units of its size.
_LONGEST = 1.5
# Integration steps of a candidate, in multiples of those at the start: one whose motions are so much faster than the
# start's is not looked at.
_SLOWER = 4
# Share of the largest slope in a state below which nothing is known of the state.
_FLAT = 1e-6


@dataclass(frozen=True)
class Projected:
    """The parameters' problem with the pieces' states at their best: half the summed squares, gradient (nv,) and
    Gauss-Newton matrix (nv, nv); and the states' change (1+nv, M, n) of each record: constant, and for each parameter.
    """

    cost: float
    gradient: Array
    matrix: Array
    nodes: tuple[Array, ...]


class Pieces:
    """Records cut into pieces of one length, each with an initial state of its own; only bounds hold the parameters.

    records : of a fit; lengths : samples, for each; starts : (M, n) states of a record's pieces where the search begins
    """

    def __init__(
        self,
        records: Sequence[RecordTerm],
        lengths: Sequence[int],
        starts: Callable[[RecordTerm], Array],
        sigma: Array,
    ) -> None:
        self.records = [
            record.again(gain=None, length=length) for record, length in zip(records, lengths, strict=True)
        ]
        for record in self.records:
            record.set_sigma(sigma)
        self.starts = [starts(record) for record in self.records]

    def project(self, v: Array, nodes: Sequence[Array], order: int = 1) -> Projected | None:
        """The problem at v (nv,), or None where the model cannot be evaluated."""
        size = len(v)
        cost, gradient, matrix, changes = 0.0, np.zeros(size), np.zeros((size, size)), []
        for record, at in zip(self.records, nodes, strict=True):
            try:
                with steps_kept(record.propagator, _SLOWER):
                    point = record.evaluate(v, at, order=order)
            except (FloatingPointError, np.linalg.LinAlgError, ModelError):
                return None
            rest, change = _without_states(record, point, sizes_of(at))
            flat = np.concatenate([point.r[None], point.jz]).reshape(len(rest), -1)
            gram = rest.reshape(len(rest), -1) @ flat.T
            active = record.active[: len(rest) - 1]
            cost += 0.5 * float(gram[0, 0])
            gradient[active] += gram[1:, 0]
            matrix[np.ix_(active, active)] += gram[1:, 1:]
            whole = np.zeros((1 + size, *change.shape[1:]))
            whole[0], whole[1 + active] = change[0], change[1:]
            changes.append(whole)
        if not np.isfinite(cost):
            return None
        return Projected(cost, gradient, matrix, tuple(changes))

    def cost(self, v: Array) -> float:
        """Half the summed squares at v, the states at their best to first order."""
        linear = all(record.linear for record in self.records)
        found = self.project(v, self.starts, order=0 if linear else 1)
        if found is not None and not linear:
            nodes = [at + change[0] for at, change in zip(self.starts, found.nodes, strict=True)]
            found = self.project(v, nodes)
        return np.inf if found is None else found.cost

    def descend(
        self,
        v: Array,
        bounds: tuple[Array, Array],
        log: NDArray[np.bool_],
        steps: int,
        stop: Callable[[], bool] = lambda: False,
    ) -> tuple[Array, float]:
        """Levenberg-Marquardt steps from v within bounds; where they end, and the cost there."""
        best: tuple[Array, Sequence[Array], Projected] | None = None

        def evaluate(at: Array) -> Squares | None:
            """The problem at a point, with the states that the best one so far foretells there."""
            nonlocal best
            nodes: Sequence[Array] = self.starts
            if best is not None:
                before, known, here = best
                if np.array_equal(before, at):
                    return Squares(here.cost, here.gradient, here.matrix)
                nodes = [
                    n + c[0] + np.tensordot(at - before, c[1:], axes=1)
                    for n, c in zip(known, here.nodes, strict=True)
                ]
            found = self.project(at, nodes)
            if found is None:
                return None
            if best is None or found.cost < best[2].cost:
                best = (at.copy(), nodes, found)
            return Squares(found.cost, found.gradient, found.matrix)

        def longest(at: Array) -> Array:
            return np.asarray(_LONGEST * np.where(log, 1.0, np.maximum(1.0, np.abs(at))))

        low, high = bounds
        at = np.clip(v, low, high)
        begun = None if stop() else evaluate(at)
        if begun is None or best is None:
            return at, np.inf
        before = np.inf
        while (
            best[2].cost < _LOWER * before
        ):  # the fall that ends a search is a share of the cost where it ends
            before, fall = best[2].cost, _FALL * best[2].cost
            minimise(
                evaluate, best[0], low, high, fall=fall, steps=steps, longest=longest, stop=lambda _: stop()
            )
        return best[0], best[2].cost


def _without_states(record: RecordTerm, point: RecordPoint, size: Array) -> tuple[Array, Array]:
    """Residual and Jacobian (1+nz, K, M) less what the pieces' states can explain, and the states (1+nz, M, n) that do.

    A weak spring on every state keeps those that nothing is known of; it goes by how large (n,) they are.
    """
    js, both, weight = point.js, np.concatenate([point.r[None], point.jz]), record._common
    alike = js.ndim == 2 and weight is not None  # one projection serves all pieces
    if js.ndim == 2 and weight is not None:
        slope, columns = (js * weight)[None], both.transpose(1, 0, 2).reshape(1, both.shape[1], -1)
    else:
        wide = js if js.ndim == 3 else js[:, None, :]
        slope = (wide * record.weight[:, :, None]).transpose(1, 0, 2)
        columns = both.transpose(2, 1, 0)
    pieces, samples, n = slope.shape
    most = max(float((np.abs(slope) * size).max()), 1e-300)
    spring = np.broadcast_to(np.diag(_FLAT * most / size), (pieces, n, n))
    q, r = np.linalg.qr(np.concatenate([slope, spring], axis=1))
    inside = q[:, :samples].transpose(0, 2, 1) @ columns
    rest = columns - q[:, :samples] @ inside
    change = -np.linalg.solve(r, inside)
    if alike:
        rest = rest[0].reshape(samples, both.shape[0], both.shape[2]).transpose(1, 0, 2)
        return rest, change[0].reshape(n, both.shape[0], both.shape[2]).transpose(1, 2, 0)
    return rest.transpose(2, 1, 0), change.transpose(2, 0, 1)


def lengths(record: RecordTerm) -> list[int]:
    """The lengths of a record's pieces [samples]: from a hundredth of it, growing to a quarter."""
    length = max(interval_length("auto", record.grid) or 1, _LEAST * record.n)
    found = [length]
    while _GROWTH * found[-1] < record.grid.samples // 2:
        found.append(_GROWTH * found[-1])
    return found


def _with_entries(v: Array, used: NDArray[np.intp], other: Array) -> Array:
    """A vector with some entries of another one: predictions do not act on a gain, which stays as it was."""
    found = v.copy()
    found[used] = other[used]
    return found


def approach(
    records: Sequence[RecordTerm],
    candidates: Sequence[Array],
    nodes: Callable[[RecordTerm], Array],
    *,
    coordinates: Coordinates,
    bounds: tuple[Array, Array],
    sigma: Array,
    stop: Callable[[], bool] = lambda: False,
) -> Array:
    """A start (nv,) for the simulation: the best of the candidates on short pieces, fitted to longer and longer ones.

    candidates : (nv,) vectors, the first of which is always followed; nodes : where the search for the states of a
    record's pieces begins; sigma : (ny,) weights; stop : looked at before every step
    """
    ladders = [lengths(record) for record in records]
    stages = [
        Pieces(records, [ladder[min(stage, len(ladder) - 1)] for ladder in ladders], nodes, sigma)
        for stage in range(max(map(len, ladders)))
    ]
    used = np.unique(np.concatenate([record.active for record in stages[0].records]))
    candidates = [_with_entries(candidates[0], used, v) for v in candidates]

    def climb(stages: Sequence[Pieces]) -> tuple[Array, float]:
        """The best candidate on the first pieces, fitted to these and to all longer ones, and its cost there."""
        first, log = stages[0], coordinates.log
        costs = np.array([np.inf if stop() else first.cost(v) for v in candidates[1:]])
        chosen = [
            candidates[0],
            *(candidates[1 + k] for k in np.argsort(costs)[:FOLLOWED] if np.isfinite(costs[k])),
        ]
        ends = [first.descend(v, bounds, log, _STEPS, stop) for v in chosen]
        best = min(ends, key=lambda end: end[1])
        for pieces in stages:
            best = pieces.descend(best[0], bounds, log, _MORE, stop)
        return best

    # A piece that is short beside the slowest motion says little of it, a long one has narrow valleys: both are tried.
    return min((climb(stages[begin:]) for begin in range(min(2, len(stages)))), key=lambda end: end[1])[0]
