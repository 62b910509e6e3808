"""Lines that the inputs bring: what comes back in a residual at a frequency of an input is what answers to it.

A law that the model lacks answers to a sine of an input at its frequency, its multiples, and at sums and differences of
those of several sines. Such a line says that something is missing, but not that something else acts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.spectral_line import BETWEEN, PERIODS, line_ratios

# Time times half bandwidth of the tapers, and their number: narrower than those of a residual, as an input has no
# noise that would have to be averaged over, but often several sines close to one another.
_HALF, _TAPERS = 2.0, 3
# How often an input without a line has one at a frequency that is asked for by chance; how often it has any.
_CHANCE, _ANY = 1e-3, 0.01
# Part of an input's variance below which a sine in it does nothing beside the rest: a hundredth of its amplitude.
_LEAST = 1e-4
# Sines whose sums are looked at, the largest first; sines in a sum.
_SINES, _ORDER = 12, 3
# Part of all frequencies that sums may cover: where it is more, a foreign line lies on one of them by chance.
_RARE = 0.1


@dataclass(frozen=True)
class _Sines:
    """The lines of one input: frequency, ratio of their test and part of the variance, on a fine grid; samples."""

    frequency: Array
    ratio: Array
    part: Array
    samples: int

    def lies_at(self, frequency: float) -> bool:
        """True if there is a line within the resolution of a frequency."""
        near = np.abs(self.frequency - frequency) * self.samples <= 1
        clear = self.ratio >= _limit(_CHANCE / (2 * BETWEEN))
        return bool(np.any(near & clear & (self.part >= _LEAST)))

    def peaks(self) -> list[tuple[float, float]]:
        """(part of the variance, frequency) of every line."""
        r = self.ratio
        top = np.r_[False, (r[1:-1] > r[:-2]) & (r[1:-1] >= r[2:]), False]
        clear = r >= _limit(_ANY / (BETWEEN * self.samples / 2))
        found = np.flatnonzero(top & clear & (self.part >= _LEAST))
        order = found[np.argsort(-self.part[found])]
        kept: list[int] = []
        for k in order:  # ripples on the flank of a line are none
            if all(abs(self.frequency[k] - self.frequency[other]) * self.samples > 1 for other in kept):
                kept.append(int(k))
        return [(float(self.part[k]), float(self.frequency[k])) for k in kept]


def driven_by(frequency: float, inputs: Mapping[str, Array]) -> tuple[str, ...]:
    """Names of the inputs that have a line at a frequency, or else of those whose lines have it as a sum; none where
    nothing of the inputs is there.

    frequency : in cycles per sample, known to one over the samples. inputs : name -> (N,) course on equal steps
    """
    found = {name: sines for name, course in inputs.items() if (sines := _sines(course)) is not None}
    direct = tuple(name for name, sines in found.items() if sines.lies_at(frequency))
    if direct or not found:
        return direct
    width = 1 / max(sines.samples for sines in found.values())
    every = sorted(((*peak, name) for name, own in found.items() for peak in own.peaks()), reverse=True)
    largest = [(f, name) for _, f, name in every[:_SINES]]
    for order in range(2, _ORDER + 1):
        sums = _sums(largest, order)
        if _covered([f for f, _ in sums], width) > _RARE:
            break
        near = next((names for f, names in sums if abs(f - frequency) <= width), None)
        if near is not None:
            return tuple(name for name in found if name in near)
    return ()


def _sines(course: Array) -> _Sines | None:
    """The lines of a course, less a straight line: an angle that goes on and on has none of its own. None for one that
    does not move, or is too short."""
    t = np.linspace(-1.0, 1.0, len(course))
    straight = np.column_stack([np.ones_like(t), t])
    own = course - straight @ np.linalg.lstsq(straight, course, rcond=None)[0]
    size = float(np.abs(own).max(initial=0.0))
    if len(own) < 2 * PERIODS or not size > 1e-9 * float(np.abs(course).max(initial=0.0)):
        return None
    own = own / math.sqrt(float(own @ own) / len(own))
    frequency, ratio, amplitude = line_ratios(own, _HALF, _TAPERS)
    ratio[frequency * len(own) < 1] = 0.0
    # a sine is two complex waves, and holds twice the square of the amplitude of one
    return _Sines(frequency, ratio, 2 * amplitude**2, len(own))


def _limit(chance: float) -> float:
    """Ratio that a course without lines exceeds so often at one frequency: the tail of F(2, 2K - 2) in closed form."""
    return (_TAPERS - 1) * (chance ** (1 / (1 - _TAPERS)) - 1)


def _sums(lines: Sequence[tuple[float, str]], order: int) -> list[tuple[float, set[str]]]:
    """(frequency, names of the inputs) of all sums and differences of so many sines, each as often as one likes."""
    signed = [(sign * f, name) for f, name in lines for sign in (1, -1)]
    found = []
    for chosen in combinations_with_replacement(signed, order):
        total = sum(f for f, _ in chosen)
        if total > 0:
            # beyond half a cycle per sample it is folded back
            found.append((abs(total - round(total)), {name for _, name in chosen}))
    return found


def _covered(frequencies: Sequence[float], width: float) -> float:
    """Part of the band up to the largest frequency that lies within a width of one of them."""
    if not frequencies:
        return 0.0
    cells = np.unique(np.floor(np.asarray(frequencies) / (2 * width)))
    return float(len(cells) * 2 * width / max(max(frequencies), 2 * width))
