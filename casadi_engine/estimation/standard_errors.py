"""Standard errors at the best point of a search: bounds and constraints that act, and errors through ties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.dichotomy import eliminated, grows
from casadi_engine.estimation.fit import AtBound, Direction, Estimate
from casadi_engine.estimation.growth import check_growth
from casadi_engine.estimation.inside_limits import HELD, Active, inside_limits
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.parameter_errors import ParameterErrors
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.uncertainty import (
    Covariance,
    chained_gradient,
    chained_information,
    in_words,
    invert,
    orthonormal,
)

Array = NDArray[np.float64]

# A bound or a limit acts if the estimate is nearer to it than this many standard errors (a move that the data cannot
# tell: it changes chi-squared by the square, 1e-3), and if without it the estimate would go beyond it by more than
# ``_BEYOND`` times as far. The standard error is the one that the estimate has without bounds.
_NEAR, _BEYOND = 0.03, 3.0
# Why an estimate has no error that no record tells.
UNDETERMINED = "the data do not determine it"


@dataclass(frozen=True)
class Released:
    """The errors of the estimate as they were without the bounds and inequalities that act, and the force (N,) of these
    on the summed loss: covariance @ force is how far the estimate would move if they let it go."""

    covariance: Covariance
    force: Array


@dataclass(frozen=True)
class Uncertainty:
    """What is known of the errors at the point x (size,), parameters at a bound put on it.

    bound : False, "min" or "max" of every entry of [v; initial states]; covariance : over the same entries
    decrement : the fall of chi-squared that one more Gauss-Newton step promises, within bounds and constraints;
    step : that step, of the same entries
    """

    search: Search
    x: Array
    bound: list[AtBound]
    covariance: Covariance
    acting: tuple[str, ...] = ()  # constraints that hold the estimate back, with the limit that does
    optimal: bool = True
    decrement: float = 0.0
    step: Array | None = None
    released: Released | None = None  # where bounds or inequalities act: the errors if they did not
    blind: Sequence[Array] = ()  # directions of which nothing is known but for what is at its bound
    # (N, k) how all move with what is at its bound and may be inside, in its standard errors
    inside: Array | None = None

    @property
    def v(self) -> Array:
        """(nv,) solver's coordinates of the free parameters."""
        return self.x[: self.search.problem.nv]

    @property
    def directions(self) -> tuple[Direction, ...]:
        """What the data do not determine, in words."""
        return tuple(Direction(*in_words(d, _names(self.search))) for d in self.covariance.directions)

    @property
    def kept(self) -> Array:
        """(N, N) the covariance where what is at a bound stays there."""
        if self.inside is None:
            return self.covariance.matrix
        rest = self._beside_bounds(self.inside)
        return np.asarray(self.covariance.matrix - rest @ rest.T)

    @property
    def told(self) -> Array:
        """(N, N) the covariance of everything, what is at a bound and may be inside too."""
        return self.kept if self.inside is None else np.asarray(self.kept + self.inside @ self.inside.T)

    def scattered(self, more: Array) -> Array:
        """(N, N) what the covariance of everything grows by where the slopes of the loss scatter by ``more`` (N, N)
        than the information says."""
        found = self.kept @ more @ self.kept
        if self.inside is not None:
            found = found + self.inside @ (self.inside.T @ more @ self.inside) @ self.inside.T
        return np.asarray(found)

    def _beside_bounds(self, inside: Array) -> Array:
        """(N, k) how what is at no bound moves with what is."""
        held = np.array([side is not False for side in self.bound])
        return np.where(held[:, None], 0.0, inside)

    def widened(self, more: Array) -> Uncertainty:
        """The same where the slopes of the loss scatter by ``more`` (N, N) than the information says."""
        known = self.released
        if known is not None:
            grown = known.covariance.matrix @ more @ known.covariance.matrix
            known = replace(
                known, covariance=replace(known.covariance, matrix=known.covariance.matrix + grown)
            )
        grown, held = self.scattered(more), np.array([side is not False for side in self.bound])
        grown[held, :] = grown[:, held] = 0.0  # it has no symmetric error
        return replace(
            self, covariance=replace(self.covariance, matrix=self.covariance.matrix + grown), released=known
        )

    def of_parameters(self) -> Array:
        """(nz, nz) covariance in the parameters' units; NaN where the data do not determine an entry."""
        scale = self.search.coordinates.slope(self.v)
        nv = len(scale)
        matrix = self.covariance.matrix[:nv, :nv] * np.outer(scale, scale)
        unknown = np.zeros(nv, dtype=bool)
        for direction in self.covariance.directions:
            unknown |= np.abs(direction[:nv]) >= 1e-6
        if not self.optimal:
            unknown[:] = True
        matrix[unknown, :] = np.nan
        matrix[:, unknown] = np.nan
        return matrix

    def as_prior(self) -> ParameterErrors | None:
        """The errors of the free vector z as a prior for other data; None if the search did not end at an optimum."""
        if not self.optimal:
            return None
        scale, nv = self.search.coordinates.slope(self.v), self.search.problem.nv
        known = self.covariance if self.released is None else self.released.covariance
        unknown = np.array([d[:nv] for d in known.directions]).T if known.directions else np.zeros((nv, 0))
        covariance = known.matrix[:nv, :nv] * np.outer(scale, scale)
        shift = np.zeros(nv) if self.released is None else known.matrix[:nv] @ self.released.force * scale
        return ParameterErrors.of(self.search.pmap.free, covariance, unknown * scale[:, None], scale, shift)

    def slopes(self) -> dict[str, Array]:
        """Reported parameter -> its slope (nv,) in the coordinates v, through ties."""
        search, nv = self.search, len(self.v)
        pmap, z = search.pmap, search.coordinates.values(self.v)
        function = ca.Function("j", [pmap.z], [ca.densify(ca.jacobian(pmap.reported_expressions, pmap.z))])
        names = list(pmap.values(z))
        slopes = np.asarray(function(z), dtype=float).reshape(len(names), nv)
        return dict(zip(names, slopes * search.coordinates.slope(self.v), strict=True))

    def estimates(self) -> dict[str, Estimate]:
        """Every reported parameter with its error, propagated through ties to first order."""
        search, nv, matrix = self.search, len(self.v), self.covariance.matrix
        pmap, z = search.pmap, search.coordinates.values(self.v)
        values, found = pmap.values(z), {}
        for name, slope in self.slopes().items():
            side: AtBound = self.bound[pmap.free.index(name)] if name in pmap.free else False
            error, why = self._error(slope, matrix[:nv, :nv], side)
            unit = search.parameters[name.split("@")[0]].unit
            found[name] = Estimate(values[name], error, unit, side, why, fixed=not slope.any())
        return found

    def _error(self, slope: Array, matrix: Array, side: AtBound) -> tuple[float | None, str | None]:
        """Standard error of a quantity with this slope (nv,), or why there is none."""
        if not slope.any():
            return None, "fixed"
        if side is not False:
            return None, f"at its {'lower' if side == 'min' else 'upper'} bound: there is no symmetric error"
        if not self.optimal:
            return None, "the search did not end at an optimum"
        size = float(np.linalg.norm(slope))
        if any(abs(d[: len(slope)] @ slope) > 1e-6 * size for d in self.covariance.directions):
            return None, UNDETERMINED
        if any(abs(d[: len(slope)] @ slope) > 1e-6 * size for d in self.blind):
            return None, "the data tell it only for what is at its bound"
        variance = float(slope @ matrix @ slope)
        # what it would be if the entries were independent
        if variance <= HELD * float(slope**2 @ np.diag(matrix)):
            return None, "held by active bounds or constraints"
        return float(np.sqrt(variance)), None

    def initial_estimates(self) -> dict[str, dict[str, Estimate]]:
        """Record -> state -> its estimate at the start."""
        found, at = {}, self.search.problem.nv
        for record, limits in zip(self.search.records, self.search._initial, strict=True):
            found[record.experiment.name] = self._initial_states(record, limits, at)
            at += record.n
        return found

    def _initial_states(self, record: RecordTerm, limits: tuple[Array, ...], at: int) -> dict[str, Estimate]:
        """The initial states of a record, whose entries of the covariance begin ``at``."""
        lay = self.search.problem.layouts[self.search.records.index(record)]
        start = lay.take(self.x)[0] * record.scale
        found = {}
        for k, state in enumerate(self.search.model.states):
            fixed = bool(limits[0][k] == limits[1][k])
            side = self.bound[at + k]
            error, why = None, None
            if fixed:
                side, why = False, "fixed"
            elif side is not False:
                why = f"at its {'lower' if side == 'min' else 'upper'} bound: there is no symmetric error"
            elif not self.optimal:
                why = "the search did not end at an optimum"
            elif any(abs(d[at + k]) >= 1e-6 for d in self.covariance.directions):
                why = UNDETERMINED
            else:
                error = float(np.sqrt(max(self.covariance.matrix[at + k, at + k], 0.0)) * record.scale[k])
            found[state.name] = Estimate(float(start[k]), error, state.unit, side, why, fixed)
        return found


def uncertainty(search: Search, best: Attempt) -> Uncertainty:
    """Errors at the best point, with the noise levels that the search is weighted by."""
    information, gradient, turn = _information(search, best)
    limits = [(low, high) for low, high, _ in search._initial]
    fixed = np.concatenate([np.zeros(search.problem.nv, dtype=bool), *[low == high for low, high in limits]])
    equal = _rows(search, best.v, search.constraints.lower == search.constraints.upper, len(information))
    x = best.solution.x.copy()
    entries = np.concatenate([x[: search.problem.nv], *[lay.take(x)[0] for lay in search.problem.layouts]])
    open_ = invert(information, fixed, equal, entries)
    force = gradient.copy()
    if search.constraints.count:  # what the bounds have to hold beside the constraints
        pull = search.constraints.evaluate(best.v)[1].T @ best.solution.lam_g[: search.constraints.count]
        force[: search.problem.nv] += search.problem.samples * pull
    bound = _at_bounds(search, best, open_, force, np.diag(information))
    for k, side in enumerate(bound[: search.problem.nv]):
        if side is not False:
            x[k] = search.lower[k] if side == "min" else search.upper[k]
    closed = fixed | np.array([side is not False for side in bound], dtype=bool)
    rows, spans, acting = _active_rows(search, best, x[: search.problem.nv], open_)
    optimal = best.solution.status == "converged"
    found = invert(information, closed, rows, entries)
    step = -found.matrix @ gradient
    decrement = float(-gradient @ step)
    held = np.flatnonzero(closed[: search.problem.nv] & ~fixed[: search.problem.nv])
    spans = np.concatenate([search.upper[held] - search.lower[held], spans])
    inside, blind = inside_limits(information, found, Active(closed, held, rows, spans), gradient)
    if inside is not None:
        rest = np.where(closed[:, None], 0.0, inside)  # what is at a bound has no symmetric error
        found = replace(found, matrix=found.matrix + rest @ rest.T)
    acts = bool(closed[: search.problem.nv].any()) or bool(acting)
    released = _released(search, best, information, closed, x[: search.problem.nv]) if acts else None
    told = Uncertainty(search, x, bound, found, acting, optimal, decrement, step, released, blind, inside)
    return told if turn is None else _turned(told, turn)


def _turned(told: Uncertainty, turn: Array) -> Uncertainty:
    """What is known of [v; initial states] from what is known of other coordinates, that ``turn`` (N, N) leads from."""

    def matrix(own: Covariance) -> Covariance:
        return replace(
            own, matrix=turn @ own.matrix @ turn.T, directions=list(orthonormal(own.directions, turn).T)
        )

    known = told.released
    if known is not None:
        known = replace(known, covariance=matrix(known.covariance))
    return replace(
        told,
        covariance=matrix(told.covariance),
        step=None if told.step is None else turn @ told.step,
        released=known,
        blind=list(orthonormal(told.blind, turn).T),
        inside=None if told.inside is None else turn @ told.inside,
    )


def _released(
    search: Search, best: Attempt, information: Array, closed: NDArray[np.bool_], v: Array
) -> Released:
    """The errors without the bounds of parameters and the inequalities between them; equalities stay."""
    nv, samples, user = search.problem.nv, search.problem.samples, search.constraints
    force = np.zeros(len(information))
    force[:nv] = np.where(closed[:nv], best.solution.lam_x[:nv] * samples, 0.0)
    rows = np.zeros((0, len(information)))
    if user.count:
        _, jacobian = user.evaluate(v)
        equal = user.lower == user.upper
        force[:nv] += (best.solution.lam_g[: user.count] * samples * ~equal) @ jacobian
        rows = np.zeros((int(equal.sum()), len(information)))
        rows[:, :nv] = jacobian[equal]
    return Released(invert(information, np.concatenate([np.zeros(nv, dtype=bool), closed[nv:]]), rows), force)


def _information(search: Search, best: Attempt) -> tuple[Array, Array, Array | None]:
    """Information matrix over [v; initial states] and gradient of half chi-squared, both through continuity; of records
    along which changes grow over other coordinates, which the last matrix leads from (None: none does)."""
    problem, x = search.problem, best.solution.x
    point = problem.at(x)
    check_growth(search.records, point.records)
    size = problem.nv + sum(record.n for record in search.records)
    information, turn, turned = np.zeros((size, size)), np.eye(size), False
    information[: problem.nv, : problem.nv] = problem.priors.evaluate(x[: problem.nv])[3]
    gradient, out = np.zeros((2, size))
    gradient[: problem.nv] = point.gradient[: problem.nv] * problem.samples
    at = problem.nv
    for record, found, lay, limits in zip(
        search.records, point.records, problem.layouts, search._initial, strict=True
    ):
        # Huber's information is that of least squares times the efficiency of the clipped residuals.
        share = efficiency(search.loss, found.r[record.observation.valid], search.lost)
        where = np.concatenate([record.active, np.arange(at, at + record.n)])
        kept = np.isfinite(np.array(limits[:2])).any(axis=0)
        apart = None
        if grows(record, found):
            apart = eliminated(record, found, np.asarray(kept), search.loss.slope(found.r))
        if apart is None:
            own = chained_information(record, found, record.gauss_newton(found))
            node_gradient = lay.take(point.gradient) * problem.samples
            gradient[where] += chained_gradient(record, found, node_gradient)
        else:
            own, turned = apart.information, True
            turn[at : at + record.n, where] = apart.turn[len(record.active) :]
            out[where] += apart.gradient
            out[record.active] -= record.gradient(found, search.loss)[0]  # which is in that of the problem
        information[np.ix_(where, where)] += own * share
        at += record.n
    return information, turn.T @ gradient + out if turned else gradient, turn if turned else None


def efficiency(loss: Loss, r: Array, lost: float = 0.0) -> float:
    """(mean rho'')^2 / mean rho'^2: 1 for least squares with unit residuals; lost : share of the samples that free
    parameters and initial states take, for which few samples have the corrections of Huber 1981, section 7.6.

    No more than 1: residuals that are smaller than the noise is known or can be make no estimate better than the noise.
    """
    if not loss.robust:
        return 1.0
    curvature, slope = loss.curvature(r), loss.slope(r)
    if curvature is None:
        return 1.0
    inner = float(np.mean(curvature))
    size = float(np.mean(slope**2)) / max(1.0 - lost, 1e-9)
    few = 1.0 + lost * (1.0 - inner) / max(inner, 1e-9)
    return inner**2 / max(size, inner**2, 1e-300) / few**2


def _acts(near: float, force: float, variance: float) -> bool:
    """True if a limit at the distance ``near`` holds the estimate back.

    force : slope of half chi-squared towards the limit; variance : of the estimate across the limit
    """
    if near <= 0:
        return force >= 0
    shift = force * variance  # how far beyond its place the estimate would go
    return bool(near < _NEAR * np.sqrt(max(variance, 0.0)) and shift > _BEYOND * near)


def _at_bounds(search: Search, best: Attempt, open_: Covariance, force: Array, alone: Array) -> list[AtBound]:
    """For v and the initial states: False, "min" or "max"; force : slopes of half chi-squared there; alone : (N,) their
    information with all others held: one is put on its bound without them, which the data must not tell either."""
    problem, x, found = search.problem, best.solution.x, []
    entries = list(range(problem.nv))
    for lay in problem.layouts:
        entries += range(lay.at, lay.at + lay.n)
    for k, entry in enumerate(entries):
        low, high = x[entry] - search.lower[entry], search.upper[entry] - x[entry]
        side: AtBound = "min" if low <= high else "max"
        own = float(force[k]) if side == "min" else -float(force[k])
        near = float(min(low, high))
        acts = _acts(near, own, float(open_.matrix[k, k])) and max(near, 0.0) ** 2 * alone[k] < _NEAR**2
        found.append(side if acts else False)
    return found


def _active_rows(
    search: Search, best: Attempt, v: Array, open_: Covariance
) -> tuple[Array, Array, tuple[str, ...]]:
    """Gradients (c, N) of the constraints that act, the equalities first; and of the inequalities among them how far it
    is to their other limit, and which they are in words."""
    user, nv = search.constraints, search.problem.nv
    if not user.count:
        return np.zeros((0, len(open_.matrix))), np.zeros(0), ()
    value, jacobian = user.evaluate(v)
    variance = np.einsum("ca,ab,cb->c", jacobian, open_.matrix[:nv, :nv], jacobian)
    force = best.solution.lam_g[: user.count] * search.problem.samples
    equal = user.lower == user.upper
    active, words = np.zeros_like(equal), []
    for side, limit, near, push in (
        ("lower", user.lower, value - user.lower, -force),
        ("upper", user.upper, user.upper - value, force),
    ):
        acts = ~equal & np.array([_acts(*numbers) for numbers in zip(near, push, variance, strict=True)])
        words += [
            f"{user.labels[k]} at its {side} limit {limit[k] * user.scale[k]:.6g}"
            for k in np.flatnonzero(acts)
        ]
        active |= acts
    rows = [_rows(search, v, which, len(open_.matrix)) for which in (equal, active)]
    return np.concatenate(rows), (user.upper - user.lower)[active], tuple(words)


def _rows(search: Search, v: Array, which: NDArray[np.bool_], size: int) -> Array:
    """Gradients (c, size) of these constraints on parameters."""
    rows = np.zeros((int(which.sum()), size))
    if len(rows):
        rows[:, : len(v)] = search.constraints.evaluate(v)[1][which]
    return rows


def _names(search: Search) -> list[str]:
    names = list(search.pmap.free)
    for record in search.records:
        at = f" at the start of {record.experiment.name}" if len(search.records) > 1 else " at the start"
        names += [state.name + at for state in search.model.states]
    return names
