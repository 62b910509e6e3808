"""Whether standard errors describe the likelihood: it is looked at two standard errors away from the optimum.

The errors of a fit are those of a quadratic around it. Along a few directions, those that the data tell least of, the
model is simulated at two standard errors to either side, the initial states at their best; along all others at once,
and where it bends there, along each of them. Three numbers tell:

- the rise of chi-squared, which the quadratic says is 4;
- the intrinsic curvature: how far the outputs leave their tangent, less what parameters and initial states could make
  of it, at the edge of the 95 % region and in units of its radius (Bates & Watts, Nonlinear Regression Analysis, 1988,
  chapter 7, where 1/2 is the limit of what is nearly flat). The noise projects on it too. Where it is large, noise
  decides where the optimum lies and how many there are: below that signal-to-noise ratio no quadratic, and no profile,
  tells the error;
- how far another parameter's best value lies off the quadratic's (the parameter-effects curvature of the same book).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import Deadline, TimeUp, late
from casadi_engine.distributions import chi2_isf
from casadi_engine.errors import ModelError
from casadi_engine.estimation.beside_optimum import (
    UNEVEN,
    bounds,
    entries_of,
    exchanged,
    lost,
    rivals,
    state_bounds,
    uneven,
    unstable,
)
from casadi_engine.estimation.dichotomy import grows
from casadi_engine.estimation.doubt import CALL, FLAT, OR_CALL, RUGGED, Doubt
from casadi_engine.estimation.exchanged import linear_residual
from casadi_engine.estimation.few_samples import interpolated
from casadi_engine.estimation.final_check import printed_cost, residual, response
from casadi_engine.estimation.fit import Optimum
from casadi_engine.estimation.foreseen_ends import FAR, RISES, Rises
from casadi_engine.estimation.growth import in_their_sizes, log_growth
from casadi_engine.estimation.integration import shorten_steps
from casadi_engine.estimation.looked_along import along_parameters, along_states, together
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.standard_errors import Uncertainty, efficiency
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.estimation.uncertainty import chained_gradient

Array = NDArray[np.float64]

# Directions that are looked along; so many others are looked along at once, by twice two simulations, where there are
# more of them.
_DIRECTIONS, _FEWER = 3, 2
# Nearest place to look from [standard errors].
_NEAR = 0.2
# Longest step at which the curvature is the surface's own, and how often it is halved while what is seen falls by more
# than a share: over a whole one a straight line leaves a valley that bends, which noise does not make rugged, and what
# is seen falls with the step; where noise decides it is the same at any.
_SHORT, _HALVED, _SAME = 0.25, 4, 0.1
# Standard errors by which the integration may be off at such a place, and how often its steps are shortened.
_FELT, _SHORTENED = 0.1, 4
# Squared residuals that closing the gaps between shooting intervals may change, and how often they are closed.
_CLOSED, _CLOSINGS = 1e-3, 6
# Standard errors by which another parameter may bend: with c of them at two standard errors along a direction,
# chi-squared d standard errors off, at its lowest z of them along it, is (d - c z^2/4)^2 + z^2, and that is lower than
# d^2 at the ends of a 95 % interval only where c is above 1.02.
_BENDS = 1.0
_UNCHECKED = (
    "the errors are those of the curvature at the optimum, and were not checked away from it: that takes more than "
    "{:.0f} s, as a simulation there is far slower; ce.profile(fit) looks there"
)
_UNLOOKED = (
    "other optima, at which parameters are exchanged, were not looked for to the end: that takes more than {:.0f} s; "
    "starts=10 looks for them"
)
# Logarithm of the growth of a change of the start from which a straight step leads nowhere near where the motion goes.
_BENT = float(np.log(1e3))


def doubts_of(
    search: Search,
    best: Attempt,
    errors: Uncertainty,
    optima: Sequence[Optimum],
    residuals: Sequence[Array],
    *,
    wider: Uncertainty | None = None,
    seconds: float = np.inf,
) -> tuple[tuple[Doubt, ...], dict[str, Rises], dict[int, Rises], str | None]:
    """What speaks against the standard errors at an optimum; how chi-squared rises beside parameters, and beside
    initial states by their entry in [v; initial states]; and why it was not looked at, where it was not.

    errors : those of the likelihood; residuals : (K, M) of each record there, simulated from the printed values;
    wider : the errors that are printed, where they are larger; seconds : of the processor that a look beside the
    optimum may take
    """
    if not errors.optimal:
        return (), {}, {}, None
    unchecked = growing(search, best)
    if not search.problem.nv or not np.isfinite(errors.covariance.matrix).all():
        return (), {}, {}, unchecked
    rises: dict[str, Rises] = {}
    of_states: dict[int, Rises] = {}
    unlooked: str | None = None
    found = rivals(search, best, errors, optima)
    found += lost(search, errors, residuals) + interpolated(search, errors) + unstable(errors)
    if not found:
        try:
            with Deadline(seconds, clock=time.process_time):
                found += exchanged(search, errors)
        except np.linalg.LinAlgError:  # a point of that search; the answer does not hang on it
            pass
        except TimeUp:
            if late():
                raise
            unlooked = _UNLOOKED.format(seconds)
    if unchecked is None:
        around = _Around(search, best, errors, residuals)
        try:
            with Deadline(seconds, clock=time.process_time):
                for move in around.directions():
                    found += around.doubts(move)
                if all(doubt.profiles for doubt in found):
                    rises, of_states = around.rises(found), around.state_rises(found)
                    found += uneven(search, errors, rises)
        except TimeUp:
            if late():
                raise
            rises, of_states, unchecked = {}, {}, _UNCHECKED.format(seconds)
    found += bounds(search, wider or errors, rises) + state_bounds(search, wider or errors)
    return tuple(found), rises, of_states, unchecked or unlooked


def growing(search: Search, best: Attempt) -> str | None:
    """Why nothing is looked at away from an optimum: a step along which a record's start goes is lost on its way; None
    where it can be."""
    points = search.problem.at(best.solution.x).records
    for record, point in zip(search.records, points, strict=True):
        far = grows(record, point)  # then slopes are lost with which coloured noise would count
        if far or (not record.linear and grows(record, point, _BENT)):
            times = np.exp(log_growth(in_their_sizes(point), record.plan.m - 1))
            white = " with white noise" if far else ""
            return (
                f"the errors are those of the curvature at the optimum{white}, and were not checked away from it: a "
                f"change of the start of {record.experiment.name} grows {times:.0e} times on its way"
            )
    return None


def words_of(doubts: Sequence[Doubt], missing: Sequence[str]) -> list[str]:
    """One line for each kind of doubt, the gravest of its kind; those that a profile settles only where nothing graver
    is said. missing : parameters that have no interval by profile."""
    said: list[str] = []
    for kind in ("rival", "lost", "rugged", "curved", "bent", "bound", "uneven"):
        own = [doubt for doubt in doubts if doubt.kind == kind]
        if not own or (said and own[0].profiles):
            continue
        text = f"{', '.join(doubt.text for doubt in own)}: no symmetric error"
        said.append(text if kind in ("bound", "uneven") else max(own, key=lambda doubt: doubt.size).text)
    if said and missing and all(doubt.profiles for doubt in doubts):
        # of what has a value in each record there is no profile
        call = CALL if any("@" in name for name in missing) else f"call ce.profile(fit){OR_CALL}"
        said[-1] += f"; for {', '.join(missing)} {call}"
    return said


# ---- around


class _There(NamedTuple):
    """What is some way from an optimum: the rise of chi-squared; the change of each record's residual (K, M); and felt,
    that of what the loss makes of it, the same for squares."""

    rise: float
    change: list[Array]
    felt: list[Array]


class _Around:
    """The model around an optimum."""

    def __init__(
        self, search: Search, best: Attempt, errors: Uncertainty, residuals: Sequence[Array]
    ) -> None:
        self.search, self.best, self.errors, self.residuals = search, best, errors, residuals
        self.cost = printed_cost(search, errors.v, residuals)
        nv, covariance = search.problem.nv, errors.covariance
        self.entries, self.lower, self.upper = (
            entries_of(search, x) for x in (errors.x, search.lower, search.upper)
        )
        self._inverse = np.linalg.pinv(errors.kept[:nv, :nv], hermitian=True)
        # a long record's slopes are not kept: one direction has to do, and its initial state follows to first order
        self.long = not all(
            isinstance(point.parts, list) for point in search.problem.at(best.solution.x).records
        )
        # squares tell the best initial states of a linear record at once
        self._free = (
            not self.long
            and not search.loss.robust
            and all(
                record.linear and np.isinf(search.upper[lay.at : lay.at + lay.n]).all()
                for record, lay in zip(search.records, search.problem.layouts, strict=True)
            )
        )
        self._to_printed = np.ones(len(self.entries))
        self._to_printed[:nv] = search.coordinates.slope(errors.v)
        self._radius = np.sqrt(chi2_isf(0.05, max(covariance.rank, 1)))

    def directions(self) -> list[Array]:
        """Those along which the likelihood may be no quadratic."""
        moves = along_parameters(self.errors, self.search.problem.nv)
        if self.long:
            return moves[:1]
        first, others = moves[:_DIRECTIONS], moves[_DIRECTIONS:] + along_states(self.search, self.errors)
        straight = len(others) > _FEWER and not any(
            self._bends(move, len(others)) for move in together(others)
        )
        return first if straight else first + others

    def _bends(self, move: Array, count: int) -> bool:
        """Whether the model bends along a direction that goes along so many others as if one of these did."""
        sides = [min(FAR, _room(self.lower, self.upper, self.entries, side * move)) for side in (-1.0, 1.0)]
        if min(sides) < _NEAR:
            return True
        there = [self._simulated(move, far, printed=False) for far in (-sides[0], sides[1])]
        if there[0] is None or there[1] is None:
            return True
        return count * self._even(sides[0], sides[1], there[0].change, there[1].change) > FLAT

    def doubts(self, move: Array) -> list[Doubt]:
        """What is seen to both sides of the optimum.

        A line in the coordinates of the search is one way along this direction, a line in the parameters as they are
        printed another: stiffnesses and inertias keep their ratio along the first, the amount of a damper that is
        hardly known changes by two of its errors along the second. The milder one is what the surface asks for.
        """
        found = self._along(move, printed=False) or []
        if not found or not self.search.coordinates.log.any():
            return found
        other = self._along(move, printed=True)
        return found if other is None else min(found, other, key=_gravity)

    def _along(self, move: Array, *, printed: bool) -> list[Doubt] | None:
        """What is seen along one line; None where a bound is so near that nothing can be."""
        ends, here, way = (self.lower, self.upper), self.entries, move
        if printed:
            ends, here = tuple(_printed(self.search, one) for one in ends), _printed(self.search, here)  # type: ignore[assignment]
            way = self._to_printed * move
        sides = [min(FAR, _room(*ends, here, side * way)) for side in (-1.0, 1.0)]
        if min(sides) < _NEAR:  # a bound is close, and that is said of it
            return None
        gone = [self._as_far_as_it_goes(move, far, printed=printed) for far in (-sides[0], sides[1])]
        fars, there = (gone[0][0], gone[1][0]), [one[1] for one in gone]
        if there[0] is None or there[1] is None:
            return [self._without_value(move)]
        edge = [] if fars == (-sides[0], sides[1]) else [self._without_value(move, fars)]
        if self._plainly(fars, there[0], there[1]):
            return edge
        if self._integrated(move, fars, printed=printed):  # steps that do at the optimum may not do there
            there = [self._simulated(move, far, printed=printed) for far in fars]
        back, forth = there
        if back is None or forth is None:
            return [self._without_value(move)]
        if self._plainly(fars, back, forth):
            return edge
        low, bent, off = self._seen(move, fars[0], back)
        high, other, away = self._seen(move, fars[1], forth)
        curvature = max(bent, other)
        if curvature > RUGGED:
            curvature = self._own_curvature(move, fars, curvature, printed=printed)
        return self._told(move, (low, high), curvature, np.maximum(off, away)) + edge

    def _as_far_as_it_goes(self, move: Array, far: float, *, printed: bool) -> tuple[float, _There | None]:
        """How far along a line the model has a value, and what is there; None where it has none but beside the optimum.

        A state below 0 under a root has none: that is a bound of what leads there.
        """
        there = self._simulated(move, far, printed=printed)
        while there is None and abs(far) > 2 * _NEAR:
            far = far / 2
            there = self._simulated(move, far, printed=printed)
        return far, there

    def _without_value(self, move: Array, fars: tuple[float, float] | None = None) -> Doubt:
        """fars : how far the model has one to both sides, in standard errors; None where that is hardly anywhere."""
        names = _names_along(self.search, move)
        if fars is not None:
            least = min(-fars[0], fars[1])
            text = f"the model has no value {2 * least:g} standard errors along {names}"
            return Doubt("curved", text, move, FLAT)
        text = (
            f"the errors are not known: within {FAR:g} standard errors along {names} the model has no value"
        )
        return Doubt("rugged", f"{text}; {CALL}", move, np.inf)

    def rises(self, doubts: Sequence[Doubt]) -> dict[str, Rises]:
        """How chi-squared rises beside each parameter that is doubted, or whose logarithm and itself differ."""
        search, matrix = self.search, self.errors.kept
        found: dict[str, Rises] = {}
        for k, name in enumerate(() if self.long else search.pmap.free):
            own, size = np.eye(1, len(matrix), k)[0], float(np.sqrt(matrix[k, k]))
            wide = search.coordinates.log[k] and size > UNEVEN / FAR
            if size and (wide or any(doubt.about(own, matrix) for doubt in doubts)):
                risen = self._rises(k, size)
                found |= {} if risen is None else {name: risen}
        return found

    def state_rises(self, doubts: Sequence[Doubt]) -> dict[int, Rises]:
        """The same beside each initial state that is doubted, in which its record is not linear."""
        matrix, at = self.errors.kept, self.search.problem.nv
        found: dict[int, Rises] = {}
        for record in () if self.long else self.search.records:
            for k in range(at, at if record.linear else at + record.n):
                own, size = np.eye(1, len(matrix), k)[0], float(np.sqrt(max(matrix[k, k], 0.0)))
                if size and any(doubt.about(own, matrix) for doubt in doubts):
                    risen = self._rises(k, size)
                    found |= {} if risen is None else {k: risen}
            at += record.n
        return found

    def _rises(self, k: int, size: float) -> Rises | None:
        """How chi-squared rises beside an entry with this standard error; None where that is not to be had."""
        move = self.errors.kept[:, k] / size
        low, high = (self._risen(move, far) for far in (-FAR, FAR))
        return Rises(float(self.entries[k]), size, low, high) if low and high else None

    def _risen(self, move: Array, far: float) -> float:
        """Rise of chi-squared over the quadratic's so far along a move; 0 where none is to be had."""
        if _room(self.lower, self.upper, self.entries, far * move) < 1:
            return 0.0
        there = self._simulated(move, far, printed=False)
        return 0.0 if there is None else max(self._seen(move, far, there)[0], 0.0)

    def _own_curvature(self, move: Array, fars: tuple[float, float], seen: float, *, printed: bool) -> float:
        """The intrinsic curvature over steps so short that a straight line is the surface's own way; ``seen`` over the
        whole ones."""
        least = seen
        for k in range(_HALVED):
            short, found = _SHORT / 2**k, 0.0
            for far in (max(fars[0], -short), min(fars[1], short)):
                there = self._simulated(move, far, printed=printed)
                found = max(found, np.inf if there is None else self._seen(move, far, there)[1])
            settled, least = found > (1 - _SAME) * least, min(found, least)
            if settled or least <= FLAT:
                break
        return least

    def _told(self, move: Array, rises: tuple[float, float], curvature: float, bends: Array) -> list[Doubt]:
        """The doubts that follow from what is seen along a line; see ``_seen``."""
        names = _names_along(self.search, move)
        if curvature > RUGGED:
            text = (
                f"the errors are not known: within them the model is far from linear along {names} (curvature "
                f"{curvature:.2g}, flat below {FLAT:g}), so that noise decides which optimum is the lowest; {CALL}"
            )
            return [Doubt("rugged", text, move, curvature)]
        found, matrix = [], self.errors.kept
        uneven = not all(RISES[0] < rise < RISES[1] for rise in rises)
        if curvature > FLAT or uneven:
            low, high = (FAR**2 * rise for rise in rises)
            # a point so far off that the slopes there lead below the optimum tells no rise
            seen = (
                f"chi-squared rises by {low:.2g} and {high:.2g}"
                if min(low, high) > 0
                else "slopes lead astray"
            )
            text = (
                f"the likelihood is not quadratic along {names}: {FAR:g} standard errors away {seen}"
                + (f", not by {FAR**2:g}" if min(low, high) > 0 else "")
                if uneven
                else f"the outputs bend along {names} within the errors "
                f"(curvature {curvature:.2g}, flat below {FLAT:g})"
            )
            found.append(Doubt("curved", text, move, curvature))
        for k in np.flatnonzero(bends > _BENDS):
            text = (
                f"the likelihood is not quadratic: {FAR:g} standard errors along {names} the best "
                f"{self.search.pmap.free[k]} lies {bends[k]:.2g} of its own off where the quadratic has it"
            )
            found.append(Doubt("bent", text, matrix[:, k] / np.sqrt(matrix[k, k])))
        return found

    def _moved(self, move: Array, far: float, *, printed: bool) -> tuple[Array, Array]:
        """The coordinates (nv,) so far along a line, and the step (N,) there."""
        step, coordinates, nv = far * move, self.search.coordinates, self.search.problem.nv
        if not printed:
            return self.errors.v + step[:nv], step
        return coordinates.of(coordinates.values(self.errors.v) + (self._to_printed * step)[:nv]), step

    def _simulated(self, move: Array, far: float, *, printed: bool) -> _There | None:
        """What is there so far along a line; None where the model has no value."""
        v, step = self._moved(move, far, printed=printed)
        try:
            found = self._residuals(v, step, min(1.0, abs(far) / FAR))
        except (FloatingPointError, np.linalg.LinAlgError, ModelError):
            return None
        rise = printed_cost(self.search, v, found) - self.cost
        loss, pairs = self.search.loss, list(zip(found, self.residuals, strict=True))
        change = [there - here for there, here in pairs]
        felt = [loss.slope(there) - loss.slope(here) for there, here in pairs] if loss.robust else change
        return _There(rise, change, felt) if np.isfinite(rise) else None

    def _integrated(self, move: Array, fars: tuple[float, float], *, printed: bool) -> bool:
        """Give the records steps that do at these places too; True if any has shorter ones now."""
        records, changed, nv = self.search.records, False, self.search.problem.nv
        if self.long or all(record.linear for record in records):
            return False
        for far in fars:
            v, step = self._moved(move, far, printed=printed)
            at = nv
            for record, lay in zip(records, self.search.problem.layouts, strict=True):
                start = lay.take(self.errors.x)[0] + step[at : at + record.n]
                at += record.n
                try:
                    nodes = chained_nodes(record, v, start)
                    for _ in range(_SHORTENED):
                        if not shorten_steps([record], v, [nodes], shift=_FELT):
                            break
                        changed, nodes = True, chained_nodes(record, v, start)
                except (FloatingPointError, np.linalg.LinAlgError, ModelError):
                    continue
        if changed:
            self.search.problem.forget()
        return changed

    def _plainly(
        self,
        fars: tuple[float, float],
        back: _There,
        forth: _There,
    ) -> bool:
        """True if no slopes are needed to see that the quadratic holds: the even part of the changes is nearly 0."""
        a, b = -fars[0], fars[1]
        if not all(
            RISES[0] < self._shares[1] * one.rise / far**2 < RISES[1] for one, far in ((back, a), (forth, b))
        ):
            return False
        return self._even(a, b, back.change, forth.change) < FLAT

    def _even(self, a: float, b: float, back: Sequence[Array], forth: Sequence[Array]) -> float:
        """The curvature that the even part of the changes of the residuals is, a standard errors back and b forth."""
        even = sum(float(np.sum((a * q + b * p) ** 2)) for p, q in zip(back, forth, strict=True))
        return float(self._radius * 2 * np.sqrt(even)) / (a * b * (a + b))

    def _seen(self, move: Array, far: float, there: _There) -> tuple[float, float, Array]:
        """Rise of chi-squared over the quadratic's, curvature, and the standard errors (nv,) by which the best values
        of the parameters lie off the quadratic's, for a whole step."""
        search, nv, step = self.search, self.search.problem.nv, far * move
        prior = search.problem.priors.evaluate(self.errors.v)[3] @ step[:nv]
        held = np.append(prior, np.zeros(len(self.entries) - nv))
        plain = self._along_slopes(there.change) + held
        gradient = plain if there.felt is there.change else self._along_slopes(there.felt) + held
        size = sum(float(np.sum(q**2)) for q in there.change) + float(step[:nv] @ prior)
        matrix = self.errors.kept
        squares, bends = self._shares
        inside, moved = bends * float(gradient @ matrix @ gradient), bends * (matrix[:nv] @ gradient)
        outside = max(size - squares * float(plain @ matrix @ plain), 0.0)
        # where initial states are at their best already, a profile lowers the rise by the parameters alone
        own = float(moved @ self._inverse @ moved) / bends if self._free else inside
        beside = max(own - bends * float(gradient @ move) ** 2, 0.0)
        # whitened innovations change with the noise levels too, which is no bend of the model
        bent = 0.0 if search.predictor.kind == "process" else float(np.sqrt(outside))
        sizes = np.sqrt(np.maximum(np.diag(matrix)[:nv], 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.where(sizes > 0, np.abs(moved - step[:nv]) / sizes, 0.0) * (FAR / far) ** 2
        return bends * (there.rise - beside) / far**2, self._radius * 2 * bent / far**2, off

    @cached_property
    def _shares(self) -> tuple[float, float]:
        """What the covariance is multiplied by to be the inverse of the squares of the slopes, and of the curvature of
        the loss: both 1 for squares."""
        loss, residuals = self.search.loss, zip(self.residuals, self.search.records, strict=True)
        if not loss.robust:
            return 1.0, 1.0
        r = np.concatenate([found[record.observation.valid] for found, record in residuals])
        share, curvature = efficiency(loss, r, self.search.lost), loss.curvature(r)
        return share, share / max(1.0 if curvature is None else float(np.mean(curvature)), 1e-9)

    def _residuals(self, v: Array, step: Array, share: float) -> list[Array]:
        """The weighted residual (K, M) of each record after a step (N,) to v, so short a share of a whole one."""
        search, at, found = self.search, self.search.problem.nv, []
        points = search.problem.at(self.best.solution.x).records
        for record, point, lay in zip(search.records, points, search.problem.layouts, strict=True):
            own = np.concatenate([step[record.active], step[at : at + record.n]])
            if not isinstance(point.parts, list):  # a long record
                found.append(
                    residual(record, response(record, v, lay.take(self.errors.x)[0] + own[-record.n :])[0])
                )
            elif record.linear:
                start = lay.take(self.errors.x)[0] + own[-record.n :]
                found.append(linear_residual(record, v, start, np.full(record.n, self._free)))
            else:
                found.append(_followed(record, point, lay.take(self.best.solution.x), v, own, share))
            at += record.n
        return found

    def _along_slopes(self, change: Sequence[Array]) -> Array:
        """Products (N,) of a change of the residuals (K, M) of each record with their slopes."""
        search, nv = self.search, self.search.problem.nv
        points, at, found = search.problem.at(self.best.solution.x).records, nv, np.zeros(len(self.entries))
        for record, point, q in zip(search.records, points, change, strict=True):
            parts = [part.gradient(record.observation.part(q, part.at)) for part in point.parts]
            in_nodes = np.sum([one[1] for one in parts], axis=0)
            own = chained_gradient(record, point, in_nodes)
            found[record.active] += np.sum([one[0] for one in parts], axis=0) + own[: len(record.active)]
            found[at : at + record.n] += own[len(record.active) :]
            at += record.n
        return found


def _followed(
    record: RecordTerm, point: RecordPoint, nodes: Array, v: Array, step: Array, share: float
) -> Array:
    """The weighted residual (K, M) after a step (nz + n,) of the active parameters and the first state.

    The intervals start where the slopes at the point foresee it, and run side by side; what then gapes is closed by
    these slopes, again where that is much beside the squares that a curvature makes of so short a step.
    """
    nz, count, path = len(record.active), record.plan.m, point.path
    ends = np.broadcast_to(path.end_s, (count, record.n, record.n))
    js = point.js if point.js.ndim == 3 else point.js[:, None]
    change = np.zeros_like(nodes)
    change[0] = step[nz:]
    for k in range(count - 1):
        change[k + 1] = ends[k] @ change[k] + path.end_z[:, :, k].T @ step[:nz]
    at = nodes + change
    for _ in range(_CLOSINGS):
        outputs, there = record.outputs_at(v, at)
        gaps, closed = there.end[:, :-1].T - at[1:], np.zeros_like(nodes)
        for k in range(count - 1):
            closed[k + 1] = ends[k] @ closed[k] + gaps[k]
        felt = np.einsum("kma,ma->km", js, closed) * record.weight
        if float(np.sum(felt**2)) < _CLOSED * share**4:
            break
        at = at + closed
    return residual(record, outputs) + felt


def _gravity(found: Sequence[Doubt]) -> tuple[bool, bool, float]:
    """How grave doubts are, for the milder of two."""
    return bool(found), any(not one.profiles for one in found), max((one.size for one in found), default=0.0)


def _printed(search: Search, entries: Array) -> Array:
    """Entries (N,) with the parameters as they are printed."""
    nv = search.problem.nv
    return np.concatenate([search.coordinates.values(entries[:nv]), entries[nv:]])


def _room(lower: Array, upper: Array, entries: Array, move: Array) -> float:
    """How many times a move fits between the bounds."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to = np.where(move > 0, upper - entries, lower - entries) / move
    return float(to[move != 0].min(initial=np.inf))


def _names_along(search: Search, move: Array) -> str:
    """The free parameters that a direction moves most; the initial states, where these are held."""
    nv = search.problem.nv
    if not move[:nv].any():
        return _states_along(search, move[nv:])
    own = np.abs(move[:nv])
    order = [k for k in np.argsort(-own) if own[k] > 0.2 * own.max()][:3]
    return ", ".join(search.pmap.free[k] for k in order)


def _states_along(search: Search, move: Array) -> str:
    """The initial states that a direction moves most, of those of a record."""
    at = 0
    for record in search.records:
        own = np.abs(move[at : at + record.n])
        if own.any():
            order = [k for k in np.argsort(-own) if own[k] > 0.2 * own.max()][:3]
            names = [state.name for k in order for state in record.model.states[k : k + 1]]
            return f"the first {', '.join(names)} of {record.experiment.name}"
        at += record.n
    return "the first states"
