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
from functools import cached_property
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.resolvent import Orthonormal, Resolvent
from casadi_engine.estimation.spectral_modes import ModalResponse, Modes, Room
from casadi_engine.simulation.discretisation import Discretisation
from casadi_engine.simulation.linear import LinearPropagator

Array = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

# A Cholesky factor with no smaller entry than this on its diagonal has lost few digits. Otherwise combinations of the
# columns of t are held at zero that show in the outputs by less than the root of this share of them.
_PLAIN, _WEAK = 1e-2, 1e-12
# In the frequency domain a state that grows is one that decays backwards: points at which one grows more over the
# record than a simulation from its start can follow are refused.
_GROWTH = 1e8
# Bins of a band for each parameter and state, at least.
_FEWEST = 4
# What records at one point have in common: modes by the identity of their core.
Common = dict[int, Modes | None]
# Bins that are worked on at a time in a record of more than LONG of them.
LONG, _PART = 50_000, 4096


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


def half_bins(series: Array) -> Spectrum:
    """The transform (..., K) of (..., N) samples at the odd half bins up to half the sampling rate, K = ceil(N/2).

    One series after the other, as a transform takes several times the memory of its series. Of an even number of
    samples both halves go together as real and imaginary part into a transform of half the length: its first bins are
    every second one, and its last ones, from behind, the conjugates of the others.
    """
    count = series.shape[-1]
    half = (count + 1) // 2
    even = count % 2 == 0
    turn = np.exp(-1j * np.pi / count * np.arange(half if even else count))
    found = np.empty((*series.shape[:-1], half), complex)
    for index in np.ndindex(series.shape[:-1]):
        own = series[index]
        if even:
            both = np.fft.fft((own[:half] - 1j * own[half:]) * turn)
            found[index][0::2] = both[: (half + 1) // 2]
            found[index][1::2] = both[::-1][: half // 2].conj()
        else:
            found[index] = np.fft.fft(own * turn)[:half]
    return found


class SpectralRecord:
    """One record in the frequency domain.

    record : whose propagator is a LinearPropagator without gain, on equal steps, every output measured at every one
    room : shared with records that are evaluated after one another
    size : number of bins; ``sigma`` (ny,) standard deviations that the outputs are divided by
    """

    def __init__(self, record: RecordTerm, room: Room | None = None) -> None:
        self.record, self._propagator = record, cast(LinearPropagator, record.propagator)
        count = record.grid.samples
        self.size = (count + 1) // 2
        self.hertz = self._turn(slice(0, self.size)) / (2 * np.pi * record.grid.step)
        measured = np.array([record.grid.measured[name].values for name in record.outputs])
        self._measured = half_bins(measured)
        self._measured *= self._share(slice(0, self.size))
        self._drives: tuple[Array, Spectrum, Spectrum] | None = None
        self._kept: dict[int, Bins] = {}
        self._room = Room() if room is None else room
        self.sigma = np.ones(len(measured))

    def _turn(self, part: slice) -> Array:
        """The angles (K,) of some bins."""
        return np.asarray(np.pi * (2 * np.arange(part.start, part.stop) + 1) / self.record.grid.samples)

    def _share(self, part: slice) -> Array:
        """The roots of some bins' shares in the sum of squares."""
        count = self.record.grid.samples
        share = np.full(part.stop - part.start, np.sqrt(2 / count))
        if count % 2 and part.stop == self.size:
            share[-1] = np.sqrt(1 / count)  # the bin at z = -1 is its own conjugate
        return share

    def below(self, hertz: float) -> slice:
        """The bins below a frequency; no fewer than a band needs in which parameters and states are to be seen."""
        fewest = _FEWEST * (self.record.n + len(self.record.active))
        return slice(0, min(max(int(np.searchsorted(self.hertz, hertz)), fewest), self.size))

    def release(self) -> None:
        """Give back the memory of a long record's spectra; they are made again when they are asked for."""
        if self.size > LONG:
            self._drives, self._kept = None, {}

    def bins(self, z: Array, part: slice, *, keep: bool = True) -> Bins:
        """The bins in ``part`` at the record's own parameters z (na,); kept for the next time unless told not to."""
        if self._drives is None or len(self._propagator.drives_active):
            samples = self._propagator.merged_drives(z)
            if self._drives is None or self._drives[0] is not samples.value:
                drives, slopes = half_bins(samples.value), half_bins(samples.first)
                share = self._share(slice(0, self.size))
                drives *= share
                slopes *= share
                self._drives, self._kept = (samples.value, drives, slopes), {}
            if not len(samples.active):  # made once: the samples themselves are not needed any more
                self._drives = (samples.value[:0], *self._drives[1:])
                self._propagator.forget_merged()
        _, drives, slopes = self._drives
        if keep and part.stop in self._kept:
            return self._kept[part.stop]
        found = Bins(
            self.record.grid.samples,
            np.exp(1j * self._turn(part)),
            self._share(part),
            np.ascontiguousarray(drives[:, part]),
            np.ascontiguousarray(slopes[..., part]),
            np.ascontiguousarray(self._measured[:, part]),
        )
        if keep:  # one part at a time beside the whole, which is as large as the samples
            self._kept = {part.stop: found}
        return found

    def columns(
        self, v: Array, part: slice, common: dict[tuple[int, int, int], Response] | None = None
    ) -> tuple[Array, Array]:
        """Residual and Jacobian (1 + na, 2 ny K) in the active entries of v, the transients projected out; and
        orthonormal rows (r, 2 ny K) that span these.

        common : kept for further records at the same v, those of the same length and bins have much in common
        """
        z = v[self.record.active]
        discrete = self._propagator.discretisation(z, 1)
        bins, common = self.bins(z, part), {} if common is None else common
        key = (id(discrete), bins.samples, len(bins.z))
        if key not in common:
            common[key] = Response(discrete, bins, self.sigma)
        response = common[key]
        free = response.free
        made = response.residual(bins)
        flat = response.columns(bins, made, free.best(made[0]), self._propagator.drives_active)
        flat -= (flat @ free.rows.T) @ free.rows
        return flat, free.rows

    def gram(self, v: Array, stops: list[int], common: Common | None = None) -> Array:
        """Products (e, 1 + na, 1 + na) of residual and Jacobian in the bins before each of the rising ``stops``, the
        transients projected out; part by part of the bins, as those of a long record take much memory.

        common : kept for further records at the same v
        """
        z, long = v[self.record.active], self.size > LONG
        core, common = self._propagator.core, {} if common is None else common
        if id(core) not in common:
            common[id(core)] = Modes.of(core, z)
        modes, last = common[id(core)], stops[-1]
        parts = [slice(k, min(k + _PART, last)) for k in range(0, last, _PART)] if long else [slice(0, last)]

        def at(part: slice) -> tuple[ModalResponse | Response, Bins, Any]:
            bins = self.bins(z, part, keep=not long)
            response = self._response(z, modes, bins)
            return response, bins, response.residual(bins)

        made = None if long else [at(part) for part in parts]
        n = core.states
        spans, sight = np.zeros((len(parts), n, n)), np.zeros(n)
        for span, (response, _, kept) in zip(spans, made or map(at, parts), strict=True):
            span[:] = response.seen @ response.seen.T
            sight += response.seen @ kept[0]
        root = _inverse_root(spans.sum(axis=0))
        jump = -root @ (root.T @ sight)
        total, sums = np.zeros((n + 1 + len(z),) * 2), []
        for part, span, (response, bins, kept) in zip(parts, spans, made or map(at, parts), strict=True):
            rows = response.columns(bins, kept, jump, self._propagator.drives_active)
            rows[0] += jump @ response.seen
            cuts = [part.start, *(stop for stop in stops if part.start < stop < part.stop), part.stop]
            for own in (slice(one - part.start, two - part.start) for one, two in pairwise(cuts)):
                seen, felt = (_cut(values, len(self.sigma), own) for values in (response.seen, rows))
                total[:n, :n] += span if len(cuts) == 2 else seen @ seen.T
                total[:n, n:] += seen @ felt.T
                total[n:, n:] += felt @ felt.T
                if own.stop + part.start in stops:
                    sums.append(total.copy())
        whole = _without(total, root)[None]
        if len(sums) == 1:
            return whole
        below = np.array(sums[:-1])
        return np.concatenate([_without(below, _inverse_roots(below[:, :n, :n])), whole])

    def _response(self, z: Array, modes: Modes | None, bins: Bins) -> ModalResponse | Response:
        """Raises FloatingPointError where the states grow too far."""
        if modes is None:
            return Response(self._propagator.discretisation(z, 1), bins, self.sigma)
        check_growth(float(np.abs(modes.poles[0]).max(initial=0.0)), bins)
        return ModalResponse(modes, bins, self.sigma, self._room)


def check_growth(radius: float, bins: Bins) -> None:
    """Raise FloatingPointError where states grow beyond what their start decides; radius : of the poles."""
    if bins.samples * np.log(max(radius, 1e-300)) > np.log(_GROWTH):
        raise FloatingPointError("the states grow beyond what their start decides")


def _cut(rows: Array, outputs: int, bins: slice) -> Array:
    """Some of the bins of rows (k, 2 ny K), of one output without a copy."""
    if outputs == 1:
        return rows[:, 2 * bins.start : 2 * bins.stop]
    parts = rows.reshape(len(rows), outputs, -1, 2)
    if bins.start == 0 and bins.stop == parts.shape[2]:
        return rows
    return np.ascontiguousarray(parts[:, :, bins]).reshape(len(rows), -1)


def _inverse_root(gram: Array) -> Array:
    """(n, n) whose product with its transpose inverts a Gram matrix (n, n), without what hardly shows in it."""
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    try:
        factor = np.linalg.cholesky(gram / np.outer(size, size))
        if factor.diagonal().min(initial=1.0) > _PLAIN:
            return np.asarray(np.linalg.inv(factor).T / size[:, None])
    except np.linalg.LinAlgError:
        pass
    return _inverse_roots(gram)


def _inverse_roots(grams: Array) -> Array:
    """The same of several (..., n, n)."""
    size = np.sqrt(np.maximum(np.diagonal(grams, axis1=-2, axis2=-1), 1e-300))[..., None]
    values, vectors = np.linalg.eigh(grams / size / size.swapaxes(-1, -2))
    shown = np.where(values > _WEAK, values, np.inf)[..., None, :]
    return np.asarray(vectors / np.sqrt(shown) / size)


def _without(grams: Array, roots: Array) -> Array:
    """Products of the rows behind the first n, these projected out; roots : (..., n, n) of their products."""
    n = roots.shape[-1]
    cross = roots.swapaxes(-1, -2) @ grams[..., :n, n:]
    return np.asarray(grams[..., n:, n:] - cross.swapaxes(-1, -2) @ cross)


class Response:
    """A model at K bins, its outputs in units of their standard deviations.

    seen : (n, 2 ny K) what the transients do, real and imaginary parts side by side; free : what they span
    Raises FloatingPointError where the states grow too far.
    """

    def __init__(self, discrete: Discretisation, bins: Bins, sigma: Array) -> None:
        self._resolvent = Resolvent(discrete.f[0], bins.z)
        check_growth(self._resolvent.radius, bins)
        self._discrete, self._sigma = discrete, sigma
        self._c, self._d = discrete.c / sigma[:, None], discrete.d / sigma[:, None]
        self._rows, self._shifted = self._resolvent.rows(self._c[0]), bins.z * bins.share
        self.seen = _real((self._rows * self._shifted).swapaxes(0, 1).reshape(len(discrete.f[0]), -1))

    @cached_property
    def free(self) -> Orthonormal:
        """Orthonormal rows that span the transients."""
        return Orthonormal.of(self.seen)

    def forced(self, bins: Bins) -> tuple[Spectrum, Spectrum, Spectrum]:
        """Residual (ny, K) without transients, what drives the states (n, K), and what the Jacobian is made of."""
        n, m = self._discrete.f.shape[1], len(bins.drives)
        source = np.empty((n + 2 * m, len(bins.z)), complex)
        source[n : n + m] = bins.drives
        np.multiply(bins.drives, bins.z, out=source[n + m :])
        hold = np.concatenate([self._discrete.g0[0], self._discrete.g1[0]], axis=1)
        drive = _times(hold, source[n:])
        left = np.einsum("ynk,nk->yk", self._rows, drive) + _times(self._d[0], bins.drives)
        return left - bins.measured / self._sigma[:, None], drive, source

    def residual(self, bins: Bins) -> tuple[Array, Spectrum, Spectrum]:
        """The same with the residual (2 ny K,) in real numbers; see ``ModalResponse``."""
        left, drive, source = self.forced(bins)
        return _real(left.reshape(-1)), drive, source

    def columns(
        self,
        bins: Bins,
        made: tuple[Array, Spectrum, Spectrum],
        jump: Array,
        active: NDArray[np.intp],
    ) -> Array:
        """Residual without transients and Jacobian at the transient ``jump`` (n,): (1 + na, 2 ny K), real and imaginary
        parts side by side; active : entries that the drives depend on."""
        discrete, c, d, rows = self._discrete, self._c, self._d, self._rows
        left, drive, source = made
        n, count = discrete.f.shape[1], len(bins.z)
        found = np.empty((len(discrete.f), *bins.measured.shape), complex)
        found[0] = left.view(np.complex128).reshape(found[0].shape)
        source[:n] = self._resolvent.states(drive + jump[:, None] * self._shifted)
        if len(found) > 1:
            hold = np.concatenate([discrete.f[1:], discrete.g0[1:], discrete.g1[1:]], axis=2)
            pushed = _times(hold.reshape(-1, hold.shape[2]), source).reshape(-1, n, count)
            np.einsum("ynk,pnk->pyk", rows, pushed, out=found[1:])
        if c[1:].any():
            found[1:] += _times(c[1:].reshape(-1, n), source[:n]).reshape(found[1:].shape)
        if d[1:].any():
            found[1:] += _times(d[1:].reshape(-1, d.shape[2]), bins.drives).reshape(found[1:].shape)
        for entry, slope in zip(active if len(found) > 1 else (), bins.slopes, strict=False):
            push = _times(discrete.g0[0], slope) + _times(discrete.g1[0], slope * bins.z)
            found[1 + entry] += np.einsum("ynk,nk->yk", rows, push) + _times(d[0], slope)
        return _real(found.reshape(len(found), -1))


def _real(values: Spectrum) -> Array:
    """Real and imaginary parts side by side, of the same memory."""
    return np.ascontiguousarray(values).view(np.float64)


def _times(matrix: Array, spectra: Spectrum) -> Spectrum:
    """A real matrix times spectra (n, K): half the work of a complex one."""
    return np.asarray((matrix @ _real(spectra)).view(np.complex128))
