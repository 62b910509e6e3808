"""profile: the profile likelihood of parameters of a fit, with its intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.distributions import chi2_isf, f_isf
from casadi_engine.errors import CasadiEngineError, EstimationError
from casadi_engine.estimation.estimate import estimate
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.options import check_level, check_likelihood, whole
from casadi_engine.parameters import Parameters, near_matches
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

# Errors that are larger than those of white noise by this factor are said to be.
_SEEN = 1.05
# Steps of the root of the cost's rise, as shares of the threshold's root, and how far a side is followed in them.
_BEYOND, _MOST_REFITS = 1.5, 40
# A step never moves the parameter by more than this factor of what the quadratic of the fit foresees.
_GROWTH = 3.0
# A refit this much below the fit's cost found a better optimum.
_BETTER = 1e-3


# Refits that look for an end between two points, and the share of its distance within which it is found.
_HALVED, _NARROW = 12, 0.01
# Root of the rise, as a share of that at the threshold, by which no refit leaps from the last one.
_LEAP = 0.5
# Standard errors within which two optima are one.
_ALIKE = 0.1
# How it begins what is said of a side on which a refit was not to be had.
LOST = "the refit"
# The same of one beyond which another optimum lies that the data hardly tell from the fit's.
OTHER = "another optimum"


@dataclass(frozen=True)
class Interval:
    """An interval by profile likelihood: low, high in the parameter's unit; None on a side that is open.

    low_why, high_why : None, "at its bound", "open: the data set no limit here", why a refit failed, or which other
    optimum of the fit lies beyond
    lost : a side ends where a refit failed, or before another optimum: nobody knows how far it goes
    """

    low: float | None
    high: float | None
    low_why: str | None = None
    high_why: str | None = None

    @property
    def lost(self) -> bool:
        sides = (self.low, self.low_why), (self.high, self.high_why)
        return any(end is None and (why or "").startswith((LOST, OTHER)) for end, why in sides)


@dataclass(frozen=True, eq=False)
class ProfileLine:
    """The profile of one parameter.

    values : (P,) rising, in its unit; rise : (P,) of the cost above the fit's, the other parameters refitted, divided
    by ``fit.own_noise[name]`` squared where the residual is not the white noise that the cost counts with
    others : name -> (P,), the other free parameters along the profile
    estimate : the fit's. threshold : rise at the ends of the interval
    """

    name: str
    unit: str
    values: Array
    rise: Array
    others: Mapping[str, Array]
    estimate: Estimate
    interval: Interval
    threshold: float

    @property
    def error(self) -> float | None:
        """The standard error of the quadratic, whether the fit stands by it or not; None without one."""
        return self.estimate.stderr or self.estimate.quadratic

    def quadratic(self, values: Array) -> Array | None:
        """The rise that the fit's quadratic foresees at these values, or None without one."""
        error = self.error
        return None if not error else ((values - self.estimate.value) / error) ** 2


@dataclass(frozen=True, eq=False)
class Profile:
    """Profile likelihoods of parameters of a fit.

    lines : name -> ProfileLine; level : of the intervals; refits : how many fits it took
    messages : what the user should know
    """

    fit: Fit
    lines: Mapping[str, ProfileLine]
    level: float
    refits: int
    messages: tuple[str, ...] = ()

    def __str__(self) -> str:
        from casadi_engine.identifiability.practical_summary import profile_text

        return profile_text(self)

    def __getitem__(self, name: str) -> ProfileLine:
        if name in self.lines:
            return self.lines[name]
        raise EstimationError(
            "there is no profile of this parameter",
            seen=repr(name),
            allowed=", ".join(self.lines),
            cure="ask for it: ce.profile(fit, name)",
        )

    @property
    def intervals(self) -> dict[str, tuple[float | None, float | None]]:
        """Name -> (low, high)."""
        return {name: (line.interval.low, line.interval.high) for name, line in self.lines.items()}


@one_blas_thread
def profile(
    fit: Fit,
    *names: str,
    points: int = 9,
    level: float = 0.95,
    progress: Callable[[str, int], Any] | bool | None = None,
) -> Profile:
    """Profile likelihood of free parameters: the cost as each is held at values around the estimate, the rest refitted.

    Each refit starts from the last one, moved along the tangent. A side ends where the cost has risen well beyond
    the threshold, at a bound, or where it is plain that no limit comes.

    fit : a converged Fit; names : free parameters (default: all)
    points : values on each side up to the interval's end; level : of the intervals
    progress : None or False, or a function of (name, number of refits so far)

    The interval ends where the cost, with the noise level of the fit, has risen by the chi-squared quantile with one
    degree of freedom; where the noise level was estimated, by the F quantile with the fit's degrees of freedom,
    which for many samples is the same. Where the residual is coloured or larger than stated, the rise is divided by the
    square of what this makes of the error (``fit.own_noise``), as the interval of ± is.
    Returns a Profile. Raises EstimationError for a fit that did not converge, a robust loss, or an unknown name.
    Source: Raue et al., Bioinformatics 25, 2009; Bates & Watts, Nonlinear Regression Analysis, 1988.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> noise = 0.02 * np.random.default_rng(1).standard_normal(200)
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)) + noise)
    >>> fit = ce.estimate(ce.one_inertia(), exp, noise=ce.Noise(omega=0.02))
    >>> low, high = ce.profile(fit, "J_eng", points=3).intervals["J_eng"]
    >>> print(f"{low:.3f} to {high:.3f} kg m2, estimate {fit.values['J_eng']:.3f}")
    0.398 to 0.404 kg m2, estimate 0.401
    """
    check_likelihood(fit, "a profile")
    check_level(level)
    points = whole("points", points, 2)
    if progress not in (None, False) and not callable(progress):
        raise EstimationError(
            "progress is not acceptable",
            seen=repr(progress),
            allowed="None, False, or a function of (name, number of refits so far)",
            cure="leave it out",
        )
    known = [name for name in fit.free if name in fit.parameters and fit.parameters[name].vary]
    for name in names:
        if name not in known:
            raise EstimationError(
                "there is no such free parameter in the fit, or it is tied or varies by experiment",
                seen=repr(name),
                allowed=near_matches(name, known) if known else "(none)",
                cure="name parameters that are free and shared by all records",
            )
    estimated = any(found for _, found in fit.noise.values())
    beyond = 1 - level
    quantile = f_isf(beyond, 1, fit.dof) if estimated and fit.dof > 0 else chi2_isf(beyond, 1)
    walker = _Walker(fit, float(quantile), points, progress)
    lines = {name: walker.line(name) for name in dict.fromkeys(names or known)}
    by_record = [name for name in fit.free if name not in known]
    if by_record and not names:
        walker.messages.append(
            f"{', '.join(by_record)}: what has a value in each record has no profile; call ce.posterior(fit)"
        )
    return Profile(fit, lines, level, walker.refits, tuple(dict.fromkeys(walker.messages)))


@dataclass(frozen=True)
class _Warm:
    """What ``estimate`` starts from: the values foreseen, with the initial states of the last refit."""

    values: Mapping[str, float]
    initial: Mapping[str, Any]
    noise: Mapping[str, tuple[float, bool]]
    converged: bool
    fineness: Mapping[str, Any]  # steps that are longer may leap where the fit's did not


@dataclass
class _Point:
    value: float
    rise: float
    fit: Any


class _Walker:
    """Refits along one parameter at a time."""

    def __init__(self, fit: Fit, threshold: float, points: int, progress: Any) -> None:
        self.fit, self.threshold, self.points, self.progress = fit, threshold, points, progress
        levels: dict[str, Any] = {name: sigma for name, (sigma, _) in fit.noise.items()}
        if fit.innovations is not None and fit.innovations.kind == "process":
            levels = dict(fit.innovations.sigma)  # the noise of the measurement is a part of these
        self.noise = Noise(gain=fit.gain, **levels)
        # The fixed states of the fit stay fixed; its cost counts with the noise levels that it found.
        self.initial = {
            record: {state: one.value for state, one in states.items() if one.fixed}
            for record, states in fit.initial.items()
        }
        self.refits = 0
        self.messages: list[str] = []
        if fit.gain is not None:
            self.messages.append("the predictor's gain is held at the fit's, not estimated again")
        # A search in the frequency domain takes valleys that one from nearby does not.
        self.in_full = "frequency bins" not in str(fit.options.get("searched on", ""))
        self.base = self._again() if fit.innovations is not None else fit.cost
        most = max((fit.own_noise.get(name, 1.0) for name in fit.free), default=1.0)
        if most > _SEEN:
            self.messages.append(
                "the residual is not white noise of the fit's level: the rise of the cost is divided by what that "
                f"makes of the squared errors, up to {most**2:.2g}"
            )

    def _again(self) -> float:
        """The cost of a fit with a predictor as refits count it, which is to be one at the same values.

        Raises EstimationError where it is not: nothing that is looked at around it tells of the fit then.
        """
        fit = self.fit
        warm = _Warm(fit.values, fit.initial, fit.noise, self.in_full, fit.fineness)
        found = self._estimated(fit.parameters.copy(), warm)
        moved = {
            name: abs(found.values[name] - fit.values[name]) for name in found.free if name in fit.values
        }
        errors = {name: fit.estimates[name].stderr or fit.estimates[name].quadratic for name in moved}
        far = [n for n, by in moved.items() if by > _ALIKE * (errors[n] or math.inf)]
        if not found.converged or far:
            raise EstimationError(
                "the fit's predictor held as it is has another optimum, so that no profile tells of the fit",
                seen=f"{', '.join(far)} elsewhere" if far else f"a refit that is {found.status}",
                allowed="a fit whose values are the best ones beside its predictor",
                cure="ce.posterior(fit) has the noise estimated again; or profile a fit without a predictor",
            )
        return float(found.cost)

    def line(self, name: str) -> ProfileLine:
        own = self.fit.estimates[name]
        centre = _Point(own.value, 0.0, self.fit)
        down, low, low_why = self._side(name, centre, -1.0)
        up, high, high_why = self._side(name, centre, +1.0)
        if other := self._beyond(name, low, -1.0):
            low, low_why = None, other
        if other := self._beyond(name, high, +1.0):
            high, high_why = None, other
        course = [*reversed(down), centre, *up]
        others = {
            other: np.array([point.fit.values[other] for point in course])
            for other in self.fit.free
            if other != name
        }
        return ProfileLine(
            name,
            own.unit,
            np.array([point.value for point in course]),
            np.array([point.rise for point in course]),
            others,
            own,
            Interval(low, high, low_why, high_why),
            self.threshold,
        )

    def _beyond(self, name: str, end: float | None, sign: float) -> str:
        """Why an end is none where starts of the fit found another optimum beyond it that the threshold lets in: refits
        from one value to the next go along the fit's own valley."""
        own, fit = self.fit.own_noise.get(name, 1.0), self.fit
        for one in fit.optima if end is not None else ():
            rise = max(one.cost - fit.cost, 0.0) / own**2
            if one.status == "converged" and one.apart and rise <= self.threshold and name in one.values:
                value = one.values[name]
                if sign * (value - float(end or 0.0)) > 0:
                    return (
                        f"{OTHER} lies beyond, at {value:.6g}, with a chi-squared that is {rise:.2g} higher: "
                        "ce.posterior(fit) weighs both"
                    )
        return ""

    def _side(self, name: str, centre: _Point, sign: float) -> tuple[list[_Point], float | None, str | None]:
        """Points on one side, the interval's end there, and why there is none."""
        parameter = self.fit.parameters[name]
        limit = parameter.min if sign < 0 else parameter.max
        root = math.sqrt(self.threshold)
        found: list[_Point] = []
        step, last = self._first_step(name, centre), centre
        target = root / self.points
        for _ in range(_MOST_REFITS):
            value = last.value + sign * step
            at_limit = (value - limit) * sign >= 0
            value = limit if at_limit else value
            if value == last.value:
                return found, None, "at its bound"
            point = self._refit(name, value, last)
            if isinstance(point, str):
                return found, _crossing([centre, *found], root), point
            found.append(point)
            height = math.sqrt(max(point.rise, 0.0))
            if height >= root:
                end = self._refined(name, [centre, *found], root, found)
                why = f"{LOST} that looks for the end did not converge" if end is None else None
                return sorted(found, key=lambda one: sign * one.value), end, why
            if at_limit:
                return found, None, "at its bound"
            gained = height - math.sqrt(max(last.rise, 0.0))
            step = min(step * _GROWTH, step * target / max(gained, target / _GROWTH))
            last = point
        return found, None, "open: the data set no limit here"

    def _first_step(self, name: str, centre: _Point) -> float:
        own = centre.fit.estimates[name]
        error = own.stderr or own.quadratic
        if error:
            return float(math.sqrt(self.threshold) / self.points * error)
        return 0.01 * abs(centre.value) or 0.01

    def _refined(self, name: str, course: list[_Point], root: float, found: list[_Point]) -> float | None:
        """The interval's end, with more refits where the last step was so long that interpolation is coarse: a wall
        behind a flat is halved in upon."""
        before, after = course[-2], course[-1]
        for _ in range(_HALVED):
            low, high = math.sqrt(max(before.rise, 0.0)), math.sqrt(after.rise)
            coarse = high - low > 2 * root / self.points
            if not coarse or abs(after.value - before.value) <= _NARROW * abs(after.value - course[0].value):
                break
            middle = 0.5 * (before.value + after.value)
            end = middle if high > 2 * root else _crossing([before, after], root)
            point = self._refit(name, middle if end is None else end, before)
            if isinstance(point, str):
                return None
            found.append(point)
            if math.sqrt(max(point.rise, 0.0)) >= root:
                after = point
            else:
                before = point
        return _crossing([before, after], root)

    def _refit(self, name: str, value: float, last: _Point) -> _Point | str:
        """The fit with the parameter held at a value, or why there is none."""
        own, held = self.fit, self.fit.parameters.copy()
        held.fix(name, value)
        guess = {key: last.fit.values[key] for key in own.free if key != name}
        tangent = _tangent(own, name)
        for key, slope in tangent.items():
            guess[key] += slope * (value - last.value)
        self.refits += 1
        try:
            fit = self._nearby(held, guess, last)
        except CasadiEngineError as error:
            return f"{LOST} failed: {error.problem}"
        if self.progress:
            self.progress(name, self.refits)
        if not fit.converged:
            return f"{LOST} did not converge: {fit.status}"
        rise = (fit.cost + _of_held(own, fit) - self.base) / own.own_noise.get(name, 1.0) ** 2
        if rise < -_BETTER * max(1.0, self.threshold):
            self.messages.append(
                f"a refit with {name} = {value:.6g} costs {-rise:.3g} less than the fit: start again there"
            )
        return _Point(value, rise, fit)

    def _nearby(self, held: Parameters, guess: Mapping[str, float], last: _Point) -> Fit:
        """The refit from where the tangent leads; where that does not converge, or the cost leaps, which a profile does
        not do, the lowest of it and those from the last point and from the fit."""
        found: list[Fit] = []
        most = (math.sqrt(max(last.rise, 0.0)) + _LEAP * math.sqrt(self.threshold)) ** 2
        for values, initial in (
            (guess, last.fit.initial),
            (last.fit.values, last.fit.initial),
            (self.fit.values, self.fit.initial),
        ):
            found.append(
                self._estimated(held, _Warm(values, initial, self.fit.noise, self.in_full, last.fit.fineness))
            )
            if found[-1].converged and found[-1].cost + _of_held(self.fit, found[-1]) - self.base <= most:
                break
        return min(found, key=lambda fit: (not fit.converged, fit.cost))

    def _estimated(self, held: Parameters, warm: _Warm) -> Fit:
        own = self.fit
        return estimate(
            own.model,
            own.data,
            parameters=held,
            noise=self.noise,
            initial=self.initial,
            interval=own.options.get("interval", "auto"),
            ties=own.options.get("ties", "substitute"),
            method=own.options.get("method", "exact"),
            warm=warm,
            errors="quadratic",
            progress=False,
        )


def _tangent(fit: Fit, name: str) -> dict[str, float]:
    """How the other free parameters move with this one, to first order (d other / d name)."""
    k = fit.free.index(name)
    variance = fit.covariance[k, k]
    if not np.isfinite(variance) or variance <= 0:
        return {}
    slopes = fit.covariance[:, k] / variance
    return {
        other: float(slope)
        for other, slope in zip(fit.free, slopes, strict=True)
        if other != name and np.isfinite(slope)
    }


def _crossing(course: list[_Point], root: float) -> float | None:
    """Where the root of the rise reaches ``root``, by linear interpolation of the root (a parabola is exact)."""
    for before, after in itertools.pairwise(course):
        low, high = math.sqrt(max(before.rise, 0.0)), math.sqrt(max(after.rise, 0.0))
        if low < root <= high:
            return before.value + (after.value - before.value) * (root - low) / (high - low)
    return None


def _of_held(own: Fit, held: Fit) -> float:
    """What the priors of parameters that are held in a refit, and were not in the fit, add to chi-squared there."""
    found = 0.0
    for name, one in held.estimates.items():
        prior = own.parameters[name.partition("@")[0]].prior
        before = own.estimates.get(name)
        if prior is not None and one.fixed and before is not None and not before.fixed:
            found += ((one.value - prior[0]) / prior[1]) ** 2
    return found
