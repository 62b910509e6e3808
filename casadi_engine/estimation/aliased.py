"""Modes that are faster than the samples show them: a slower one, their alias, looks the same."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Fit

Array = NDArray[np.float64]

# Share of an amplitude that is left a sample later, of a mode that rings from sample to sample.
_RINGS = 0.3
# Relative change of a parameter at which modes are looked at again; share of it by which one moves that a parameter
# sets; relative error up to which a parameter is known, and that by this mode.
_STEP, _SETS, _KNOWN = 1e-3, 0.1, 0.2


def aliased(fit: Fit) -> tuple[str, ...]:
    """What to say of parameters that are known by a mode above half the sampling rate of every output; at the first
    states, and the inputs there."""
    if not fit.converged:
        return ()
    record = fit.data[0]
    times = [record[o.name].time for o in fit.model.outputs if o.name in record]
    steps = [np.median(np.diff(time)) for time in times if len(time) > 1]
    values = fit.values_for(record.name)
    here = _modes(fit, values)
    if not steps or here is None:
        return ()
    step = float(min(steps))
    for mode in here[(here.imag > np.pi / step) & (here.real * step > np.log(_RINGS))]:
        names = [name for name in fit.free if name in values and _is_set(fit, values, name, mode)]
        if names:
            hertz = float(mode.imag) / (2 * np.pi)
            other, who = abs(hertz - round(hertz * step) / step), " and ".join(names)
            return (
                f"a mode at {hertz:.4g} Hz, which {who} set{'s' * (len(names) == 1)}, is faster than half the sampling "
                f"rate of every output, {0.5 / step:.4g} Hz: samples show it at {other:.4g} Hz, and other values of "
                f"{who} with a mode there, or at another alias, may do as well: give bounds that exclude them, or "
                "sample faster",
            )
    return ()


def _is_set(fit: Fit, values: dict[str, float], name: str, mode: complex) -> bool:
    """True if a parameter sets a mode, and is known."""
    error, value = fit.estimates[name].stderr, values[name]
    if not error or not value or error > _KNOWN * abs(value):
        return False
    moved = _modes(fit, values | {name: value * (1 + _STEP)})
    if moved is None:
        return False
    nearest = moved[np.argmin(np.abs(moved - mode))]
    return bool(abs(nearest.imag - mode.imag) > _SETS * _STEP * mode.imag)


def _modes(fit: Fit, values: dict[str, float]) -> NDArray[np.complex128] | None:
    """Eigenvalues [1/s] at the first states of the first record; None where there are no numbers."""
    model, record = fit.model, fit.data[0]
    symbols = [model.x, model.u, model.t, model.p]
    jacobian = ca.Function("modes", symbols, [ca.densify(ca.jacobian(model.closed_ode, model.x))])
    x = [fit.initial[record.name][state.name].value for state in model.states]
    given = [record[i.name].values[0] if i.name in record else 0.0 for i in model.inputs]
    u = np.concatenate([given, np.zeros(int(model.u.numel()) - len(given))])
    matrix = np.asarray(jacobian(x, u, 0.0, [values[name] for name in model.parameter_names]), dtype=float)
    return np.asarray(np.linalg.eigvals(matrix)) if np.isfinite(matrix).all() else None
