"""White noise that is not of one size, or that two sensors share; and a sensor's steps, which are no noise.

A fit weighs all samples of an output alike. Where the squares of its residual go with the output, or change along the
record, noise is not of one size: that of many instruments is a share of what they show. Where the residuals of two
outputs go together, both sensors show one disturbance, and each is worth less than it says. The estimates of such a fit
are right on average; their errors are those of the sandwich A^-1 B A^-1 of ``residual_noise``, with B of the residuals
themselves: the sum over samples of slopes times squared residuals, each over what the estimates left of it; by the
square of the share that they took, with variances that are a smooth function of the output or the time. Where few
samples leave it open whether noise is of one size, B is the mean of both by their probability (by the change of the log
likelihood, less half the logarithm of the number of samples for each of two numbers: Schwarz, Ann. Statist. 6 (1978)
461): errors by a test that does not see it are too small by a factor. Rounding is determined by the signal and comes
back with it: B is found by rounding the simulation, moved within its errors.

Source: White, Econometrica 48 (1980) 817; MacKinnon & White, J. Econometrics 29 (1985) 305 (their HC3); the test is
the likelihood ratio of log-linear variances (Harvey, Econometrica 44 (1976) 461), with the scatter of the squares where
it is larger than of normal noise.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.distributions import chi2_sf
from casadi_engine.estimation.record import RecordPoint
from casadi_engine.estimation.search import Search
from casadi_engine.experiment.resolution import step_of
from casadi_engine.simulation.grid import Measured

Array = NDArray[np.float64]

# How rarely chance makes normal noise of one size look otherwise, once in two hundred records; correlation of two
# residuals, in standard errors, that is as rare as that of neighbours of one; fewest samples to say so.
_RARE, _TOGETHER, _FEW = 5e-3, 3.2, 15
# Noise beside the rounding, in steps, from which on it hides what rounding does: the first harmonic of the mean error
# falls as exp(-2 (pi s)^2), to 0.7 % here (Widrow & Kollar, Quantization Noise, 2008); drawings of it.
_HIDDEN, _DRAWS = 0.5, 100
# Samples that are drawn at most, but for so many drawings of a long record.
_SAMPLES, _FEWEST = 10_000_000, 20
# Chance below which noise is taken to be of one size; share of the largest value below which an instrument's error is
# no share of what it shows.
_UNLIKELY, FLOOR = 0.05, 0.02
# Size of a residual, in its level, below which errors that count with the level are larger than any it may ask for.
_LOUD = 0.5
# Share of a sample's own residual that estimates may take at most, for what is left to tell its size; beyond which it
# tells nothing of that.
_TAKEN, _TOLD = 0.9, 0.98
# A sensor that shows one sign over so many times its least value has noise that may go with its logarithm.
_DECADE = 10.0
# Steps of Newton's method for the variances, the farthest in their logarithm; what is none, and twice the logarithm of
# a likelihood that is none; most of the logarithm of a variance.
_NEWTON, _FAR, _NOTHING, _SMALL, _MOST = 30, 3.0, 1e-12, 1e-6, 30.0


@dataclass(frozen=True, eq=False)
class Varied:
    """The residual of an output of a record that is not of one size; or of two outputs that go together.

    at : number of the record; outputs : one, or two; share : the correlation of two; grows : True where its size goes
    with what the output shows, False with the time; step : of a sensor that reads in steps, which are most of its noise
    chance : how probable it is, of what no test tells; of_share : the noise is a share of what the output shows
    """

    at: int
    outputs: tuple[str, ...]
    share: float = 0.0
    grows: bool = True
    step: float = 0.0
    chance: float = 1.0
    of_share: bool = False


def varied_noise(
    search: Search,
    points: Sequence[RecordPoint],
    known: Collection[tuple[int, str]],
    taken: Mapping[tuple[int, str], Array],
) -> tuple[Varied, ...]:
    """What is not white noise of one size for each sensor, of outputs that nothing else is known of.

    known : number of the record and output of those whose residuals are coloured, or larger than stated; of those
    steps alone are told
    taken : the same -> (n,) share of each sample's variance that the estimates took, of those of few samples
    """
    found: list[Varied] = []
    if search.loss.robust or search.predictor.kind != "none":
        return ()
    for at, (record, point) in enumerate(zip(search.records, points, strict=True)):
        rows = {
            name: r
            for name in record.observation.where
            if record.observation.series(record.observation.valid, name).all()
            and len(r := record.observation.series(point.r, name)) >= _FEW
            and np.mean(r**2) > _LOUD**2
            and not search.levels.rounding(name, r, search.sigma)
        }
        plain = dict[str, _Signs]()
        for name, r in rows.items():
            own, sigma = record.grid.measured[name], float(search.sigma[search.levels.outputs.index(name)])
            step = steps_of(own.values, sigma * r)
            if step:
                found.append(Varied(at, (name,), step=step))
            elif (at, name) not in known:
                plain[name] = _signs_of(r, own.values + sigma * r, own.time, taken.get((at, name)))
        found += _of_signs(at, plain)
        for one, other in combinations(plain, 2):
            share, count = _correlation(record.grid.measured, rows, one, other)
            if count >= _FEW and abs(share) * math.sqrt(count) > _TOGETHER:
                found.append(Varied(at, (one, other), share))
    return tuple(found)


@dataclass(frozen=True)
class _Signs:
    """Log likelihoods, beside that of noise of one size, of a size that follows a course, less what choosing it costs,
    and of one that is a share of what the output shows; grows : the course is of that; told : a test tells it."""

    course: float
    share: float
    grows: bool
    told: bool

    @property
    def odds(self) -> float:
        """Of either, as logarithm."""
        return float(np.logaddexp(self.course, self.share)) - math.log(2)


def _signs_of(r: Array, shown: Array, time: Array, taken: Array | None) -> _Signs:
    by_size, by_time = (_gain_of(r, course, taken) for course in (of_size(shown), time))
    best, price = max(by_size, by_time), math.log(2 * len(r))
    return _Signs(
        best - price,
        as_a_share(r, shown, taken),
        by_size >= by_time,
        float(chi2_sf(2 * best, 2)) < _RARE / 2,
    )


def _of_signs(at: int, signs: Mapping[str, _Signs]) -> list[Varied]:
    """What the signs of a record's outputs say together."""
    shares, courses = (
        math.fsum(getattr(one, kind) for one in signs.values()) for kind in ("share", "course")
    )
    of_share = shares > max(courses, 0.0)
    chances = _chances({name: one.odds for name, one in signs.items()})
    return [
        Varied(
            at,
            (name,),
            grows=one.grows or of_share,
            chance=1.0 if one.told else chances[name],
            of_share=of_share,
        )
        for name, one in signs.items()
        if one.told or chances[name] > _UNLIKELY
    ]


def steps_of(measured: Array, residual: Array) -> float:
    """The steps in which a sensor reads, where they are most of the noise; else 0."""
    step = step_of(measured)
    return step if step is not None and _beside(residual, step) < (_HIDDEN * step) ** 2 else 0.0


def _beside(residual: Array, step: float) -> float:
    """Variance of the noise beside rounding."""
    return max(float(np.mean(residual**2)) - step**2 / 12, 0.0)


def of_size(shown: Array) -> Array:
    """What the size of noise may go with: what an output shows, or its logarithm where it has one sign and goes over
    more than a decade, as noise that is a share of it does."""
    size = np.abs(shown)
    one_sign = bool((shown > 0).all() or (shown < 0).all())
    return np.log(size) if one_sign and size.max() > _DECADE * size.min() else shown


def sizes_of(residual: Array, shown: Array, taken: Array | None = None) -> Array | None:
    """(n,) how large the noise of each sample of a residual is beside that of the others, by what an output shows; None
    where it is of one size as far as these tell."""
    course = of_size(shown)
    if len(residual) < _FEW or not _goes_with(residual, course, taken) < _RARE:
        return None
    weight = np.ones(len(residual)) if taken is None else np.maximum(1 - np.clip(taken, 0.0, 1.0), 1 - _TOLD)
    squares = residual**2 / weight
    return np.sqrt(_variances(squares * float(weight.sum()) / float(weight @ squares), weight, course))


def _chances(odds: Mapping[str, float]) -> dict[str, float]:
    """Output -> how probable it is that its noise is not of one size, by the log odds of that of each by itself.

    None is as probable before as any: instruments of one kind, in one place, are all so or none is, half as often as
    some of them.
    """
    names = list(odds)
    if not names:
        return {}
    every, some = math.fsum(odds.values()), {name: np.logaddexp(0.0, log) for name, log in odds.items()}
    apart = math.fsum(some.values()) - len(names) * math.log(2)
    ways = np.array([math.log(0.5), math.log(0.25) + every, math.log(0.25) + apart])
    share = np.exp(ways - np.logaddexp.reduce(ways))
    return {
        name: float(share[1] + share[2] / (1 + math.exp(-min(log, _MOST)) if log > -_MOST else math.inf))
        for name, log in odds.items()
    }


def _goes_with(r: Array, course: Array, taken: Array | None = None) -> float:
    """How often chance makes the squares of white noise (n,) depend as much on a course and its square."""
    return float(chi2_sf(2 * _gain_of(r, course, taken), 2))


def _gain_of(r: Array, course: Array, taken: Array | None = None) -> float:
    """Logarithm of the likelihood of variances exp(a + b x + c x^2) of noise (n,) over that of one variance, of squares
    each with as many degrees of freedom as are left of it.

    taken : (n,) share of each sample's variance that the estimates took, None where that is next to nothing
    """
    spread = float(np.ptp(course))
    weight = np.ones(len(r)) if taken is None else 1 - np.clip(taken, 0.0, 1.0)
    here = weight > 1 - _TOLD
    if not spread > 0 or here.sum() < _FEW:
        return 0.0
    weight, squares = weight[here], r[here] ** 2 / weight[here]
    level = float(weight @ squares) / float(weight.sum())
    if not level > 0:
        return 0.0
    own = _variances(squares / level, weight, course[here])
    gain = float(weight @ (squares / level - np.log(own) - squares / level / own))
    return gain / _tails(squares / level / own, weight) if gain > _NOTHING else 0.0


def _tails(squares: Array, weight: Array) -> float:
    """Variance of squared noise (n,) over its squared mean: 2 of normal noise, more where tails are heavy."""
    mean = float(weight @ squares) / float(weight.sum())
    return max(2.0, float(weight @ (squares - mean) ** 2) / float(weight.sum()) / mean**2)


def as_a_share(r: Array, shown: Array, taken: Array | None = None) -> float:
    """Logarithm of the likelihood of noise (n,) that is a share of what an output shows over that of one size.

    taken : as for a course
    """
    weight = np.ones(len(r)) if taken is None else 1 - np.clip(taken, 0.0, 1.0)
    here = weight > 1 - _TOLD
    size = np.abs(shown[here])
    if here.sum() < _FEW or not size.max() > 0 or not r[here].any():
        return -math.inf
    weight, squares, size = weight[here], r[here] ** 2 / weight[here], _floored(size)

    def cost(shape: Array) -> float:
        level = float(weight @ (squares / shape)) / float(weight.sum())
        return float(weight @ np.log(level * shape)) / 2  # and half the weights' sum, whatever the shape

    gain = cost(np.ones_like(size)) - cost(size**2)
    return gain if gain <= 0 else 2 * gain / _tails(squares / size**2, weight)


def _floored(size: Array) -> Array:
    return np.maximum(size, FLOOR * size.max())


def _variances(squares: Array, weight: Array, course: Array) -> Array:
    """The most likely variances exp(a + b x + c x^2) of normal noise (n,) with these squares, whose mean is one."""
    x = 2 * (course - course.min()) / np.ptp(course) - 1
    columns = np.stack([np.ones_like(x), x, x**2], axis=1)
    q, root = np.linalg.qr(columns * np.sqrt(weight)[:, None])
    if np.abs(np.diag(root)).min() < _NOTHING * np.abs(np.diag(root)).max():
        return np.ones_like(squares)
    frame = q / np.sqrt(weight)[:, None]
    at, cost = np.zeros(3), float(weight @ squares)
    for _ in range(_NEWTON):
        log = frame @ at
        ratio = squares * np.exp(-log)
        slope = frame.T @ (weight * (1 - ratio))
        bend = (frame * (weight * (ratio + _NOTHING))[:, None]).T @ frame
        step = np.linalg.solve(bend, -slope)
        step *= min(1.0, _FAR / max(float(np.abs(frame @ step).max()), _NOTHING))
        while True:
            new = frame @ (at + step)
            then = float(weight @ (new + squares * np.exp(-new)))
            if then <= cost or np.abs(step).max() < _NOTHING:
                break
            step = 0.5 * step
        at, cost, before = at + step, then, cost
        if before - then < _SMALL:
            break
    return np.asarray(np.exp(np.clip(frame @ at, -_MOST, _MOST)))


def _correlation(
    measured: Mapping[str, Measured], rows: Mapping[str, Array], one: str, other: str
) -> tuple[float, int]:
    """Of the residuals of two outputs where both were measured, and at how many samples."""
    here, there = shared(measured[one], measured[other])
    a, b = rows[one][here], rows[other][there]
    size = math.sqrt(float(a @ a) * float(b @ b))
    return (float(a @ b) / size if size > 0 else 0.0), len(here)


def shared(one: Measured, other: Measured) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Numbers of the samples of two outputs that were measured at the same points."""
    _, here, there = np.intersect1d(one.position, other.position, return_indices=True)
    return here, there


def scattered(residual: Array, slopes: Array, errors: Array, course: Array) -> Array:
    """J'VJ of one output with these slopes (n, k) and V of its residual (n,), which goes with a course (n,); errors
    (k, k) of what they are slopes in, which took a part of it.

    The variance of each sample is its own square, and the most likely smooth one by the square of the share that the
    estimates took: where one rests on a single sample, what is left of that tells nothing of its noise.
    """
    taken = np.clip(np.einsum("nk,kl,nl->n", slopes, errors, slopes, optimize=True), 0.0, 1.0)
    own = (residual / (1 - np.minimum(taken, _TAKEN))) ** 2
    smooth, weight = own, 1 - taken
    here = weight > 1 - _TOLD
    if here.sum() >= _FEW and np.ptp(course[here]) > 0:
        squares, weight = residual[here] ** 2 / weight[here], weight[here]
        level = float(weight @ squares) / float(weight.sum())
        smooth = own.copy()
        smooth[here] = level * _variances(squares / level, weight, course[here]) if level > 0 else own[here]
    return np.asarray((slopes * ((1 - taken**2) * own + taken**2 * smooth)[:, None]).T @ slopes)


def scattered_by_share(residual: Array, slopes: Array, errors: Array, shown: Array) -> Array:
    """The same of noise that is a share of what an output shows (n,)."""
    left = 1 - np.clip(np.einsum("nk,kl,nl->n", slopes, errors, slopes, optimize=True), 0.0, 1.0)
    shape = _floored(np.abs(shown)) ** 2
    level = float(np.sum(residual**2 / shape)) / float(left.sum())
    return np.asarray((slopes * (level * shape)[:, None]).T @ slopes)


def by_rounding(measured: Array, residual: Array, slopes: Array, errors: Array, step: float) -> Array:
    """J'VJ of one output that is read in steps, in levels of its noise: measured, residual (n,), slopes (n, k) in these
    and errors (k, k) of what they are slopes in, by which the simulation is moved."""
    random, found = np.random.default_rng(0), np.zeros_like(errors)
    values, vectors = np.linalg.eigh(errors)
    root = slopes @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    scatter = math.sqrt(_beside(residual, step))
    count = int(np.clip(_SAMPLES / len(measured), _FEWEST, _DRAWS))
    for _ in range(count):
        shown = measured + residual + root @ random.standard_normal(root.shape[1])
        seen = shown + scatter * random.standard_normal(len(shown))
        read = measured[0] + step * np.round((seen - measured[0]) / step)
        pull = slopes.T @ (read - shown)
        found += np.outer(pull, pull)
    return found / count


def together(share: float, one: Array, other: Array) -> Array:
    """What J'VJ of two outputs with slopes (n, k), at the same samples, has more where they correlate by a share."""
    cross = one.T @ other
    return np.asarray(share * (cross + cross.T))
