"""Effects that are one and the same in the equations of a model: dry friction of a body, and of its spring to the
ground. One of them is refitted and judged on fresh data; the other has its probability, as a second name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.model import Model

Key = tuple[str, str]
# What two numbers may differ by that are the same but for the order of their sums.
_SAME = 1e-9


def second_names_of(
    candidates: Sequence[Candidate], columns: Mapping[str, Mapping[str, Array]], order: Sequence[int]
) -> dict[Key, tuple[Key, ...]]:
    """(effect, port) -> the ports at which the same effect does the same, the first in order with those behind it.

    They do where both move the outputs alike along the records, and enter the equations alike anywhere.
    columns : record -> output -> (N, k) what each candidate does to the outputs
    """
    ordered = [*order, *sorted(set(range(len(candidates))) - set(order))]
    families: dict[Key, list[int]] = {}
    for k in range(len(candidates)):
        families.setdefault(candidates[k].key, []).append(k)
    found: dict[Key, tuple[Key, ...]] = {}
    done: set[Key] = set()
    for key in dict.fromkeys(candidates[k].key for k in ordered):
        if key in done:
            continue
        own = [
            other
            for other in families
            if other[0] == key[0]
            and other != key
            and other not in done
            and _alike(candidates, columns, families[key], families[other])
        ]
        done |= {key, *own}
        if own:
            found[key] = tuple(own)
    return found


def _alike(
    candidates: Sequence[Candidate],
    columns: Mapping[str, Mapping[str, Array]],
    one: Sequence[int],
    other: Sequence[int],
) -> bool:
    """True if the candidates of two families are the same, one by one."""
    if len(one) != len(other):
        return False
    pairs = list(zip(one, other, strict=True))
    if any(dict(candidates[a].nuisance) != dict(candidates[b].nuisance) for a, b in pairs):
        return False
    for outputs in columns.values():
        for every in outputs.values():
            first, second = every[:, list(one)], every[:, list(other)]
            if np.abs(first - second).max(initial=0.0) > _SAME * np.abs(first).max(initial=0.0):
                return False
    return all(_same_anywhere(candidates[a], candidates[b]) for a, b in pairs)


def _same_anywhere(one: Candidate, other: Candidate) -> bool:
    """True if two candidates enter the equations alike at states, inputs and parameters drawn at random; False where
    these have no value."""
    if one.source.states or other.source.states:
        return False
    first, second = (_anywhere(c.source.model, (c.source.ode, c.source.output)) for c in (one, other))
    fine = np.isfinite(first)
    alike = np.allclose(first[fine], second[fine], rtol=_SAME, atol=0.0)
    return bool(fine.any(axis=0).all() and alike)


def _anywhere(model: Model, expressions: Sequence[ca.SX]) -> Array:
    """Expressions (4, K) in a model's symbols at points near its scales and start values, the same at every call."""
    symbols = [model.x, model.u, model.d, model.t, model.p]
    function = ca.Function("anywhere", symbols, [ca.densify(ca.vertcat(*expressions))])
    rng = np.random.default_rng(0)
    scale = np.array([state.scale for state in model.states])
    start = np.array([one.value for one in model.declarations])
    found = []
    for _ in range(4):
        x, u, d, t, p = (rng.standard_normal(symbol.numel()) for symbol in symbols)
        # a parameter keeps its sign: roots and logarithms of it have values
        near = np.where(start == 0, 0.1 * p, start * np.exp(0.3 * p))
        found.append(np.asarray(function(scale * x, u, d, t, near)).ravel())
    return np.array(found)
