"""Implicit steps one after the other, by CasADi's virtual machine: a fixed number of Newton's iterations for each.

A step whose stages have not arrived then says so, and whoever asked goes on from there with as many as it takes.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_engine.simulation.stage_slope import StageSlope
from casadi_engine.simulation.tableau import Tableau

# Change of Newton's method, relative to the state, after which the next would be below rounding.
SMALL = 1e-8
# Rounding of a stage, relative to the largest state: that of a linear system whose step spans 1e3 time constants.
ROUNDING = 1e-11
# Distance of a root from where the first iteration leads, in lengths of that iteration, up to which it is the one that
# belongs to where it began; and what is not looked at, as a share of the state.
NEAR, SEEN = 0.5, 0.01
# Iterations of the machine: between corners two or three suffice, and long steps take five.
_FIXED = 6


def newton_steps(slope: StageSlope, scheme: Tableau, count: int) -> ca.Function:
    """(x, known of the distinct nodes (rows, count), z (nz, count)) -> ends (n, count), stage values (S n, count), and
    whether the stages of each have arrived (1, count); what follows a step that has not is worth nothing. RuntimeError
    where a matrix is singular."""
    key = (f"newton {count}", scheme.name)
    if key not in slope.made:
        slope.made[key] = _step(slope, scheme).mapaccum(count)
    return slope.made[key]


def _step(slope: StageSlope, scheme: Tableau) -> ca.Function:
    n, size = slope.n, scheme.stages
    nodes = list(dict.fromkeys(scheme.c.tolist()))
    rows = int(slope.known_symbols.numel())
    x, z = ca.MX.sym("x", n), ca.MX.sym("z", slope.z.numel())
    known = ca.MX.sym("known", rows * len(nodes))
    system, judge = _system(slope, scheme, nodes), _judge(n, size)
    stages, before, arrived = ca.repmat(x, size, 1), ca.MX(np.full(n * size, np.inf)), ca.MX(0)
    first = ca.MX(np.full(n * size, np.nan))
    for iteration in range(_FIXED):
        matrix, residual, fine = system(x, stages, known, z)
        # what is not finite never arrives, whatever a solver makes of it
        change = ca.if_else(fine, -ca.solve(matrix, residual, "qr"), np.nan)
        first = first if iteration else change
        stages, before, arrived = judge(x, stages, change, before, arrived)
    arrived = ca.logic_and(arrived, _near(n, size)(x, stages, first))
    return ca.Function("newton_step", [x, known, z], [stages[-n:], stages, arrived])


def _near(n: int, size: int) -> ca.Function:
    """(x, stages, first change) -> whether the stages moved about as the first iteration asked for (`stage_newton`)."""
    x, stages, first = ca.SX.sym("x", n), ca.SX.sym("stages", n * size), ca.SX.sym("first", n * size)
    begun = ca.repmat(x, size, 1)
    off = ca.fabs(stages - begun - first)

    def largest(of: ca.SX) -> ca.SX:
        return ca.vertcat(*[ca.mmax(of[k::n]) for k in range(n)])

    room = NEAR * largest(ca.fabs(first)) + SEEN * (largest(ca.fabs(stages)) + ca.fabs(x))
    leapt = ca.logic_and(largest(stages * begun < 0), largest(off > SEEN * ca.fabs(first)))
    return ca.Function("near", [x, stages, first], [ca.sum1(ca.logic_or(largest(off) > room, leapt)) < 1])


def _system(slope: StageSlope, scheme: Tableau, nodes: list[float]) -> ca.Function:
    """(x, stages, known, z) -> matrix and residual of Newton's method, and whether all of them is finite."""
    n, size, rows = slope.n, scheme.stages, int(slope.known_symbols.numel())
    stages, known = ca.SX.sym("stages", n * size), ca.SX.sym("known", rows * len(nodes))
    by_x = ca.jacobian(slope.expression, slope.x)
    phi = ca.Function("phi", [slope.x, slope.known_symbols, slope.z], [slope.expression, by_x])
    values, slopes = [], []
    for i, c in enumerate(scheme.c.tolist()):
        place = nodes.index(c) * rows
        value, by_x = phi(stages[n * i : n * (i + 1)], known[place : place + rows], slope.z)
        values.append(value)
        slopes.append(by_x)
    weights = ca.kron(ca.DM(scheme.a), ca.DM.eye(n))
    residual = stages - ca.repmat(slope.x, size, 1) - weights @ ca.vertcat(*values)
    matrix = ca.SX.eye(n * size) - weights @ ca.diagcat(*slopes)
    matrix, residual = ca.densify(matrix), ca.densify(residual)
    fine = ca.sum1(ca.fabs(ca.vertcat(ca.vec(matrix), residual))) < np.inf
    return ca.Function("system", [slope.x, stages, known, slope.z], [matrix, residual, fine])


def _judge(n: int, size: int) -> ca.Function:
    """(x, stages, change, change before, arrived) -> the same of the last three after an iteration; what has arrived
    stays. What has decayed is known to the rounding of the states that it follows from, where it moves to and fro."""
    x, arrived = ca.SX.sym("x", n), ca.SX.sym("arrived")
    stages, change, before = (ca.SX.sym(name, n * size) for name in ("stages", "change", "before"))
    after, moved = stages + change, ca.fabs(change)
    own = ca.fabs(x) + ca.vertcat(*[ca.mmax(ca.fabs(after[k::n])) for k in range(n)])
    rests = ca.logic_and(moved >= 0.5 * before, moved <= ROUNDING * ca.mmax(own))
    small = moved <= SMALL * ca.repmat(own, size, 1) + 1e-30
    now = ca.sum1(ca.logic_or(rests, small)) >= n * size
    done = ca.logic_or(arrived, now)
    kept = ca.if_else(arrived, stages, after)
    return ca.Function("judge", [x, stages, change, before, arrived], [kept, moved, done])
