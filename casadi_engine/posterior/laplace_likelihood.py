"""The likelihood of any model, the initial states integrated out by Laplace's method.

The integral over the initial states is that of a normal density about their best values at each point of the
parameters, with their prior (``states``). For a linear model it is exact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.many_points import ManyPoints
from casadi_engine.posterior.states import StatePrior

Array = NDArray[np.float64]

# Gauss-Newton steps in the initial states at a point, the same at a look, and the fall of chi-squared that ends them.
_STEPS, _ROUGH, _FALL = 5, 2, 0.02
# Points that run side by side between two looks whether they say what one by itself says; and the log likelihood by
# which they may differ, as a share of how far it lies below the best.
_LOOKED, _ALIKE = 64, 1e-2
# Squared standard errors within which two ends are one.
_ONE = 1.0
# Standard errors of an optimum within which its initial states are looked for.
_NEARBY = 30.0


class Branch:
    """First states that are best about one optimum, and their prior; other ones may explain the records as well, as
    those of the other sign where a state is seen by its square."""

    def __init__(
        self,
        shots: SingleShots,
        first: Mapping[str, Array],
        v: Array,
        held: Mapping[str, NDArray[np.bool_]],
        states: Sequence[StatePrior],
    ) -> None:
        """See ``LaplaceLikelihood``; slopes are those at the noise levels that ``shots`` has."""
        self.best, self.at, self.size = np.concatenate([v, *first.values()]), v, len(v)
        residual, slopes = shots.evaluate(self.best)
        # of each record: the places of its unknown initial states in x, and their prior; those that are known are
        # held, and take no part in the others' prior
        self.parts: list[tuple[NDArray[np.intp], StatePrior]] = []
        at = self.size
        for known, state in zip(held.values(), states, strict=True):
            moving = np.flatnonzero(~known)
            if len(moving):
                rows = slopes[:, at + moving].T
                rest = residual - self.best[at + moving] @ rows
                self.parts.append((at + moving, state.part(moving).settled(rows, rest)))
            at += len(known)
        # how the best initial states follow v
        self._turn = [
            own.best(slopes[:, where].T, one) - own.mean
            for one in slopes[:, : self.size].T
            for where, own in self.parts
        ]

    def begun(self, v: Array) -> Array:
        """x where the best initial states are expected."""
        x = np.concatenate([v, self.best[self.size :]])
        for i, (where, _) in enumerate(self.parts):
            for k, step in enumerate(v - self.at):
                x[where] += step * self._turn[k * len(self.parts) + i]
        return x

    def settled(self, shots: SingleShots, v: Array) -> Settled | None:
        """The integral over the initial states at v (nv,), about the best that are met from where they are expected."""
        x = self.begun(v)
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                try:
                    residual, slopes = shots.evaluate(x)
                    left = residual.copy()
                    for where, own in self.parts:
                        left -= slopes[:, where] @ (x[where] - own.mean)
                    total, fall = -0.5 * float(left @ left), 0.0
                    for where, own in self.parts:
                        rows = np.ascontiguousarray(slopes[:, where].T)
                        alone = left - own.mean @ rows
                        (log,), (best,) = own.integral(rows[None], alone[None])
                        total, step = total + float(log) + 0.5 * float(left @ left), best - x[where]
                        fall += _length(rows, own, step)
                        x[where] = best
                except (FloatingPointError, np.linalg.LinAlgError):
                    return None
                if not fall > _FALL:
                    break
        return Settled(total, left, slopes, x, self.parts) if np.isfinite(total) else None


@dataclass(frozen=True, eq=False)
class Settled:
    """Log likelihood but for the noise levels' share, the residual (K,) that a line leads to from the best initial
    states at the prior's mean of them, the slopes (K, nx), x there, and the priors of its branch."""

    log: float
    left: Array
    slopes: Array
    x: Array
    parts: list[tuple[NDArray[np.intp], StatePrior]]

    def squares(self, size: int) -> Squares:
        """Half the sum of squares with slopes in v (size,), the initial states at their best."""
        rows = np.concatenate([self.left[None], self.slopes[:, :size].T])
        gram = rows @ rows.T
        for where, own in self.parts:
            gram -= own.without(self.slopes[:, where].T, rows)
        return Squares(0.5 * float(gram[0, 0]), gram[1:, 0], gram[1:, 1:])

    def is_at(self, x: Array) -> bool:
        """True if other best initial states are these."""
        return (
            sum(_length(self.slopes[:, where].T, own, x[where] - self.x[where]) for where, own in self.parts)
            < _ONE
        )


def _length(rows: Array, own: StatePrior, step: Array) -> float:
    """A step of initial states, in squared standard errors."""
    return float(np.sum((step @ rows) ** 2) + np.sum(np.linalg.solve(own.factor, step) ** 2))


class LaplaceLikelihood:
    """Log likelihood of records at parameters v (nv,) and noise levels (ny,), the initial states integrated out."""

    bins: tuple[int, int] | None = None

    def untold(self, v: Array, sigma: Array) -> tuple[int, int]:  # noqa: ARG002
        """Not counted here."""
        return 0, 0

    def __init__(
        self,
        shots: SingleShots,
        first: Mapping[str, Array],
        v: Array,
        held: Mapping[str, NDArray[np.bool_]],
        states: Sequence[StatePrior],
    ) -> None:
        """first : record -> (n,) initial states of the optimum v, scaled; held : record -> (n,) those that are known;
        states : the prior of those of each record"""
        self._shots, self._size, self._held = shots, len(v), held
        self._outputs = tuple(dict.fromkeys(output for _, output in shots.places))
        self.branches = [Branch(shots, first, v, held, states)]
        self._reach: list[Array] = []  # the information at each branch, where there are several
        self._last = self.branches[0].best  # where the model was looked at last
        self._top = -np.inf  # the largest log likelihood that was met
        self._since = _LOOKED  # points that ran side by side since it was last asked whether they may

    def leads_to(self, first: Mapping[str, Array], v: Array, sigma: Array) -> bool:
        """True if these initial states of another optimum, scaled, are met at its v (nv,), or none can be."""
        found = self._settled(v, sigma)
        x = np.concatenate([v, *first.values()])
        return not self.branches[0].parts or any(one.is_at(x) for one in found)

    def add(self, first: Mapping[str, Array], v: Array, states: Sequence[StatePrior]) -> None:
        """Look for the best initial states from where they are at another optimum too, arguments as at first."""
        self._shots.weigh(dict.fromkeys(self._outputs, 1.0))
        self.branches.append(Branch(self._shots, first, v, self._held, states))

    @property
    def states(self) -> list[StatePrior]:
        """Of each record with unknown initial states, their prior."""
        return [own for _, own in self.branches[0].parts]

    def choose(self, points: object, sigma: Array, left_out: float = 0.0) -> None:
        """Nothing is left out here; see ``SpectralLikelihood``."""

    def integrate_finely(self, v: Array, sigma: Array) -> bool:
        """Shorter steps where those there are are too long for points v (P, nv), an optimum first; True if any are
        shorter now."""
        changed, lowest = False, np.inf
        for one in v:
            if not self._settled(one, sigma):
                continue
            with np.errstate(all="ignore"):
                try:
                    lowest = min(lowest, float(np.square(self._shots.residuals(self._last)).sum()))
                    changed |= self._shots.integrate_finely(self._last, lowest)
                except (FloatingPointError, np.linalg.LinAlgError):
                    continue
        return changed

    def value(self, v: Array, sigma: Array) -> Array:
        """Log likelihood (P,) at v (P, nv) and noise levels (P, ny); -inf where the model cannot be evaluated."""
        found = self._side_by_side(v, sigma)
        for k in np.flatnonzero(np.isnan(found)):
            found[k] = self._value(v[k], sigma[k])
        return found

    def _side_by_side(self, v: Array, sigma: Array) -> Array:
        """The same by one run for many points, NaN where it is not told so: where it does not say what a point by
        itself says, as laws may ask for steps of their own at each point. That is looked at now and then."""
        found = np.full(len(v), np.nan)
        if len(self.branches) > 1 or not self._shots.runs_side_by_side(self.branches[0].best):
            return found
        many = ManyPoints(self._shots, self.branches[0].parts, _STEPS, _FALL)
        for part in np.array_split(np.arange(len(v)), -(-len(v) // many.room)):
            found[part] = self._of_many(many, v[part], sigma[part])
        self._since += len(v)
        if self._since < _LOOKED:
            return found
        order = np.argsort(np.where(np.isnan(found), -np.inf, found))
        for k in dict.fromkeys(
            order[[-1, -1 - len(order) // 4, len(order) // 2]]
        ):  # the best one, and others
            alone = self._value(v[k], sigma[k])
            if np.isfinite(found[k]) and abs(found[k] - alone) > _ALIKE * max(1.0, found[order[-1]] - alone):
                return np.full(len(v), np.nan)
        self._since = 0
        return found

    def _of_many(self, many: ManyPoints, v: Array, sigma: Array) -> Array:
        x = np.array([self.branches[0].begun(one) for one in v])
        found = many.logs(x, {name: sigma[:, k] for k, name in enumerate(self._outputs)})
        for (_, name), at in self._shots.places.items():
            found -= (at.stop - at.start) * np.log(sigma[:, self._outputs.index(name)])
        return found

    def _value(self, v: Array, sigma: Array) -> float:
        if self.branches[0].parts:
            found = self._settled(v, sigma)
            total = float(np.logaddexp.reduce([one.log for one in found])) if found else -np.inf
        else:
            total = self._without_slopes(v, sigma)
        for (_, name), at in self._shots.places.items():
            total -= (at.stop - at.start) * float(np.log(self._level(sigma, name)))
        return total if np.isfinite(total) else -np.inf

    def _without_slopes(self, v: Array, sigma: Array) -> float:
        """The same where no initial state is unknown."""
        self._shots.weigh({name: self._level(sigma, name) for name in self._outputs})
        with np.errstate(all="ignore"):
            try:
                return -0.5 * float(np.square(self._shots.residuals(self.branches[0].begun(v))).sum())
            except (FloatingPointError, np.linalg.LinAlgError):
                return -np.inf

    def full(self, v: Array, sigma: Array) -> Array:
        """The same: all samples are looked at anyway."""
        return self.value(v, sigma)

    def squares_of(self, v: Array, sigma: Array, *, roughly: bool = False) -> list[Squares | None]:
        """See ``squares``, at points v (P, nv) that lie far apart; roughly : with few steps in the initial states."""
        found: list[Squares | None] = [None] * len(v)
        if len(v) > 1 and len(self.branches) == 1 and self._shots.runs_side_by_side(self.branches[0].best):
            steps = _ROUGH if roughly else _STEPS
            many = ManyPoints(self._shots, self.branches[0].parts, steps, _FALL)
            x = np.array([self.branches[0].begun(one) for one in v])
            levels = {name: np.full(len(v), self._level(sigma, name)) for name in self._outputs}
            found, top = many.squares(x, levels, self._size, self._top if roughly else np.inf)
            self._top = top if roughly else self._top
        return [self.squares(one, sigma) if own is None else own for one, own in zip(v, found, strict=True)]

    def squares(self, v: Array, sigma: Array) -> Squares | None:
        """Half the sum of squares with slopes, the initial states at their best; None where there is none."""
        found = self._settled(v, sigma)
        if not found:
            return None
        best = max(found, key=lambda own: own.log).squares(self._size)
        finite = (
            np.isfinite(best.cost) and np.isfinite(best.matrix).all() and np.isfinite(best.gradient).all()
        )
        return best if finite else None

    def _level(self, sigma: Array, name: str) -> float:
        return float(sigma[self._outputs.index(name)])

    def _settled(self, v: Array, sigma: Array) -> list[Settled]:
        """Where the branches lead at a point, each end once."""
        self._shots.weigh({name: self._level(sigma, name) for name in self._outputs})
        found: list[Settled] = []
        for branch in self._near(v):
            one = branch.settled(self._shots, v)
            if one is not None and not any(other.is_at(one.x) for other in found):
                found.append(one)
        if found:
            self._last = max(found, key=lambda one: one.log).x
        return found

    def _near(self, v: Array) -> list[Branch]:
        """The branches that are expected to lead anywhere at v (nv,): those nearby, and the nearest one."""
        if len(self.branches) == 1:
            return self.branches
        if len(self._reach) < len(self.branches):
            ends = [one.settled(self._shots, one.at) for one in self.branches]
            self._reach = [np.zeros((len(v),) * 2) if e is None else e.squares(len(v)).matrix for e in ends]
        away = [
            float((v - one.at) @ matrix @ (v - one.at))
            for one, matrix in zip(self.branches, self._reach, strict=True)
        ]
        return [
            one for one, far in zip(self.branches, away, strict=True) if far <= max(_NEARBY**2, min(away))
        ]
