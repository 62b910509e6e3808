"""What the steps of a sensor do to the tests of its residual.

Rounding is no noise: the signal determines it, and where the signal comes back, so does what rounding leaves. Then the
residual of a right model has lines in its spectrum and is not white. How clear that is by rounding alone is found by
rounding the model's own prediction, moved within the errors of what was fitted, with the noise that is left beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.discrepancy.null_model import NullModel, RecordNull
from casadi_engine.discrepancy.score import TESTABLE
from casadi_engine.experiment.resolution import step_of

# Noise beside the rounding, in steps, from which on it hides what rounding does: the first harmonic of the mean error
# falls as exp(-2 (pi s)^2), to 0.7 % here (Widrow & Kollar, Quantization Noise, 2008).
_HIDDEN = 0.5
# Draws of rounding: of scores, and of tests that take longer.
_DRAWS, _FEW = 60, 20
_TINY = 1e-300
# Ratio of squared scores that draws of white noise in place of rounding do not reach.
_WORSE = 1.25


@dataclass(frozen=True, eq=False)
class Rounded:
    """An output that reads in steps with little noise beside them.

    measured, residual : (N,); frame : (N, r) basis of what was fitted; step, scatter : of the sensor, and of the noise
    """

    measured: Array
    residual: Array
    frame: Array
    step: float
    scatter: float

    def draws(self, count: int, seed: int) -> Iterator[tuple[Array, Array]]:
        """So many residuals (N,) by rounding and this noise alone, each with white noise of that level; one after the
        other, as records may be long."""
        draw = np.random.default_rng(seed)
        level = math.sqrt(self.scatter**2 + self.step**2 / 12)
        for _ in range(count):
            moved = self.measured - self.residual
            moved = moved + level * (self.frame @ draw.standard_normal(self.frame.shape[1]))
            moved = moved + self.scatter * draw.standard_normal(len(moved))
            read = self.measured[0] + self.step * np.round((moved - self.measured[0]) / self.step)
            yield read - moved, level * draw.standard_normal(len(moved))


def rounded(record: RecordNull, output: str) -> Rounded | None:
    """How an output is rounded, where that is most of its noise; None elsewhere."""
    measured, e = record.path.grid.measured[output].values, record.residual[output]
    step = step_of(measured)
    rest = math.inf if step is None else float(e @ e) / len(e) - step**2 / 12
    if step is None or rest > (_HIDDEN * step) ** 2:
        return None
    return Rounded(measured, e, basis(record.slopes[output]), step, math.sqrt(max(rest, 0.0)))


def rounded_levels(
    null: NullModel, columns: Mapping[str, Mapping[str, Array]], sigma: Mapping[str, float], seed: int = 0
) -> dict[str, float]:
    """Output -> level of the white noise by which candidates would score as high as by rounding alone; for the outputs
    whose noise is rounding, and that are worse than white noise.

    columns : record -> output -> (N, k) of the candidates. The largest of their squared scores, and of the fitted
    directions, by rounding alone is held against the largest by white noise of the same level.
    """
    found: dict[str, float] = {}
    for record in null.records:
        for output in record.outputs:
            one = rounded(record, output)
            if one is None:
                continue
            tested = columns[record.name][output]
            left = without(one.frame, tested)
            size = np.linalg.norm(left, axis=0)
            good = size > TESTABLE * np.linalg.norm(tested, axis=0)
            left = np.column_stack([one.frame, left[:, good] / size[good]])
            largest = [[((left.T @ e) ** 2).max() for e in pair] for pair in one.draws(_DRAWS, seed)]
            steps, white = np.mean(largest, axis=0).tolist()
            found[output] = max(found.get(output, 1.0), steps / max(white, _TINY))
    return {name: sigma[name] * math.sqrt(more) for name, more in found.items() if more > _WORSE}


def beyond_rounding(
    record: RecordNull, output: str, test: Callable[[Array], float | None], seed: int = 0
) -> Callable[[float], float]:
    """What makes the p-value of a test of a residual (N,) that of one which knows the sensor's steps.

    Minus the logarithm of a p-value is 1 on average where only noise is tested. Where rounding alone makes it larger,
    p is taken to the power of one over that average.
    """
    one = rounded(record, output)
    if one is None:
        return lambda p: p
    found = [test(without(one.frame, e[:, None])[:, 0]) for e, _ in one.draws(_FEW, seed)]
    mean = max(1.0, sum(0.0 if p is None else -math.log(max(p, _TINY)) for p in found) / _FEW)
    return lambda p: max(p, _TINY) ** (1 / mean)
