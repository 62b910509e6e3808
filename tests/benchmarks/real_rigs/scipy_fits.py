"""Fits by hand: Runge-Kutta in NumPy and SciPy's least squares, nothing of the package.

All parameter sets that a Jacobian or several starts need are integrated side by side in one sweep.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import least_squares


@dataclass(frozen=True)
class Record:
    """Times (N,), inputs (N, m) that are joined by straight lines or held, and one output (N,), NaN where missing."""

    time: Any
    inputs: Any
    output: Any
    held: bool = False


@dataclass(frozen=True)
class Structure:
    """A model to be fitted by hand.

    rhs(x, u, p) : ẋ (n, B) of states x (n, B), inputs u (m, 1) and p, name -> (B,)
    output(x, u, p) : (B,)
    starts : name -> values to start from, as many for each name
    guess(record) : initial states (n,)
    steps : Runge-Kutta steps between two samples
    """

    rhs: Callable[[Any, Any, Mapping[str, Any]], Any]
    output: Callable[[Any, Any, Mapping[str, Any]], Any]
    starts: Mapping[str, Sequence[float]]
    guess: Callable[[Record], Any]
    steps: int = 2
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    state_scale: float = 0.1


def simulate(structure: Structure, record: Record, table: Any, states: Any) -> Any:
    """(N, B) outputs for a table (k, B) of parameters and states (n, B)."""
    p = dict(zip(structure.starts, table, strict=True))
    x = np.array(states, float)
    out = np.empty((len(record.time), x.shape[1]))
    inputs = np.zeros((len(record.time), 1)) if record.inputs is None else np.asarray(record.inputs, float)
    for k, time in enumerate(record.time):
        out[k] = structure.output(x, inputs[k][:, None], p)
        if k + 1 == len(record.time):
            break
        h = (record.time[k + 1] - time) / structure.steps
        ends = inputs[k][:, None], inputs[k if record.held else k + 1][:, None]
        for step in range(structure.steps):
            x = _runge_kutta(structure.rhs, x, ends, (step / structure.steps, 1 / structure.steps), h, p)
    return out


def _runge_kutta(rhs: Any, x: Any, ends: Any, share: Any, h: float, p: Any) -> Any:
    first, last = ends
    u0 = first + share[0] * (last - first)
    um, u1 = u0 + 0.5 * share[1] * (last - first), u0 + share[1] * (last - first)
    k1 = rhs(x, u0, p)
    k2 = rhs(x + 0.5 * h * k1, um, p)
    k3 = rhs(x + 0.5 * h * k2, um, p)
    k4 = rhs(x + h * k3, u1, p)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def fit(structure: Structure, estimation: Sequence[Record], fresh: Sequence[Record]) -> dict[str, Any]:
    """The best of all starts: parameters, rmse on the estimation records, and on fresh ones with the parameters held
    and the initial states free."""
    count = len(next(iter(structure.starts.values())))
    best = None
    for number in range(count):
        start = np.array([values[number] for values in structure.starts.values()], float)
        found = _least_squares(structure, estimation, start, free=True)
        if best is None or found[1] < best[1]:
            best = found
    assert best is not None
    values, rmse = best
    _, held_out = _least_squares(structure, fresh, values, free=False)
    return {
        "parameters": {name: float(f"{value:.6g}") for name, value in zip(structure.starts, values, strict=True)},
        "estimation": float(f"{rmse:.5g}"),
        "fresh": float(f"{held_out:.5g}"),
    }  # fmt: skip


def _least_squares(
    structure: Structure, records: Sequence[Record], start: Any, *, free: bool
) -> tuple[Any, float]:
    """Parameters and rmse; initial states of every record are free, parameters if `free`."""
    guesses = [np.asarray(structure.guess(record), float) for record in records]
    k, n = (len(start) if free else 0), len(guesses[0])
    scale = np.concatenate(
        [np.maximum(np.abs(start), 1e-6)[:k], np.full(n * len(records), structure.state_scale)]
    )
    point = np.concatenate([start[:k], *guesses]) / scale
    low, high = _bounds(structure, free, scale)

    def residuals(columns: Any) -> Any:
        """(total N, B)"""
        columns = columns * scale[:, None]
        table = columns[:k] if free else np.repeat(start[:, None], columns.shape[1], axis=1)
        parts = []
        for j, record in enumerate(records):
            states = columns[k + n * j : k + n * (j + 1)]
            made = simulate(structure, record, table, states)
            keep = np.isfinite(record.output)
            parts.append(made[keep] - record.output[keep, None])
        out = np.concatenate(parts)
        return np.where(np.isfinite(out), np.clip(out, -1e6, 1e6), 1e6)

    kept: dict[str, Any] = {}

    def value(z: Any) -> Any:
        """Residuals at z; the neighbours that the Jacobian needs come along in the same sweep."""
        small = 1e-5
        around = small * np.eye(len(z))
        values = residuals(np.concatenate([z[:, None], z[:, None] + around, z[:, None] - around], axis=1))
        kept[z.tobytes()] = (values[:, 1 : 1 + len(z)] - values[:, 1 + len(z) :]) / (2 * small)
        return values[:, 0]

    with np.errstate(all="ignore"):
        found = least_squares(
            value, np.clip(point, low, high), jac=lambda z: kept[z.tobytes()],
            bounds=(low, high), x_scale="jac", max_nfev=80,
        )  # fmt: skip
    values = (found.x * scale)[:k] if free else start
    return values, float(np.sqrt(np.mean(found.fun**2)))


def _bounds(structure: Structure, free: bool, scale: Any) -> tuple[Any, Any]:
    low, high = np.full(len(scale), -np.inf), np.full(len(scale), np.inf)
    if free:
        for number, name in enumerate(structure.starts):
            if name in structure.bounds:
                low[number], high[number] = np.array(structure.bounds[name]) / scale[number]
    return low, high
