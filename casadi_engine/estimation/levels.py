"""Noise levels of the outputs: known ones, first guesses from the data, and estimates from residuals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EstimationError
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.model import Model
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

# Share of its median absolute deviation that the standard deviation of a normal variable is.
_MAD = 1.4826
# Levels below these shares of the largest output: with the first as weight, rounding keeps a search from ending;
# the second is rounding itself.
_WEIGHT, _ROUNDING = 1e-5, 1e-12
# Residuals that say nothing: this share of a known level, or of the largest output (the tolerance of continuity).
_SMALL, _TOLERANCE = 1e-3, 1e-8
# Iterations of a robust level at most, and the change at which it has settled.
_TURNS, _SETTLED = 50, 1e-4
# Times the largest sample, and its inverse, beyond which a stated level is none: the digits of a number.
_BEYOND = 1e15
# Degrees of freedom that a level has at least.
_LEAST = 1.0


class NoiseLevels:
    """The levels (ny,) of a fit's outputs.

    estimated : whether the level of each output is estimated; counts : (ny,) samples of each that count
    """

    def __init__(self, noise: Any, model: Model, records: list[RecordTerm]) -> None:
        self.noise, self.records = noise, records
        self.outputs = tuple(out.name for out in model.outputs)
        self.estimated = [noise.level(name) == "estimate" for name in self.outputs]
        self.counts = np.array(
            [
                sum(int((r.observation.valid & (r.observation.column == k)).sum()) for r in records)
                for k in range(len(self.outputs))
            ]
        )
        self._size = np.array(
            # An output that is zero throughout is of no size: its unit's scale stands in, for it gives the weights.
            [
                max((_largest(s) for s in self._series(out.name)), default=0.0) or out.scale
                for out in model.outputs
            ]
        )

        self._check_stated()

    def _check_stated(self) -> None:
        """Raise EstimationError for a stated level that is no noise of such samples: below their digits, or so far
        above them that nothing of them counts."""
        for name, size, estimated in zip(self.outputs, self._size, self.estimated, strict=True):
            level = np.nan if estimated else float(self.noise.level(name))
            if level < size / _BEYOND or level > size * _BEYOND:
                raise EstimationError(
                    f"the noise level of {name} cannot be that of its samples",
                    seen=f"{level:g}, where the largest sample is {size:.3g}",
                    allowed=f"{size / _BEYOND:.1g} to {size * _BEYOND:.1g}",
                    cure=f"look at its unit, or leave {name} out of the noise to have its level estimated",
                )

    def _series(self, name: str) -> list[Array]:
        return [r.grid.measured[name].values for r in self.records if name in r.grid.measured]

    def first(self, warm: Any = None) -> Array:
        """Known levels; for the others those of a warm start, or the scatter between neighbouring samples."""
        before, levels = getattr(warm, "noise", {}), []
        for name, size in zip(self.outputs, self._size, strict=True):
            level = self.noise.level(name)
            if level == "estimate":
                found = before.get(name)
                if isinstance(found, tuple) and found[0] > 0:
                    level = found[0]
                else:
                    steps = np.concatenate([np.diff(s, 2) for s in self._series(name)] or [np.zeros(0)])
                    level = np.sqrt(np.mean(steps**2) / 6) if len(steps) else size
            levels.append(float(level))
        return self.weights(np.array(levels))

    def weights(self, levels: Array) -> Array:
        """The levels as they can serve for weights in a search: not too small where they are estimated."""
        least = np.maximum(_WEIGHT * self._size, 1e-300)
        return np.where(self.estimated, np.maximum(levels, least), levels)

    def at(
        self,
        points: list[RecordPoint],
        sigma: Array,
        loss: Loss,
        lost: int,
        taken: Array | None = None,
    ) -> Array:
        """Levels from the residuals of points that were weighted by ``sigma``.

        lost : degrees of freedom of all samples together; taken : (ny,) of each output, where they are known
        """
        found = sigma.copy()
        whole = 1.0 - lost / sum(record.count for record in self.records)
        for k, wanted in enumerate(self.estimated):
            parts = [
                point.r[record.observation.valid & (record.observation.column == k)]
                for record, point in zip(self.records, points, strict=True)
            ]
            r = np.concatenate(parts)
            if not wanted or not len(r):
                continue
            share = whole if taken is None else max(len(r) - taken[k], _LEAST) / len(r)
            size = (
                _robust(r, loss, share) if loss.robust else float(np.sqrt(np.mean(r**2) / max(share, 1e-9)))
            )
            found[k] *= size
            found[k] = max(found[k], _ROUNDING * self._size[k], 1e-300)
        return found

    def rounding(self, name: str, r: Array, sigma: Array) -> bool:
        """True if residuals r in units of the levels sigma (ny,) are but what a search leaves of data without noise:
        below the tolerance of continuity, or a thousandth of a level that is known."""
        k = self.outputs.index(name)
        size = float(np.sqrt(np.mean(r**2)))
        known = not self.estimated[k] and size < _SMALL
        return known or size * float(sigma[k]) < _TOLERANCE * float(self._size[k])

    def by_name(self, sigma: Array) -> dict[str, tuple[float, bool]]:
        """Output -> (level, whether it was estimated)."""
        rows = zip(self.outputs, sigma.tolist(), self.estimated, strict=True)
        return {name: (level, estimated) for name, level, estimated in rows}

    def variation(self) -> float:
        """Mean square of the weighted outputs about their means: what a fit of 0 % leaves."""
        total, count = 0.0, 0
        for record in self.records:
            for name, sample in record.grid.measured.items():
                weight = record.weight.ravel()[record.observation.where[name]]
                total += float((((sample.values - sample.values.mean()) * weight) ** 2).sum())
                count += int((weight > 0).sum())
        return max(total / max(count, 1), 1e-300)


def _robust(r: Array, loss: Loss, share: float) -> float:
    """The size of residuals of which some are outliers, share of whose number is left to tell it: the one at which the
    mean square of the clipped residuals is that of a normal variable (proposal 2 of Huber 1964).

    The median absolute deviation, from which it begins, is known by a third of the samples alone: of ten residuals half
    may be next to nothing.
    """
    size = _MAD * float(np.median(np.abs(r - np.median(r))))
    if not size > 0:  # most are one number, as of a sensor that reads in steps: the others tell the size
        return max(float(np.sqrt(np.mean(r**2) / max(share, 1e-9))), 1e-300)
    wanted = max(share, 1e-9) * _clipped(loss.knee)
    for _ in range(_TURNS):
        new = size * float(np.sqrt(np.mean(loss.slope(r / size) ** 2) / wanted))
        size, before = max(new, 1e-300), size
        if abs(size - before) < _SETTLED * size:
            break
    return size


def _clipped(knee: float) -> float:
    """The mean square of a standard normal variable that is clipped at a knee."""
    tail = 0.5 * math.erfc(knee / math.sqrt(2))
    density = math.exp(-(knee**2) / 2) / math.sqrt(2 * math.pi)
    return 1 - 2 * tail - 2 * knee * density + 2 * knee**2 * tail


def check_samples(noise: Noise, records: list[RecordTerm], unknowns: int, pulls: int) -> None:
    """Raise unless there are more samples than what is found from them, where noise levels are among that.

    unknowns : free parameters and initial states, less the equalities between them; pulls : priors, which count as
    samples. With fewer, the model goes through every sample and the noise that is left over says nothing.
    """
    if not records:
        return
    count = sum(record.count for record in records)
    known = all(noise.level(name) != "estimate" for name in records[0].outputs)
    if known or count + pulls > unknowns:
        return
    raise EstimationError(
        "there are too few samples to estimate the parameters and the noise level",
        seen=f"{count} that count, for {unknowns} unknown parameters and initial states",
        allowed=f"more than {unknowns - pulls} samples, or a known noise level",
        cure="take a longer record, fix parameters or initial states, or give ce.Noise(output=sigma)",
    )


def _largest(values: Array) -> float:
    return float(np.abs(values).max(initial=0.0))


def check_noise(noise: Any, model: Model) -> Noise:
    """The noise of a fit, all levels estimated if None is given."""
    if noise is None:
        return Noise()
    if not isinstance(noise, Noise):
        raise EstimationError(
            "the noise is not acceptable",
            seen=repr(noise),
            allowed="a Noise, or None to estimate the levels of all outputs",
            cure="write noise=ce.Noise(omega=0.1), for instance",
        )
    outputs = tuple(out.name for out in model.outputs)
    for name in noise.outputs:
        if name not in outputs:
            raise EstimationError(
                f"the model {model.name} has no such output",
                seen=f"noise of {name!r}",
                allowed=", ".join(outputs),
                cure="name the model's outputs",
            )
    shape = (len(model.states), len(outputs))
    if noise.gain is not None and noise.gain.shape != shape:
        states = ", ".join(s.name for s in model.states)
        raise EstimationError(
            "the gain has the wrong shape",
            seen=str(noise.gain.shape),
            allowed=f"{shape}: states {states} by outputs {', '.join(outputs)}",
            cure="give one row for each state and one column for each output",
        )
    return noise
