"""Implicit steps of many intervals at once: Newton's method, and which root of the stage equations is the step's.

The stage equations of a nonlinear law can have several roots (a rate S/(K + S) has one beyond its pole, S < -K, too).
The step is the one that its length, grown from nothing, leads to, so that its value does not depend on what was
simulated before. A root is taken for that one where it lies as near to what the first iteration asked for as the
theorem of Newton and Kantorovich has it; else the length is ramped up. Where that leads nowhere, as over steps of many
time constants, the root that was met is kept, and the estimated error of the integration has to tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from casadi_engine.deadline import ask
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.newton_machine import NEAR, ROUNDING, SEEN, SMALL
from casadi_engine.simulation.tableau import Tableau, newton_step

Function = Callable[[Array, Array], Sequence[Array]]
# Newton's method: most iterations; share of what is asked for below which it goes nowhere; part of a share by which the
# residual has to fall.
_ITERATIONS, _LEAST, _LESS = 200, 1e-12, 0.1
# Units of work that one iteration costs, however few steps there are.
_CALL = 200
# The length of a step is ramped up from this share of it, and by no less than the least; so often at most, with so many
# iterations each: from near by, few arrive or none do.
_FIRST, _FINEST, _RAMPED, _SOON = 0.125, 1e-3, 40, 10


def stages_of(
    scheme: Tableau, function: Function, x: Array, given: Array, near: Array | None = None
) -> Array:
    """Stage values (stages, n, K) of implicit steps from x (n, K), NaN where Newton's method does not arrive.

    function : (stage values (n, stages*K), known (rows, stages*K)) -> slopes and their derivatives, z put in; near :
    stage values of a point near by, where there are any, NaN where they are not known
    """
    still = np.repeat(x[None], scheme.stages, axis=0)
    known = np.zeros(x.shape[1], dtype=bool) if near is None else np.isfinite(near).all(axis=(0, 1))
    guess = still if near is None else np.where(known, near, still)
    found, sure, first = solve_stages(scheme, function, x, guess, given)
    # which is no neighbour of a point from which it lies further than a step goes
    sure &= ~(known & beyond(first, guess - x, guess, x))
    again = np.flatnonzero(~sure & known & np.isfinite(x).all(axis=0))
    if len(again):  # from where all steps begin that have no neighbour
        rest = given[:, _of(again, scheme.stages, x.shape[1])]
        found[..., again], sure[again], _ = solve_stages(
            scheme, function, x[:, again], still[..., again], rest
        )
    doubted = np.flatnonzero(~sure & np.isfinite(x).all(axis=0))
    doubted = doubted[np.isfinite(found[..., doubted]).all(axis=(0, 1))]  # others have no root at all
    if len(doubted):
        rest = given[:, _of(doubted, scheme.stages, x.shape[1])]
        ramped = _ramped(scheme, function, x[:, doubted], rest)
        found[..., doubted] = np.where(np.isfinite(ramped), ramped, found[..., doubted])
    return found


def _of(steps: NDArray[np.intp], size: int, count: int) -> NDArray[np.intp]:
    """Columns of what is known at the stages of these steps."""
    return (count * np.arange(size)[:, None] + steps).ravel()


def _ramped(scheme: Tableau, function: Function, x: Array, given: Array) -> Array:
    """The same with slopes that grow from nothing to what they are, NaN where that leads nowhere."""
    size, (n, count) = scheme.stages, x.shape
    stages = np.repeat(x[None], size, axis=0)
    before, grown = np.zeros((size, n, count)), np.zeros(count)
    more = np.full(count, _FIRST)
    for _ in range(_RAMPED):
        left = np.flatnonzero((grown < 1.0) & (more >= _FINEST))
        if not len(left):
            break
        to = np.minimum(grown[left] + more[left], 1.0)
        many = np.tile(to, size)

        def part(columns: Array, known: Array) -> tuple[Array, Array]:
            which = known[-1]
            value, slope = function(columns, known[:-1])
            return value * which, slope * which

        guess = stages[..., left] + before[..., left] * (to - grown[left])
        known = np.vstack([given[:, _of(left, size, count)], many])
        found, sure, _ = solve_stages(scheme, part, x[:, left], guess, known, most=_SOON)
        went = left[sure]
        before[..., went] = (found[..., sure] - stages[..., went]) / (to[sure] - grown[went])
        stages[..., went], grown[went] = found[..., sure], to[sure]
        more[left] = np.where(sure, 2.0, 0.5) * more[left]
    stages[..., grown < 1.0] = np.nan
    return stages


@np.errstate(all="ignore")  # what does not arrive has no numbers
def solve_stages(
    scheme: Tableau, function: Function, x: Array, guess: Array, given: Array, *, most: int = _ITERATIONS
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Stage values (stages, n, K) of implicit steps from x (n, K), NaN for those where Newton's method does not arrive;
    whether each is the root that belongs to the guess; and the changes that the first iteration asked for.

    A step that goes across a corner (friction that begins to stick) is damped: where the residual is no smaller, half
    of what was asked for is taken (Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 3.1).
    """
    size, _, count = guess.shape
    found, first = np.full(guess.shape, np.nan), np.zeros(guess.shape)
    known = given.reshape(len(given), size, count)
    # of the steps that have not arrived: where they are, what was asked for there, and how far that is gone
    left = np.flatnonzero(np.isfinite(x).all(axis=0))
    stages = guess[..., left]
    base, change = stages, np.full(stages.shape, np.inf)
    norm, share = np.full(len(left), np.inf), np.ones(len(left))
    own, rest = x[:, left], known[..., left]
    for iteration in range(most):
        if not len(left):
            break
        ask(_CALL + size * len(left))
        asked, off = _asked(scheme, function, own, stages, rest)
        if not iteration:
            first[..., left] = asked
        moved = np.abs(asked)
        largest = np.abs(stages).max(axis=0) + np.abs(own)
        # What has decayed is known to the rounding of the states that it follows from: there it moves to and fro.
        rests = (moved >= 0.5 * np.abs(change)) & (moved <= ROUNDING * largest.max(axis=0))
        arrived = (rests | (moved <= SMALL * largest + 1e-30)).all(axis=(0, 1))
        found[..., left[arrived]] = (stages + asked)[..., arrived]
        nearer = off < (1 - _LESS * share) * norm
        if nearer.all():
            base, change, norm = stages, asked, off
            share = np.minimum(2 * share, 1.0)
        else:
            share = np.where(nearer, np.minimum(2 * share, 1.0), 0.5 * share)
            base, change, norm = (
                np.where(nearer, new, old) for new, old in ((stages, base), (asked, change), (off, norm))
            )
        on = ~arrived & (share > _LEAST)
        if not on.all():
            left, base, change, norm, share = left[on], base[..., on], change[..., on], norm[on], share[on]
            own, rest = own[:, on], rest[..., on]
        stages = base + share * change
    sure = np.isfinite(found).all(axis=(0, 1)) & np.isfinite(first).all(axis=(0, 1))
    # Newton and Kantorovich have the root within the length of the first change of where that leads, and nearer the
    # less the slopes bend; nothing there tells of a pole that was leapt over, on the other side of zero
    off = found - guess - first
    leapt = (found * guess < 0).any(axis=0) & (np.abs(off) > SEEN * np.abs(first)).any(axis=0)
    return found, sure & ~beyond(off, first, found, x) & ~leapt.any(axis=0), first


def beyond(way: Array, length: Array, stages: Array, x: Array) -> NDArray[np.bool_]:
    """Whether a way (stages, n, K) is, in one of the states, longer than a share of another."""
    size = np.abs(stages).max(axis=0) + np.abs(x)
    room = NEAR * np.abs(length).max(axis=0) + SEEN * size
    return np.asarray((np.abs(way).max(axis=0) > room).any(axis=0))


def _asked(scheme: Tableau, function: Function, x: Array, stages: Array, known: Array) -> tuple[Array, Array]:
    """The change (stages, n, K) that Newton's method asks for, NaN where it has none, and the norms (K,) of the
    residuals, infinite there."""
    size, n, count = stages.shape
    columns = stages.transpose(1, 0, 2).reshape(n, -1)
    value, slope = function(columns, known.reshape(len(known), size * count))
    value = value.reshape(n, size, count).transpose(1, 0, 2)
    residual = stages - x - (scheme.a @ value.reshape(size, n * count)).reshape(stages.shape)
    by_x = slope.reshape(n, n, size, count).transpose(2, 3, 1, 0)
    norm = np.sqrt(np.einsum("snk,snk->k", residual, residual))
    if np.isfinite(norm).all() and np.isfinite(slope).all():
        with suppress(np.linalg.LinAlgError):
            return newton_step(scheme, by_x, residual.transpose(0, 2, 1)).transpose(0, 2, 1), norm
    fine = np.isfinite(residual).all(axis=(0, 1)) & np.isfinite(by_x).all(axis=(0, 2, 3))
    asked = np.full(stages.shape, np.nan)
    try:
        made = newton_step(scheme, by_x[:, fine], residual[..., fine].transpose(0, 2, 1))
    except np.linalg.LinAlgError:
        return asked, np.full(count, np.inf)
    asked[..., fine] = made.transpose(0, 2, 1)
    return asked, np.where(fine, norm, np.inf)
