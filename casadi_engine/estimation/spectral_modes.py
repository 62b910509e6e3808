"""The response of a linear model at many frequencies by its modes, with first derivatives in the parameters.

With F = V diag(poles) V^-1 the outputs are sums over the modes, C (z - F)^-1 (G0 + z G1) + D = sum_i c_i b_i / (z -
pole_i) + d, and so are their slopes: those of c_i, b_i and d, and (z - pole_i)^-2 times that of the pole (Lancaster
1964 has the slopes of eigenvectors). A parameter is then a row of coefficients of a few functions of frequency that
all parameters share, where ``spectral.Response`` multiplies matrices for each.

Conjugate modes go together: their sum is a real combination of 1 / (z - pole) + 1 / (z - pole*) and i / (z - pole) -
i / (z - pole*). Coordinates of a transient are [real modes; real parts of pairs; imaginary parts of pairs].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.discretisation import Discretisation
from casadi_engine.simulation.exponential import balance

if TYPE_CHECKING:
    from casadi_engine.estimation.spectral import Bins

Array = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

# Condition of the eigenvectors beyond which they are no basis, and the least distance of two poles: beyond these the
# digits of values or slopes go.
_SOUND, _APART = 1e6, 1e-8
# A mode that one output sees by less than this share of another one is not scaled by what is seen of it.
_SEEN = 1e-6


@dataclass(frozen=True)
class Modes:
    """Jets (1 + na, ...) of a model's real modes and of one of each pair: poles (h,), c (ny, h), b (h, m); and of the
    part of the response that is the same at all frequencies, d (ny, m).

    real : number of real modes, which come first
    """

    real: int
    poles: Spectrum
    c: Spectrum
    b: Spectrum
    d: Array

    @classmethod
    def of(cls, discrete: Discretisation) -> Modes | None:
        """None where the modes are no basis to work with."""
        f, n = discrete.f, discrete.f.shape[1]
        found = balance(f[0])
        scale = np.ones(n) if found is None else found
        poles, vectors = np.linalg.eig(f[0] * scale / scale[:, None])
        apart = poles - poles[:, None]
        np.fill_diagonal(apart, np.inf)
        if not np.abs(apart).min(initial=np.inf) > _APART:
            return None
        back = np.linalg.inv(vectors)
        if not np.linalg.norm(back) * np.linalg.norm(vectors) < _SOUND:
            return None
        left, right = back / scale, vectors * scale[:, None]
        moved = left @ f[1:] @ right
        turn = moved / apart
        c = np.asarray(discrete.c @ right, dtype=np.complex128)
        b0, b1 = left @ discrete.g0, left @ discrete.g1
        c[1:] += c[0] @ turn
        b0[1:] -= turn @ b0[0]
        b1[1:] -= turn @ b1[0]
        jet = np.concatenate([poles[None], np.diagonal(moved, axis1=1, axis2=2)])
        b = b0 + jet[0][:, None] * b1
        b[1:] += jet[1:, :, None] * b1[0]
        d = discrete.d + discrete.c[0] @ discrete.g1
        d[1:] += discrete.c[1:] @ discrete.g1[0]
        if c.shape[1] == 1 and (size := np.abs(c[0, 0])).min(initial=1.0) > _SEEN * size.max(initial=0.0):
            # of one output: modes as large as they are seen, and the slopes of c are none
            b = np.concatenate(
                [b[:1] * c[0, 0, :, None], b[1:] * c[0, 0, :, None] + b[0] * c[1:, 0, :, None]]
            )
            c = np.concatenate([np.ones_like(c[:1]), np.zeros_like(c[1:])])
        keep = np.concatenate([np.flatnonzero(poles.imag == 0), np.flatnonzero(poles.imag > 0)])
        real = int(np.count_nonzero(poles.imag == 0))
        return cls(real, jet[:, keep], c[:, :, keep], b[:, keep], d)


class ModalResponse:
    """Modes at K bins, the outputs in units of their standard deviations.

    seen : (n, 2 ny K) what the transients do, real and imaginary parts side by side
    """

    def __init__(self, modes: Modes, bins: Bins, sigma: Array) -> None:
        poles, r = modes.poles[0], modes.real
        self._modes, self._sigma = modes, sigma
        self._c, self._d = modes.c / sigma[:, None], modes.d / sigma[:, None]
        self._near = 1.0 / (bins.z - poles[:, None])
        self._far = 1.0 / (bins.z - poles[r:, None].conj())
        self._basis = self._paired(self._near, self._far)
        self._shifted = bins.z * bins.share
        self._late = self._basis * self._shifted
        if len(sigma) == 1 and (modes.c[0] == 1).all():
            seen = self._late / sigma[0]
        else:
            seen = np.empty((len(self._basis), len(sigma), len(bins.z)), complex)
            for y, c in enumerate(self._c[0]):
                self._turned(c, seen[:, y])
        self.seen = seen.view(np.float64).reshape(len(seen), -1)

    def _paired(self, near: Spectrum, far: Spectrum) -> Spectrum:
        """Functions (n, K) whose real combinations are the sums over modes and their conjugates."""
        r, h = self._modes.real, len(near)
        found = np.empty((h + len(far), near.shape[1]), complex)
        found[:r] = near[:r]
        np.add(near[r:], far, out=found[r:h])
        np.subtract(near[r:], far, out=found[h:])
        found[h:] *= 1j
        return found

    def _turned(self, c: Spectrum, out: Spectrum) -> None:
        """What unit transients in every coordinate do to an output that sees the modes by c (h,)."""
        r, h, late = self._modes.real, len(c), self._late
        np.multiply(c[:r, None].real, late[:r], out=out[:r])
        re, im = c[r:, None].real, c[r:, None].imag
        np.multiply(re, late[r:h], out=out[r:h])
        out[r:h] += im * late[h:]
        np.multiply(re, late[h:], out=out[h:])
        out[h:] -= im * late[r:h]

    def _coefficients(self, sums: Spectrum) -> Array:
        """Real coefficients (..., n, m) of sums over modes (..., h, m)."""
        return np.concatenate([sums.real, sums[..., self._modes.real :, :].imag], axis=-2)

    def residual(self, bins: Bins) -> tuple[Array, Spectrum]:
        """Residual (2 ny K,) without transients, and the functions that it and the slopes are made of."""
        n, m, count = len(self._basis), len(bins.drives), len(bins.z)
        parts = np.empty((n * (m + 2) + m, count), complex)
        np.multiply(self._basis[:, None], bins.drives, out=parts[: n * m].reshape(n, m, count))
        parts[n * m : n * (m + 1)] = self._late
        parts[n * (m + 2) :] = bins.drives
        own = self._coefficients(self._c[0][..., None] * self._modes.b[0]).reshape(len(self._sigma), n * m)
        left = own @ parts[: n * m].view(np.float64) + self._d[0] @ bins.drives.view(np.float64)
        left -= bins.measured.view(np.float64) / self._sigma[:, None]
        return left.ravel(), parts

    def slopes(self, bins: Bins, parts: Spectrum, jump: Array, active: NDArray[np.intp]) -> Array:
        """Slopes (na, 2 ny K) at the transient ``jump`` (n,); active : entries that the drives depend on."""
        modes, c, b, d = self._modes, self._c, self._modes.b, self._d
        if len(c) == 1:
            return np.zeros((0, 2 * bins.measured.size))
        n, m, h, r = len(self._basis), len(bins.drives), modes.poles.shape[1], modes.real
        start = jump[:h] + 1j * np.concatenate([np.zeros(r), jump[h:]])
        drives = bins.drives.view(np.float64)
        re, im = (part @ drives for part in (b[0].real, b[0].imag))
        push, pull = re.view(np.complex128), 1j * im.view(np.complex128)
        near = push + pull + start[:, None] * self._shifted
        far = (push - pull)[r:] + start[r:, None].conj() * self._shifted
        near *= self._near
        near *= self._near
        far *= self._far
        far *= self._far
        parts[n * (m + 1) : n * (m + 2)] = self._paired(near, far)
        forced = self._coefficients(c[1:, :, :, None] * b[0] + c[0][..., None] * b[1:, None])
        late = self._coefficients((c[1:] * start)[..., None])
        moved = self._coefficients((c[0] * modes.poles[1:, None])[..., None])
        lead = forced.shape[:2]
        rows = np.concatenate(
            [own.reshape(*lead, math.prod(own.shape[2:])) for own in (forced, late, moved, d[1:])], axis=2
        )
        found = rows.reshape(-1, len(parts)) @ parts.view(np.float64)
        found = found.reshape(lead[0], -1)
        for entry, slope in zip(active, bins.slopes, strict=True):
            gain = self._coefficients(c[0][..., None] * b[0]).swapaxes(1, 2) @ self._basis + d[0][..., None]
            found[entry] += (gain * slope).sum(axis=1).view(np.float64).ravel()
        return found
