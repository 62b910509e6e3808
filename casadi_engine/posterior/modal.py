"""The responses of discrete linear models at many frequencies from their modes, and what their transients do.

``estimation.spectral`` works for every matrix, and gives slopes; this gives values alone, at many points of the
parameters at once and several times as fast, where the eigenvectors are a good basis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.spectral import Bins, Response
from casadi_engine.simulation.discretisation import DiscreteCore
from casadi_engine.simulation.exponential import balance

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Condition of the eigenvectors beyond which they are no basis to work with.
_SOUND = 1e7
# Below this size the functions of an eigenvalue are their series, of so many terms.
_SMALL, _TERMS = 0.5, 16


class Transients:
    """Models at P points and K bins: their residuals without transients, and what these do.

    rest : (P, ny, K, 2) real and imaginary parts; rows : (P, n, ny, K, 2) in a basis of their own; turn : (P, n, n)
    with turn.T @ rows the same in the states; radius : (P,) of the largest pole, infinite where there is no model
    """

    def __init__(self, core: DiscreteCore, z: Array, bins: Bins, sigma: Array) -> None:
        """z : (P, nz) of the core; sigma : (P, ny)"""
        points, n, ny, count = len(z), core.states, core.outputs, len(bins.z)
        self._rows = np.zeros((points, n, ny, count), complex)
        self._rest = np.zeros((points, ny, count), complex)
        self.turn, self.radius = np.tile(np.eye(n), (points, 1, 1)), np.full(points, np.inf)
        parts = [core.matrices(own, 0) for own in z]
        a, b, c, d = (np.array([part[k][0] for part in parts]) for k in range(4))
        good = np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2))
        plain = good.copy()
        if core.method == "exact" and good.any():
            c, d = c / sigma[:, :, None], d / sigma[:, :, None]
            scale = balance(a[good.argmax()] * core.step)
            scale = np.ones(n) if scale is None else scale
            rates, vectors = np.linalg.eig(a[good] * core.step * scale / scale[:, None])
            inverse, sound = _inverses(vectors)
            oscillate = np.count_nonzero(rates.imag > 0, axis=1)
            plain[good] = ~sound
            for pairs in np.unique(oscillate[sound]):
                own = sound & (oscillate == pairs)
                at = np.flatnonzero(good)[own]
                modes = _Modes(rates[own], vectors[own] * scale[:, None], inverse[own] / scale, int(pairs))
                self._fill(at, modes, core, (b[at], c[at], d[at]), bins, sigma)
        for at in np.flatnonzero(plain):
            self._plainly(int(at), core, z[at], bins, sigma[at])
        self._rows *= bins.z * bins.share
        self.rows = self._rows.view(np.float64).reshape(points, n, ny, count, 2)
        self.rest = self._rest.view(np.float64).reshape(points, ny, count, 2)

    def _fill(
        self,
        at: NDArray[np.intp],
        modes: _Modes,
        core: DiscreteCore,
        parts: tuple[Array, Array, Array],
        bins: Bins,
        sigma: Array,
    ) -> None:
        """The points ``at``, whose models have as many oscillating modes."""
        b, c, d = parts
        poles = np.exp(modes.rates)
        phi1, phi2 = _phi(modes.rates)
        push = (modes.inverse @ b) * core.step
        ramp = push * phi2[:, :, None] * core.first
        held = push * phi1[:, :, None] - ramp
        seen = c @ modes.vectors
        # the drive at the end of a step acts by z / (z - pole) = 1 + pole / (z - pole)
        drive = modes.coordinates(held + poles[:, :, None] * ramp)
        direct = modes.total(seen[:, :, :, None] * ramp[:, None]) + d
        rows = modes.rows(bins.z, poles, seen)
        for y in range(len(sigma[0])):
            own = np.ascontiguousarray(rows[:, :, y])
            gain = (drive.swapaxes(1, 2) @ own.view(np.float64)).view(np.complex128)
            gain += direct[:, y, :, None]
            gain *= bins.drives
            self._rest[at, y] = gain.sum(axis=1) - bins.measured[y] / sigma[at, y, None]
        self._rows[at], self.turn[at] = rows, modes.coordinates(modes.inverse)
        self.radius[at] = np.abs(poles).max(axis=1, initial=0.0)

    def _plainly(self, at: int, core: DiscreteCore, z: Array, bins: Bins, sigma: Array) -> None:
        try:
            discrete = core.at(z, 0)
            response = Response(discrete, bins, sigma)
        except (FloatingPointError, np.linalg.LinAlgError):
            return
        seen = response.seen.reshape(*self._rows.shape[1:], 2)
        self._rows[at] = np.ascontiguousarray(seen).view(np.complex128)[..., 0] / (bins.z * bins.share)
        self._rest[at] = response.forced(bins)[0]
        self.radius[at] = np.abs(np.linalg.eigvals(discrete.f[0])).max(initial=0.0)


class _Modes:
    """Modes of P models: real ones first, then one of each pair, its real and imaginary part as coordinates.

    rates : (P, h) eigenvalues of the continuous model times the step; vectors : (P, n, h); inverse : (P, h, n)
    """

    def __init__(self, rates: Complex, vectors: Complex, inverse: Complex, pairs: int) -> None:
        n = rates.shape[1]
        self.real = n - 2 * pairs
        # real ones, those that turn forwards, the others
        order = np.argsort(
            np.where(rates.imag == 0, 0, np.where(rates.imag > 0, 1, 2)), axis=1, kind="stable"
        )
        order = order[:, : n - pairs]
        self.rates = np.take_along_axis(rates, order, 1).astype(complex)
        self.vectors = np.take_along_axis(vectors, order[:, None], 2).astype(complex)
        self.inverse = np.take_along_axis(inverse, order[:, :, None], 1).astype(complex)

    def coordinates(self, values: Complex) -> Array:
        """(P, n, ...) real coordinates of the modes' values (P, h, ...)."""
        real = self.real
        return np.concatenate([values.real, values[:, real:].imag], axis=1)

    def total(self, values: Complex) -> Array:
        """(P, ny, m) sums of the modes' shares (P, ny, h, m), those of pairs twice."""
        real = self.real
        return np.asarray(values[:, :, :real].real.sum(axis=2) + 2 * values[:, :, real:].real.sum(axis=2))

    def rows(self, z: Complex, poles: Complex, seen: Complex) -> Complex:
        """(P, n, ny, K) responses of the outputs to the coordinates, seen (P, ny, h).

        On the unit circle a pair is (u - w / z) / ((1 + |p|^2) cos - 2 Re p + i (1 - |p|^2) sin), in real numbers.
        """
        real, pairs = self.real, poles.shape[1] - self.real
        found = np.empty((len(poles), real + 2 * pairs, seen.shape[1], len(z)), complex)
        own = seen.swapaxes(1, 2)[..., None]  # (P, h, ny, 1)
        if real:
            found[:, :real] = own[:, :real] / (z - poles[:, :real, None])[:, :, None]
        pole = poles[:, real:, None]
        square = np.square(pole.real) + np.square(pole.imag)
        below = (1 + square) * z.real - 2 * pole.real
        beside = (1 - square) * z.imag
        size = 1 / (np.square(below) + np.square(beside))
        first = np.empty((*below.shape[:2], len(z)), complex)
        first.real, first.imag = below * size, -beside * size
        second = np.empty_like(first)
        second.real = first.real * z.real + first.imag * z.imag
        second.imag = first.imag * z.real - first.real * z.imag
        first, second, turned = first[:, :, None], second[:, :, None], own[:, real:] * pole.conj()[..., None]
        found[:, real : real + pairs] = 2 * own[:, real:].real * first
        found[:, real : real + pairs] -= 2 * turned.real * second
        found[:, real + pairs :] = -2 * own[:, real:].imag * first
        found[:, real + pairs :] += 2 * turned.imag * second
        return found


def _inverses(vectors: Complex) -> tuple[Complex, NDArray[np.bool_]]:
    """Inverses of (P, n, n), and where they are to be trusted."""
    found = np.zeros_like(vectors)
    try:
        found[:] = np.linalg.inv(vectors)
    except np.linalg.LinAlgError:  # one of them is singular
        for k, own in enumerate(vectors):
            if np.linalg.matrix_rank(own) == len(own):
                found[k] = np.linalg.inv(own)
    size = np.linalg.norm(vectors, axis=(1, 2)) * np.linalg.norm(found, axis=(1, 2))
    return found, (size > 0) & (size < _SOUND)


def _phi(x: Complex) -> tuple[Complex, Complex]:
    """(exp(x) - 1) / x and (exp(x) - 1 - x) / x^2."""
    small = np.abs(x) < _SMALL
    near, far = np.where(small, x, 0.0), np.where(small, 1.0, x)
    series = np.zeros_like(near)
    for k in range(_TERMS, -1, -1):  # sum x^k / (k + 2)!, by 1 / ((k + 2) (k + 1) ...) from within
        series = (1.0 + near * series) / (k + 2)
    first = np.where(small, 1.0 + near * series, (np.exp(far) - 1) / far)
    return first, np.where(small, series, (first - 1) / far)
