"""Effects that no library names: score tests of unknown smooth functions of a signal, at every location.

A torque psi f(v), f a Gaussian process over the range of a signal v (twist, twist rate, speed, crank angle, time), is
written in cosines of falling variance. The test looks at the few combinations of them to which the data are most
sensitive under that prior, as a group; the course f(v) with its band is found under the same prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_distribution import Row
from casadi_engine.discrepancy.null_model import FOUR_STROKE, NullModel
from casadi_engine.discrepancy.score import Scores
from casadi_engine.simulation.candidate_sensitivities import Direction, torque_direction

SIGNALS = ("twist", "twist_rate", "speed", "angle", "time")
_TERMS = 12
_DIMENSIONS = 6
_SHARE = 0.999
_POINTS = 61
# Variance of the k-th cosine over that of the first: the course of a Matern process of length half the range.
_ROUGH = 2.0


@dataclass(frozen=True, eq=False)
class Family:
    """Functions of one signal at one port: numbers of its candidates, their prior variances, and the signal's range."""

    port: str
    signal: str
    members: tuple[int, ...]
    variances: Array
    low: float
    high: float
    visited: Array  # (_POINTS,) share of the samples near each point of the range

    @property
    def name(self) -> str:
        """``a function of signal at port``."""
        return f"a function of {self.signal} at {self.port}"


def family_candidates(
    null: NullModel, *, ports: Sequence[str] | None = None, first: int = 0, terms: int = _TERMS
) -> tuple[list[Candidate], list[Family]]:
    """The terms of all families as candidates, to be scored together with a library, and the families.

    ports : names of ports that take a torque; None for all inertias and couplings. first : number of the first term
    among all candidates that are scored
    """
    model = null.model
    chosen = (
        [p.name for p in model.ports.with_slot if p.kind in ("inertia", "coupling")]
        if ports is None
        else ports
    )
    candidates: list[Candidate] = []
    families: list[Family] = []
    for name in chosen:
        signals = dict(model.ports[name].signals) | {"time": model.t}
        for signal in SIGNALS:
            if signal not in signals:
                continue
            expression = signals[signal]
            values = _values(null, expression)
            cyclic = signal == "angle"
            low, high = (0.0, FOUR_STROKE) if cyclic else (float(values.min()), float(values.max()))
            if not high - low > 1e-9 * max(abs(low), abs(high)):
                continue
            orders = range(1, terms + 1) if cyclic else range(terms)
            basis, variances = _terms(expression, low, high, orders, cyclic=cyclic)
            members = tuple(range(first + len(candidates), first + len(candidates) + len(basis)))
            for k, term in enumerate(basis):
                direction: Direction = torque_direction(model, name, term, name=f"{signal} {k} at {name}")
                unit = model.ports[name].unit
                candidates.append(
                    Candidate(f"function_of_{signal}", name, direction, nuisance={"term": k}, unit=unit)
                )
            wrapped = np.mod(values, FOUR_STROKE) if cyclic else values
            count, _ = np.histogram(wrapped, bins=_POINTS, range=(low, high))
            families.append(Family(name, signal, members, variances, low, high, count / max(count.sum(), 1)))
    return candidates, families


def _values(null: NullModel, expression: ca.SX) -> Array:
    found = []
    for record in null.records:
        value = record.path.function([expression])(*record.path.at_samples().arguments)[0][0]
        found.append(np.broadcast_to(value, record.path.grid.time.shape))
    return np.concatenate(found)


def _terms(v: ca.SX, low: float, high: float, orders: range, *, cyclic: bool) -> tuple[list[ca.SX], Array]:
    terms, variances = [], []
    for k in orders:
        variance = 1 / (1 + (k / _ROUGH) ** 2) ** 2
        if cyclic:  # half orders of the crank
            terms += [ca.cos(0.5 * k * v), ca.sin(0.5 * k * v)]
            variances += [variance, variance]
        else:
            terms.append(ca.cos(math.pi * k * (v - low) / (high - low)))
            variances.append(variance)
    return terms, np.array(variances)


def _basis_at(family: Family, points: Array) -> Array:
    """(points, terms) values of a family's terms."""
    if family.signal == "angle":
        orders = np.arange(1, len(family.members) // 2 + 1)
        phase = 0.5 * orders * points[:, None]
        return np.stack([np.cos(phase), np.sin(phase)], axis=2).reshape(len(points), -1)
    share = (points - family.low) / (family.high - family.low)
    return np.cos(math.pi * np.arange(len(family.members)) * share[:, None])


def family_row(scores: Scores, family: Family, *, dimensions: int = _DIMENSIONS) -> Row | None:
    """The group test of a family; None if the data cannot test it."""
    frame, strength, turn = _seen(scores, family, dimensions)
    if not len(strength):
        return None
    return Row(family.name, frame, 0, _freedom(scores, family, turn))


def _freedom(scores: Scores, family: Family, turn: Array) -> float:
    """Degrees of freedom of a family's test: those of the terms, by their share in the combinations that are seen."""
    if scores.freedom is None:
        return math.inf
    members = list(family.members)
    share = (turn**2).sum(axis=0) * family.variances * scores.information[members]
    return float(share.sum() / (share / scores.freedom[members]).sum())


def _seen(scores: Scores, family: Family, dimensions: int) -> tuple[Array, Array, Array]:
    """The combinations of terms to which the data are most sensitive under the prior: frame (m, r) in the data,
    strength (r,), and turn (r, terms) in the scaled terms. The rest the parameters take, or noise hides."""
    columns = _columns(scores, family) * np.sqrt(family.variances)
    if not columns.any():
        return np.zeros((len(columns), 0)), np.zeros(0), np.zeros((0, columns.shape[1]))
    frame, strength, turn = np.linalg.svd(columns, full_matrices=False)
    share = np.cumsum(strength**2) / (strength**2).sum()
    keep = min(int(np.searchsorted(share, _SHARE)) + 1, dimensions)
    return np.asarray(frame[:, :keep]), np.asarray(strength[:keep]), np.asarray(turn[:keep])


def _columns(scores: Scores, family: Family) -> Array:
    """(m, terms) sensitivities left after all parameters took theirs, per unit amplitude."""
    members = list(family.members)
    return np.asarray(scores.directions[:, members] * np.sqrt(scores.information[members]))


@dataclass(frozen=True, eq=False)
class Course:
    """An unknown function over its signal: signal (K,), mean (K,) and band (K,) [N m] (one standard deviation).

    Parts that the parameters can take over (a level, a slope) are not determined: mean and band leave them out, and
    the course stands for all that differ by such parts.
    looks_like : shape -> squared correlation with the mean, where the record has been
    """

    family: Family
    signal: Array
    mean: Array
    band: Array
    level: float
    looks_like: Mapping[str, float]


def family_course(scores: Scores, family: Family, *, dimensions: int = 2 * _DIMENSIONS) -> Course:
    """The most likely course of a family's function."""
    from scipy import optimize

    frame, strength, turn = _seen(scores, family, dimensions)
    energy, slope = strength**2, strength * (frame.T @ scores.y)

    def cost(log_level: float) -> float:
        v = math.exp(2 * log_level)
        return float((np.log1p(v * energy) - slope**2 * v / (1 + v * energy)).sum())

    top = float(energy.max(initial=0.0))
    level = 0.0
    if top > 0:
        middle = -0.5 * math.log(top)
        found = optimize.minimize_scalar(cost, bounds=(middle - 3, middle + 15), method="bounded")
        level = math.exp(float(found.x)) if float(found.fun) < 0 else 0.0
    points = np.linspace(family.low, family.high, _POINTS)
    turned = _basis_at(family, points) * np.sqrt(family.variances) @ turn.T
    shrunk = level**2 / (1 + level**2 * energy)
    mean, band = turned @ (shrunk * slope), np.sqrt((turned**2 * shrunk).sum(axis=1))
    return Course(family, points, mean, band, level, _likeness(family, points, mean))


def _likeness(family: Family, points: Array, mean: Array) -> dict[str, float]:
    """Squared correlation of a course with plain shapes, weighted by where the record has been."""
    middle = 0.5 * (family.low + family.high)
    half = 0.5 * (family.high - family.low)
    centred = (points - middle) / half
    shapes = {
        "linear": centred,
        "quadratic": centred**2,
        "cubic": points**3 if family.low < 0 < family.high else centred**3,
        "step": np.where(points > (0.0 if family.low < 0 < family.high else middle), 1.0, -1.0),
        "periodic": np.cos(2 * math.pi * centred),
    }
    weight = family.visited / max(family.visited.sum(), 1e-300)

    def spread(a: Array, b: Array) -> float:
        return float((weight * (a - weight @ a) * (b - weight @ b)).sum())

    own = spread(mean, mean)
    found = {}
    for name, shape in shapes.items():
        other = spread(shape, shape)
        found[name] = spread(mean, shape) ** 2 / (own * other) if own > 0 and other > 0 else 0.0
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))
