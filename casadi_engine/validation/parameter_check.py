"""Do fresh data agree with the parameters of a fit, within the errors of these? The refit that the tests look at.

A fit knows its parameters to a covariance, and on a longer or stronger record their errors may be far larger than its
noise: simulated with the parameters held, the right model then fails every test. So the parameters are fitted to the
fresh data once more, with what the fit knows of them as a prior, and initial states free. How far they move is a test
of its own, and the residual is tested for what no parameters explain; see `parameter_prior`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casadi_engine.distributions import f_sf, normal_sf
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit
from casadi_engine.estimation.doubt import as_able
from casadi_engine.estimation.fit_percent import FloatArray
from casadi_engine.estimation.loss import loss_of
from casadi_engine.estimation.single_shots import Place, SingleShots
from casadi_engine.estimation.varied_noise import sizes_of
from casadi_engine.problem.noise import Noise
from casadi_engine.validation.level_tests import memory_of, worth_of
from casadi_engine.validation.parameter_prior import PriorSplit, felt
from casadi_engine.validation.projection import orthonormal
from casadi_engine.validation.residual_tests import ResidualTest

# A direction that bounds or constraints hold is kept to this share of the parameters' size.
_KEPT = 1e-6
# Noise levels that are estimated are settled in rounds, to this share.
_ROUNDS, _SETTLED = 6, 1e-4
# Steps of a search in which the residual is evaluated once or twice each.
_EVALUATIONS = 60
# A gap is called beyond the noise from this many standard deviations of chi-squared.
_BEYOND = 3.0
# Fewest samples of which a memory is told.
_FEW = 30
# Residual in standard deviations that stands for a point at which the model cannot be simulated.
_REFUSED = 1e6


@dataclass(frozen=True)
class Moved:
    """One parameter of a fit on fresh data: fitted : (value, standard error or None); fresh : where both data put it
    together; unit"""

    fitted: tuple[float, float | None]
    fresh: float
    unit: str


@dataclass(frozen=True)
class ParameterCheck:
    """The test "the parameters agree with those of the fit" on fresh data.

    statistic : chi-squared by which the parameters disagree, dof : directions compared, p_value : its chance; None with
    ``why`` where there is nothing to compare
    explained : share of the gap, beyond the noise of the fit, that errors of the parameters explain; None without such
    a gap. chi2 : chi-squared per sample at the fitted parameters, and within their errors
    moved : name -> Moved; at_bound : parameters that were at a bound in the fit
    limits : one-sided test of the bounds and inequalities ``beyond`` which fit and fresh data together go; None if they
    stay inside
    """

    statistic: float | None
    dof: int | None
    p_value: float | None
    explained: float | None = None
    chi2: tuple[float, float] | None = None
    moved: Mapping[str, Moved] | None = None
    at_bound: tuple[str, ...] = ()
    limits: ResidualTest | None = None
    beyond: tuple[str, ...] = ()
    why: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for result.json, each null with its reason under ``why``."""
        found: dict[str, Any] = {
            "statistic": self.statistic,
            "dof": self.dof,
            "p_value": self.p_value,
            "explained": self.explained,
            "chi2_fitted": None if self.chi2 is None else self.chi2[0],
            "chi2_within_errors": None if self.chi2 is None else self.chi2[1],
        }
        why = {key: self.why or "the refit was not made" for key, value in found.items() if value is None}
        if self.explained is None and self.chi2 is not None:
            why["explained"] = "no gap beyond the noise of the fit"
        moved = {
            name: {"fitted": one.fitted[0], "stderr": one.fitted[1], "fresh": one.fresh, "unit": one.unit}
            | ({"why": {"stderr": "the fit has no standard error of it"}} if one.fitted[1] is None else {})
            for name, one in (self.moved or {}).items()
        }
        made = found | {"moved": moved, "at_bound": list(self.at_bound), "beyond": list(self.beyond)}
        made["limits_p"] = None if self.limits is None else self.limits.p_value
        if self.limits is None:
            why["limits_p"] = "fit and fresh data stay within all bounds"
        return made | {"why": why}


@dataclass(frozen=True, eq=False)
class Refit:
    """The check, and by (record, output) what the tests of the residual need: the samples' numbers (K,), the residual
    [output's unit] (K,), and the directions (K, p) in which fitting has moved it.

    levels : output -> standard deviation of what no parameters explain of the fresh data, and that of the fit's noise,
    for outputs of which both are estimated; freedom : output -> degrees of freedom of the first one
    """

    check: ParameterCheck
    index: Mapping[Place, Any]
    residual: Mapping[Place, FloatArray]
    slopes: Mapping[Place, FloatArray]
    levels: Mapping[str, tuple[float, float]]
    freedom: Mapping[str, float]
    reach: Mapping[Place, float]


def noise_changed(fit: Fit, again: Refit, output: str) -> float:
    """Chance of a ratio of the two noise levels of an output that is as far from one (two-sided, Fisher's F), as many
    samples as each residual is worth."""
    fresh, own = again.levels[output]
    here = worth_of([one for place, one in again.residual.items() if place[1] == output])
    there = worth_of([t[output].residual[t[output].mask] for t in fit.traces.values() if output in t])
    larger = float(
        f_sf((fresh / own) ** 2, max(here * again.freedom[output], 1.0), max(there * fit.dof, 1.0))
    )
    return 2.0 * min(larger, 1.0 - larger)


def refit(fit: Fit, held: Fit) -> Refit:
    """Fit the parameters to fresh data beside what a fit knows of them.

    fit : the errors are its; held : its parameters on the fresh data, initial states found
    """
    try:
        problem = _Problem(fit, held)
        x, sigma = problem.settled()
        return problem.answer(x, sigma)
    except (CasadiEngineError, FloatingPointError) as error:
        why = f"the parameters could not be fitted to the fresh data ({str(error).splitlines()[0]})"
        return Refit(ParameterCheck(None, None, None, why=why), {}, {}, {}, {}, {}, {})


class _Problem:
    """The refit as nonlinear least squares in x = [coordinates of z; first states]."""

    def __init__(self, fit: Fit, held: Fit) -> None:
        self.fit, self.held = fit, held
        parameters = fit.parameters.copy()
        used = parameters.references(held.model.parameter_names)
        for name in parameters:
            if parameters[name].vary and name not in used:
                parameters.fix(name)  # gains, levels of noise
        outputs: dict[str, Any] = dict(held.residual_level)
        self.shots = SingleShots(
            held.model, held.data, parameters, Noise(gain=held.gain, **outputs),
            method=str(held.options.get("method", "exact")),
        )  # fmt: skip
        self.estimated = {name for name, (_, free) in held.noise.items() if free}
        free = self.shots.free
        values = held.values
        self.fitted = np.array(
            [fit.values.get(name, values.get(name, values.get(name.partition("@")[0], 0.0))) for name in free]
        )
        errors = None if fit.doubted else fit.errors
        nothing, self.blind = np.zeros((0, len(free))), False
        self.rows, self.shift = (nothing, np.zeros(0)) if errors is None else errors.over(free)
        self.still = nothing if errors is None else errors.held_over(free)
        if errors is not None and len(self.rows) + len(self.still) < sum(
            name in errors.names for name in free
        ):
            # Along what the fit does not tell, fresh data may go farther than its other errors are linear.
            self.rows, self.shift, self.blind = nothing, np.zeros(0), True
        first = {record.name: held.states_at_start[record.name] for record in held.data}
        now = {name: values.get(name, value) for name, value in zip(free, self.fitted, strict=True)}
        self.begin = self.shots.start(now, first)
        x_fitted = self.shots.start(dict(zip(free, self.fitted, strict=True)), first)
        # Normal in the solver's coordinates: what must be positive is known to a factor.
        self.centre, self.units = x_fitted[: len(free)], self.shots.units(x_fitted)
        self.freedom: dict[str, float] = {}

    # ---- search

    def settled(self) -> tuple[FloatArray, dict[str, float]]:
        """The point x, and the noise levels of the fresh data."""
        x = self.begin
        sigma = dict(self.held.residual_level)
        sigma |= {name: self.fit.residual_level.get(name, sigma[name]) for name in self.estimated}
        for _ in range(_ROUNDS):
            x = self._solved(x, sigma)
            found = self._levels(x, sigma)
            change = max((abs(found[name] / sigma[name] - 1) for name in sigma), default=0.0)
            sigma = found
            if change < _SETTLED:
                break
        return x, sigma

    def _solved(self, x: FloatArray, sigma: Mapping[str, float]) -> FloatArray:
        from scipy.optimize import least_squares

        self.shots.weigh(sigma)
        stored: dict[bytes, tuple[FloatArray, FloatArray]] = {}

        def at(point: FloatArray) -> tuple[FloatArray, FloatArray]:
            key = point.tobytes()
            if key not in stored:
                stored.clear()
                stored[key] = self._joint(point)
            return stored[key]

        open_ = self.shots.lower < self.shots.upper
        if not open_.any():
            return x

        def whole(part: FloatArray) -> FloatArray:
            point = x.copy()
            point[open_] = part
            return point

        lower, upper = self.shots.lower[open_], self.shots.upper[open_]
        within = np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf)
        inside = np.clip(x[open_], *within)

        def residual(part: FloatArray) -> FloatArray:
            return at(whole(part))[0]

        def slopes(part: FloatArray) -> FloatArray:
            return at(whole(part))[1][:, open_]

        # where the frequency domain leads, a few steps are left to do
        sooner = np.clip(self.shots.nearer(x, self._prior_squares)[open_], *within)
        if float(np.sum(residual(sooner) ** 2)) < float(np.sum(residual(inside) ** 2)):
            inside = sooner
        found = least_squares(
            residual,
            inside,
            jac=slopes,
            bounds=(lower, upper),
            x_scale="jac",
            xtol=1e-10,
            ftol=1e-10,
            max_nfev=_EVALUATIONS,
        )
        return whole(found.x)

    def _joint(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals of data and prior, and their slopes."""
        prior, slope = self._prior(x)
        try:
            residual, slopes = self.shots.evaluate(x)
        except FloatingPointError:
            if np.array_equal(x, self.begin):
                raise
            residual = np.full(self.shots.count, _REFUSED)
            slopes = np.zeros((self.shots.count, len(x)))
        return np.concatenate([residual, prior]), np.vstack([slopes, slope])

    def _prior(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = np.vstack([self.rows, self.still / _KEPT]) * self.units
        shift = np.concatenate([self.shift, np.zeros(len(self.still))])
        slope = np.zeros((len(rows), len(x)))
        slope[:, : len(self.centre)] = rows
        return rows @ (x[: len(self.centre)] - self.centre) - shift, slope

    def _prior_squares(self, v: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Half the summed squares of the prior at the coordinates v (nv,), gradient, Hessian and Gauss-Newton's."""
        value, rows = self._prior(v)
        matrix = rows.T @ rows
        return 0.5 * float(value @ value), rows.T @ value, matrix, matrix

    def _levels(self, x: FloatArray, sigma: Mapping[str, float]) -> dict[str, float]:
        """Levels of the outputs that are estimated: from what no parameters and no initial states explain of all
        outputs together, as in a fit; each output by itself would be explained by what another one contradicts."""
        residual, slopes = self.shots.evaluate(x)
        reach = orthonormal(slopes) if slopes.size else np.zeros((len(residual), 0))
        left, taken = residual - reach @ (reach.T @ residual), np.sum(reach**2, axis=1)
        found = dict(sigma)
        for name in sorted(self.estimated):
            own = [rows for (_, output), rows in self.shots.places.items() if output == name]
            total = sum(float(left[rows] @ left[rows]) for rows in own)
            freedom = sum(float(rows.stop - rows.start - taken[rows].sum()) for rows in own)
            self.freedom[name] = freedom
            if freedom >= 1 and total > 0:  # less is rounding, of as many numbers as samples
                found[name] = sigma[name] * math.sqrt(total / freedom)
        return found

    # ---- answer

    def answer(self, x: FloatArray, sigma: Mapping[str, float]) -> Refit:
        """The test at x, and the residuals there."""
        self.shots.weigh(sigma)
        residual, slopes = self.shots.evaluate(x)
        # directions that are held take no part: the columns are those that keep them
        turn = _kept(self.still * self.units, slopes.shape[1])
        offset, rows = (part[: len(self.rows)] for part in self._prior(x))
        split = PriorSplit.of(-residual, slopes @ turn, rows @ turn, offset)
        size = self._sizes(residual, slopes, sigma)
        told = split
        if (size != 1).any():
            told = PriorSplit.of(-residual / size, slopes @ turn / size[:, None], rows @ turn, offset)
        # coloured noise moves what is slow further than white noise of its size
        told = replace(told, value=told.value / self._memory(told.noise))
        fresh_freedom = math.inf if not self.estimated else max(float(len(residual) - split.rank), 1.0)
        known = not any(free for _, free in self.fit.noise.values())
        p_value = told.p_value(math.inf if known else max(self.fit.dof, 1.0), fresh_freedom)
        why = None if p_value is not None else self._why_not()
        limits, beyond = self._limits(x, turn @ split.step, turn @ split.covariance @ turn.T)
        gap = self._gap(sigma, split)
        check = ParameterCheck(
            None if p_value is None else told.value,
            None if p_value is None else told.dof,
            p_value,
            *gap,
            self._moved(x),
            tuple(name for name, one in self.fit.estimates.items() if one.at_bound is not False),
            limits,
            beyond,
            why,
        )
        level = {place: sigma[place[1]] for place in self.shots.places}
        return Refit(
            check,
            self.shots.index,
            {place: -residual[rows] * level[place] for place, rows in self.shots.places.items()},
            {place: felt(split.frame[rows]) * level[place] for place, rows in self.shots.places.items()},
            {
                name: (sigma[name], self.fit.residual_level[name])
                for name in sorted(self.estimated)
                if name in self.fit.residual_level and self.freedom.get(name, 0.0) > 0
            },
            self.freedom,
            self._reach(split.frame),
        )

    def _sizes(self, residual: FloatArray, slopes: FloatArray, sigma: Mapping[str, float]) -> FloatArray:
        """(n,) how large the noise of each sample is beside that of the others of its output, where it goes with what
        that shows."""
        found = np.ones(len(residual))
        for place, rows in self.shots.places.items():
            record, output = place
            measured = self.held.traces[record][output].measured[self.shots.index[place]]
            taken = np.square(orthonormal(slopes[rows])).sum(axis=1) if slopes.size else None
            own = sizes_of(residual[rows], measured + sigma[output] * residual[rows], taken)
            found[rows] = 1.0 if own is None else own
        return found

    def _memory(self, noise: FloatArray) -> float:
        """How many samples count for one in the output that is most coloured, by what parameters do not reach of it."""
        every = [noise[rows] for rows in self.shots.places.values()]
        return max((memory_of(own) for own in every if len(own) >= _FEW), default=1.0)

    def _reach(self, frame: FloatArray) -> dict[Place, float]:
        """See ``Refit``."""
        return {
            place: max(
                1.0 - float((frame[rows].sum(axis=0) ** 2).sum()) / max(rows.stop - rows.start, 1), 0.0
            )
            for place, rows in self.shots.places.items()
        }

    def _limits(
        self, x: FloatArray, step: FloatArray, covariance: FloatArray
    ) -> tuple[ResidualTest | None, tuple[str, ...]]:
        """The bounds and inequalities beyond which both data would go, and the chance of it for a right model."""
        found = []
        for name, inside, slope in self.shots.limits(x):
            error = math.sqrt(max(float(slope @ covariance @ slope), 0.0))
            if error > 0 and inside + slope @ step < 0:
                found.append((-float(inside + slope @ step) / error, name))
        if not found:
            return None, ()
        found.sort(reverse=True)
        chance = min(1.0, float(normal_sf(found[0][0])) * len(found))
        return ResidualTest(found[0][0], 1, chance, self.shots.count), tuple(name for _, name in found)

    def _why_not(self) -> str:
        if self.fit.doubted:
            words = "the errors of the fit are not known, see its notes: call ce.posterior(fit)"
            return as_able(words, predicted=self.fit.innovations is not None, robust=loss_of(self.fit).robust)
        if self.fit.errors is None:
            return "the fit is no optimum, so that its parameters have no errors"
        if not self.fit.free:
            return "the parameters were given, not estimated: they have no errors"
        if self.blind:
            return "the fit does not determine all parameters (fit.undetermined): they are free on the fresh data"
        return "no direction of the parameters is determined by the fit and by the fresh data both"

    def _gap(
        self, sigma: Mapping[str, float], split: PriorSplit
    ) -> tuple[float | None, tuple[float, float] | None]:
        """Share of the gap that errors of the parameters explain, by the noise that the fit found; chi-squared per
        sample without and with them."""
        own = {name: self.fit.residual_level.get(name, sigma[name]) for name in sigma}
        ratio = np.concatenate(
            [
                np.full(rows.stop - rows.start, sigma[output] / own[output])
                for (_, output), rows in self.shots.places.items()
            ]
        )
        self.shots.weigh(own)
        before, _ = self.shots.evaluate(self.begin)
        after = split.within * ratio
        total, rest, n = float(before @ before), float(after @ after), len(before)
        chi2 = (total / n, rest / n)
        if total - n < _BEYOND * math.sqrt(2.0 * n):
            return None, chi2
        return float(np.clip((total - rest) / (total - min(rest, n)), 0.0, 1.0)), chi2

    def _moved(self, x: FloatArray) -> dict[str, Moved]:
        found = {}
        for name, value in zip(self.shots.free, self.shots.values(x), strict=True):
            one = self.fit.estimates.get(name)
            unit = self.fit.parameters[name.partition("@")[0]].unit
            fitted = (
                (one.value, one.stderr) if one is not None else (self.held.values.get(name, math.nan), None)
            )
            found[name] = Moved(fitted, float(value), unit)
        return found


def _kept(still: FloatArray, size: int) -> FloatArray:
    """(size, k) orthonormal columns that move none of the directions held (h, nz)."""
    if not len(still):
        return np.eye(size)
    wide = np.zeros((len(still), size))
    wide[:, : still.shape[1]] = still
    _, strength, right = np.linalg.svd(wide, full_matrices=True)
    return np.asarray(right[int(np.sum(strength > 1e-9 * strength[0])) :].T)
