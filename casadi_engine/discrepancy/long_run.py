"""The level at which white noise counts as much as coloured noise does along given directions.

Least squares with equal weights and its covariance under coloured noise (the sandwich of White 1980, Newey & West
1987): with g = M s, the score g'e has the variance g'Omega g, whatever the weights were. Weights by the inverse of
Omega, as in ``NoiseModel.whiten``, are better where the model is right at all frequencies; where its error is slow and
its corners are a sample early or late, they weigh the corners alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array, basis, without
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel, fitted_colour
from casadi_engine.discrepancy.null_model import Index, NullModel
from casadi_engine.discrepancy.screening import Screened

_FINE = 8


def long_run_noise(
    screened: Screened, chosen: Sequence[int], left: NullModel, estimated: int
) -> tuple[NoiseModel, float]:
    """White noise at the level at which no chosen candidate's score, nor the difference of two, varies more than by the
    coloured noise there is.

    screened : the scores; chosen : candidates' numbers; left : a model of the same data whose residuals are the noise;
    estimated : how many numbers were estimated for it. Returns the noise, and its degrees of freedom: as many as there
    are independent samples, less the numbers estimated. Without any left, or where nothing is left of the
    residuals, the level is infinite.
    """
    null = screened.null
    spread = {
        name: math.sqrt(
            float(
                np.mean(np.concatenate([r.residual[name] for r in left.records if name in r.residual]) ** 2)
            )
        )
        for name in {name for record in left.records for name in record.outputs}
    }
    if not all(level > 0 for level in spread.values()):
        return NoiseModel(dict.fromkeys(spread, math.inf), {}, {}, "estimated"), 0.0
    pieces = [(record, output) for record in null.records for output in record.outputs]
    count = null.turn.shape[1]
    own = [record.slopes[record.outputs[0]].shape[1] - count for record in null.records]
    first = dict(zip([r.name for r in null.records], count + np.cumsum([0, *own]), strict=False))
    slopes, columns = [], []
    for record, output in pieces:
        found = record.slopes[output]
        wide = np.zeros((len(found), count + sum(own)))
        wide[:, :count] = found[:, :count]
        wide[:, first[record.name] : first[record.name] + found.shape[1] - count] = found[:, count:]
        slopes.append(wide / spread[output])
        columns.append(screened.columns[record.name][output][:, list(chosen)] / spread[output])
    stacked = np.concatenate(slopes)
    size = np.linalg.norm(stacked, axis=0)
    free = without(basis(stacked / np.where(size > 0, size, 1.0)), np.concatenate(columns))
    free = np.column_stack([free, *_apart(free)])
    power = np.zeros(free.shape[1])
    ends = np.cumsum([len(part) for part in columns])
    for (record, output), part in zip(pieces, np.split(free, ends[:-1]), strict=True):
        after = next(one for one in left.records if one.name == record.name)
        colour = fitted_colour(after.residual[output], after.index[output], after.length[output])
        level = float(np.mean(after.residual[output] ** 2)) / spread[output] ** 2
        power += level * coloured_power(colour, part, record.index[output], record.length[output])
    white = np.maximum((free**2).sum(axis=0), 1e-300)
    inflation = float(np.max(power / white, initial=1.0))
    samples = len(free) / inflation
    freedom = samples - estimated
    scale = math.sqrt(inflation * samples / freedom) if freedom > 0 else math.inf
    return NoiseModel({name: sigma * scale for name, sigma in spread.items()}, {}, {}, "estimated"), freedom


def _apart(free: Array) -> list[Array]:
    """What each two columns (N, k) differ in, their lengths and signs alike."""
    unit = free / np.maximum(np.linalg.norm(free, axis=0), 1e-300)
    pairs = ((unit[:, j], unit[:, k]) for k in range(unit.shape[1]) for j in range(k))
    return [one - np.sign(one @ other) * other for one, other in pairs]


def coloured_power(colour: Colour, columns: Array, index: Index, length: int) -> Array:
    """g'Omega g of columns (N, k) at the samples ``index`` of a channel; Omega has ones on its diagonal.

    >>> import numpy as np
    >>> from casadi_engine.discrepancy.noise_model import Colour
    >>> slow = Colour((np.ones(1), np.array([1.0, -0.5])), np.array([4 / 3, 1.0]))
    >>> pair = np.array([[1.0], [1.0]])
    >>> float(np.round(coloured_power(slow, pair, np.arange(2), 2)[0], 6))  # 1 + 1 + 2 times the correlation 0.5
    3.0
    """
    size = _FINE * (1 << (max(length, 64) - 1).bit_length())
    full = np.zeros((length, columns.shape[1]))
    full[index] = columns
    gain = 1 / np.abs(np.fft.rfft(colour.predictors[-1], size)) ** 2
    weight = np.full(len(gain), 2.0)
    weight[0] = weight[-1] = 1.0
    density = gain / (gain @ weight) * weight
    return np.asarray((density[:, None] * np.abs(np.fft.rfft(full, size, axis=0)) ** 2).sum(axis=0))
