"""The responses of discrete linear models at many frequencies from their modes, and what their transients do.

``estimation.spectral`` works for every matrix, and gives slopes; this gives values alone, at many points of the
parameters at once and several times as fast, where the eigenvectors are a good basis.
"""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class Basis:
    """What the likelihood needs of K bins: real and imaginary parts, one plane (..., K) after the other.

    z, share : (K,); drives : (m, 2, K) over what a transient's bin is multiplied with; direct : (m, 2 K);
    measured : (ny, 2 K)
    """

    bins: Bins
    z: Complex
    share: Array
    drives: Array
    direct: Array
    measured: Array

    @classmethod
    def of(cls, bins: Bins) -> Basis:
        return cls(
            bins,
            bins.z,
            bins.share,
            _planes(bins.drives * bins.z.conj() / bins.share),
            _planes(bins.drives).reshape(len(bins.drives), 2 * len(bins.z)),  # also without any drive
            _planes(bins.measured).reshape(len(bins.measured), 2 * len(bins.z)),
        )


class Transients:
    """Models at P points: their outputs at some bins, and what their transients do.

    turn : (P, n, n), the coordinates of the transients in the states; radius : (P,) of the largest pole, infinite
    where there is no model
    """

    def __init__(self, core: DiscreteCore, z: Array, sigma: Array) -> None:
        """z : (P, nz) of the core; sigma : (P, ny) that the outputs are divided by"""
        points, n = len(z), core.states
        self._core, self._z, self._sigma = core, z, sigma
        self.turn, self.radius = np.tile(np.eye(n), (points, 1, 1)), np.full(points, np.inf)
        parts = [core.matrices(own, 0) for own in z]
        a, b, c, d = (np.array([part[k][0] for part in parts]) for k in range(4))
        good = np.isfinite(a).all(axis=(1, 2)) & np.isfinite(b).all(axis=(1, 2))
        plain = good.copy()
        self._modes: list[tuple[NDArray[np.intp], _Modes]] = []
        if core.method == "exact" and good.any():
            c, d = c / sigma[:, :, None], d / sigma[:, :, None]
            scale = balance(a[good.argmax()] * core.step)
            scale = np.ones(n) if scale is None else scale
            rates, vectors = np.linalg.eig(a[good] * core.step * scale / scale[:, None])
            inverse, sound = _inverses(vectors)
            pairs = np.count_nonzero(rates.imag > 0, axis=1)
            plain[good] = ~sound
            for count in np.unique(pairs[sound]):
                own = sound & (pairs == count)
                at = np.flatnonzero(good)[own]
                matrices = b[at] * core.step, c[at], d[at]
                modes = _Modes(
                    (rates[own], vectors[own] * scale[:, None], inverse[own] / scale),
                    int(count),
                    matrices,
                    core.first,
                )
                self.turn[at] = modes.turn
                self.radius[at] = np.abs(modes.poles).max(axis=1, initial=0.0)
                self._modes.append((at, modes))
        self._plain = np.flatnonzero(plain)
        for k in self._plain:
            self.radius[k] = np.abs(np.linalg.eigvals(core.at(z[k], 0).f[0])).max(initial=0.0)

    def at(self, basis: Basis) -> tuple[Array, Array]:
        """What the transients do, (P, n, 2 ny K), and the residual without any, (P, 2 ny K)."""
        points, n, ny = *self.turn.shape[:2], len(basis.measured)
        rows, rest = np.zeros((points, n, ny, 2 * len(basis.z))), np.zeros((points, ny, 2 * len(basis.z)))
        for at, modes in self._modes:
            own = modes.rows(basis)
            rest[at] = modes.forced(basis, own) - basis.measured / self._sigma[at, :, None]
            if len(at) == points:
                rows = own
            else:
                rows[at] = own
        for k in self._plain:
            try:
                response = Response(self._core.at(self._z[k], 0), basis.bins, self._sigma[k])
            except (FloatingPointError, np.linalg.LinAlgError):
                self.radius[k] = np.inf
                continue
            seen = np.ascontiguousarray(response.seen).view(np.complex128).reshape(n, ny, -1)
            rows[k] = _planes(seen).reshape(n, ny, -1)
            rest[k] = _planes(response.forced(basis.bins)[0]).reshape(ny, -1)
        return rows.reshape(points, n, -1), rest.reshape(points, -1)


class _Modes:
    """P models with as many oscillating modes: real ones first, then one of each pair, whose real and imaginary part
    are coordinates.

    poles : (P, h); turn : (P, n, n)
    """

    def __init__(
        self,
        modes: tuple[Complex, Complex, Complex],
        pairs: int,
        matrices: tuple[Array, Array, Array],
        first: NDArray[np.bool_],
    ) -> None:
        """modes : eigenvalues (P, n) of the continuous model times the step, vectors, and their inverse; matrices : its
        B times the step, C and D, over the outputs' deviations; first : drives that are joined by lines"""
        rates, vectors, inverse = modes
        b, c, d = matrices
        n = rates.shape[1]
        self.real = real = n - 2 * pairs
        kind = np.where(rates.imag == 0, 0, np.where(rates.imag > 0, 1, 2))
        order = np.argsort(kind, axis=1, kind="stable")[:, : n - pairs]
        rates = np.take_along_axis(rates, order, 1).astype(complex)
        inverse = np.take_along_axis(inverse, order[:, :, None], 1).astype(complex)
        self.poles = np.exp(rates)
        seen = c @ np.take_along_axis(vectors, order[:, None], 2)
        phi1, phi2 = _phi(rates)
        push = inverse @ b
        ramp = push * phi2[:, :, None] * first
        held = push * phi1[:, :, None] - ramp
        # the drive at the end of a step acts by z / (z - pole) = 1 + pole / (z - pole)
        self.drive = self._coordinates(held + self.poles[:, :, None] * ramp).swapaxes(1, 2)
        direct = seen[:, :, :, None] * ramp[:, None]
        self.direct = direct[:, :, :real].real.sum(axis=2) + 2 * direct[:, :, real:].real.sum(axis=2) + d
        self.turn = self._coordinates(inverse)
        self.seen = seen.swapaxes(1, 2)[..., None]  # (P, h, ny, 1)

    def _coordinates(self, values: Complex) -> Array:
        """(P, n, ...) of the modes' values (P, h, ...)."""
        return np.concatenate([values.real, values[:, self.real :].imag], axis=1)

    def rows(self, basis: Basis) -> Array:
        """(P, n, ny, 2 K) what the transients do.

        On the unit circle a pair is (u z - w) / (z D) with D = (1 + |p|^2) cos - 2 Re p + i (1 - |p|^2) sin, in real
        numbers; a transient's bin is that times z.
        """
        real, pairs, count = self.real, self.poles.shape[1] - self.real, len(basis.z)
        found = np.empty((len(self.poles), real + 2 * pairs, self.seen.shape[2], 2, count))
        if real:
            own = basis.share * basis.z / (basis.z - self.poles[:, :real, None])
            found[:, :real] = self.seen[:, :real, :, None].real * _planes(own)[:, :, None]
        pole = self.poles[:, real:, None]
        square = np.square(pole.real) + np.square(pole.imag)
        cosine, sine = basis.z.real, basis.z.imag
        below = (1 + square) * cosine
        below -= 2 * pole.real
        beside = (square - 1) * sine
        size = np.square(below)
        size += np.square(beside)
        np.divide(basis.share, size, out=size)
        below *= size
        beside *= size
        ahead = below * cosine
        ahead -= beside * sine
        above = below * sine
        above += beside * cosine
        parts = ((ahead[:, :, None], below[:, :, None]), (above[:, :, None], beside[:, :, None]))
        own = self.seen[:, real:]
        turned = own * pole[..., None].conj()
        for plane, (one, other) in enumerate(parts):
            for at, u, w in ((real, own.real, turned.real), (real + pairs, -own.imag, -turned.imag)):
                part = found[:, at : at + pairs, :, plane]
                np.multiply(2 * u, one, out=part)
                part -= 2 * w * other
        return found.reshape(*found.shape[:3], -1)

    def forced(self, basis: Basis, rows: Array) -> Array:
        """(P, ny, 2 K) outputs without transients."""
        points, _, ny, both = rows.shape
        found = self.direct @ basis.direct
        for y in range(ny):
            gain = (self.drive @ rows[:, :, y]).reshape(points, -1, 2, both // 2)
            own = found[:, y].reshape(points, 2, -1)
            for plane, signs in enumerate(((1.0, -1.0), (1.0, 1.0))):
                for part, sign in enumerate(signs):
                    own[:, plane] += sign * np.einsum(
                        "pmk,mk->pk", gain[:, :, part], basis.drives[:, (plane + part) % 2]
                    )
        return found


def _planes(values: Complex) -> Array:
    """(..., 2, K) real and imaginary parts of (..., K)."""
    return np.stack([values.real, values.imag], axis=-2)


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
