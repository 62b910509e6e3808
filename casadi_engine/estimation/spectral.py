"""Records of linear models in the frequency domain: exact, the initial states projected out.

Over N samples x+ = F x + G0 v + G1 v+, y = C x + D v reads, at the odd half bins z = exp(i pi (2k+1)/N) of the
discrete Fourier transform,

    (z - F) X = (G0 + z G1) V + z t,    Y = C X + D V,    t = x_0 + x_N,

with t free where the initial state is (Pintelon & Schoukens 2012, chapter 6), and the summed squares of all bins are
those of all samples (Parseval). At half bins z = 1 is no bin, and an integrator no singularity. t enters linearly:
it is at its best for every value of the parameters, and only these are searched (variable projection; Golub & Pereyra
1973, the Jacobian without the slopes of the projection that do not act to first order, Kaufman 1975).

A transformed record holds as many numbers as before, but the parameters act in few of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import zgees

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.simulation.discretisation import Discretisation
from casadi_engine.simulation.exponential import balance
from casadi_engine.simulation.linear import LinearPropagator

Array = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

# A combination of the columns of t that shows in the outputs by less than this share of them is held at zero.
_SPRING = 1e-9
# A Cholesky factor with a smaller entry on its diagonal has lost half the digits.
_DIGITS = 1e-6
# In the frequency domain a state that grows is one that decays backwards: points at which one grows more over the
# record than a simulation from its start can follow are refused.
_GROWTH = 1e8
# Bins of a band for each parameter and state, at least.
_FEWEST = 4
# Bins that are worked on at a time in a record of more than LONG of them.
LONG, _PART = 50_000, 8192


@dataclass(frozen=True)
class Bins:
    """A record at K half bins, each times the root of its share in the sum of squares.

    samples : N of the record; z, share : (K,); measured : (ny, K)
    drives : (m, K); slopes : (a, m, K) their first derivatives in the entries of the parameters that they depend on
    """

    samples: int
    z: Spectrum
    share: Array
    drives: Spectrum
    slopes: Spectrum
    measured: Spectrum

    def part(self, bins: slice) -> Bins:
        """Some of the bins, contiguous in memory."""
        return Bins(
            self.samples,
            self.z[bins].copy(),
            self.share[bins].copy(),
            np.ascontiguousarray(self.drives[:, bins]),
            np.ascontiguousarray(self.slopes[..., bins]),
            np.ascontiguousarray(self.measured[:, bins]),
        )


def half_bins(series: Array) -> Spectrum:
    """The transform (..., K) of (..., N) samples at the odd half bins up to half the sampling rate, K = ceil(N/2).

    One series after the other: a transform takes several times the memory of its series.
    """
    count = series.shape[-1]
    turn = np.exp(-1j * np.pi / count * np.arange(count))
    found = np.empty((*series.shape[:-1], (count + 1) // 2), complex)
    for index in np.ndindex(series.shape[:-1]):
        found[index] = np.fft.fft(series[index] * turn)[: found.shape[-1]]
    return found


class SpectralRecord:
    """One record in the frequency domain.

    record : whose propagator is a LinearPropagator without gain, on equal steps, every output measured at every one
    size : number of bins; ``sigma`` (ny,) standard deviations that the outputs are divided by
    """

    def __init__(self, record: RecordTerm) -> None:
        self.record, self._propagator = record, cast(LinearPropagator, record.propagator)
        count = record.grid.samples
        turn = np.pi * (2 * np.arange((count + 1) // 2) + 1) / count
        self.size, self.hertz = len(turn), turn / (2 * np.pi * record.grid.step)
        share = np.full(self.size, np.sqrt(2 / count))
        if count % 2:
            share[-1] = np.sqrt(1 / count)  # the bin at z = -1 is its own conjugate
        self._share = share
        measured = np.array([record.grid.measured[name].values for name in record.outputs])
        self._measured = half_bins(measured) * share
        self._z = np.exp(1j * turn)
        self._drives: tuple[Array, Spectrum, Spectrum] | None = None
        self._kept: dict[tuple[int, int], Bins] = {}
        self.sigma = np.ones(len(measured))

    def below(self, hertz: float) -> slice:
        """The bins below a frequency; no fewer than a band needs in which parameters and states are to be seen."""
        fewest = _FEWEST * (self.record.n + len(self.record.active))
        return slice(0, min(max(int(np.searchsorted(self.hertz, hertz)), fewest), self.size))

    def bins(self, z: Array, part: slice, last: int | None = None) -> Bins:
        """The bins in ``part`` at the record's own parameters z (na,); last : of parts that follow one another, of
        which none is kept."""
        samples = self._propagator.merged_drives(z)
        if self._drives is None or self._drives[0] is not samples.value:
            drives = half_bins(samples.value) * self._share
            slopes = half_bins(samples.first) * self._share
            self._drives, self._kept = (samples.value, drives, slopes), {}
        _, drives, slopes = self._drives
        whole = Bins(self.record.grid.samples, self._z, self._share, drives, slopes, self._measured)
        if last is not None:
            return whole.part(part)
        key = (part.start, part.stop)
        if key not in self._kept:
            self._kept = {
                key: whole.part(part)
            }  # one part at a time: a record's bins are as large as its samples
        return self._kept[key]

    def gram(self, v: Array, stops: list[int]) -> Array:
        """Products (e, 1 + na, 1 + na) of residual and Jacobian in the bins before each of the rising ``stops``, the
        transients projected out; part by part of the bins, as those of a long record take much memory."""
        z = v[self.record.active]
        discrete, active = self._propagator.discretisation(z, 1), self._propagator.merged_drives(z).active
        last = stops[-1]
        cuts = sorted({*range(0, last, _PART), *stops})
        parts = [slice(begin, end) for begin, end in pairwise(cuts)]
        n = discrete.f.shape[1]
        span, seen = np.zeros((n, n)), np.zeros(n)
        for part in parts:
            piece = _Piece(discrete, self.bins(z, part, last), self.sigma)
            left = _real(piece.residual().reshape(-1))
            span += piece.free @ piece.free.T
            seen += piece.free @ left
        jump = -np.linalg.lstsq(span, seen, rcond=_SPRING)[0]
        total, found = 0.0, []
        for part in parts:
            piece = _Piece(discrete, self.bins(z, part, last), self.sigma)
            rows = np.concatenate([piece.free, piece.columns(jump, active)])
            total = total + rows @ rows.T
            if part.stop in stops:
                found.append(_without(total, n))
        return np.array(found)

    def columns(self, v: Array, part: slice, order: int = 1) -> tuple[Array, Array]:
        """Residual and Jacobian (1 + na, 2 ny K) in the active entries of v, the transients projected out; and
        orthonormal rows (r, 2 ny K) that span these."""
        z = v[self.record.active]
        discrete = self._propagator.discretisation(z, order)
        active = self._propagator.merged_drives(z).active
        piece = _Piece(discrete, self.bins(z, part), self.sigma)
        free = Orthonormal.of(piece.free)
        flat = piece.columns(free.best(_real(piece.residual().reshape(-1))), active)
        flat -= (flat @ free.rows.T) @ free.rows
        return flat, free.rows


def _without(gram: Array, n: int) -> Array:
    """Products of the rows behind the first n, these projected out."""
    size = np.sqrt(np.maximum(np.diag(gram)[:n], 1e-300))
    values, vectors = np.linalg.eigh(gram[:n, :n] / np.outer(size, size))
    told = values > _SPRING
    cross = (vectors[:, told] / np.sqrt(values[told])).T @ (gram[:n, n:] / size[:, None])
    return np.asarray(gram[n:, n:] - cross.T @ cross)


class _Piece:
    """The equations of some bins at one point; free : (n, 2 ny K) what the transients do."""

    def __init__(self, discrete: Discretisation, bins: Bins, sigma: Array) -> None:
        n, m, count = discrete.f.shape[1], len(bins.drives), len(bins.z)
        self._discrete, self._bins, self._sigma = discrete, bins, sigma
        self._c, self._d = discrete.c / sigma[:, None], discrete.d / sigma[:, None]
        self._hold = np.concatenate([discrete.f, discrete.g0, discrete.g1], axis=2)
        self._resolvent = Resolvent(discrete.f[0], bins.z)
        if bins.samples * np.log(max(self._resolvent.radius, 1e-300)) > np.log(_GROWTH):
            raise FloatingPointError("the states grow beyond what their start decides")
        self._rows = self._resolvent.rows(self._c[0])
        self._source = np.empty((n + 2 * m, count), complex)
        self._source[n : n + m] = bins.drives
        np.multiply(bins.drives, bins.z, out=self._source[n + m :])
        self._drive = _times(self._hold[0, :, n:], self._source[n:])
        self._shifted = bins.z * bins.share
        self.free = _real((self._rows * self._shifted).swapaxes(0, 1).reshape(n, -1))

    def residual(self) -> Spectrum:
        """(ny, K) without transients."""
        bins = self._bins
        found = np.einsum("ynk,nk->yk", self._rows, self._drive) + _times(self._d[0], bins.drives)
        return np.asarray(found - bins.measured / self._sigma[:, None])

    def columns(self, jump: Array, active: NDArray[np.intp]) -> Array:
        """Residual and Jacobian (1 + na, 2 ny K), real and imaginary parts side by side; the Jacobian at the transient
        ``jump`` (n,), the residual without it."""
        bins, discrete, c, d = self._bins, self._discrete, self._c, self._d
        n, count = discrete.f.shape[1], len(bins.z)
        found = np.empty((len(discrete.f), *bins.measured.shape), complex)
        found[0] = self.residual()
        source, rows = self._source, self._rows
        source[:n] = self._resolvent.states(self._drive + jump[:, None] * self._shifted)
        if len(found) > 1:
            pushed = _times(self._hold[1:].reshape(-1, self._hold.shape[2]), source).reshape(-1, n, count)
            np.einsum("ynk,pnk->pyk", rows, pushed, out=found[1:])
        if c[1:].any():
            found[1:] += _times(c[1:].reshape(-1, n), source[:n]).reshape(found[1:].shape)
        if d[1:].any():
            found[1:] += _times(d[1:].reshape(-1, d.shape[2]), bins.drives).reshape(found[1:].shape)
        for entry, slope in zip(active if len(found) > 1 else (), bins.slopes, strict=False):
            forced = _times(discrete.g0[0], slope) + _times(discrete.g1[0], slope * bins.z)
            found[1 + entry] += np.einsum("ynk,nk->yk", rows, forced) + _times(d[0], slope)
        return _real(found.reshape(len(found), -1))


def _real(values: Spectrum) -> Array:
    """Real and imaginary parts side by side, of the same memory."""
    return np.ascontiguousarray(values).view(np.float64)


def _times(matrix: Array, spectra: Spectrum) -> Spectrum:
    """A real matrix times spectra (n, K): half the work of a complex one."""
    return np.asarray((matrix @ _real(spectra)).view(np.complex128))


class Resolvent:
    """(z - F)^-1 at many z (K,), by the complex Schur form of the balanced F (n, n).

    Unlike eigenvectors it exists to the last digit for every matrix: two integrators in a row have but one eigenvector.
    """

    def __init__(self, f: Array, z: Spectrum) -> None:
        turn = balance(f)
        self._turn = np.ones(len(f)) if turn is None else turn
        balanced = f * self._turn / self._turn[:, None]
        self._t, _, poles, self._u, _, info = zgees(lambda _: None, balanced)
        if info:
            raise np.linalg.LinAlgError("the Schur form does not converge")
        self._near = 1.0 / (z - poles[:, None])
        self.radius = float(np.abs(poles).max(initial=0.0))

    def rows(self, c: Array) -> Spectrum:
        """C (z - F)^-1, (ny, n, K), for C (ny, n)."""
        left, near = (c * self._turn) @ self._u, self._near
        found = np.empty((len(near), len(c), near.shape[1]), complex)
        for j in range(len(near)):
            found[j] = left[:, j, None]
            if j:
                found[j] += (self._t[:j, j] @ found[:j].reshape(j, -1)).reshape(found[j].shape)
            found[j] *= near[j]
        back = self._u.conj() / self._turn[:, None]
        return np.asarray((back @ found.reshape(len(near), -1)).reshape(found.shape).swapaxes(0, 1))

    def states(self, drive: Spectrum) -> Spectrum:
        """(z - F)^-1 times the drive (n, K)."""
        found = (self._u.conj().T / self._turn) @ drive
        for j in range(len(found) - 1, -1, -1):
            found[j] += self._t[j, j + 1 :] @ found[j + 1 :]
            found[j] *= self._near[j]
        return np.asarray((self._u * self._turn[:, None]) @ found)


@dataclass(frozen=True)
class Orthonormal:
    """Rows (r, L) that span given ones (n, L); ``back`` (n, r) makes coefficients of these of those of the rows."""

    rows: Array
    back: Array

    @classmethod
    def of(cls, given: Array) -> Orthonormal:
        """By Cholesky factors of the Gram matrix, twice; by Householder reflections where they lose digits."""
        size = np.linalg.norm(given, axis=1)
        known = np.flatnonzero(size > 0)
        back = np.zeros((len(given), len(known)))
        back[known, np.arange(len(known))] = 1 / size[known]
        rows = back.T @ given
        try:
            for _ in range(2):
                factor = np.linalg.cholesky(rows @ rows.T)
                if factor.diagonal().min(initial=1.0) < _DIGITS:
                    raise np.linalg.LinAlgError
                turn = np.linalg.inv(factor)
                rows, back = turn @ rows, back @ turn.T
        except np.linalg.LinAlgError:
            return cls._by_reflections(given, size, known)
        return cls(rows, back)

    @classmethod
    def _by_reflections(cls, given: Array, size: Array, known: NDArray[np.intp]) -> Orthonormal:
        """With a weak spring on every row, for those that are almost combinations of the others."""
        scaled = given[known] / size[known, None]
        q, r = np.linalg.qr(np.vstack([scaled.T, _SPRING * np.eye(len(known))]))
        back = np.zeros((len(given), len(known)))
        back[known] = np.linalg.inv(r) / size[known, None]
        return cls(np.ascontiguousarray(q[: given.shape[1]].T), back)

    def best(self, target: Array) -> Array:
        """Coefficients (n,) of the given rows that make the target (L,) least when added to it."""
        return -self.back @ (self.rows @ target)
