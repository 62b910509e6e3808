"""Shooting intervals of a record: how its samples are cut into intervals and blocks, and laid out for the batch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.jets import Array

# A block this long makes the matrix products large enough for BLAS and the block matrix cheap to build.
_BLOCK = 16
_LONGEST_BLOCK = 64
# Samples of an interval that holds a cubic.
_CUBIC = 4


@dataclass(frozen=True)
class Intervals:
    """m intervals of b blocks of q samples; outputs at ``samples`` of each block.

    samples : numbers 0 .. q-1, and q, the block's end, where outputs are interpolated: a measured sample between an
    interval's last grid point and the next interval's first then has grid points on both sides.
    padded : m*b*q >= N, the samples with the padding of the last interval
    """

    m: int
    b: int
    q: int
    samples: NDArray[np.intp]

    @property
    def length(self) -> int:
        """Samples of an interval."""
        return self.b * self.q

    @property
    def points(self) -> int:
        """Samples of an interval at which there are outputs or further steps: its length, or one more."""
        return max(self.length, (self.b - 1) * self.q + int(self.samples[-1]) + 1)

    @property
    def padded(self) -> int:
        """Samples of all intervals."""
        return self.m * self.length


def cut(grid: Grid, length: int | None) -> Intervals:
    """Cut a record into intervals of about ``length`` samples (None: one interval, single shooting).

    A length is rounded to the next multiple of the outputs' stride, if they were measured at every k-th sample; and a
    long one without a divisor that makes a good block to the next multiple of one.
    """
    stride, offset = _stride(grid)
    beyond = 0 if _on_grid(grid) else 1
    if length is None or length >= grid.samples:
        q = _LONGEST_BLOCK if grid.samples > 20 * _LONGEST_BLOCK else min(_BLOCK, grid.samples)
        q = math.ceil(q / stride) * stride
        b = math.ceil(grid.samples / q)
        return Intervals(1, b, q, np.arange(offset, q + beyond, stride))
    if beyond:
        length = max(length, _CUBIC)
    if length > stride:
        length = math.ceil(length / stride) * stride
    q = _block(length, stride)
    if q == 0:
        q = math.ceil(_BLOCK / stride) * stride
        length = math.ceil(length / q) * q
    if q % stride:
        stride, offset = 1, 0
    return Intervals(math.ceil(grid.samples / length), length // q, q, np.arange(offset, q + beyond, stride))


def _on_grid(grid: Grid) -> bool:
    return all(m.on_grid for m in grid.measured.values())


def _stride(grid: Grid) -> tuple[int, int]:
    """Step and offset of the grid points at which any output was measured; (1, 0) off the grid."""
    if not grid.measured or not _on_grid(grid):
        return 1, 0
    points = np.unique(np.concatenate([m.position for m in grid.measured.values()])).astype(int)
    stride = int(np.gcd.reduce(np.diff(points))) if len(points) > 1 else 1
    return (stride, int(points[0] % stride)) if 1 < stride <= _LONGEST_BLOCK else (1, 0)


def _block(length: int, stride: int) -> int:
    """The divisor of ``length`` nearest to the wanted block, a multiple of the stride if there is one; 0 if none."""
    if length <= _BLOCK and (length % stride == 0 or length < stride):
        return length
    divisors = [d for d in range(1, min(length, _LONGEST_BLOCK) + 1) if length % d == 0]
    good = [d for d in divisors if d % stride == 0] or divisors
    best = min(good, key=lambda d: abs(math.log(d / _BLOCK)))
    return best if best >= 4 or length <= _BLOCK else 0


class Observation:
    """The measured samples of a record in the batch's layout, K rows for each of M intervals.

    measured : (K, M), 0 where there is none; valid : (K, M) bool; column : (K, M) number of the output.
    On the grid the rows are those of the propagator (R*ny*b); off the grid they are the measured samples of each
    interval, interpolated from four grid points.
    """

    def __init__(self, grid: Grid, intervals: Intervals, outputs: tuple[str, ...]) -> None:
        self.plan, self.outputs, self.samples = intervals, outputs, grid.measured
        self.on_grid = _on_grid(grid)
        rows, ny, plan = len(intervals.samples), len(outputs), intervals
        self._shape = (rows, ny, plan.b, plan.m)
        self._row_of = np.full(plan.q + 1, -1)
        self._row_of[plan.samples] = np.arange(rows)
        self._index: NDArray[np.intp] | None = None
        place = self._place_on_grid if self.on_grid else self._place_off_grid
        self.where = place(grid)
        kinds = np.zeros(self.shape, np.intp)
        self.measured, self.valid = np.zeros(self.shape), np.zeros(self.shape, dtype=bool)
        for column, name in enumerate(outputs):
            if name in self.where:
                self.measured.ravel()[self.where[name]] = grid.measured[name].values
                self.valid.ravel()[self.where[name]] = True
                kinds.ravel()[self.where[name]] = column
        self.column = kinds

    def leave_out(self, points: NDArray[np.bool_]) -> None:
        """Take the samples at the given grid points, (N,) True, out of those that count."""
        for name, where in self.where.items():
            gone = points[self.samples[name].position.astype(int)]
            self.valid.ravel()[where[gone]] = False

    def _flat(
        self, position: NDArray[np.intp], column: NDArray[np.intp] | int, interval: NDArray[np.intp]
    ) -> NDArray[np.intp]:
        """Index of grid points of the given intervals in the propagator's layout (R, ny, b, M)."""
        inside = position - interval * self.plan.length
        block = np.minimum(inside // self.plan.q, self.plan.b - 1)
        row = self._row_of[inside - block * self.plan.q]
        return np.ravel_multi_index((row, np.broadcast_to(column, row.shape), block, interval), self._shape)

    def _place_on_grid(self, grid: Grid) -> dict[str, NDArray[np.intp]]:
        rows, ny, b, m = self._shape
        self.shape = (rows * ny * b, m)
        numbers = {name: column for column, name in enumerate(self.outputs) if name in grid.measured}
        points = {name: grid.measured[name].position.astype(int) for name in numbers}
        return {name: self._flat(at, numbers[name], at // self.plan.length) for name, at in points.items()}

    def _place_off_grid(self, grid: Grid) -> dict[str, NDArray[np.intp]]:
        names = [name for name in self.outputs if name in grid.measured]
        position = np.concatenate([grid.measured[name].position for name in names])
        kind = np.concatenate([np.full(len(grid.measured[n].position), self.outputs.index(n)) for n in names])
        interval = np.clip(position // self.plan.length, 0, self.plan.m - 1).astype(int)
        order = np.argsort(interval, kind="stable")
        counts = np.bincount(interval, minlength=self.plan.m)
        rank = np.empty(len(position), np.intp)
        rank[order] = np.arange(len(position)) - np.repeat(np.cumsum(counts) - counts, counts)
        self.shape = (int(counts.max()), self.plan.m)
        points, weights = _stencil(position, interval, self.plan, grid.samples)
        index = np.zeros((*self.shape, 4), np.intp)
        self._weights = np.zeros((*self.shape, 4))
        flat = self._flat(points.ravel(), np.repeat(kind, 4), np.repeat(interval, 4))
        index[rank, interval] = flat.reshape(points.shape)
        self._weights[rank, interval] = weights
        self._index = index
        places = np.ravel_multi_index((rank, interval), self.shape)
        ends = np.cumsum([len(grid.measured[name].position) for name in names])[:-1]
        return dict(zip(names, np.split(places, ends), strict=True))

    def observe(self, y: Array) -> Array:
        """(..., R*ny, b, M) grid outputs at the measured samples, (..., K, M)."""
        if self._index is None:
            return y.reshape(*y.shape[:-3], *self.shape)
        flat = y.reshape(*y.shape[:-3], -1)
        return (flat[..., self._index] * self._weights).sum(axis=-1)

    def observe_starts(self, ys: Array) -> Array:
        """Sensitivities to the intervals' starts: (R*ny, b, [M,] n) to (K, n), or (K, M, n) where they differ."""
        n = ys.shape[-1]
        if self._index is None:
            return ys.reshape(-1, n) if ys.ndim == 3 else ys.reshape(*self.shape, n)
        if ys.ndim == 3:
            flat, index = ys.reshape(-1, n), self._index // self.plan.m
        else:
            flat, index = ys.reshape(-1, n), self._index
        return (flat[index] * self._weights[..., None]).sum(axis=-2)

    def adjoint(self, rho: Array) -> Array:
        """The transpose of ``observe``: (K, M) to (R*ny, b, M)."""
        rows, ny, b, m = self._shape
        if self._index is None:
            return rho.reshape(rows * ny, b, m)
        spread = (rho[..., None] * self._weights).ravel()
        total = np.bincount(self._index.ravel(), spread, minlength=rows * ny * b * m)
        return total.astype(np.float64).reshape(rows * ny, b, m)

    def series(self, values: Array, name: str) -> Array:
        """(K, M) values at the valid samples of one output, in time order."""
        return values.ravel()[self.where[name]]


def _stencil(
    position: Array, interval: NDArray[np.intp], plan: Intervals, samples: int
) -> tuple[NDArray[np.intp], Array]:
    """Grid points (N, 4) and Lagrange weights (N, 4) of off-grid positions, within the sample's interval."""
    low = interval * plan.length
    high = np.minimum(low + plan.length, samples - 1)
    first = np.clip(np.floor(position) - 1, low, np.maximum(high - 3, low))
    points = first[:, None] + np.arange(4)[None, :]
    usable = points <= high[:, None]
    weights = np.ones_like(points)
    for i in range(4):
        for j in range(4):
            if i != j:
                factor = (position - points[:, j]) / (points[:, i] - points[:, j])
                weights[:, i] *= np.where(usable[:, j], factor, 1.0)
    weights[~usable] = 0.0
    points = np.minimum(points, high[:, None])
    return points.astype(np.intp), weights
