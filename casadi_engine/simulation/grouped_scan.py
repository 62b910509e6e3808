"""Outputs of s[k+1] = F_k s[k] + W_k g[k] for many columns of g, group by group and without the states of all.

Stretches of steps advance side by side, and so do columns that are pushed alike: a step of all of them is one matrix
product of what stays in the cache. A state is kept where a stretch ends; the outputs are all that is written.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.variational import scan

# Numbers of a step of all stretches and columns that stay in the cache.
_CACHED = 40_000
# Columns that advance together where the steps differ.
_TOGETHER = 96


@dataclass(frozen=True)
class Pushed:
    """Columns that are pushed alike: their numbers (E,), W (T, n, q), or (1, n, q) for all steps, and g (q, E, T)."""

    columns: NDArray[np.intp]
    turn: Array
    force: Array


def constant_scan(
    f: Array, c: Array, pushed: Iterable[Pushed], start: Array, count: int
) -> tuple[Array, Array]:
    """Outputs (T+1, ny, K) before each of ``count`` = T steps and after the last one, and the states (n, K) then.

    f : (n, n) and c : (ny, n) of all steps; start : (n, K)
    """
    n, ny = len(f), len(c)
    length = max(1, math.isqrt(count))
    many = math.ceil(count / length)
    powers = np.empty((length + 1, n, n))
    powers[0] = np.eye(n)
    for k in range(length):
        powers[k + 1] = f @ powers[k]
    shown = (c @ powers[:length]).reshape(-1, n)
    out = np.empty((count + 1, ny, start.shape[1]))
    end = np.empty_like(start)
    for one in pushed:
        most = max(1, _CACHED // (many * (n + one.turn.shape[2])))
        step = np.concatenate([f, one.turn[0]], axis=1)
        for first in range(0, len(one.columns), most):
            ask()
            here = slice(first, first + most)
            columns = one.columns[here]
            wide = len(columns)
            force = np.zeros((len(one.force), wide, many * length))
            force[:, :, :count] = one.force[:, here]
            ordered = force.reshape(len(force), wide, many, length).transpose(3, 0, 2, 1)
            both = np.zeros((n + len(force), many * wide))
            y = np.empty((length, ny, many * wide))
            # the last state is that of a stretch's beginning, or within the last one
            stretch, within = divmod(count, length)
            last = np.zeros((n, wide))
            for k in range(length):
                if k == within and stretch < many:
                    last = both[:n].reshape(n, many, wide)[:, stretch].copy()
                np.matmul(c, both[:n], out=y[k])
                both[n:] = ordered[k].reshape(len(force), many * wide)
                both[:n] = step @ both
            ends = both[:n].reshape(n, many, wide)
            starts = np.empty((n, many + 1, wide))
            starts[:, 0] = start[:, columns]
            for j in range(many):
                starts[:, j + 1] = powers[length] @ starts[:, j] + ends[:, j]
            y += (shown @ starts[:, :many].reshape(n, -1)).reshape(y.shape)
            rows = y.reshape(length, ny, many, wide).transpose(2, 0, 1, 3).reshape(-1, ny, wide)
            last = last + powers[within] @ starts[:, stretch]
            out[:count, :, columns] = rows[:count]
            out[count, :, columns] = (c @ last).T
            end[:, columns] = last
    return out, end


def varying_scan(f: Array, c: Array, pushed: Iterable[Pushed], start: Array) -> tuple[Array, Array]:
    """The same where f (T, n, n) and c (T+1, ny, n) differ from step to step."""
    out = np.empty((len(f) + 1, c.shape[1], start.shape[1]))
    end = np.empty_like(start)
    for one in pushed:
        for first in range(0, len(one.columns), _TOGETHER):
            ask()
            here = slice(first, first + _TOGETHER)
            columns = one.columns[here]
            push = one.turn @ np.ascontiguousarray(one.force[:, here].transpose(2, 0, 1))
            states = scan(f, push, start[:, columns])
            out[:, :, columns] = c @ states
            end[:, columns] = states[-1]
    return out, end
