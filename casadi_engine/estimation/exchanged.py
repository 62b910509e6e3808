"""Other points that explain the data as well, which no search from one start meets: values exchanged, as the rates of a
chain of which the last member alone is measured or two exponentials of a sum, or of the other sign, as a detuning that
is seen through a cosine. All that is looked at around one of them says nothing of the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ModelError, UnitError
from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.final_check import printed_cost, residual, response
from casadi_engine.estimation.predictor import output_stride
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.same_response import same_response
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.standard_errors import Uncertainty
from casadi_engine.estimation.starts import chained_nodes, nodes_by_first
from casadi_engine.experiment.units import NOT_STATED, Unit, read_unit
from casadi_engine.simulation.propagator import steps_kept

Array = NDArray[np.float64]

# Squared standard errors within which values that are exchanged are the same ones; samples that are simulated at most.
_ALIKE, _WORK = 25.0, 3e6
# Times as many integration steps as at the optimum that are taken elsewhere.
_SLOWER = 4
# Share of the information below which a state shows nothing.
_BLIND = 1e-12
# Steps of the others at an exchange; chi-squared that one leaves, as a share, for another to be worth its time.
_STEPS, _FALLS = 8, 0.5
# Share of a parameter from which a step down is another one in its inverse.
_BENDS = 0.1
# Chi-squared that rises between two optima; and less than which a step down gains nothing.
_RISES, _FLAT = 1.0, 0.1
# First samples of each record that may deny a move before all of it is simulated; records of fewer than _LONG times as
# many are simulated at once.
_HEAD, _LONG = 1000, 4
# Standard deviations by which first samples deny a first state.
_SEEN = 5.0
# Information on an equation between parameters, in that of the data.
_FIRM = 1e6
# Units of angles, and a turn in them.
_TURN = {"rad": 2 * np.pi, "deg": 360.0}
# Units of frequencies, and in them one of a swing a second; share by which steps are equal.
_RATE, _EQUAL = {"rad/s": 2 * np.pi, "Hz": 1.0}, 1e-6
# Units of what may have none, or none that was stated.
_OPEN = (NOT_STATED, "1")
# Coordinates within which two ends are one; and the information on a first state, on its scale, that says so.
_SAME, _TOLD = 1e-2, _ALIKE / 1e-4


class Swap(NamedTuple):
    """Two parameters, by their numbers, that take each other's part: one of so many units of the other, or of its
    inverse, as a time constant and a rate."""

    one: int
    other: int
    factor: float = 1.0
    inverse: bool = False

    def of(self, z: Array) -> tuple[float, float]:
        """The values of both after the exchange."""
        one, other = float(z[self.one]), float(z[self.other])
        if self.inverse:
            return self.factor / other, self.factor / one
        return other * self.factor, one / self.factor


@dataclass(frozen=True)
class Move:
    """What is done to an optimum: pairs of parameters that are exchanged, numbers of those that take the other
    sign, and of states that begin with the other sign, in all records; angles that are turned, and frequencies that
    look alike at the samples, each with what is added."""

    pairs: tuple[Swap, ...] = ()
    signs: tuple[int, ...] = ()
    states: tuple[int, ...] = ()
    turns: tuple[tuple[int, float], ...] = ()
    aliases: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class Twin:
    """Another point that explains the data: what leads there, parameters by pairs and what takes the other sign, in
    words, or the values of what differs where neither does; the point v (nv,), first states (n,) of each record there,
    and its chi-squared above the optimum's."""

    pairs: tuple[tuple[str, str], ...]
    signs: tuple[str, ...]
    v: Array
    starts: tuple[Array, ...]
    higher: float
    values: tuple[tuple[str, float], ...] = ()

    def __str__(self) -> str:
        """ "k1 and k2 exchanged", or "the other sign of dw and of the first phi", or "ka = 0.2 and V = 3"."""
        if self.values:
            return " and ".join(", ".join(f"{n} = {z:.4g}" for n, z in self.values).rsplit(", ", 1))
        if self.signs:
            return f"the other sign of {' and of '.join(self.signs)}"
        return ", and ".join(" and ".join(pair) for pair in self.pairs) + " exchanged"


def twins(search: Search, errors: Uncertainty, limit: float) -> list[Twin]:
    """Pairs of parameters of one dimension, or of its inverse, and two of them at once, whose exchange raises
    chi-squared by less than ``limit``, the others and the first states at their best; and likewise what may have the
    other sign."""
    starts = [lay.take(errors.x)[0] for lay in search.problem.layouts]
    metric = np.asarray(np.linalg.pinv(errors.covariance.matrix, hermitian=True), dtype=np.float64)
    joined = printed_cost(search, errors.v, [point.r for point in search.problem.at(errors.x).records])
    return list(_twins(search, errors.v, starts, metric, limit, joined=joined))


def mirrored_starts(search: Search, v: Array, starts: Sequence[Array], limit: float) -> list[Twin]:
    """Other points beside v (nv,) and first states (n,) of each record to which first states of the other sign lead,
    and which raise chi-squared by less than ``limit``."""
    metric = np.diag(np.concatenate([np.zeros(len(v)), *(np.full(len(one), _TOLD) for one in starts)]))
    return list(_twins(search, v, starts, metric, limit, states=True))


def _twins(
    search: Search,
    v: Array,
    starts: Sequence[Array],
    metric: Array,
    limit: float,
    *,
    states: bool = False,
    joined: float = np.inf,
) -> Iterator[Twin]:
    """See ``twins``; metric (N, N) of distances from [v; first states], states : those that move first states alone;
    joined : chi-squared of the optimum from interval to interval, which one simulation has to come to: where it runs
    away from what is measured, what runs away less is no better explanation."""
    most = _WORK
    names, known = search.pmap.free, [np.concatenate([v, *starts]) if states else v]
    optimum, stages = _Exchange(search, search.records, list(starts), Move(), 0.0), _stages(search)
    here = optimum.cost(v)
    if here > joined + limit:
        return
    for move, at in _places(search, v, starts, states=states):
        if most <= 0 and move != Move():
            continue
        away = np.concatenate([at[0] - v, *(a - b for a, b in zip(at[1], starts, strict=True))])
        if away @ metric @ away < _ALIKE or np.abs(away).max() < _SAME:
            continue
        for records in stages:
            exchange = _Exchange(search, records, list(at[1]), move, here + limit)
            try:
                with np.errstate(all="ignore"), ExitStack() as kept:  # a model may have no value there
                    for record in records:
                        kept.enter_context(steps_kept(record.propagator, _SLOWER))
                    higher = exchange.settled(at[0], optimum.first) - here
            except (FloatingPointError, np.linalg.LinAlgError, ModelError):
                higher = np.inf
            most -= exchange.work
            if not higher < limit:  # what follows adds to chi-squared
                break
        if not higher < limit or search.constraints.violated(exchange.v):
            continue
        if not _apart(search, v, starts, exchange, here + max(higher, 0.0), metric):
            continue
        point = np.concatenate([exchange.v, *exchange.starts])
        if not any(np.allclose(point[: len(one)], one, rtol=0, atol=_SAME) for one in known):
            known.append(point)
            own = [search.model.states[i].name for i in move.states]
            signs = (*(names[k] for k in move.signs), *(f"the first {name}" for name in own))
            pairs = tuple((names[p.one], "1/" * p.inverse + names[p.other]) for p in move.pairs)
            if move.turns:
                signs = ()
            values = () if pairs or signs else _differing(search, v, exchange.v)
            yield Twin(pairs, signs, exchange.v, tuple(exchange.starts), higher, values)


def _places(
    search: Search, v: Array, starts: Sequence[Array], *, states: bool
) -> Iterator[tuple[Move, tuple[Array, list[Array]]]]:
    """The moves within bounds, with the point v (nv,) and the first states (n,) of each record that they lead to; last,
    where else a linear model does the same."""
    for move in _moves(search, v, starts):
        at = _moved(search, v, starts, move)
        if at is not None and (move.states or not states):
            yield move, at
    if not states:
        yield from ((Move(), at) for at in same_response(search, v, starts))


def _differing(search: Search, v: Array, other: Array) -> tuple[tuple[str, float], ...]:
    """The parameters that are not the same at two points (nv,), with their values at the other one."""
    here, there = (search.coordinates.values(at) for at in (v, other))
    far = ~np.isclose(here, there, rtol=_SAME, atol=0)
    return tuple((search.pmap.free[k], float(there[k])) for k in np.flatnonzero(far))


def _apart(
    search: Search, v: Array, starts: Sequence[Array], end: _Exchange, cost: float, metric: Array
) -> bool:
    """True if chi-squared rises between an optimum and where a move led, with all but what moved most at its best:
    between values that are nearly one, or small, it is flat, and along a valley that bends."""
    half = [0.5 * (a + b) for a, b in zip(starts, end.starts, strict=True)]
    middle = _Exchange(search, search.records, half, Move(), cost + _RISES)
    moved = np.concatenate([end.v - v, *(b - a for a, b in zip(starts, end.starts, strict=True))])
    middle.hold(int(np.argmax(np.abs(moved) * np.sqrt(np.maximum(np.diag(metric), 0.0)))))
    values = 0.5 * (search.coordinates.values(v) + search.coordinates.values(end.v))
    try:
        with np.errstate(all="ignore"):
            between = middle.lowest(search.coordinates.of(values))
    except (FloatingPointError, np.linalg.LinAlgError, ModelError):
        return True
    return not between < cost + _RISES


def _stages(search: Search) -> list[Sequence[RecordTerm]]:
    """What a move is tried on, one after the other: the first samples of long records, and all."""
    if search.predictor.kind != "none" or search.problem.samples < _LONG * _HEAD * len(search.records):
        return [search.records]
    return [[record.head(_HEAD, search.sigma) for record in search.records], search.records]


def _moved(search: Search, v: Array, starts: Sequence[Array], move: Move) -> tuple[Array, list[Array]] | None:
    """The point v (nv,) and first states (n,) of each record that a move leads to; None beyond bounds."""
    z, lays = search.coordinates.values(v), search.problem.layouts
    for swap in move.pairs:
        z[[swap.one, swap.other]] = swap.of(z)
    z[list(move.signs)] *= -1
    for k, amount in (*move.turns, *move.aliases):
        z[k] += amount
    own = [one.copy() for one in starts]
    for start in own:
        start[list(move.states)] *= -1
    inside = (search.pmap.lower <= z).all() and (z <= search.pmap.upper).all()
    for start, lay in zip(own, lays, strict=True):
        ends = slice(lay.at, lay.at + lay.n)
        inside &= bool((search.lower[ends] <= start).all() and (start <= search.upper[ends]).all())
    return (search.coordinates.of(z), own) if inside else None


class _Exchange:
    """Where a move led on these records, all or the first samples of each, and what the others make of it.

    work : samples that were simulated so far; v : (nv,) where it ended; starts : first states (n,) of each record
    there; first : the residuals of the first samples of all outputs where it was last
    """

    def __init__(
        self, search: Search, records: Sequence[RecordTerm], starts: list[Array], move: Move, limit: float
    ) -> None:
        self._search, self._records, self._limit, self.work = search, records, limit, 0
        self._samples = sum(record.grid.samples for record in records)
        self.v, self.starts, self.first = np.zeros(0), starts, np.zeros(0)
        self._begins = bool(move.states)
        at = len(search.pmap.free)
        swapped = (k for pair in move.pairs for k in (pair.one, pair.other))
        self._held = [*move.signs, *swapped, *(k for k, _ in move.turns)]
        for start in starts:
            self._held += [at + i for i in move.states]
            at += len(start)

    def hold(self, entry: int) -> None:
        """Let an entry of [v; first states] stay where it is."""
        self._held.append(entry)

    def settled(self, v: Array, before: Array) -> float:
        """Chi-squared with the exchange at v (nv,), the others going on from there where that serves.

        before : the residuals of the first samples at the optimum; a first state that these deny leads nowhere
        """
        cost = self.cost(v)
        denied = self._begins and bool((np.abs(self.first - before) > _SEEN).any())
        for _ in range(0 if denied else _STEPS):
            if cost < self._limit or self._search.predictor.kind != "none":
                break
            last, step = cost, self._step(v)
            v, cost = self._taken(*step)
            downwards = (-step[1] > _BENDS * step[0]) & (step[0] > 0)
            if downwards.any() and not (cost < self._limit or cost < _FALLS * last):
                there, starts = v, self.starts
                v, other = self._taken(*step, inverse=True)
                if not other < cost:
                    v, self.starts = there, starts
                cost = min(cost, other)
            if not cost < _FALLS * last:
                break
        self.v = v
        return cost

    def lowest(self, v: Array) -> float:
        """Chi-squared where steps from v (nv,) end that go down, or are below the limit."""
        cost = self.cost(v)
        for _ in range(_STEPS):
            if cost < self._limit:
                break
            last = cost
            v, cost = self._taken(*self._step(v))
            if not cost < last - _FLAT:
                return min(cost, last)
        return cost

    def _taken(self, now: Array, moved: Array, *, inverse: bool = False) -> tuple[Array, float]:
        """The point (nv,) after a step from a place (N,), straight in the parameters as they are printed or in the
        inverses of positive ones, and chi-squared there."""
        low, high = self._limits()
        nv = len(self._search.pmap.free)
        after = now + moved
        positive = np.zeros(len(now), dtype=bool)
        positive[:nv] = self._search.coordinates.log & (moved[:nv] < now[:nv])
        # a volume by which an amount is divided goes on to nothing by steps of its own; 1/V by one
        turned = positive & (inverse | (after <= low))
        after[turned] = now[turned] / (1 - moved[turned] / now[turned])
        after = np.clip(after, low, high)
        self.starts = np.split(after[nv:], np.cumsum([record.n for record in self._records])[:-1])
        v = self._search.coordinates.of(after[:nv])
        return v, self.cost(v)

    def cost(self, v: Array) -> float:
        """Chi-squared at v (nv,)."""
        self.work += self._samples
        search, records = self._search, self._records
        left = [
            _best(search, record, v, start, k)
            for k, (record, start) in enumerate(zip(records, self.starts, strict=True))
        ]
        self.first = np.array(
            [
                own.ravel()[where[0]]
                for own, record in zip(left, records, strict=True)
                for where in record.observation.where.values()
            ]
        )
        return printed_cost(search, v, left)

    def _step(self, v: Array) -> tuple[Array, Array]:
        """The parameters as they are printed, and first states (N,), at v (nv,), and a Gauss-Newton step (N,) of all
        that is not held: a gain is met in one, however far it is."""
        search, nv, at = self._search, len(v), len(v)
        sizes = [record.n for record in self._records]
        gradient, matrix = np.zeros(nv + sum(sizes)), np.zeros((nv + sum(sizes), nv + sum(sizes)))
        _, gradient[:nv], _, matrix[:nv, :nv] = search.problem.priors.evaluate(v)
        for record, start in zip(self._records, self.starts, strict=True):
            self.work += (1 + len(record.active) + record.n) * record.grid.samples
            point = record.evaluate(v, chained_nodes(record, v, start))
            slopes = chained_slopes(record, point)
            slopes = slopes.reshape(len(slopes), -1)
            own = np.concatenate([record.active, np.arange(at, at + record.n)])
            gradient[own] += slopes @ point.r.ravel()
            matrix[np.ix_(own, own)] += slopes @ slopes.T
            at += record.n
        self._hold_equations(v, gradient, matrix)
        unit = np.concatenate([search.coordinates.slope(v), np.ones(sum(sizes))])
        now = np.concatenate([search.coordinates.values(v), *self.starts])
        low, high = self._limits()
        free = low < high
        free[self._held] = False
        return now, _least_squares(gradient / unit, matrix / np.outer(unit, unit), free)

    def _hold_equations(self, v: Array, gradient: Array, matrix: Array) -> None:
        """Add what a step from v (nv,) away from constraints that are equations costs to a gradient (N,) and a matrix
        (N, N): beside it data count for nothing."""
        user, nv = self._search.constraints, len(v)
        held = user.lower == user.upper
        if not held.any():
            return
        value, slopes = user.evaluate(v)
        slopes, off = slopes[held], (value - user.lower)[held]
        weight = _FIRM * np.trace(matrix) / max(float((slopes**2).sum()), 1e-300)
        gradient[:nv] += weight * slopes.T @ off
        matrix[:nv, :nv] += weight * slopes.T @ slopes

    def _limits(self) -> tuple[Array, Array]:
        """Bounds (N,) of parameters, as they are printed, and of first states."""
        search = self._search
        low, high = (
            np.concatenate([values, *(ends[lay.at : lay.at + lay.n] for lay in search.problem.layouts)])
            for values, ends in ((search.pmap.lower, search.lower), (search.pmap.upper, search.upper))
        )
        return low, high


def _least_squares(gradient: Array, matrix: Array, free: NDArray[np.bool_]) -> Array:
    """The step (N,) to the minimum of a quadratic, of what is free alone; none along what it does not know."""
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        raise FloatingPointError("the slopes are not finite here")
    moved = np.zeros(len(gradient))
    size = np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
    whole = matrix[np.ix_(free, free)] / np.outer(size, size)
    moved[free] = -np.linalg.lstsq(whole, gradient[free] / size, rcond=_BLIND)[0] / size
    return moved


def _moves(search: Search, v: Array, starts: Sequence[Array]) -> Iterator[Move]:
    """Pairs of free parameters, by their numbers, that have one unit; what may have the other sign: parameters, and of
    models in which they do not enter in lines first states, each alone and all together, beside each other too; angles
    that go on by a turn, or by half of one where something takes the other sign, as the phase of a swing does; then two
    pairs at once, as a resistance and a capacity of one branch are exchanged with those of another."""
    units = [search.parameters[name.split("@")[0]].unit for name in search.pmap.free]
    z, states = search.coordinates.values(v), list[tuple[int, ...]]()  # none of what enters in lines
    pairs = list(_swaps(units, z))
    yield from (Move((pair,)) for pair in pairs)
    step = _sampled_every(search)
    if not all(record.linear for record in search.records):
        states = _each_and_all(np.any([start != 0 for start in starts], axis=0))
    either = (search.pmap.lower <= -z) & (-z <= search.pmap.upper) & (z != 0)
    signs = _each_and_all(either)
    yield from (Move(signs=own) for own in signs)
    yield from (Move(states=own) for own in states)
    yield from (Move(signs=own, states=other) for own in signs for other in states)
    for k, turn in ((k, _TURN[unit]) for k, unit in enumerate(units) if unit in _TURN):
        if abs(z[k]) > turn / 2:  # an angle within half a turn of 0 is meant as it is
            yield from (Move(turns=((k, side * turn),)) for side in (1, -1))
        halves = [Move(turns=((k, side * turn / 2),)) for side in (1, -1)]
        yield from (replace(half, signs=own) for half in halves for own in signs if k not in own)
    for k, rate in ((k, _RATE[unit] / step) for k, unit in enumerate(units) if step and unit in _RATE):
        amounts = (rate - 2 * z[k], rate, -rate, -rate - 2 * z[k])
        if abs(z[k]) > rate / 2:  # below half the rate of samples a frequency is meant as it is
            yield from (Move(aliases=((k, amount),)) for amount in amounts if z[k] * (z[k] + amount) > 0)
    for both in combinations([pair for pair in pairs if not pair.inverse], 2):
        if len({k for pair in both for k in (pair.one, pair.other)}) == 4:
            yield Move(both)


def _swaps(units: Sequence[str], z: Array) -> Iterator[Swap]:
    """Pairs that may be exchanged: of one unit as it is written, or of one dimension; and positive ones of which one
    has the dimension of the other's inverse, or that have not stated theirs."""
    read = [_read(unit) for unit in units]
    for i, j in combinations(range(len(units)), 2):
        one, other = read[i], read[j]
        if units[i] == units[j]:
            yield Swap(i, j)
            if units[i] in _OPEN and z[i] > 0 and z[j] > 0:
                yield Swap(i, j, inverse=True)
        elif one and other and one.dimension == other.dimension:
            yield Swap(i, j, float(other.factor / one.factor))
        elif not (z[i] > 0 and z[j] > 0):
            continue
        elif one and other and _inverse(one.dimension) == set(other.dimension.split()):
            yield Swap(i, j, float(1 / (one.factor * other.factor)), inverse=True)
        elif NOT_STATED in (units[i], units[j]):
            yield from (Swap(i, j), Swap(i, j, inverse=True))


def _read(unit: str) -> Unit | None:
    with suppress(UnitError):
        return read_unit(unit)
    return None


def _inverse(dimension: str) -> set[str]:
    """The parts of the inverse of a dimension as it is written: "s-1 m3" of "s m-3"."""
    turned = set()
    for part in dimension.split():
        name = part.rstrip("0123456789-")
        power = -int(part[len(name) :] or 1)
        turned.add(name if power == 1 else f"{name}{power}")
    return turned


def _sampled_every(search: Search) -> float | None:
    """Seconds from one sample of the outputs to the next, of all records; None where they are not equal."""
    grids = [record.grid for record in search.records]
    steps = [output_stride(grid) * grid.step for grid in grids]
    alike = all(grid.uniform for grid in grids) and max(steps) - min(steps) < _EQUAL * max(steps)
    return steps[0] if alike and steps[0] > 0 else None


def _each_and_all(which: NDArray[np.bool_]) -> list[tuple[int, ...]]:
    """The numbers that are marked, each by itself, then all of them together."""
    marked = np.flatnonzero(which).tolist()
    return [(k,) for k in marked] + ([tuple(marked)] if len(marked) > 1 else [])


def _best(search: Search, record: RecordTerm, v: Array, start: Array, k: int) -> Array:
    """The weighted residual (K, M) of a record with parameters v from a first state; linear models as it serves
    best."""
    lay = search.problem.layouts[k]
    if not record.linear:
        return residual(record, response(record, v, start)[0])
    own = slice(lay.at, lay.at + lay.n)
    return linear_residual(record, v, start, np.isinf(search.lower[own]) & np.isinf(search.upper[own]))


def linear_residual(record: RecordTerm, v: Array, start: Array, free: NDArray[np.bool_]) -> Array:
    """The weighted residual (K, M) of a linear model from a first state (n,), whose free entries are at their best."""
    point = record.evaluate(v, np.zeros((record.plan.m, record.n)), order=0)
    js, n, by_first = point.js, record.n, nodes_by_first(point)
    powers, left = by_first[..., :n], point.r + (js @ by_first[..., n].T) * record.weight
    start = np.where(free, 0.0, start)
    left = left + (js @ (powers @ start).T) * record.weight
    if not free.any():
        return np.asarray(left)
    powers = powers[..., free]
    turned = powers.swapaxes(1, 2)
    gradient = (turned @ ((left * record.weight).T @ js)[..., None]).sum(axis=0)[:, 0]
    matrix = (turned @ record.gauss_newton(point).ss @ powers).sum(axis=0)
    if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
        raise FloatingPointError("the slopes of the first states are not finite here")
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    moved = -np.linalg.lstsq(matrix / np.outer(size, size), gradient / size, rcond=_BLIND)[0] / size
    return np.asarray(left + (js @ (powers @ moved).T) * record.weight)
