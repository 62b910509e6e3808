"""Effects that no library names: score tests of unknown smooth functions of a signal, at every location.

A torque psi f(v), f a Gaussian process over the range of a signal v (of the port, its place where that is not known,
time), is written in cosines of falling variance, a line and a parabola. The test looks at the few combinations of them
to which the data are most sensitive under that prior, as a group; the course f(v) with its band is found under the same
prior. What comes back with every turn of a shaft is looked for order by order. An input and a sensor are locations too:
what they do may be another function of what they say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.compression import candidate_columns
from casadi_engine.discrepancy.linear_algebra import Array, svd
from casadi_engine.discrepancy.null_distribution import Row
from casadi_engine.discrepancy.null_model import FOUR_STROKE, NullModel
from casadi_engine.discrepancy.score import Scores
from casadi_engine.effects.candidate import responses
from casadi_engine.experiment.units import NOT_STATED, read_unit
from casadi_engine.model import Model, Port
from casadi_engine.model.term import joined
from casadi_engine.simulation.candidate_sensitivities import slot_direction

TIME, PLACE, TURN = "time", "place", "turn"
_TERMS = 12
_DIMENSIONS = 6
_SHARE = 0.999
_POINTS = 61
# Whole periods in a record from which a course over time comes back, and frequencies tried for each.
_PERIODS, _BETWEEN = 2.0, 40
# Variance of the k-th cosine over that of the first: the course of a Matern process of length half the range.
_ROUGH = 2.0
# What comes back so often in a turn of a shaft is looked for.
ORDERS = 24
# Links between ports are looked at where they are no more than so many.
LINKS = 6
# Steps of a sensor beyond this share of its residual are not blurred by its noise.
_STEP = 1.0


@dataclass(frozen=True, eq=False)
class Family:
    """Functions of one signal at one port: numbers of its candidates, their prior variances, and the signal's range.

    order : how often in a turn the functions come back, 0 for others; cycle : they come back with every engine cycle
    """

    port: str
    signal: str
    members: tuple[int, ...]
    variances: Array
    low: float
    high: float
    visited: Array  # (_POINTS,) share of the samples near each point of the range
    order: int = 0
    cycle: bool = False

    @property
    def name(self) -> str:
        """``a function of signal at port``."""
        if self.order:
            return f"{self.order} per turn at {self.port}"
        return f"a function of {self.signal} at {self.port}"


@dataclass(frozen=True, eq=False)
class Signal:
    """A signal at a port: its expression, its values at all samples, the rate of a place that is none of the model's
    states, and after how much of it everything comes back, 0 where nothing does."""

    name: str
    expression: ca.SX
    values: Array
    rate: ca.SX | None = None
    cycle: float = 0.0


def family_candidates(
    null: NullModel, *, ports: Sequence[str] | None = None, first: int = 0, terms: int = _TERMS
) -> tuple[list[Candidate], list[Family]]:
    """The terms of all families as candidates, to be scored together with a library, and the families.

    ports : names of ports; None for all inertias, couplings, inputs and sensors, what is internal and has signals, and
    links and pipes that no coupling joins. first : number of the first term among all candidates that are scored
    """
    kinds = ("inertia", "coupling", "input", "sensor")
    offered = [p for p in null.model.ports if p.kind in kinds or p.is_own]
    links = null.model.ports.links
    between = [p for p in links if not joined(null.model, p)] if len(links) <= LINKS else []
    if ports is not None:
        offered = list(null.model.ports)
    chosen = [p for p in [*offered, *between] if ports is None or p.name in ports]
    candidates: list[Candidate] = []
    families: list[Family] = []
    for port in chosen:
        for signal in _signals(null, port):
            for basis, family in families_of(port.name, signal, terms):
                members = tuple(range(first + len(candidates), first + len(candidates) + len(basis)))
                families.append(replace(family, members=members))
                candidates += [
                    term_candidate(null.model, port, signal, k, term) for k, term in enumerate(basis)
                ]
    return candidates, families


def family_columns(null: NullModel, candidates: Sequence[Candidate]) -> dict[str, dict[str, Array]]:
    """Sensitivities of the terms: record -> output -> (N, k), zero for a term whose sensitivity grows beyond all
    numbers in any of them: the data cannot test it."""
    found = {record.name: candidate_columns(record, candidates) for record in null.records}
    every = [own for outputs in found.values() for own in outputs.values()]
    finite = np.all([np.isfinite(own).all(axis=0) for own in every], axis=0)
    return {r: {o: np.where(finite, own, 0.0) for o, own in outputs.items()} for r, outputs in found.items()}


def _signals(null: NullModel, port: Port) -> list[Signal]:
    """What a function at a port may depend on and what moves there: its own signals; the place of what turns or slides,
    which is its speed added up, where that is none of them; and time, where something may act."""
    if port.kind == "sensor" and _in_steps(null, port.name.partition("_")[2]):
        return []
    # what flows between two ports depends on their difference: one of an end alone is a function at that end
    names = ("value",) if port.kind == "sensor" else ("difference",) if port.ends else tuple(port.signals)
    found = [Signal(name, port.signals[name], along(null, port.signals[name])) for name in names]
    fired = any(one.kind == "cylinder" for one in null.model.ports)
    if "angle" in names and fired:
        found = [replace(one, cycle=FOUR_STROKE) if one.name == "angle" else one for one in found]
    elif "angle" in names and port.kind == "inertia":
        found += _turns(null, port)
    if port.slot is not None:
        found.append(Signal(TIME, null.model.t, along(null, null.model.t)))
    turns_or_slides = port.kind == "inertia" and port.is_mechanical
    if turns_or_slides and "speed" in port.signals and "angle" not in port.signals:
        factor = _radians(port, "speed", "s-1 rad")
        rate = port.signals["speed"] * (factor or 1.0)
        place = _added_up(null, rate)
        whole = factor is not None and np.ptp(place) > 2 * math.pi
        name, cycle = (TURN, 2 * math.pi) if whole else (PLACE, 0.0)
        found.append(Signal(name, ca.SX.sym("place"), place, rate, cycle))
    span = [max(float(np.abs(one.values).max()), 1e-300) for one in found]
    return [one for one, size in zip(found, span, strict=True) if np.ptp(one.values) > 1e-9 * size]


def _turns(null: NullModel, port: Port) -> list[Signal]:
    """The angle of a shaft that turns round."""
    factor = _radians(port, "angle", "rad")
    angle = port.signals["angle"] * (factor or 1.0)
    values = along(null, angle)
    whole = factor is not None and np.ptp(values) > 2 * math.pi
    return [Signal(TURN, angle, values, cycle=2 * math.pi)] if whole else []


def _radians(port: Port, signal: str, dimension: str) -> float | None:
    """What a signal of a shaft is multiplied by to be in radians; None where its unit is of another kind."""
    unit = port.units.get(signal, NOT_STATED)
    known = None if unit == NOT_STATED else read_unit(unit)
    if known is None or known.dimension != dimension:
        return None
    return float(known.factor) * math.pi ** float(known.pi)


def _in_steps(null: NullModel, output: str) -> bool:
    """True for a sensor that is read in steps that its noise does not blur: what it adds is a function of its value."""
    for record in null.records:
        if output not in record.residual:
            continue
        values = np.unique(record.path.grid.measured[output].values)
        size = float(np.std(record.residual[output]))
        if len(values) > 1 and float(np.median(np.diff(values))) > _STEP * size:
            return True
    return False


def families_of(port: str, signal: Signal, terms: int) -> list[tuple[list[ca.SX], Family]]:
    """The families of a signal with their terms."""
    v, values = signal.expression, signal.values
    cycle = signal.cycle
    low, high = (0.0, cycle) if cycle else (float(values.min()), float(values.max()))
    count, _ = np.histogram(np.mod(values, cycle) if cycle else values, bins=_POINTS, range=(low, high))
    blank = Family(port, signal.name, (), np.ones(2), low, high, count / max(count.sum(), 1))
    if signal.name == TURN and signal.cycle:  # a signal of a model may have that name
        return [
            ([ca.cos(k * v), ca.sin(k * v)], replace(blank, order=k))
            for k in range(1, 1 + ORDERS)
        ]  # fmt: skip
    if cycle:  # half orders of the crank
        orders = np.arange(1, terms + 1)
        variances = _variances(orders)
        basis = [turn(0.5 * k * v) for k in orders for turn in (ca.cos, ca.sin)]
        return [(basis, replace(blank, variances=np.repeat(variances, 2), cycle=True))]
    family = replace(blank, variances=_of_waves_and_ends(terms))
    return [(terms_at(family, v), family)]


def _variances(orders: NDArray[np.integer]) -> Array:
    return np.asarray(1 / (1 + (orders / _ROUGH) ** 2) ** 2)


def _of_waves_and_ends(terms: int) -> Array:
    """Of cosines, and behind them of a line and a parabola, with those of the cosines that are like them: cosines have
    no slope at the ends of the range, and with them alone a function that does not end level is off there by more than
    the noise of good data."""
    return _variances(np.append(np.arange(terms - 2), (1, 2)))


def smooth_family(port: str, signal: str, values: Array, *, terms: int = _TERMS) -> Family:
    """The family of smooth functions of a signal over the values (N,) that it has."""
    low, high = float(values.min()), float(values.max())
    count, _ = np.histogram(values, bins=_POINTS, range=(low, high))
    return Family(
        port, signal, tuple(range(terms)), _of_waves_and_ends(terms), low, high, count / len(values)
    )


def terms_at(family: Family, signal: ca.SX) -> list[ca.SX]:
    """The terms of a smooth family as expressions of its signal."""
    share = (signal - family.low) / (family.high - family.low)
    waves = (ca.cos(math.pi * k * share) for k in range(len(family.variances) - 2))
    return [*waves, 2 * share - 1, (2 * share - 1) ** 2]


def term_candidate(model: Model, port: Port, signal: Signal, number: int, term: ca.SX) -> Candidate:
    """A term of a family at its port."""
    name = f"{signal.name} {number} at {port.name}"
    slots, drives, outputs, beyond = responses(model, port, ca.vertcat(term, term if port.ends else 0))
    direction = slot_direction(model, slots, name=name, drives=drives, outputs=outputs)
    if beyond is not None:
        direction = replace(direction, ode=direction.ode + beyond)
    if signal.rate is not None:
        direction = replace(direction, states=signal.expression, rates=signal.rate, start=(0.0,))
    return Candidate(
        f"function_of_{signal.name}", port.name, direction, nuisance={"term": number}, unit=port.unit
    )


def along(null: NullModel, expression: ca.SX) -> Array:
    return np.concatenate(_by_record(null, expression))


def _by_record(null: NullModel, expression: ca.SX) -> list[Array]:
    found = []
    for record in null.records:
        value = record.path.function([expression])(*record.path.at_samples().arguments)[0][0]
        found.append(np.broadcast_to(value, record.path.grid.time.shape))
    return found


def _added_up(null: NullModel, rate: ca.SX) -> Array:
    """A place (N,) from its rate, zero where a record begins."""
    made = []
    for record, speed in zip(null.records, _by_record(null, rate), strict=True):
        steps = np.diff(record.path.grid.time) * (speed[1:] + speed[:-1]) / 2
        made.append(np.concatenate([[0.0], np.cumsum(steps)]))
    return np.concatenate(made)


def _basis_at(family: Family, points: Array) -> Array:
    """(points, terms) values of a family's terms."""
    if family.order or family.cycle:
        half = np.arange(1, len(family.members) // 2 + 1)
        phase = points[:, None] * (family.order or 0.5 * half)
        return np.stack([np.cos(phase), np.sin(phase)], axis=2).reshape(len(points), -1)
    share = (points - family.low) / (family.high - family.low)
    waves = np.cos(math.pi * np.arange(len(family.members) - 2) * share[:, None])
    return np.column_stack([waves, 2 * share - 1, (2 * share - 1) ** 2])


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
    spent = float((share / scores.freedom[members]).sum())
    return float(share.sum()) / spent if spent > 0 else math.inf


def _seen(scores: Scores, family: Family, dimensions: int) -> tuple[Array, Array, Array]:
    """The combinations of terms to which the data are most sensitive under the prior: frame (m, r) in the data,
    strength (r,), and turn (r, terms) in the scaled terms. The rest the parameters take, or noise hides."""
    columns = _columns(scores, family) * np.sqrt(family.variances)
    if not columns.any():
        return np.zeros((len(columns), 0)), np.zeros(0), np.zeros((0, columns.shape[1]))
    frame, strength, turn = svd(columns)
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
    period : of a course over time, that of the wave it is nearest to [s]; nan of any other
    """

    family: Family
    signal: Array
    mean: Array
    band: Array
    level: float
    looks_like: Mapping[str, float]
    period: float = math.nan


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
    points = _points(family)
    turned = _basis_at(family, points) * np.sqrt(family.variances) @ turn.T
    shrunk = level**2 / (1 + level**2 * energy)
    mean, band = turned @ (shrunk * slope), np.sqrt((turned**2 * shrunk).sum(axis=1))
    return _course(family, points, mean, band, level)


def course_of(family: Family, coefficients: Array, root: Array) -> Course:
    """The course of a family's function whose coefficients are known.

    root : (terms, r), root @ root.T is their covariance
    """
    points = _points(family)
    basis = _basis_at(family, points)
    mean, band = basis @ coefficients, np.linalg.norm(basis @ root, axis=1)
    level = float(np.sqrt(np.mean(mean**2)))
    return _course(family, points, mean, band, level)


def _course(family: Family, points: Array, mean: Array, band: Array, level: float) -> Course:
    """A course with what it looks like."""
    alike, period = _likeness(family, points, mean), math.nan
    if family.signal == TIME:
        alike["periodic"], period = _wave(points, mean)
        alike = dict(sorted(alike.items(), key=lambda pair: -pair[1]))
    return Course(family, points, mean, band, level, alike, period)


def _wave(points: Array, mean: Array) -> tuple[float, float]:
    """The share of a course (K,) over time that one wave explains, of two periods or more, and its period."""
    length = points[-1] - points[0]
    most = len(points) / 8
    cycles = np.linspace(_PERIODS, most, int(_BETWEEN * (most - _PERIODS)))
    turns = 2 * math.pi * cycles[:, None, None] * ((points - points[0]) / length)[:, None]
    own = mean - mean.mean()
    whole = float(own @ own)
    if not whole > 0:
        return 0.0, math.nan
    frame = np.linalg.qr(np.concatenate([np.ones_like(turns), np.cos(turns), np.sin(turns)], axis=2))[0]
    taken = ((frame.transpose(0, 2, 1) @ own) ** 2).sum(axis=1) / whole
    best = int(np.argmax(taken))
    return float(taken[best]), float(length / cycles[best])


def _points(family: Family) -> Array:
    return np.linspace(family.low, family.high, _POINTS)


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
