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


@dataclass(frozen=True)
class Intervals:
    """m intervals of b blocks of q samples; outputs at ``samples`` of each block.

    samples : numbers out of 0 .. q-1
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
    def padded(self) -> int:
        """Samples of all intervals."""
        return self.m * self.length


def cut(grid: Grid, length: int | None) -> Intervals:
    """Cut a record into intervals of about ``length`` samples (None: one interval, single shooting).

    A length is rounded to the next multiple of the outputs' stride, if they were measured at every k-th sample; and a
    long one without a divisor that makes a good block to the next multiple of one.
    """
    stride, offset = _stride(grid)
    if length is None or length >= grid.samples:
        q = _LONGEST_BLOCK if grid.samples > 20 * _LONGEST_BLOCK else min(_BLOCK, grid.samples)
        q = math.ceil(q / stride) * stride
        b = math.ceil(grid.samples / q)
        return Intervals(1, b, q, np.arange(offset, q, stride))
    if length > stride:
        length = math.ceil(length / stride) * stride
    q = _block(length, stride)
    if q == 0:
        q = math.ceil(_BLOCK / stride) * stride
        length = math.ceil(length / q) * q
    if q % stride:
        stride, offset = 1, 0
    return Intervals(math.ceil(grid.samples / length), length // q, q, np.arange(offset, q, stride))


def _stride(grid: Grid) -> tuple[int, int]:
    """Step and offset of the grid points at which any output was measured."""
    if not grid.measured:
        return 1, 0
    there = np.zeros(grid.samples, dtype=bool)
    for measured in grid.measured.values():
        there[measured.position] = True
    points = np.flatnonzero(there)
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
    The rows are those of the propagator, K = R*ny*b.
    """

    def __init__(self, grid: Grid, intervals: Intervals, outputs: tuple[str, ...]) -> None:
        self.plan, self.outputs, self.samples = intervals, outputs, grid.measured
        rows, ny, b, m = len(intervals.samples), len(outputs), intervals.b, intervals.m
        self._rows = (rows, ny, b, m)
        self.shape = (rows * ny * b, m)
        numbers = {name: column for column, name in enumerate(outputs) if name in grid.measured}
        self.where = {name: self._flat(grid.measured[name].position, k) for name, k in numbers.items()}
        kinds = np.zeros(self.shape, np.int16)
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
            gone = points[self.samples[name].position]
            self.valid.ravel()[where[gone]] = False

    def _flat(self, position: NDArray[np.intp], column: int) -> NDArray[np.intp]:
        """Index of grid points in the propagator's layout (R, ny, b, M)."""
        plan = self.plan
        row_of = np.full(plan.q, -1)
        row_of[plan.samples] = np.arange(len(plan.samples))
        interval, inside = np.divmod(position, plan.length)
        block, sample = np.divmod(inside, plan.q)
        row = row_of[sample]
        return np.ravel_multi_index((row, np.broadcast_to(column, row.shape), block, interval), self._rows)

    def observe(self, y: Array) -> Array:
        """(..., R*ny, L, M) grid outputs of some blocks in this layout, (..., R*ny*L, M)."""
        return y.reshape(*y.shape[:-3], y.shape[-3] * y.shape[-2], y.shape[-1])

    def observe_starts(self, ys: Array) -> Array:
        """Sensitivities to the intervals' starts: (R*ny, L, [M,] n) to (K, n), or (K, M, n) where they differ."""
        return ys.reshape(-1, *ys.shape[2:])

    def adjoint(self, rho: Array) -> Array:
        """The transpose of ``observe``: (R*ny*L, M) of L blocks to (R*ny, L, M)."""
        rows = self._rows[0] * self._rows[1]
        return rho.reshape(rows, len(rho) // max(rows, 1), rho.shape[1])

    def part(self, values: Array, at: slice) -> Array:
        """The rows of (K, M) values that belong to some blocks, as ``observe`` lays them out."""
        return self.observe(self.adjoint(values)[:, at])

    def series(self, values: Array, name: str) -> Array:
        """(K, M) values at the valid samples of one output, in time order."""
        return values.ravel()[self.where[name]]
