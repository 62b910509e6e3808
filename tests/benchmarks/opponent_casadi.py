"""Textbook multiple shooting in CasADi: symbols, `mapaccum`, `nlpsol` with IPOPT, every derivative by CasADi.

After CasADi's own example of system identification: the unknowns are the parameters and the state at every node;
within an interval `mapaccum` runs the exact first-order-hold step (worked out symbolically from the parameters, once
an evaluation), `map` runs all intervals, gaps are equality constraints. The Hessian is the Gauss-Newton one,
J'J, as in that example, or CasADi's exact Hessian of the Lagrangian.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from cases import Case, Record
from chain import Array

NODE = 20  # samples of a shooting interval
TERMS = 14
MOST_SECONDS = 120.0  # the caller may stop it before


def _hold(case: Case, scale: Array) -> ca.Function:
    """Scaled free values -> F, G, H of x⁺ = F x + G u + H u⁺ in scaled states; a series, with balanced states."""
    shape = case.shape
    values = ca.SX.sym("values", len(case.free))
    full = ca.DM(case.fixed) + ca.DM(case.spreading) @ values
    ww, wt, bw = shape.blocks(full, ca.diag)
    n, m = shape.states, shape.size
    a = ca.blockcat([[ww, wt], [ca.DM(shape.difference), ca.SX(n - m, n - m)]])
    x = a * ca.DM(case.step * scale / scale[:, None])
    b = ca.vertcat(bw, ca.SX(n - m, shape.inputs)) * ca.DM(
        np.tile(case.step / scale[:, None], (1, shape.inputs))
    )
    # The series as a chain of small functions: written out as scalars it would be a hundred thousand operations.
    block = ca.Function("block", [values], [x, b])
    s, xm = ca.MX.sym("s", n, n), ca.MX.sym("x", n, n)
    horner = {
        k: ca.Function(f"horner_{k}", [s, xm], [ca.DM.eye(n) + xm @ s / (k + 1)]) for k in range(1, TERMS + 1)
    }
    at = ca.MX.sym("values", len(case.free))
    x_at, b_at = block(at)
    ramp = ca.MX(ca.DM.eye(n))
    for k in range(TERMS, 1, -1):
        ramp = horner[k](ramp, x_at)
    ramp = 0.5 * ramp
    hold = ca.DM.eye(n) + x_at @ ramp
    late = ramp @ b_at
    return ca.Function("hold", [at], [ca.DM.eye(n) + x_at @ hold, hold @ b_at - late, late])


def _interval(case: Case) -> ca.Function:
    """Node, hold, inputs of an interval -> state after it, speeds at its samples."""
    n, m = case.shape.states, case.shape.inputs
    x, u = ca.MX.sym("x", n), ca.MX.sym("u", 2 * m)
    f, gh = ca.MX.sym("f", n, n), ca.MX.sym("gh", n, 2 * m)
    step = ca.Function("step", [x, u, f, gh], [f @ x + gh @ u])
    node, inputs = ca.MX.sym("node", n), ca.MX.sym("inputs", 2 * m, NODE)
    states = step.mapaccum("run", NODE)(node, inputs, ca.repmat(f, 1, NODE), ca.repmat(gh, 1, NODE))
    speeds = ca.horzcat(node[0], states[0, :-1]).T
    return ca.Function("interval", [node, inputs, f, gh], [states[:, -1], speeds])


def _cut(record: Record) -> tuple[Array, Array, Array]:
    """Inputs [u; u⁺] (2 m, N'), speeds and weights (N',) with N' a multiple of the interval."""
    count = -(-record.samples // NODE) * NODE
    fill = count - record.samples
    drives = np.pad(record.drives, ((0, 0), (0, fill + 1)), mode="edge")
    both = np.vstack([drives[:, :-1], drives[:, 1:]])
    weight = np.r_[np.ones(record.samples), np.zeros(fill)]
    return both, np.pad(record.speed, (0, fill), mode="edge"), weight


def fit(case: Case, start: Array, mark: Callable[[], None], hessian: str = "gauss-newton") -> dict[str, Any]:
    """As the other opponents. hessian : "gauss-newton" or "exact"."""
    shape = case.shape
    n, np_ = shape.states, len(case.free)
    scale = np.r_[np.ones(shape.size), np.full(n - shape.size, 1e-3)]
    hold, interval = _hold(case, scale), _interval(case)
    share = ca.MX.sym("share", np_)
    f, g, h = hold(share * ca.DM(start))
    gh = ca.horzcat(g, h)
    unknowns, first, residuals, gaps = [share], [np.ones(np_)], [], []
    for number, record in enumerate(case.records):
        both, speed, weight = _cut(record)
        count = speed.size // NODE
        nodes = ca.MX.sym(f"nodes_{number}", n, count)
        ends, found = interval.map(count)(nodes, ca.DM(both), ca.repmat(f, 1, count), ca.repmat(gh, 1, count))
        unknowns.append(ca.vec(nodes))
        residuals.append((ca.vec(found) - ca.DM(speed)) * ca.DM(weight / case.sigma))
        gaps.append(ca.vec(ends[:, :-1] - nodes[:, 1:]))
        guess = np.zeros((n, count))
        guess[: shape.size] = speed[::NODE]
        first.append(guess.T.ravel())
    if case.priors:
        index = [case.free.index(name) for name in case.priors]
        mean, deviation = np.array(list(case.priors.values())).T
        residuals.append(((share * ca.DM(start))[index] - ca.DM(mean)) / ca.DM(deviation))
    v, r, gap = ca.vertcat(*unknowns), ca.vertcat(*residuals), ca.vertcat(*gaps)
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 500, "max_cpu_time": MOST_SECONDS},
    }
    if hessian == "gauss-newton":
        j = ca.jacobian(r, v)
        multipliers, factor = ca.MX.sym("lam", gap.size1()), ca.MX.sym("sigma")
        options["hess_lag"] = ca.Function(
            "gauss_newton",
            [v, ca.MX.sym("p", 0, 1), factor, multipliers],
            [ca.triu(factor * j.T @ j)],
            ["x", "p", "lam_f", "lam_g"],
            ["hess_gamma_x_x"],
        )
    solver = ca.nlpsol("fit", "ipopt", {"x": v, "f": 0.5 * ca.sumsqr(r), "g": gap}, options)
    low, high = (bound / start for bound in case.bounds)
    free = np.full(v.size1() - np_, np.inf)
    mark()
    answer = solver(x0=np.concatenate(first), lbx=np.r_[low, -free], ubx=np.r_[high, free], lbg=0, ubg=0)
    stats = solver.stats()
    values = np.asarray(answer["x"]).ravel()[:np_] * start
    return {"values": values, "iterations": int(stats["iter_count"]), "words": str(stats["return_status"])}


exact = partial(fit, hessian="exact")
