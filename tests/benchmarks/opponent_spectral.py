"""The strongest `scipy.optimize.least_squares` opponent known to us for a linear chain: exact, in the frequency domain.

It uses what is special about the problem: a linear model, uniform and complete samples, output error.

* Over N samples x⁺ = F x + G u + H u⁺ reads (z − F) X = (G + z H) U + z t bin by bin of the DFT, exactly, with t the
  jump x_0 − x_N that stands for the free initial state (Pintelon and Schoukens, System Identification, chapter 6);
  Parseval makes the sum of squares over the bins that over the samples. A simulation is one product per bin.
* t enters linearly and is projected out (variable projection with Kaufman's Jacobian): only parameters are searched.
* The resolvent is evaluated in modal coordinates; the Jacobian is C (z − F)⁻¹ [dF X + dG U + dH z U], a few real
  matrix products; dF, dG, dH by complex steps through the exponential's series, all parameters together.
* The solver gets the triangular factor of [J r]: same cost, gradient and steps, but a few rows instead of N.
* A first solve on the bins below `COARSE_HZ`, above which there is noise alone, starts a second on every bin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from cases import Case, Record
from chain import Array
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

Spectrum = NDArray[np.complex128]

COARSE_HZ, COARSE_TOLERANCE, TOLERANCE = 2500.0, 1e-6, 1e-9
COMPLEX_STEP = 1e-30
MOST_EVALUATIONS = 1000


@dataclass(frozen=True)
class Bins:
    """A record on K bins, each weighted by the root of its share: inputs and their z-multiples (2 m, K), speed (K,)."""

    inputs: Spectrum
    speed: Spectrum
    z: Spectrum
    weight: Array

    def below(self, hertz: float, step: float) -> Bins:
        """The same record below a frequency."""
        keep = int(np.searchsorted(np.angle(self.z), 2 * np.pi * hertz * step))
        return Bins(
            self.inputs[:, :keep].copy(),
            self.speed[:keep].copy(),
            self.z[:keep].copy(),
            self.weight[:keep].copy(),
        )


def bins_of(record: Record, sigma: float) -> Bins:
    """Transform a record; the speed is divided by sigma through its weight."""
    count = record.samples
    drives, speed = rfft(record.drives), rfft(record.speed)
    z = np.exp(2j * np.pi * np.arange(speed.size) / count)
    weight = np.full(speed.size, np.sqrt(2 / count) / sigma)
    weight[0] = np.sqrt(1 / count) / sigma
    if count % 2 == 0:
        weight[-1] = weight[0]
    drives *= weight
    return Bins(np.vstack([drives, drives * z]), speed * weight, z, weight)


def derivatives_of_hold(case: Case, values: Array) -> tuple[Array, Array]:
    """[F G H] and its derivatives (free, states, states + 2 inputs) to the logarithms of the free values."""
    shape, step = case.shape, case.step
    n, m = shape.states, shape.inputs
    shifts = values * (1 + 1j * COMPLEX_STEP * np.eye(values.size))
    a, b = np.empty((values.size, n, n), complex), np.empty((values.size, n, m), complex)
    for i, shifted in enumerate(shifts):
        a[i], b[i] = shape.matrices(case.fixed + case.spreading @ shifted)
    # twists are 1e-4 of the speeds: balance them, or the series needs squaring
    scale = np.r_[np.ones(shape.size), np.full(n - shape.size, 1e-4)]
    x = a * (step * scale / scale[:, None])
    norm = float(np.abs(x[0]).sum(axis=1).max())
    order, remainder = 2, norm
    while remainder > 1e-17:
        order += 1
        remainder *= norm / order
    eye = np.eye(n)
    ramp = eye + x / (order + 2)
    for k in range(order, 1, -1):  # Horner's rule for the sum of 2 xᵏ/(k + 2)!
        ramp = eye + x @ ramp / (k + 1)
    ramp *= 0.5
    hold = eye + x @ ramp
    drive = b * (step / scale[:, None])
    late = ramp @ drive
    whole = np.concatenate([eye + x @ hold, hold @ drive - late, late], axis=2)
    whole *= scale[:, None]
    whole[:, :, :n] /= scale
    return whole[0].real, whole.imag / COMPLEX_STEP


@dataclass(frozen=True)
class Orthonormal:
    """Rows (n, K) that span the given ones; given coefficients = back @ coefficients of these."""

    rows: Array
    back: Array


def orthonormal(rows: Array) -> Orthonormal:
    """Orthonormal rows by Cholesky factors of the Gram matrix, twice, which is cheaper than Householder's way."""
    back = np.diag(1 / np.linalg.norm(rows, axis=1))
    rows = back @ rows
    try:
        for _ in range(2):
            turn = solve_triangular(np.linalg.cholesky(rows @ rows.T), np.eye(rows.shape[0]), lower=True)
            rows, back = turn @ rows, turn @ back
    except np.linalg.LinAlgError:
        factor, triangular = np.linalg.qr(rows.T)
        rows, back = factor.T.copy(), np.linalg.inv(triangular).T @ back
    return Orthonormal(rows, back.T)


def triangle(rows: Array) -> Array:
    """Triangular factor R (n, n) of rows.T = Q R."""
    size = np.linalg.norm(rows, axis=1)
    scaled = rows / size[:, None]
    try:
        return np.asarray(np.linalg.cholesky(scaled @ scaled.T).T * size)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.qr(rows.T, mode="r"))


class _Problem:
    """Compressed residual and Jacobian at one point, worked out once."""

    def __init__(self, case: Case, start: Array, records: list[Bins]) -> None:
        self.case, self.start, self.records = case, start, records
        self._at: Array | None = None

    def _record(self, bins: Bins, hold: Array, slopes: Array) -> Array:
        """Triangular factor of [J r], the transient projected out."""
        n = self.case.shape.states
        poles, shapes = np.linalg.eig(hold[:, :n])
        inverse = np.linalg.inv(shapes)
        resolvent = 1 / (bins.z - poles[:, None])
        rows = inverse.T @ (shapes[0][:, None] * resolvent)  # C (z − F)⁻¹, (n, K)
        drive = (hold[:, n:] @ bins.inputs.view(float)).view(complex)
        shifted = bins.z * bins.weight
        free = orthonormal((rows * shifted).view(float))
        columns = np.empty((slopes.shape[0] + 1, bins.z.size), complex)
        residual = columns[-1]
        np.einsum("nk,nk->k", rows, drive, out=residual)
        residual -= bins.speed
        jump = -free.back @ (free.rows @ residual.view(float))
        drive += jump[:, None] * shifted
        states = shapes @ (resolvent * (inverse @ drive))
        source = np.vstack([states, bins.inputs]).view(float)
        pushed = (slopes.reshape(-1, hold.shape[1]) @ source).view(complex).reshape(-1, n, bins.z.size)
        np.einsum("nk,pnk->pk", rows, pushed, out=columns[:-1])
        flat = columns.view(float)
        flat -= (flat @ free.rows.T) @ free.rows
        return triangle(flat)

    def _run(self, point: Array) -> None:
        if self._at is not None and np.array_equal(self._at, point):
            return
        self._at = point.copy()
        values = self.start * np.exp(point)
        hold, slopes = derivatives_of_hold(self.case, values)
        blocks = [self._record(bins, hold, slopes) for bins in self.records]
        if self.case.priors:
            jacobian = self.case.prior_jacobian() * values
            blocks.append(np.column_stack([jacobian, self.case.prior_residual(values)]))
        whole = np.linalg.qr(np.vstack(blocks), mode="r")
        self._jacobian, self._residual = whole[:, :-1], whole[:, -1]

    def residual(self, point: Array) -> Array:
        self._run(point)
        return self._residual

    def jacobian(self, point: Array) -> Array:
        self._run(point)
        return self._jacobian


Solve = Callable[[_Problem, Array, Array, Array, float], tuple[Array, int]]


def trust_region(
    problem: _Problem, point: Array, low: Array, high: Array, tolerance: float
) -> tuple[Array, int]:
    """`least_squares` from `point` within bounds, all on the logarithms; point and evaluations."""
    found = least_squares(
        problem.residual,
        point,
        jac=problem.jacobian,
        bounds=(low, high),
        x_scale="jac",
        method="trf",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        max_nfev=MOST_EVALUATIONS,
    )
    return found.x, int(found.nfev)


def fit(case: Case, start: Array, mark: Callable[[], None], solve: Solve = trust_region) -> dict[str, Any]:
    """Free values and evaluations; `mark` is called where the set-up ends and the solution begins."""
    records = [bins_of(record, case.sigma) for record in case.records]
    low, high = (np.log(bound / start) for bound in case.bounds)
    coarse = [bins.below(COARSE_HZ, case.step) for bins in records]
    mark()
    point, first = solve(_Problem(case, start, coarse), np.zeros(start.size), low, high, COARSE_TOLERANCE)
    point, second = solve(_Problem(case, start, records), point, low, high, TOLERANCE)
    return {"values": start * np.exp(point), "iterations": first + second}


def covariance(case: Case, values: Array) -> Array:
    """Covariance (free, free) of free `values` from the Jacobian there, initial states free, sigma known."""
    problem = _Problem(case, values, [bins_of(record, case.sigma) for record in case.records])
    jacobian = problem.jacobian(np.zeros(values.size)) / values
    return np.asarray(np.linalg.inv(jacobian.T @ jacobian))
