"""A torque of unknown course at one port: how much of the residual it explains, and what it looks like over time.

The torque is a Gaussian process, piecewise linear between knots, that enters where an effect at the port would. All
parameters and initial states stay free beside it, and its likelihood is compared with that of the null; given the
data, its mean and band are those of a fixed-interval smoother. With one sensor any port can explain any residual: the
gain is a screen and the course a picture, and the claim comes from the score test.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, basis, triangle, without
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.errors import EstimationError
from casadi_engine.model import Model
from casadi_engine.simulation.candidate_sensitivities import torque_direction
from casadi_engine.simulation.knot_sensitivities import knot_sensitivities

KERNELS = ("exponential", "matern32", "random_walk")
# Knots of an engine cycle, and the most of them in a record.
_PER_CYCLE, _MOST = 24, 400
# Samples averaged to one row: this many rows between knots are left.
_ROWS_BETWEEN = 5
_LENGTHS = 4
_JITTER = 1e-8
# Numbers of sensitivities that are held at a time: 64 MB.
_NUMBERS = 8_000_000


@dataclass(frozen=True, eq=False)
class LatentCourse:
    """The torque of one record: time (K,) s, mean (K,) and band (K,) N m (one standard deviation); signals of the port
    at the same times, name -> (K,)."""

    time: Array
    mean: Array
    band: Array
    signals: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class LatentTorque:
    """port; gain : 2 log likelihood over the null; level [N m] and length [s] of the process; courses by record."""

    port: str
    kernel: str
    gain: float
    level: float
    length: float
    courses: Mapping[str, LatentCourse]


def latent_torques(
    null: NullModel,
    noise: NoiseModel,
    *,
    ports: Sequence[str] | None = None,
    kernel: str = "exponential",
    knots: int | None = None,
) -> list[LatentTorque]:
    """The latent torque of every port, the one with the largest gain first.

    ports : names of ports that take a torque; None for all inertias, couplings and the cylinders together
    kernel : "exponential" (Matérn 1/2), "matern32" or "random_walk"; knots : per record, or None
    Raises EstimationError for an unknown kernel or a port that takes no torque.
    """
    if kernel not in KERNELS:
        raise EstimationError(
            "the kernel of the latent torque is not known",
            seen=repr(kernel),
            allowed=", ".join(KERNELS),
            cure='leave it out for "exponential"',
        )
    names = [p.name for p in null.model.ports if _torque_port(null.model, p.name)] if ports is None else ports
    for name in names:
        if null.model.ports[name].slot is None:
            raise EstimationError(
                "no torque can act at this port",
                seen=name,
                allowed=", ".join(p.name for p in null.model.ports.with_slot),
                cure="choose one of these",
            )
    times = [_knots(record, knots) for record in null.records]
    found = []
    for some in _groups(null, names, times):
        rows = [_rows(null, noise, record, some, at) for record, at in zip(null.records, times, strict=True)]
        found += [_latent(null, name, kernel, times, [own[k] for own in rows]) for k, name in enumerate(some)]
    return sorted(found, key=lambda one: -one.gain)


def _groups(null: NullModel, names: Sequence[str], times: Sequence[Array]) -> Iterator[list[str]]:
    """So many ports at a time that their sensitivities at all samples would not take too much memory."""
    outputs = len(null.model.outputs)
    size = max(r.path.grid.samples * outputs * len(at) for r, at in zip(null.records, times, strict=True))
    many = max(_NUMBERS // size, 1)
    for first in range(0, len(names), many):
        yield list(names[first : first + many])


def _torque_port(model: Model, name: str) -> bool:
    port = model.ports[name]
    if port.slot is None or (port.kind == "internal" and not port.is_own):
        return False
    return port.kind != "cylinder" or name == "cylinders" or "cylinders" not in model.ports


def _latent(
    null: NullModel, name: str, kernel: str, times: Sequence[Array], rows: Sequence[Array]
) -> LatentTorque:
    spans = [at[-1] - at[0] for at in times]
    shortest = 2 * min(at[1] - at[0] for at in times)
    lengths = (
        [max(spans)]
        if kernel == "random_walk"
        else np.geomspace(shortest, max(max(spans) / 3, 2 * shortest), _LENGTHS).tolist()
    )
    tries = [_Process.of(rows, times, kernel, length) for length in lengths]
    best = max(tries, key=lambda one: one.gain)
    courses = {}
    for k, record in enumerate(null.records):
        mean, band = best.course(k)
        courses[record.name] = LatentCourse(
            times[k], mean, band, _signals(record, null.model.ports[name].signals, times[k])
        )
    return LatentTorque(name, kernel, best.gain, best.level, best.length, courses)


def _knots(record: RecordNull, count: int | None) -> Array:
    grid = record.path.grid
    if count is None:
        cycles = len({int(c) for number in record.cycle.values() for c in np.unique(number)})
        count = min(_PER_CYCLE * max(cycles, 2), _MOST, max(grid.samples // (2 * _ROWS_BETWEEN), 2))
    return np.asarray(grid.start + np.linspace(0, grid.span, max(count, 2)), dtype=np.float64)


def _rows(
    null: NullModel, noise: NoiseModel, record: RecordNull, ports: Sequence[str], knots: Array
) -> list[Array]:
    """[H | e] (K + 1 columns) of one record for each port, whitened, parameters and initial states projected out."""
    grid = record.path.grid
    coloured = any((record.name, name) in noise.colour for name in record.outputs)
    complete = all(len(e) == grid.samples for e in record.residual.values())
    every = 1
    if grid.uniform and complete and not coloured:
        every = max(1, int((knots[1] - knots[0]) / grid.step / _ROWS_BETWEEN))
    units = [torque_direction(null.model, name, ca.SX(1), name=name) for name in ports]
    found = knot_sensitivities(record.path, units, knots, every=every)
    return [_left(null, noise, record, hats, every) for hats in found]


def _left(null: NullModel, noise: NoiseModel, record: RecordNull, hats: Array, every: int) -> Array:
    """[H | e] of one port; hats : (K, ny, rows) sensitivities, means of ``every`` samples."""
    grid = record.path.grid
    outputs = [out.name for out in null.model.outputs]
    parts = []
    for name in record.outputs:
        rest = np.column_stack([record.slopes[name], record.residual[name]])
        if every > 1:
            count = grid.samples // every
            mean = rest[: count * every].reshape(count, every, -1).mean(axis=1)
            own = hats[:, outputs.index(name)].T
            white = np.concatenate([mean, own], axis=1) * math.sqrt(every) / noise.sigma[name]
        else:
            white = _at_measured(noise, record, name, rest, hats[:, outputs.index(name)])
        parts.append(triangle(white))
    rows = triangle(np.concatenate(parts))
    width = next(iter(record.slopes.values())).shape[1]
    prior = np.zeros((len(null.prior), rows.shape[1]))
    shared = null.turn.shape[1]
    prior[:, :shared], prior[:, width] = null.prior[:, :-1], null.prior[:, -1]
    rows = np.concatenate([rows, prior])
    left = triangle(without(basis(rows[:, :width]), rows[:, width:]))
    return np.concatenate([left[:, 1:], left[:, :1]], axis=1)


def _at_measured(noise: NoiseModel, record: RecordNull, name: str, rest: Array, hats: Array) -> Array:
    own = hats[:, record.path.grid.measured[name].position].T
    return noise.whiten(record, name, np.concatenate([rest, own], axis=1))


def _signals(record: RecordNull, signals: Mapping[str, object], knots: Array) -> dict[str, Array]:
    path = record.path
    found = {}
    for name, expression in signals.items():
        try:
            value = path.function([expression])(*path.at_samples().arguments)[0][0]  # type: ignore[list-item]
        except RuntimeError:  # a signal in symbols that the null path does not know
            continue
        found[name] = np.interp(knots, path.grid.time, np.broadcast_to(value, path.grid.time.shape))
    return found


@dataclass(frozen=True, eq=False)
class _Process:
    """The process of one length: per record the factor of its prior (K, K), and energies of the data in it."""

    factors: list[Array]
    energy: list[Array]
    frames: list[Array]
    slopes: list[Array]
    length: float
    level: float
    gain: float

    @staticmethod
    def of(rows: Sequence[Array], times: Sequence[Array], kernel: str, length: float) -> _Process:
        from scipy import optimize

        factors, energy, frames, slopes = [], [], [], []
        for own, knots in zip(rows, times, strict=True):
            factor = _factor(kernel, knots, length)
            seen = own[:, :-1] @ factor
            values, frame = np.linalg.eigh(seen.T @ seen)
            factors.append(factor)
            energy.append(np.maximum(values, 0.0))
            frames.append(frame)
            slopes.append(frame.T @ (seen.T @ own[:, -1]))

        def cost(log_level: float) -> float:
            v = math.exp(2 * log_level)
            return sum(
                float((np.log1p(v * e) - s**2 * v / (1 + v * e)).sum())
                for e, s in zip(energy, slopes, strict=True)
            )

        top = max(float(e.max(initial=0.0)) for e in energy)
        if top <= 0:
            return _Process(factors, energy, frames, slopes, length, 0.0, 0.0)
        middle = -0.5 * math.log(top)
        found = optimize.minimize_scalar(cost, bounds=(middle - 3, middle + 15), method="bounded")
        gain = max(-float(found.fun), 0.0)
        level = math.exp(float(found.x)) if gain > 0 else 0.0
        return _Process(factors, energy, frames, slopes, length, level, gain)

    def course(self, k: int) -> tuple[Array, Array]:
        """Mean and standard deviation (K,) [N m] of one record's torque at the knots."""
        variance = self.level**2
        turned = self.factors[k] @ self.frames[k]
        shrunk = variance / (1 + variance * self.energy[k])
        return turned @ (shrunk * self.slopes[k]), np.sqrt((turned**2 * shrunk).sum(axis=1))


def _factor(kernel: str, knots: Array, length: float) -> Array:
    """A square root (K, K) of the prior covariance of unit level at the knots."""
    gap = np.abs(knots[:, None] - knots[None, :])
    if kernel == "exponential":
        covariance = np.exp(-gap / length)
    elif kernel == "matern32":
        scaled = math.sqrt(3) * gap / length
        covariance = (1 + scaled) * np.exp(-scaled)
    else:
        since = knots - knots[0]
        covariance = 1 + np.minimum(since[:, None], since[None, :]) / length
    return np.asarray(np.linalg.cholesky(covariance + _JITTER * np.eye(len(knots))), dtype=np.float64)
