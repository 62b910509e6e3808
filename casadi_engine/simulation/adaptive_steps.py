"""One step of the integrators that follow the error, as CasADi functions of a field held between events."""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_engine.simulation.jets import Array


def dormand_prince(field: ca.Function) -> ca.Function:
    """(x, t, h, segment, b, c) -> (end, its errors of order 5 and 3, α at the end, those errors of the switches, the
    switches' rates at both ends, the switches there, and α at the beginning)."""
    from scipy.integrate import DOP853

    x, t, h = ca.SX.sym("x", field.size1_in(0)), ca.SX.sym("t"), ca.SX.sym("h")
    rest = [ca.SX.sym(name, field.size1_in(k)) for k, name in ((2, "segment"), (3, "b"), (4, "c"))]
    slopes: list[tuple[ca.SX, ca.SX]] = []
    for row, node in zip(DOP853.A, DOP853.C, strict=True):
        inner = x
        for weight, (slope, _) in zip(row, slopes, strict=False):
            if weight:
                inner = inner + h * weight * slope
        rate, alpha, passing, g = field(inner, t + node * h, *rest)
        if not slopes:
            begin, first = g, alpha
        slopes.append((rate, passing))
    end = x
    for weight, (slope, _) in zip(DOP853.B, slopes, strict=True):
        if weight:
            end = end + h * weight * slope
    last, share, last_rate, g = field(end, t + h, *rest)
    slopes.append((last, last_rate))
    errors = []
    for part in (0, 1):
        for weights in (DOP853.E5, DOP853.E3):
            error = ca.SX.zeros(slopes[0][part].shape)
            for weight, pair in zip(weights, slopes, strict=True):
                if weight:
                    error = error + h * weight * pair[part]
            errors.append(error)
    found = [end, *errors[:2], share, *errors[2:], slopes[0][1], last_rate, begin, g, first]
    return ca.Function("step", [x, t, h, *rest], found)


def error_norm(fifth: Array, third: Array) -> float:
    """The scheme's error in units of what is allowed, from its errors of order 5 and 3 in these units."""
    five, three = float(fifth @ fifth), float(third @ third)
    return five / float(np.sqrt((five + 0.01 * three) * len(fifth))) if five else 0.0 if five == 0 else np.nan


def error_norms(fifth: Array, third: Array) -> Array:
    """The same (K,) of K steps, errors (K, size)."""
    five, three = (fifth**2).sum(axis=1), (third**2).sum(axis=1)
    whole = np.sqrt((five + 0.01 * three) * fifth.shape[1])
    return np.where(five == 0, 0.0, five / np.where(five == 0, 1.0, whole))


def cvodes(field: ca.Function, tolerance: float, at: Array | None = None) -> ca.Function:
    """(x0 / scale, p = [t, h, segment, b, c, scale]) -> the states at t + h s for s in ``at`` (None: 1), by CVODES."""
    n = field.size1_in(0)
    z, s, t, h = ca.SX.sym("z", n), ca.SX.sym("s"), ca.SX.sym("t"), ca.SX.sym("h")
    rest = [ca.SX.sym(name, field.size1_in(k)) for k, name in ((2, "segment"), (3, "b"), (4, "c"))]
    scale = ca.SX.sym("scale", n)
    rate = h * field(z * scale, t + h * s, *rest)[0] / scale
    options = {
        "reltol": tolerance, "abstol": 1e-3 * tolerance, "max_num_steps": 200_000, "show_eval_warnings": False,
        "disable_internal_warnings": True,  # what fails is a named error
    }  # fmt: skip
    problem = {"x": z, "t": s, "p": ca.vertcat(t, h, *rest, scale), "ode": rate}
    return ca.integrator("stiff", "cvodes", problem, 0.0, 1.0 if at is None else at.tolist(), options)
