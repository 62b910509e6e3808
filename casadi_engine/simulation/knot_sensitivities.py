"""Sensitivities of an amplitude that runs piecewise linearly over time: one column for each knot.

Between two knots an amplitude is that of these two alone, and what they have done before goes on freely. So only the
few columns of the knots about are swept, from zero between each two knots; the states that all knots have made so far
are carried from knot to knot by the transition over the whole way, and are seen at the samples between through it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.simulation.candidate_sensitivities import Direction, Sweep
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.null_path import NullPath, Points


class _Hats:
    """The columns of directions times the hat functions of the knots about: that of knot k is column k modulo width."""

    def __init__(self, columns: object, knots: Array, width: int) -> None:
        self._columns, self._knots, self._width = columns, knots, width

    def at(self, points: Points, xi: Array) -> Array:
        """(T, rows, directions * width)."""
        one = self._columns.at(points, xi)  # type: ignore[attr-defined]
        place, share = hat_weights(points.t[0], self._knots)
        out = np.zeros((*one.shape, self._width))
        row = np.arange(len(one))
        out[row, :, :, place % self._width] = one * (1 - share)[:, None, None]
        out[row, :, :, (place + 1) % self._width] = one * share[:, None, None]
        return out.reshape(len(one), one.shape[1], -1)


def hat_weights(time: Array, knots: Array) -> tuple[NDArray[np.intp], Array]:
    """Number of the knot before each time, and the share (0..1) of the way to the next; constant outside."""
    place = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
    share = (time - knots[place]) / (knots[place + 1] - knots[place])
    return place, np.clip(share, 0.0, 1.0)


@dataclass(frozen=True)
class _Stretch:
    """Steps between two knots: the knot before them, and the samples at which outputs are seen.

    local : (T, ny, P, width) outputs of what acts within; seen : (T, ny, n) outputs by the state at its beginning
    end : (n, P, width) states of what acts within, and turn (n, n) what becomes of the first state, at its end
    """

    knot: int
    shown: slice
    local: Array
    seen: Array
    end: Array
    turn: Array


def knot_sensitivities(
    path: NullPath,
    directions: Direction | Sequence[Direction],
    knots: Array,
    *,
    every: int = 1,
    substeps: int | None = None,
) -> Array:
    """dy/d(amplitude at each knot), (K, ny, rows), averaged over every ``every`` samples of the grid.

    directions : one, or P of them, which give (P, K, ny, rows)
    knots : (K,) s, rising, two or more; rows : the whole multiples of ``every`` in N samples
    """
    several = [directions] if isinstance(directions, Direction) else list(directions)
    sweep = Sweep(path, several, substeps=substeps)
    ny, many, count = sweep.shape[0], len(several), len(knots)
    # a step that begins behind a knot feels the next one, and those that it reaches
    reached = math.ceil(float(path.lengths.max()) / float(np.diff(knots).min()) + 1e-6)
    width = min(2 + reached, count)
    sweep.shape = (ny, many * width)
    sweep._ode = _Hats(sweep._ode, knots, width)  # type: ignore[assignment]
    sweep._out = _Hats(sweep._out, knots, width)  # type: ignore[assignment]
    rows = path.grid.samples // every
    total = np.zeros((rows + 1, ny, many, count))
    state = np.zeros((path.states, many, count))
    for one in _stretches(sweep, knots, width):
        group = np.minimum(np.arange(one.shown.start, one.shown.stop) // every, rows)
        first = np.flatnonzero(np.diff(group, prepend=-1))
        if len(first):
            at = group[first]
            about = np.arange(one.knot, min(one.knot + width, count))
            seen, local = (np.add.reduceat(part, first, axis=0) for part in (one.seen, one.local))
            total[at] += np.tensordot(seen, state, axes=1)
            total[at[0] : at[-1] + 1, :, :, about] += local[:, :, :, about % width]
        state = np.tensordot(one.turn, state, axes=1)
        about = np.arange(one.knot, min(one.knot + width, count))
        state[:, :, about] += one.end[:, :, about % width]
    mean = total[:rows] / every
    found = np.ascontiguousarray(mean.transpose(2, 3, 1, 0))
    return found[0] if isinstance(directions, Direction) else found


def _stretches(sweep: Sweep, knots: Array, width: int) -> Iterator[_Stretch]:
    """The steps of the record, from knot to knot."""
    path = sweep.path
    place, _ = hat_weights(path.grid.time[:-1], knots)
    last = path.grid.samples - 1
    for here, f, push, halves in sweep.steps():
        begins = np.flatnonzero(np.diff(place[here], prepend=-1))
        lengths = np.diff(begins, append=here.stop - here.start)
        states, turns = _from_zero(f, push, begins, lengths)
        # a sample belongs to the step that it begins, the last one to the step that it ends
        shown = slice(here.start, here.stop + (here.stop == last))
        row = np.repeat(np.arange(len(begins)), lengths)
        step = np.arange(here.stop - here.start) - begins[row]
        if here.stop == last:
            row, step = np.append(row, row[-1]), np.append(step, step[-1] + 1)
        local = sweep.outputs(shown, states[step, row], halves)
        local = local.reshape(*local.shape[:2], -1, width)
        seen = sweep.seen(shown) @ turns[step, row]
        ends = np.append(begins[1:], shown.stop - shown.start)
        for k, (begin, end, length) in enumerate(zip(begins, ends, lengths, strict=True)):
            yield _Stretch(
                int(place[here.start + begin]),
                slice(here.start + int(begin), here.start + int(end)),
                local[begin:end],
                seen[begin:end],
                states[length, k].reshape(len(f[0]), -1, width),
                turns[length, k],
            )


def _from_zero(
    f: Array, push: Array, begins: NDArray[np.intp], lengths: NDArray[np.intp]
) -> tuple[Array, Array]:
    """States from zero (L+1, S, n, k) of S stretches of steps, and what becomes of the first states (L+1, S, n, n).

    Those of shorter stretches go on into the next: nobody looks there.
    """
    count, n, width = push.shape
    longest = int(lengths.max())
    states = np.zeros((longest + 1, len(begins), n, width))
    turns = np.empty((longest + 1, len(begins), n, n))
    turns[0] = np.eye(n)
    for k in range(longest):
        at = np.minimum(begins + k, count - 1)
        own = f[at] if len(f) > 1 else f
        np.matmul(own, states[k], out=states[k + 1])
        states[k + 1] += push[at]
        np.matmul(own, turns[k], out=turns[k + 1])
    return states, turns
