"""Where a fit starts: shooting nodes from the measurement, parameters from the user or drawn within the bounds."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.record import RecordPoint, RecordTerm
from casadi_engine.parameters.compiled import ParameterMap
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

Array = NDArray[np.float64]

# Samples on each side of a node whose mean stands for the measured output there.
_SMOOTH = 4
# Weight of the measured outputs against the wish for a quasi-steady state.
_TRUST = 1e3
# Times as much as it moves by typical states that an output moves by a state beside a pole.
_POLE = 1e3
# A step to a state whose outputs are not finite is halved this often at most.
_HALVINGS = 10
# Steps to the states that explain an interval, the fall of the misfit that ends them; the damping at first, its change;
# share of the largest slope in a state below which nothing is known of the state.
_NODE_STEPS, _SMALL, _DAMPING, _HINDER, _BLIND = 10, 1e-2, 1e-2, 6.0, 1e-6
# Times that gaps between intervals are closed side by side, and what is left of them, as a share of the largest state.
_CLOSINGS, _CLOSED = 10, 1e-11
# Difference of a run and the nodes near it, in the size of these, from which on it has left them.
_LEFT = 1e-6
# A start is drawn within this factor of the given one where the bounds leave more room.
_REACH = 3.0
# Starts that are drawn near, before every other one is drawn from all that the bounds allow, or this power of the reach
# where there are none.
_NEAR, _FARTHER = 3, 3


def nodes_from_measurement(record: RecordTerm, physical: Array, given: Array | None = None) -> Array:
    """Starts (M, n) of a record's intervals, scaled: the quasi-steady state that explains the measured outputs.

    For each interval the least-squares solution of C x = y (trusted) and dx/dt = 0 under the mean input; for a chain
    of inertias that is equal speeds and the twists that carry the mean torque. Where that is beside a pole of an
    output, as what has all decayed is of a share, the nearest state to typical ones that explains the outputs.

    given : (n,) scaled states that are known where the record begins, NaN elsewhere: others explain the outputs beside
    them
    """
    model, scale = record.model, record.scale
    slope = ca.jacobian(model.closed_ode, model.x)
    out = ca.jacobian(model.closed_outputs, model.x)
    arguments = [model.x, model.u, model.t, model.p]
    function = ca.Function("quasi", arguments, [slope, out, model.closed_ode, model.closed_outputs])
    mean = np.array([row.mean() for row in record.grid.rows])
    observed = _measured_at_nodes(record)
    weights = np.array([variable.scale for variable in model.outputs])
    middle = np.nanmean(observed, axis=1)

    def parts(state: Array) -> list[Array]:
        return [np.asarray(part, dtype=float) for part in function(state, mean, 0.0, physical)]

    guess = first = _first_guess(parts, scale)
    whole = _is_finite(parts(guess))  # else the outputs alone decide
    for _ in range(3):  # a nonlinear model needs a few steps; a linear one is done after the first
        a, c, f, g = parts(guess)
        if not _is_finite([a, f]):
            a, f = np.zeros_like(a), np.zeros_like(f)
        if not _is_finite([c, g]):
            c, g = np.zeros_like(c), np.where(np.isfinite(middle), middle, 0.0)
        step = _balanced(a, c, f.ravel(), middle - g.ravel(), scale, weights)
        shorter = (step * 0.5**k for k in range(_HALVINGS))
        checked = slice(None) if whole else slice(1, None, 2)
        guess = guess + next((one for one in shorter if _is_finite(parts(guess + one)[checked])), 0.0 * step)
    if model.linear is None and whole and _beside_a_pole(c, parts(first)[1], scale):
        guess = _beside(parts, first, middle, scale, weights)
        a, c = np.zeros_like(a), parts(guess)[1]
    offset = observed - middle[:, None]
    shift = _balanced(a, c, np.zeros(len(scale)), offset, scale, weights)
    if whole and model.linear is None:
        shift = _shortened(lambda states: function(states, mean, 0.0, physical), guess, shift)
    nodes = np.ascontiguousarray(((guess[:, None] + shift) / scale[:, None]).T)
    if given is not None and model.linear is None and whole and 0 < np.isfinite(given).sum() < len(given):
        nodes[0] = _beside_given(
            parts, (nodes[0] * scale, first), given * scale, observed[:, 0], scale, weights
        )
        nodes[0] /= scale
    return nodes


def _beside_given(
    parts: Callable[[Array], list[Array]],
    begins: tuple[Array, Array],
    given: Array,
    wanted: Array,
    scale: Array,
    weights: Array,
) -> Array:
    """The state (n,) that explains the outputs (ny,) beside what is given of it, NaN elsewhere: from the first of two
    beginnings, or from the other where that leads nowhere, as from beyond a pole."""
    known = np.isfinite(given)
    ends = [
        _beside(parts, np.where(known, given, one), wanted, scale, weights, free=~known) for one in begins
    ]
    own, other = (_misfit(parts, one, wanted, weights)[-1] for one in ends)
    much = own > (_SMALL * float(np.nanmax(np.abs(wanted / weights), initial=0.0))) ** 2
    return ends[1] if much and other < own else ends[0]


def _beside_a_pole(c: Array, usual: Array, scale: Array) -> bool:
    """True where states move an output so many times as much as typical states do."""
    size, typical = (np.abs(slopes * scale).max(axis=1, initial=0.0) for slopes in (c, usual))
    return bool((size > _POLE * typical)[typical > 0].any())


def _beside(
    parts: Callable[[Array], list[Array]],
    state: Array,
    wanted: Array,
    scale: Array,
    weights: Array,
    free: NDArray[np.bool_] | None = None,
) -> Array:
    """The state (n,) near this one that explains the outputs (ny,), NaN where none was measured, by free ones;
    no farther on than each step explains them better."""
    c, left, cost = _misfit(parts, state, wanted, weights)
    for _ in range(_NODE_STEPS):
        slopes = c * scale / weights[:, None]
        if free is not None:
            slopes = slopes * free
        if not np.isfinite(cost):
            break
        step = np.linalg.lstsq(slopes, left, rcond=1e-9)[0] * scale
        ways = (state + 0.5**k * step for k in range(_HALVINGS))
        tried = ((way, *_misfit(parts, way, wanted, weights)) for way in ways)
        better = next((one for one in tried if one[-1] < cost), None)
        if better is None:
            break
        state, c, left, cost = better
    return state


def _misfit(
    parts: Callable[[Array], list[Array]], state: Array, wanted: Array, weights: Array
) -> tuple[Array, Array, float]:
    """Slopes of the outputs at a state (n,), what they leave of the wanted (ny,), weighted, and its squares."""
    _, c, _, g = parts(state)
    left = np.where(np.isfinite(wanted), wanted - g.ravel(), 0.0) / weights
    return c, left, float(left @ left) if _is_finite([c, g]) else np.inf


def _first_guess(parts: Callable[[Array], list[Array]], scale: Array) -> Array:
    """A state (n,) at which the equations have values and slopes; if there is none, one at which the outputs have.

    Zero, or a typical size: a root, a logarithm or a quotient has no slope or no value at zero, and an output that is a
    product of states, or an even function of one, says nothing of them there.
    """
    guesses = (0.0 * scale, scale, -scale)
    usable = [guess for guess in guesses if _is_finite(parts(guess))]
    if usable:
        return min(usable, key=lambda guess: int((parts(guess)[1] == 0).all(axis=1).sum()))
    return guesses[0] if _is_finite(parts(guesses[0])[1::2]) else guesses[1]


def _shortened(function: Callable[[Array], Any], guess: Array, shift: Array) -> Array:
    """The shifts (n, M) of a state, halved where they lead to a state without values or slopes."""
    shift, count = shift.copy(), shift.shape[1]
    for _ in range(_HALVINGS):
        found = [np.asarray(part, dtype=float) for part in function(guess[:, None] + shift)]
        # a function called with (n, M) gives its outputs side by side, (rows, columns*M)
        each = [np.isfinite(part).reshape(len(part), count, -1).all(axis=(0, 2)) for part in found]
        off = ~np.all(each, axis=0)
        if not off.any():
            return shift
        shift[:, off] *= 0.5
    shift[:, off] = 0.0
    return shift


def _is_finite(parts: list[Array]) -> bool:
    return all(np.isfinite(part).all() for part in parts)


def _balanced(a: Array, c: Array, f: Array, y: Array, scale: Array, weights: Array) -> Array:
    """Change of state that brings the outputs by y (ny,) or (ny, M) and dx/dt by -f; missing outputs count as 0."""
    rows = a * scale[None, :] / scale[:, None]
    size = np.maximum(np.abs(rows).max(axis=1), 1e-12)
    matrix = np.vstack([_TRUST * c * scale[None, :] / weights[:, None], rows / size[:, None]])
    wide = y.reshape(len(y), -1)
    steady = np.repeat((-f / scale / size)[:, None], wide.shape[1], axis=1)
    right = np.vstack([_TRUST * np.nan_to_num(wide) / weights[:, None], steady])
    found = np.linalg.lstsq(matrix, right, rcond=1e-12)[0] * scale[:, None]
    return found if y.ndim == 2 else found[:, 0]


def _measured_at_nodes(record: RecordTerm) -> Array:
    """(ny, M) outputs at the interval starts, each the mean of a few samples; NaN where an output has none."""
    plan, found = record.plan, []
    for name in record.outputs:
        measured = record.grid.measured.get(name)
        if measured is None:
            found.append(np.full(plan.m, np.nan))
            continue
        width = min(_SMOOTH, max(1, plan.length // 2), len(measured.values))
        kernel = np.ones(2 * width - 1)
        weight = np.convolve(np.ones(len(measured.values)), kernel, mode="same")[: len(measured.values)]
        smooth = np.convolve(measured.values, kernel, mode="same")[: len(measured.values)] / weight
        found.append(np.interp(np.arange(plan.m) * plan.length, measured.position, smooth))
    return np.array(found)


def fitted_nodes(record: RecordTerm, v: Array, nodes: Array) -> Array:
    """Nodes (M, n), each moved to where its own interval's run explains the interval's samples (Levenberg 1944).

    v : the parameters' vector, which is kept. States that an interval does not show stay as they are.
    """
    at, damping = nodes, np.full(len(nodes), _DAMPING)
    here = _of_intervals(record, v, at)
    if here is None:
        return nodes
    cost, slope, matrix = here
    for _ in range(_NODE_STEPS):
        size = np.einsum("maa->ma", matrix)
        size = np.maximum(size, _BLIND * size.max(axis=1, keepdims=True)) + 1e-300
        damped = matrix + (damping[:, None] * size)[..., None] * np.eye(at.shape[1])
        trial = at - np.linalg.solve(damped, slope[..., None])[..., 0]
        there = _of_intervals(record, v, trial)
        if there is None:
            damping = _HINDER * damping
            continue
        better = there[0] < cost
        fall = float((cost[better] - there[0][better]).sum())
        at = np.where(better[:, None], trial, at)
        slope = np.where(better[:, None], there[1], slope)
        matrix = np.where(better[:, None, None], there[2], matrix)
        cost = np.where(better, there[0], cost)
        damping = np.where(better, damping / _HINDER, damping * _HINDER)
        if better.any() and fall < _SMALL * cost.sum():
            break
    return at


def _of_intervals(record: RecordTerm, v: Array, nodes: Array) -> tuple[Array, Array, Array] | None:
    """Each interval's own summed squares (M,), their slope (M, n) and Gauss-Newton matrix (M, n, n) in its start.

    The squares are infinite where there is no slope by a parameter, as of y**n by n at a y below 0, from where no
    search could go on.
    """
    try:
        point = record.evaluate(v, nodes)
    except (FloatingPointError, np.linalg.LinAlgError):
        return None
    cost, slope = np.square(point.r).sum(axis=0), record.gradient(point, Loss())[1]
    blocks = record.gauss_newton(point)
    if not (np.isfinite(cost).all() and np.isfinite(blocks.ss).all()):
        return None
    return np.where(np.isfinite(blocks.zs).all(axis=(0, 1)), cost, np.inf), slope, blocks.ss


def nodes_by_first(point: RecordPoint) -> Array:
    """Nodes (M, n, n + 1) of a linear record as functions of the first one: powers of the transition, then the forced
    part; point : from nodes at zero."""
    n, m = point.path.end.shape
    free = np.empty((m, n, n + 1))
    free[0] = np.eye(n, n + 1)
    for k in range(m - 1):
        np.matmul(point.path.end_s[0], free[k], out=free[k + 1])
        free[k + 1, :, n] += point.path.end[:, k]
    return free


def chained_nodes(record: RecordTerm, v: Array, first: Array) -> Array:
    """Nodes (M, n) of the trajectory that starts at ``first`` (n,), scaled: continuous by construction."""
    plan = record.plan
    nodes = np.tile(first, (plan.m, 1))
    if plan.m == 1:
        return nodes
    if record.linear:
        _, path = record.outputs_at(v, nodes * 0.0)
        free, forced = path.end_s[0], path.end
        for i in range(plan.m - 1):
            nodes[i + 1] = free @ nodes[i] + forced[:, i]
        return nodes
    whole = record.single()
    path = whole.propagator.propagate(v[record.active], first[None], 0)
    return np.ascontiguousarray(path.x[: plan.m * plan.length : plan.length, :, 0])[: plan.m]


def run_through(record: RecordTerm, v: Array, nodes: Array, starts: NDArray[np.intp]) -> Array:
    """Nodes (M, n), scaled, of runs that start at those of the intervals numbered ``starts`` (w,), the first one among
    them."""
    if len(starts) == 1:
        return chained_nodes(record, v, nodes[0])
    found, sizes = nodes.copy(), np.diff(np.append(starts, len(nodes)))
    for k in range(1, int(sizes.max())):  # as many turns as the longest run has intervals
        at = starts[sizes > k] + k
        found[at] = record.propagator.propagate(v[record.active], found, 0).end.T[at - 1]
    return found


def joined_nodes(record: RecordTerm, v: Array, near: Array) -> Array:
    """Nodes (M, n) of the trajectory that starts at the first of nodes near it, scaled.

    The gaps between intervals close side by side, by Newton's steps; in one run, interval by interval, where they do
    not, or where that is as cheap and ends near by: along what grows beyond all digits the first state alone says
    nothing of the last one.
    """
    if record.plan.m == 1:
        return chained_nodes(record, v, near[0])
    if not isinstance(record.propagator, RungeKuttaPropagator):
        run = None
        with suppress(FloatingPointError):  # what a controller holds upright runs away without it
            run = chained_nodes(record, v, near[0])
            far = _LEFT * max(1.0, float(np.abs(near).max()))
            if not record.linear or float(np.abs(run - near).max()) <= far:
                return run
        shadow = _shadow(record, v, near.copy())
        found = run if shadow is None else shadow
        return chained_nodes(record, v, near[0]) if found is None else found
    try:
        joined = _joined(record, v, near.copy())
    except FloatingPointError:  # far from the run, a step may lead anywhere
        joined = None
    return chained_nodes(record, v, near[0]) if joined is None else joined


def _shadow(record: RecordTerm, v: Array, nodes: Array) -> Array | None:
    """The trajectory nearest to nodes (M, n), whose start moves too, by less than its digits say; None where the gaps
    do not close."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    count, n = nodes.shape
    for _ in range(_CLOSINGS):
        path = record.propagator.propagate(v[record.active], nodes, 1)
        gaps = path.end.T[:-1] - nodes[1:]
        if not np.isfinite(gaps).all():
            return None
        if np.abs(gaps).max() <= _CLOSED * max(1.0, float(np.abs(nodes).max())):
            return nodes
        # of all changes that close the gaps, to first order, the smallest
        ends = np.broadcast_to(path.end_s, (count, n, n))[:-1]
        blocks = np.stack([-ends, np.broadcast_to(np.eye(n), ends.shape)], axis=1).reshape(-1, n, n)
        index = np.arange(count - 1)
        places = np.stack([index, index + 1], axis=1).ravel()
        rows = sparse.bsr_array(
            (blocks, places, 2 * np.arange(count)), shape=((count - 1) * n, count * n)
        ).tocsr()
        nodes = nodes + (rows.T @ spsolve((rows @ rows.T).tocsc(), gaps.ravel())).reshape(nodes.shape)
    return None


def _joined(record: RecordTerm, v: Array, nodes: Array) -> Array | None:
    for _ in range(_CLOSINGS):
        path = record.propagator.propagate(v[record.active], nodes, 1)
        gaps = path.end.T[:-1] - nodes[1:]
        size = float(np.abs(gaps).max())
        if not np.isfinite(size):
            return None
        if size <= _CLOSED * max(1.0, float(np.abs(nodes).max())):
            return nodes
        ends = np.broadcast_to(path.end_s, (len(nodes), record.n, record.n))
        step = np.zeros(record.n)
        for k, gap in enumerate(gaps):
            step = ends[k] @ step + gap
            nodes[k + 1] += step
    return None


def drawn_starts(
    pmap: ParameterMap, count: int, seed: int, reach: float | None = None, scale: Array | None = None
) -> list[Array]:
    """``count`` starts of z: the given one, then points drawn within the bounds and a factor ``reach`` of it; without
    a reach every other one beyond the first few is drawn from all that the bounds allow.

    scale : (nz,) sizes in place of those of the set, for entries that are 0 or negative
    """
    scale = pmap.scale if scale is None else scale
    random = np.random.default_rng(seed)
    starts = [pmap.start.copy()]
    for k in range(1, count):
        share = random.random(len(pmap.start))
        far = reach is None and k > _NEAR and k % 2 == 0
        within = reach or _REACH ** (_FARTHER if far else 1)
        starts.append(_drawn(pmap, share, within, scale, far=far))
    return starts


def _drawn(pmap: ParameterMap, share: Array, reach: float, scale: Array, *, far: bool) -> Array:
    """The point z at these shares (nz,) of the ways between the ends; far : those are bounds, where there are both."""
    point = np.empty(len(share))
    for i, part in enumerate(share):
        low, high, at = pmap.lower[i], pmap.upper[i], pmap.start[i]
        both = far and np.isfinite(high) and np.isfinite(low)
        if low >= 0 and at > 0:
            low = max(low, at / reach) if not both or low == 0 else low
            high = high if both else min(high, at * reach)
            point[i] = low * (high / low) ** part
        else:
            width = reach * scale[i]
            low, high = (low, high) if both else (max(low, at - width), min(high, at + width))
            point[i] = low + (high - low) * part
    return point
