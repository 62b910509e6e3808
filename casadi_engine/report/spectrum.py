"""The spectrum of a residual, in a few lines: importing a library for it would cost more than a page."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def welch(values: Array, rate: float, segment: int) -> tuple[Array, Array]:
    """Frequency (K,) [Hz] and one-sided power spectral density (K,) of evenly spaced values.

    The mean of the periodograms of segments of so many samples that overlap by half, each under a Hann window
    (P. Welch, IEEE Trans. Audio Electroacoust. 15, 1967).

    >>> import numpy as np
    >>> frequency, density = welch(np.sin(2 * np.pi * 10 * np.arange(4000) / 100), 100.0, 200)
    >>> float(frequency[np.argmax(density)]), round(float(density.sum() * frequency[1]), 9)
    (10.0, 0.5)
    """
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(segment) / segment)
    pieces = np.lib.stride_tricks.sliding_window_view(values, segment)[:: segment - segment // 2]
    power = np.mean(np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2, axis=0)
    power[1 : (segment + 1) // 2] *= 2  # the negative frequencies; zero and half the rate stand alone
    return np.arange(power.size) * rate / segment, power / (rate * np.sum(window**2))
