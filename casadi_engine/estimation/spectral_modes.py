"""The response of a linear model at many frequencies by its modes, with first derivatives in the parameters.

With A h = V diag(rates) V^-1 the outputs are sums over the modes, C (z - F)^-1 (G0 + z G1) + D = sum_i c_i b_i / (z -
pole_i) + d, and so are their slopes: those of c_i, b_i and d, and (z - pole_i)^-2 times that of the pole (Lancaster
1964 has the slopes of eigenvectors). A parameter is then a row of coefficients of a few functions of frequency that
all parameters share, where ``spectral.Response`` multiplies matrices for each. Poles and pushes are functions of the
rates one by one, so that no exponential of a matrix with its slopes is needed.

Conjugate modes go together: their sum is a real combination of 1 / (z - pole) + 1 / (z - pole*) and i / (z - pole) -
i / (z - pole*). Coordinates of a transient are [real modes; real parts of pairs; imaginary parts of pairs].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.discretisation import DiscreteCore

if TYPE_CHECKING:
    from casadi_engine.estimation.spectral import Bins

Array = NDArray[np.float64]
Spectrum = NDArray[np.complex128]
Pair = tuple[Any, Any]

# Condition of the eigenvectors beyond which they are no basis, and the least distance of two poles: beyond these the
# digits of values or slopes go.
_SOUND, _APART = 1e6, 1e-8
# Coefficients 1 / (k + 3)! of the third function of a rate below 1, of which the others follow.
_SERIES = np.array([1 / math.factorial(k + 3) for k in range(17)], dtype=complex)
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
    def of(cls, core: DiscreteCore, z: Array) -> Modes | None:
        """The modes at z : (na,); None where they are no basis to work with.

        Raises FloatingPointError where the model has no finite value.
        """
        from scipy.linalg.lapack import dgebal

        a, b, outputs, d = core.finite(z, 1)
        a, b = a * core.step, b * core.step
        scale = dgebal(a[0], scale=1)[3]
        rates, vectors = np.linalg.eig(a[0] * scale / scale[:, None])
        apart = rates - rates[:, None]
        apart.flat[:: len(apart) + 1] = np.inf
        if not np.abs(apart).min(initial=np.inf) > _APART:
            return None
        back = np.linalg.inv(vectors)
        if not np.linalg.norm(back) * np.linalg.norm(vectors) < _SOUND:
            return None
        left, right = back / scale, vectors * scale[:, None]
        moved = left @ a[1:] @ right
        turn = moved / apart
        c = np.asarray(outputs @ right, dtype=np.complex128)
        c[1:] += c[0] @ turn
        drive = left @ b
        drive[1:] -= turn @ drive[0]
        faster = np.diagonal(moved, axis1=1, axis2=2)[..., None]
        poles, push, direct = _stepped(rates.astype(complex), core)
        jet = np.concatenate([poles[0][None], poles[1] * faster[..., 0]])
        pushed, late = (
            np.concatenate([f[0] * drive[:1], f[0] * drive[1:] + f[1] * drive[0] * faster])
            for f in (push, direct)
        )
        d[0] += (c[0] @ late[0]).real
        d[1:] += (c[1:] @ late[0] + c[0] @ late[1:]).real
        if c.shape[1] == 1 and (size := np.abs(c[0, 0])).min(initial=1.0) > _SEEN * size.max(initial=0.0):
            # of one output: modes as large as they are seen, and the slopes of c are none
            own = pushed * c[0, 0, :, None]
            own[1:] += pushed[0] * c[1:, 0, :, None]
            pushed = own
            c = np.concatenate([np.ones_like(c[:1]), np.zeros_like(c[1:])])
        keep = np.concatenate([np.flatnonzero(rates.imag == 0), np.flatnonzero(rates.imag > 0)])
        real = int(np.count_nonzero(rates.imag == 0))
        return cls(real, jet[:, keep], c[:, :, keep], pushed[:, keep], d)


def _stepped(rates: Spectrum, core: DiscreteCore) -> tuple[Pair, Pair, Pair]:
    """With derivatives in the rates: the poles (n,), and what a drive pushes modes by and has at once, (n, m).

    A drive that is joined by lines acts at the end of a step by z / (z - pole) = 1 + pole / (z - pole).
    """
    if core.method == "euler":
        shape = len(rates), core.drives
        return (1 + rates, np.ones_like(rates)), (np.ones(shape), np.zeros(shape)), (np.zeros(shape),) * 2
    near = np.where(np.abs(rates) < 1, rates, 0)
    third = np.vander(near, len(_SERIES), increasing=True) @ _SERIES
    second = 0.5 + near * third
    first = 1 + near * second
    if (far := rates != near).any():
        first[far] = (np.exp(rates[far]) - 1) / rates[far]
        second[far] = (first[far] - 1) / rates[far]
        third[far] = (second[far] - 0.5) / rates[far]
    poles = 1 + rates * first
    held, slope = first[:, None], (first - second)[:, None]
    push = np.where(core.first, held**2, held), np.where(core.first, 2 * held * slope, slope)
    direct = second[:, None] * core.first, (second - 2 * third)[:, None] * core.first
    return (poles, poles), push, direct


class Room:
    """Memory that one evaluation after another works in: to ask the system for it anew costs as much as the sums."""

    def __init__(self) -> None:
        self._held: dict[str, Spectrum] = {}

    def __call__(self, name: str, *shape: int) -> Spectrum:
        """An array of this shape, whose values are whatever was left in it."""
        size, held = math.prod(shape), self._held.get(name)
        if held is None or held.size < size:
            held = self._held[name] = np.empty(size, complex)
        return held[:size].reshape(shape)


class ModalResponse:
    """Modes at K bins, the outputs in units of their standard deviations.

    seen : (n, 2 ny K) what the transients do, real and imaginary parts side by side; it holds until the next response
    in the same room
    """

    def __init__(self, modes: Modes, bins: Bins, sigma: Array, room: Room) -> None:
        poles, r, m, count = modes.poles[0], modes.real, len(bins.drives), len(bins.z)
        self._modes, self._sigma, self._room = modes, sigma, room
        self._c, self._d = modes.c / sigma[:, None], modes.d / sigma[:, None]
        self._near, self._far = room("near", len(poles), count), room("far", len(poles) - r, count)
        for found, own in ((self._near, poles), (self._far, poles[r:].conj())):
            np.subtract(bins.z, own[:, None], out=found)
            np.divide(1.0, found, out=found)
        self._n = n = len(self._near) + len(self._far)
        # what residual and slopes are made of: drives and transients through the modes, slopes of poles, and drives
        self._parts = room("parts", n * (m + 2) + m, count)
        self._basis, self._late = room("basis", n, count), self._parts[n * m : n * (m + 1)]
        self._paired(self._near, self._far, self._basis)
        self._shifted = bins.z * bins.share
        np.multiply(self._basis, self._shifted, out=self._late)
        seen = room("seen", n, len(sigma), count)
        if len(sigma) == 1 and (modes.c[0] == 1).all():
            np.multiply(self._late, 1 / sigma[0], out=seen[:, 0])
        else:
            for y, c in enumerate(self._c[0]):
                self._turned(c, seen[:, y])
        self.seen = seen.view(np.float64).reshape(n, -1)

    def _paired(self, near: Spectrum, far: Spectrum, out: Spectrum) -> None:
        """Functions (n, K) whose real combinations are the sums over modes and their conjugates."""
        r, h = self._modes.real, len(near)
        out[:r] = near[:r]
        np.add(near[r:], far, out=out[r:h])
        np.subtract(near[r:], far, out=out[h:])
        out[h:] *= 1j

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
        n, m, parts = self._n, len(bins.drives), self._parts
        np.multiply(self._basis[:, None], bins.drives, out=parts[: n * m].reshape(n, m, len(bins.z)))
        parts[n * (m + 2) :] = bins.drives
        own = self._coefficients(self._c[0][..., None] * self._modes.b[0]).reshape(len(self._sigma), n * m)
        left = own @ parts[: n * m].view(np.float64) + self._d[0] @ bins.drives.view(np.float64)
        left -= bins.measured.view(np.float64) / self._sigma[:, None]
        return left.ravel(), parts

    def columns(
        self, bins: Bins, made: tuple[Array, Spectrum], jump: Array, active: NDArray[np.intp]
    ) -> Array:
        """Residual without transients and slopes (1 + na, 2 ny K) at the transient ``jump`` (n,); active : entries that
        the drives depend on."""
        (left, parts), modes, c, b, d = made, self._modes, self._c, self._modes.b, self._d
        n, m, r, ny = self._n, len(bins.drives), modes.real, len(c[0])
        found = self._room("found", len(c), ny, len(bins.z)).view(np.float64).reshape(len(c), -1)
        found[0] = left
        if len(c) == 1:
            return found
        start = jump[: modes.poles.shape[1]] + 1j * np.concatenate(
            [np.zeros(r), jump[modes.poles.shape[1] :]]
        )
        self._paired(*self._squared(bins, start), parts[n * (m + 1) : n * (m + 2)])
        forced = self._coefficients(c[1:, :, :, None] * b[0] + c[0][..., None] * b[1:, None])
        late = self._coefficients((c[1:] * start)[..., None])
        moved = self._coefficients((c[0] * modes.poles[1:, None])[..., None])
        lead = forced.shape[:2]
        rows = np.concatenate(
            [own.reshape(*lead, math.prod(own.shape[2:])) for own in (forced, late, moved, d[1:])], axis=2
        )
        slopes = found[1:].reshape(lead[0] * ny, -1)
        np.matmul(rows.reshape(len(slopes), len(parts)), parts.view(np.float64), out=slopes)
        for entry, slope in zip(active, bins.slopes, strict=True):
            gain = self._coefficients(c[0][..., None] * b[0]).swapaxes(1, 2) @ self._basis + d[0][..., None]
            found[1 + entry] += (gain * slope).sum(axis=1).view(np.float64).ravel()
        return found

    def _squared(self, bins: Bins, start: Spectrum) -> tuple[Spectrum, Spectrum]:
        """What drives and the transients ``start`` (h,) do through the squares of the modes and of the conjugates."""
        b, r, shape = self._modes.b[0], self._modes.real, self._near.shape
        near, far, turned = (
            self._room("one", *shape),
            self._room("other", *shape),
            self._room("turned", *shape),
        )
        drives = bins.drives.view(np.float64)
        np.matmul(b.real, drives, out=far.view(np.float64))
        np.matmul(b.imag, drives, out=turned.view(np.float64))
        turned *= 1j
        np.add(far, turned, out=near)
        far -= turned
        near += np.multiply(start[:, None], self._shifted, out=turned)
        far += np.multiply(start[:, None].conj(), self._shifted, out=turned)
        far = far[r:]
        for found, own in ((near, self._near), (far, self._far)):
            found *= own
            found *= own
        return near, far
