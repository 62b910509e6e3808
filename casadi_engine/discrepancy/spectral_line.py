"""Lines in the spectrum of a residual: what comes back at one frequency is no noise, whatever its colour.

Thomson's harmonic test (Spectrum estimation and harmonic analysis, Proc. IEEE 70, 1982): orthogonal tapers give several
estimates of the amplitude at a frequency. A sine makes them agree; noise, coloured or not, makes them scatter, if its
spectrum is smooth over the tapers' bandwidth. The ratio is F-distributed with 2 and 2K - 2 degrees of freedom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array

# Time times half bandwidth of the tapers; of these the first ones leak least.
_HALF, _TAPERS = 4.0, 7
# Samples from which a line can be told from noise, and that a spectrum is taken of at most.
_FEWEST, _MOST = 64, 2**17
# Independent frequencies for each one of the discrete Fourier transform: a maximum is looked for between them too.
BETWEEN = 5.0
# Periods in the record from which something comes back.
PERIODS = 3


@dataclass(frozen=True)
class Line:
    """frequency : of the strongest line, in cycles per sample; p : how often noise has one as clear anywhere."""

    frequency: float
    p: float


def strongest_line(residual: Array, valid: Array) -> Line | None:
    """The clearest line in a residual (N,) on equal steps, in its longest run without a hole; None where that is short.

    valid : (N,) bool
    """
    runs = np.split(np.flatnonzero(valid), np.flatnonzero(np.diff(np.flatnonzero(valid)) > 1) + 1)
    inside = max(runs, key=len)
    if len(inside) < _FEWEST:
        return None
    own = residual[inside][:_MOST]
    own = own - own.mean()
    scale = float(np.abs(own).max())
    if not scale > 0:
        return None
    own = own / scale
    frequency, ratio, _ = line_ratios(own)
    # as many as there are within the record, but for what is slower than three periods of it
    seen = (frequency * len(own) >= PERIODS) & (frequency <= 0.5)
    best = int(np.argmax(np.where(seen, ratio, 0.0)))
    # the upper tail of F(2, 2K - 2) in closed form
    tail = (1 + ratio[best] / (_TAPERS - 1)) ** (1 - _TAPERS)
    return Line(float(frequency[best]), float(min(1.0, tail * BETWEEN * len(own) / 2)))


def line_ratios(course: Array, half: float = _HALF, count: int = _TAPERS) -> tuple[Array, Array, Array]:
    """Frequencies in cycles per sample, the ratio of the test at each, F(2, 2 count - 2) without a line there, and the
    amplitude of the complex wave that agrees best with all tapers.

    half : time times half bandwidth of the tapers; count : of tapers
    """
    tapers = _tapers(len(course), half, count)
    # so fine that a clear line, whose ratio falls off fast beside it, is not missed between two frequencies
    size = 2 ** math.ceil(math.log2(16 * len(course)))
    spectra = np.fft.rfft(tapers * course, size)
    level = tapers.sum(axis=1)
    mean = (level @ spectra) / (level @ level)
    left = (np.abs(spectra - level[:, None] * mean) ** 2).sum(axis=0)
    ratio = (count - 1) * np.abs(mean) ** 2 * (level @ level) / np.maximum(left, 1e-300)
    return np.arange(len(ratio)) / size, ratio, np.abs(mean)


@lru_cache(maxsize=4)
def _tapers(length: int, half: float = _HALF, count: int = _TAPERS) -> Array:
    """(K, N) orthogonal tapers, but for their signs; records of one search have few lengths.

    Those of Slepian (Bell System Technical Journal 57, 1978), by the tridiagonal matrix that has them as eigenvectors:
    SciPy's signal processing would be loaded for them alone.
    """
    from scipy.linalg import eigh_tridiagonal

    k = np.arange(length)
    middle = (0.5 * (length - 1) - k) ** 2 * np.cos(2 * np.pi * half / length)
    _, found = eigh_tridiagonal(
        middle, 0.5 * k[1:] * (length - k[1:]), select="i", select_range=(length - count, length - 1)
    )
    return np.ascontiguousarray(found[:, ::-1].T)
