"""Records cut into windows, one for each combustion, and segments of these; what each tells, in a few rows.

Arrays lead with (records, windows, segments of a window). Segments are padded in front, so that all end alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.detection.plant import Plant
from casadi_engine.detection.torques import CELLS, CYCLE, TorqueTables

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Segments:
    """What the samples of each segment tell, and how the state moves on over it.

    rows : (B, K, M, r, r) upper triangular, [unknown amplitudes and state | measured], in standard deviations
    move : (B, K, M, nz, nz) of the state; add : (B, K, M, nz, 1 + 1 + spans) what is added by the known torque, one
        motored gas torque more, and the combustions of this window, the one before, ...
    seconds : (B, K, M) length; samples : (B, K, M) number of valid ones
    """

    rows: Array
    move: Array
    add: Array
    seconds: Array
    samples: NDArray[np.int64]


def window_edges(theta: Array, tables: TorqueTables) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples where the windows of a record begin, (K + 1,), and the place of each in the firing order, (K,)."""
    count = len(tables.start)
    turns = np.arange(np.floor(theta[0] / CYCLE) - 1, np.floor(theta[-1] / CYCLE) + 2)
    edges = (turns[:, None] * CYCLE + tables.start).ravel()
    places = np.tile(np.arange(count), len(turns))
    inside = (edges >= theta[0]) & (edges <= theta[-1])
    return np.searchsorted(theta, edges[inside]), places[inside][:-1]


def cut_segments(
    theta: Array, omega: Array, valid: NDArray[np.bool_], edges: NDArray[np.int64], pieces: int,
    plant: Plant, tables: TorqueTables, sigma: float,
) -> Segments:  # fmt: skip
    """Segments of records (B, N) whose windows begin at edges (B, K + 1)."""
    begin = edges[:, :-1, None] + (np.diff(edges)[..., None] * np.arange(pieces)) // pieces
    end = np.concatenate([begin[..., 1:], edges[:, 1:, None]], axis=-1)
    length = end - begin
    most = int(length.max())
    index = end[..., None] - most + np.arange(most)  # (B, K, M, most), front padding
    inside = index >= begin[..., None]
    index = np.maximum(index, 0)
    record = np.arange(len(theta))[:, None, None, None]
    pushes = _pushes(theta, omega, tables)  # (kinds, columns, B, N)
    powers = plant.powers(most)
    # Response of the output at a sample to a push in an earlier one: a Toeplitz matrix for each column.
    seen = np.einsum("i,kij,jc->kc", plant.c, powers[:-1], plant.push)
    lag = np.arange(most)[:, None] - np.arange(most) - 1
    respond = np.where(lag[..., None] >= 0, seen[np.maximum(lag, 0)], 0.0)
    reach = np.einsum("kij,jc->kic", powers[most - 1 :: -1], plant.push)
    responses, ends = [], []
    for kind in pushes:
        held = [np.where(inside, one[record, index], 0.0) for one in kind]
        responses.append(np.sum([h @ respond[:, :, c].T for c, h in enumerate(held)], axis=0))
        ends.append(np.sum([h @ reach[:, :, c] for c, h in enumerate(held)], axis=0))
    measured = omega[record, index] - responses[0]
    looks = np.einsum("i,kij->kj", plant.c, powers[:-1])
    first = np.arange(most) - (most - length)[..., None]
    raw = np.concatenate(
        [looks[np.clip(first, 0, most - 1)], *[one[..., None] for one in responses[1:]], measured[..., None]],
        axis=-1,
    )
    counted = inside & valid[record, index]
    raw *= (counted / sigma)[..., None]
    rows: Array = np.asarray(np.linalg.qr(raw, mode="r"))
    return Segments(rows, powers[length], np.stack(ends, axis=-1), length * plant.h, counted.sum(axis=-1))


def _pushes(theta: Array, omega: Array, tables: TorqueTables) -> list[list[Array]]:
    """Rates that the cylinders push with over each sample: known, motored gas, combustions of each span."""
    place = (theta % CYCLE) * (CELLS / CYCLE)
    cell = place.astype(np.int64)
    share = place - cell
    cell %= CELLS
    after = (cell + 1) % CELLS

    def over(table: Array) -> Array:
        value = table[cell] + share * (table[after] - table[cell])
        return np.concatenate([0.5 * (value[:, 1:] + value[:, :-1]), value[:, -1:]], axis=1)

    columns = range(len(tables.known))
    gas = [over(tables.known[c]) for c in columns]
    square = omega**2
    known = [gas[c] + over(tables.squared[c]) * square for c in columns]
    return [known, gas, *[[over(part[c]) for c in columns] for part in tables.combustion]]
