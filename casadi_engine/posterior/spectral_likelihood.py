"""The likelihood of linear models on complete records, the initial states integrated out, by few frequency bins.

In the frequency domain (``estimation.spectral``) initial states enter by t = x_0 + x_N, the sum of the first and the
last one, linearly: with a normal prior of x_0 (``states``), from which x_N follows (``last_state``), their integral is
exact.

An engine's torque acts at its harmonics: most bins hold noise alone. Those in which the parameters act are chosen once
by their share of the information, not by what was measured there, so that the likelihood of the chosen bins is one of
its own. The others wait for the last draws (``full``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.spectral import Bins, Response, SpectralRecord, Spectrum
from casadi_engine.estimation.spectral_squares import largest_share
from casadi_engine.posterior.last_state import LastStates, last_state
from casadi_engine.posterior.modal import Basis, Transients
from casadi_engine.posterior.states import StatePrior
from casadi_engine.simulation.linear import LinearPropagator

Array = NDArray[np.float64]

# Share of the information in any direction that the bins that are left out may hold, and shares of bins to try.
LEFT_OUT = 0.02
# Information of a record about a direction of its states, in that of the prior, below which the prior's shape matters.
_TOLD = 10.0
# Growth of a state over a record from which its start says nothing.
_GROWTH = 1e8
# Products of states, outputs, bins and points that are worked on at once, and points.
_AT_ONCE, _MOST = 2.0e5, 256
_TRIED = 2.0 ** -np.arange(8.0, -0.5, -0.5)


class SpectralLikelihood:
    """Log likelihood of records at parameters v (nv,) and noise levels (ny,), the initial states integrated out.

    bins : used and all; first, states : of each record, the priors of x_0, and of t where searches begin
    """

    def __init__(self, records: Sequence[RecordTerm], v: Array, first: Sequence[StatePrior]) -> None:
        """v : (nv,) where searches begin; first : of each record, the prior of its first state"""
        size = len(v)
        self.first = list(first)
        self._last = [LastStates.still(v, record.n) for record in records]
        self.states = [own.of_sum(*last_state(record, v)) for own, record in zip(first, records, strict=True)]
        self._records = [SpectralRecord(record) for record in records]
        self._size = size
        self._fixed = [not len(_linear(record.record).drives_active) for record in self._records]
        self._chosen: list[NDArray[np.intp] | None] = [None] * len(self._records)
        self._kept: dict[tuple[int, bool], Basis] = {}  # of (record, whole)
        # of the bins left out: log likelihood, values of an output, their mean square, at which noise levels
        self._others: tuple[float, float, float, Array] = (0.0, 0.0, 1.0, np.ones(1))
        self.outputs = len(self._records[0].sigma)
        self._groups = self._grouped()

    @property
    def bins(self) -> tuple[int, int]:
        """Number of bins in use, and of all."""
        whole = sum(record.size for record in self._records)
        used = sum(
            record.size if own is None else len(own)
            for record, own in zip(self._records, self._chosen, strict=True)
        )
        return used, whole

    def untold(self, v: Array, sigma: Array) -> tuple[int, int]:
        """Of the directions of a record's states at v, how many are told by the prior rather than by the record, of the
        record with the most; and how many there are."""
        found = []
        for k, known in enumerate(self.states):
            seen = known.factor.T @ self._response(k, v, sigma)[0].seen
            found.append((int(np.count_nonzero(np.linalg.eigvalsh(seen @ seen.T) < _TOLD)), len(seen)))
        return max(found)

    # ---- which bins

    def choose(self, points: Sequence[Array], sigma: Array, left_out: float = LEFT_OUT) -> None:
        """Take the fewest bins that leave out little of the information at any of the points v."""
        wholes, scores = [], [np.zeros(record.size) for record in self._records]
        rows = [[self._columns(k, v, sigma) for k in range(len(self._records))] for v in points]
        for own in rows:
            whole = self._information(own)
            wholes.append(whole)
            size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
            turn = np.linalg.pinv(whole / np.outer(size, size), rcond=1e-12) / np.outer(size, size)
            for k, (record, jacobian) in enumerate(zip(self._records, own, strict=True)):
                active = record.record.active
                bent = turn[np.ix_(active, active)] @ jacobian
                score = (bent * jacobian).sum(axis=0).reshape(self.outputs, -1, 2).sum(axis=(0, 2))
                scores[k] = np.maximum(scores[k], score)
        self._follow(points[0], wholes[0])
        order = np.sort(np.concatenate(scores))[::-1]
        for share in _TRIED:
            limit = order[max(int(share * len(order)) - 1, 0)]
            chosen = [np.flatnonzero(score >= limit) for score in scores]
            part = [
                self._information([self._part(one, chosen[k]) for k, one in enumerate(own)]) for own in rows
            ]
            if all(largest_share(w, p) <= left_out for w, p in zip(wholes, part, strict=True)):
                break
        self._chosen, self._kept = list(chosen), {key: own for key, own in self._kept.items() if key[1]}
        self.states = [self._settled(k, points[0], sigma) for k in range(len(self.states))]
        self._others = 0.0, 0.0, 1.0, sigma
        count = sum(2 * (r.size - len(own)) for r, own in zip(self._records, chosen, strict=True))
        at, level = points[0][None], sigma[None]
        rest = float((self.full(at, level) - self.value(at, level))[0])
        rest = rest if np.isfinite(rest) else 0.0
        squares = -2 * (rest + count * float(np.log(sigma).sum()))
        self._others = rest, float(count), squares / max(count * self.outputs, 1), sigma

    def _follow(self, v: Array, information: Array) -> None:
        """Let the last states follow the parameters, about v."""
        if all(np.array_equal(one.at, v) and one.slopes.any() for one in self._last):
            return
        for k, (own, first) in enumerate(zip(self._records, self.first, strict=True)):
            self._last[k] = LastStates.about(own.record, first, v, information)
            self.states[k] = first.of_sum(*last_state(own.record, v))

    def _columns(self, k: int, v: Array, sigma: Array) -> Array:
        """Slopes (na, 2 ny K) of one record in all bins, the transients projected out."""
        record = self._records[k]
        record.sigma = sigma
        return record.columns(v, record.below(np.inf))[0][1:]

    def _part(self, jacobian: Array, chosen: NDArray[np.intp]) -> Array:
        """The same in some of the bins. Transients are projected out of these alone when it comes to the likelihood;
        what that costs beyond is less than what the bins lack."""
        return jacobian.reshape(len(jacobian), self.outputs, -1, 2)[:, :, chosen].reshape(len(jacobian), -1)

    def _information(self, rows: Sequence[Array]) -> Array:
        found = np.zeros((self._size, self._size))
        for record, own in zip(self._records, rows, strict=True):
            active = record.record.active
            found[np.ix_(active, active)] += own @ own.T
        return found

    # ---- the likelihood

    def integrate_finely(self, v: Array, sigma: Array) -> bool:  # noqa: ARG002
        """A linear model is not integrated by steps."""
        return False

    def value(self, v: Array, sigma: Array) -> Array:
        """Log likelihood (P,) in the chosen bins, that of the others as at the first point, at v (P, nv) and noise
        levels (P, ny); -inf where there is none."""
        rest, count, square, level = self._others
        ratio = level / sigma
        rest = rest + np.sum(count * (np.log(ratio) - 0.5 * square * (ratio**2 - 1)), axis=1)
        return self._log(v, sigma, whole=False) + rest

    def full(self, v: Array, sigma: Array) -> Array:
        """The same in all bins."""
        return self._log(v, sigma, whole=True)

    def _log(self, v: Array, sigma: Array, *, whole: bool) -> Array:
        total = np.zeros(len(v))
        with np.errstate(all="ignore"):
            for members in self._groups:
                fixed = all(self._fixed[k] for k in members)
                largest = max(self._used(k, whole=whole) for k in members)
                count = int(_AT_ONCE / (self._records[members[0]].record.n * self.outputs * largest))
                count = min(max(count, 1), _MOST) if fixed else 1
                for begin in range(0, len(v), count):
                    at = slice(begin, begin + count)
                    total[at] += self._of_group(v[at], members, sigma[at], whole=whole)
        return np.where(np.isfinite(total), total, -np.inf)

    def _grouped(self) -> list[list[int]]:
        """Records whose discrete matrices are the same."""
        found: dict[tuple[int, bytes], list[int]] = {}
        for k, record in enumerate(self._records):
            key = id(_linear(record.record).core), record.record.active.tobytes()
            found.setdefault(key, []).append(k)
        return list(found.values())

    def _used(self, k: int, *, whole: bool) -> int:
        chosen = self._chosen[k]
        return self._records[k].size if whole or chosen is None else len(chosen)

    def _basis(self, k: int, v: Array, *, whole: bool) -> Basis:
        """Of one record at v, kept where it is the same for every v."""
        if (k, whole) in self._kept:
            return self._kept[k, whole]
        record, chosen = self._records[k], self._chosen[k]
        bins = record.bins(v[record.record.active], record.below(np.inf))
        found = Basis.of(bins if whole or chosen is None else _some(bins, chosen, bins.slopes[:0]))
        if self._fixed[k]:
            self._kept[k, whole] = found
        return found

    def _of_group(self, v: Array, members: list[int], sigma: Array, *, whole: bool) -> Array:
        """Log likelihood (P,) of records with the same discrete matrices; their last states are simulated for the
        whole data."""
        first = self._records[members[0]].record
        model = Transients(_linear(first).core, v[:, first.active], sigma)
        total = np.zeros(len(v))
        for k in members:
            basis = self._basis(k, v[0], whole=whole)
            rows, rest = model.at(basis)
            if whole:
                total += self._simulated(k, v, model, rows, rest)
            else:
                total += self.states[k].integral(rows, rest, model.turn, self._last[k].moved(v))[0]
            total -= 2 * len(basis.z) * np.log(sigma).sum(axis=1)
            total[~(basis.bins.samples * np.log(model.radius) < np.log(_GROWTH))] = -np.inf
        return total

    def _simulated(self, k: int, v: Array, model: Transients, rows: Array, rest: Array) -> Array:
        """Log likelihood (P,) of a record whose last state is simulated at each v (P, nv) at which there is a model."""
        found, record = np.full(len(v), -np.inf), self._records[k].record
        for p in np.flatnonzero(np.isfinite(model.radius)):
            ahead, forced = last_state(record, v[p])
            if np.isfinite(ahead).all() and np.isfinite(forced).all():
                at, known = slice(p, p + 1), self.first[k].at(v[p]).of_sum(ahead, forced)
                found[p] = known.integral(rows[at], rest[at], model.turn[at])[0][0]
        return found

    # ---- slopes, for searches

    def squares(self, v: Array, sigma: Array) -> Squares | None:
        """Half the sum of squares in the chosen bins, with slopes; None where the model cannot be evaluated."""
        matrix, gradient, cost = np.zeros((self._size, self._size)), np.zeros(self._size), 0.0
        with np.errstate(all="ignore"):
            for k, record in enumerate(self._records):
                active = record.record.active
                try:
                    gram = self._gram(k, v, sigma)
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
                cost += 0.5 * float(gram[0, 0])
                gradient[active] += gram[1:, 0]
                matrix[np.ix_(active, active)] += gram[1:, 1:]
        return Squares(cost, gradient, matrix) if np.isfinite(cost) and np.isfinite(matrix).all() else None

    def _gram(self, k: int, v: Array, sigma: Array) -> Array:
        response, bins, made, left = self._response(k, v, sigma)
        record, last = self._records[k].record, self._last[k]
        known = self._there(k, v)
        best = known.best(response.seen, left)
        flat = response.columns(bins, made, best, _linear(record).drives_active)
        flat[0] += known.mean @ response.seen
        flat[1:] += last.slopes_at(v)[:, record.active].T @ response.seen
        return np.asarray(flat @ flat.T - known.without(response.seen, flat))

    def _settled(self, k: int, v: Array, sigma: Array) -> StatePrior:
        """The prior of a record's states as searches use it."""
        response, _, made, _ = self._response(k, v, sigma)
        chosen = self._there(k, v).settled(response.seen, made[0])
        return replace(self.states[k], chosen=chosen.chosen, width=chosen.width)

    def _there(self, k: int, v: Array) -> StatePrior:
        """The prior of t at v (nv,)."""
        return self.states[k].moved(self._last[k].moved(v[None])[0])

    def _response(
        self, k: int, v: Array, sigma: Array
    ) -> tuple[Response, Bins, tuple[Array, Spectrum, Spectrum], Array]:
        """One record in the chosen bins, and its residual (L,) with the states at the prior's mean."""
        record, chosen = self._records[k].record, self._chosen[k]
        z = v[record.active]
        discrete = _linear(record).discretisation(z, 1)
        bins = self._records[k].bins(z, self._records[k].below(np.inf))
        if chosen is not None:
            bins = _some(bins, chosen, np.ascontiguousarray(bins.slopes[..., chosen]))
        response = Response(discrete, bins, sigma)
        made = response.residual(bins)
        return response, bins, made, made[0] + self._there(k, v).mean @ response.seen


def _linear(record: RecordTerm) -> LinearPropagator:
    return cast(LinearPropagator, record.propagator)


def _some(bins: Bins, chosen: NDArray[np.intp], slopes: Spectrum) -> Bins:
    """The bins with these numbers."""
    drives, measured = (np.ascontiguousarray(own[:, chosen]) for own in (bins.drives, bins.measured))
    return Bins(bins.samples, bins.z[chosen], bins.share[chosen], drives, slopes, measured)
