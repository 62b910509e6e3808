"""Other parameters with which a linear model does exactly the same, of whatever units: a rate of absorption that is
exchanged with that of elimination, a resistance and a capacity of one branch with another's time constant.

What a linear model does is its response to its inputs and from its first states, at any frequency. Searches for other
parameters with the responses of an optimum ask for no sample, and so for next to no time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Search

Array = NDArray[np.float64]
Complex = NDArray[Any]  # of complex numbers

# Starts that are drawn, those that are gone on from as they are the nearest, and steps of each; a search that has not
# come so much nearer in so many steps ends.
_STARTS, _NEAREST, _STEPS, _NEARER, _PATIENCE = 32, 12, 25, 0.5, 4
# States of a model beyond which searches from afar lead nowhere.
_STATES = 8
# How far starts lie from the optimum: so many times the logarithm of the ratio of the fastest to the slowest motion, as
# it is the motions that change their places, and at least so much.
_REACH, _LEAST = 1.2, 1.5
# A step is at most so long, in logarithms or in the size of a parameter.
_LONGEST = 2.0
# Share of the response up to which two are one; and the change of a logarithm, or of a size, that makes another point.
_ONE, _OTHER = 1e-9, 1e-2
# Share of its largest value below which a response is nothing.
_SMALL = 1e-3
# Damping to begin with, its change from step to step, and the least, above what rounding makes of a singular matrix.
_DAMPING, _CHANGE, _FLOOR = 1e-3, 6.0, 1e-10


def same_response(
    search: Search, v: Array, starts: Sequence[Array], known: NDArray[np.bool_] | None = None
) -> list[tuple[Array, list[Array]]]:
    """Other points v (nv,) with the first states (n,) of each record, within bounds, at which the responses are those
    at ``v`` and ``starts``; as far as searches find them. None for a model that is not linear in states and inputs.

    known : (n,) of the first states of the first record; None for what their bounds say
    """
    responses = _Responses(search, v, starts, known)
    if not responses.asked:
        return []
    here = responses.at(responses.here[None])[0][0]
    weight = 1 / _sizes(here)
    found, seen = list[tuple[Array, list[Array]]](), [responses.here]
    with np.errstate(all="ignore"):
        for q in _searched(responses, here, weight):
            if all(np.abs(q - one).max() > _OTHER for one in seen):
                seen.append(q)
                found.append(responses.split(q))
    return found


def _sizes(here: Complex) -> Array:
    """What differences are a share of: the size of each response at each frequency, (rows, s)."""
    size = np.abs(here)
    return np.asarray(np.maximum(size, _SMALL * size.max(axis=1, keepdims=True)) + 1e-300)


def _searched(responses: _Responses, here: Complex, weight: Array) -> Array:
    """The points (k, N) at which searches ended where the responses are the same."""

    def judged(q: Array) -> tuple[Array, Array, Array]:
        value, slopes = responses.at(q)
        left = ((value - here) * weight).reshape(len(q), -1, 1).view(float).reshape(len(q), -1, 1)
        turned = (slopes * weight).reshape(*q.shape, -1).view(float)
        cost = (left**2).mean(axis=(1, 2))
        gradient, matrix = (turned @ left)[..., 0], turned @ turned.swapaxes(1, 2)
        bad = ~(np.isfinite(cost) & np.isfinite(matrix).all(axis=(1, 2)))
        cost[bad], gradient[bad], matrix[bad] = np.inf, 0.0, 0.0
        return cost, gradient, matrix

    q = responses.drawn(_STARTS)
    q = q[np.argsort(judged(q)[0])[:_NEAREST]]
    cost, gradient, matrix = judged(q)
    damping, before = np.full(len(q), _DAMPING), cost.copy()
    for k in range(_STEPS):
        if k and k % _PATIENCE == 0:
            cost[(cost > _NEARER * before) & (cost > _ONE**2)] = np.inf
            before = cost.copy()
        busy = np.flatnonzero(np.isfinite(cost) & (cost > _ONE**2))
        if not len(busy):
            break
        size = np.einsum("knn->kn", matrix[busy]) + 1e-300
        root = np.sqrt(size)
        whole = matrix[busy] / (root[:, :, None] * root[:, None]) + damping[busy, None, None] * np.eye(
            q.shape[1]
        )
        step = -np.linalg.solve(whole, (gradient[busy] / root)[..., None])[..., 0] / root
        step = np.where(np.isfinite(step), step, 0.0)
        step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1), 1e-300))[:, None]
        after = responses.inside(q[busy] + step)
        new = judged(after)
        better = new[0] < cost[busy]
        now = busy[better]
        q[now], cost[now], gradient[now], matrix[now] = after[better], *(part[better] for part in new)
        damping[busy] = np.maximum(_FLOOR, damping[busy] * np.where(better, 1 / _CHANGE, _CHANGE))
        cost[busy[(damping[busy] > 1e6)]] = np.inf  # it is stuck
    return q[cost <= _ONE**2]


class _Responses:
    """The responses of a linear model as functions of q (N,): the parameters v, and free first states of one record.

    here : q at the optimum; asked : whether anything else may do the same: one state and one parameter are told
    """

    def __init__(
        self, search: Search, v: Array, starts: Sequence[Array], known: NDArray[np.bool_] | None
    ) -> None:
        self._nv, self._search, self._starts = len(v), search, starts
        self._records = _distinct(search.records)
        lay = search.problem.layouts[0]
        ends = slice(lay.at, lay.at + lay.n)
        known = search.lower[ends] >= search.upper[ends] if known is None else known
        self._first, self._open = starts[0], np.flatnonzero(~known)
        self._low, self._high = (
            np.concatenate([bound[: self._nv], bound[ends][self._open]])
            for bound in (search.lower, search.upper)
        )
        self.here = np.concatenate([v, self._first[self._open]])
        linear = search.predictor.kind == "none" and all(record.linear for record in search.records)
        self.asked = linear and 1 < search.records[0].n <= _STATES and self._nv > 1
        self._s: Complex = np.zeros(0, dtype=complex)
        self._spread = 0.0
        if self.asked:
            self._s, self._spread = self._frequencies(v)
            self.asked = len(self._s) > 0

    def _frequencies(self, v: Array) -> tuple[Complex, float]:
        """Where responses are compared, (s,) in rad/s, and how far starts are drawn."""
        record = self._records[0]
        a = _matrices(record, v, 0)[0][0]
        if not np.isfinite(a).all():
            return np.zeros(0, dtype=complex), 0.0
        fast = np.abs(np.linalg.eigvals(a))
        longest = record.grid.step * record.grid.samples
        fast = np.clip(fast, 1 / longest, np.pi / record.grid.step)
        low, high = float(fast.min()), float(fast.max())
        found = np.geomspace(0.3 * low, 3 * high, 2 * len(a) + 2)
        return (0.3 + 1j) * found, max(_LEAST, _REACH * np.log(high / low))

    def drawn(self, count: int) -> Array:
        """Starts (count, N) around the optimum, the same ones every time."""
        random = np.random.default_rng(0)
        size = np.abs(self.here) + 1e-3
        away = self._spread * random.uniform(-1, 1, (count, len(self.here)))
        log = np.zeros(len(self.here), dtype=bool)
        log[: self._nv] = self._search.coordinates.log
        sign = random.choice([-1.0, 1.0], away.shape)
        return self.inside(np.where(log, self.here + away, sign * size * np.exp(away)))

    def inside(self, q: Array) -> Array:
        """Points (k, N) held within the bounds."""
        return np.clip(q, self._low, self._high)

    def split(self, q: Array) -> tuple[Array, list[Array]]:
        """The point v (nv,) and the first states (n,) of each record; those of further ones stay."""
        first = self._first.copy()
        first[self._open] = q[self._nv :]
        return q[: self._nv], [first, *(one.copy() for one in self._starts[1:])]

    def at(self, q: Array) -> tuple[Complex, Complex]:
        """Responses (k, rows, s) at points q (k, N), and their slopes (k, N, rows, s)."""
        made = [self._of(record, q, first=k == 0) for k, record in enumerate(self._records)]
        value = np.concatenate([own[0] for own in made], axis=1)
        return value, np.concatenate([own[1] for own in made], axis=2)

    def _of(self, record: RecordTerm, q: Array, *, first: bool) -> tuple[Complex, Complex]:
        """Those of one record; first : from first states too."""
        jets = [_matrices(record, one, 1) for one in q]
        a, b, c, d = (np.stack(parts) for parts in zip(*jets, strict=True))  # (k, 1 + nz, ., .)
        n, count = a.shape[-1], len(q)
        if first:
            start = np.zeros((count, b.shape[1], n, 1))
            start[:, 0, :, 0] = self._first
            start[:, 0, self._open, 0] = q[:, self._nv :]
            b = np.concatenate([b, start], axis=3)
            d = np.concatenate([d, np.zeros((*d.shape[:3], 1))], axis=3)
        inverse = np.linalg.inv(self._s[:, None, None] * np.eye(n) - a[:, None, 0])  # (k, s, n, n)
        right = inverse @ b[:, None, 0]
        value = c[:, None, 0] @ right + d[:, None, 0]
        left = c[:, None, 0] @ inverse
        slopes = np.zeros((count, q.shape[1], *value.shape[1:]), dtype=complex)
        for k, place in enumerate(record.active, start=1):
            moved = left @ (a[:, None, k] @ right + b[:, None, k]) + c[:, None, k] @ right + d[:, None, k]
            slopes[:, place] = moved
        if first and len(self._open):
            slopes[:, self._nv :, ..., -1] = left[..., self._open].transpose(0, 3, 1, 2)
        return _rows(value), _rows(slopes)


def _matrices(record: RecordTerm, q: Array, order: int) -> tuple[Array, Array, Array, Array]:
    """See ``DiscreteCore.matrices``, at q (N,)."""
    core: Any = getattr(record.propagator, "core")  # noqa: B009 (of a linear model)
    found: tuple[Array, Array, Array, Array] = core.matrices(q[record.active], order)
    return found


def _rows(values: Any) -> Any:
    """Responses (..., s, outputs, columns) as (..., outputs * columns, s)."""
    return np.moveaxis(values.reshape(*values.shape[:-2], -1), -2, -1)


def _distinct(records: Sequence[RecordTerm]) -> list[RecordTerm]:
    """Records that depend on parameters of their own, and the first of those that share them."""
    found: dict[tuple[int, ...], RecordTerm] = {}
    for record in records:
        found.setdefault(tuple(int(k) for k in record.active), record)
    return list(found.values())
