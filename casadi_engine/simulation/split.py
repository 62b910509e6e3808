"""A model split for the exponential integrator: a linear core, and the laws that no linear core can hold.

Laws that are affine in the states with constant factors (a viscous damper, an absorber) join the core, and laws that
depend on channels alone (a misfire, a torque ripple) become drives: what is left of many effects is a linear model.
What depends on time itself is no drive: between two samples it is not the straight line through them, but known; it
is a law, which the integrator evaluates where it needs it. The other way round, an equation that is not affine (an
effect's own state with a nonlinear rate) keeps its linear part in the core and gives the rest to a slot of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from casadi_engine.model import Model
from casadi_engine.model.declarations import Variable
from casadi_engine.model.linear import LinearCore
from casadi_engine.model.linearity import affine_parts, is_affine

# Own slots for more than this share of the equations: then there is no linear core worth the name.
_MOST_OWN = 0.5


@dataclass(frozen=True, eq=False)
class Split:
    """model : with affine and known laws moved into its ode and drives, slots only where a law is left;
    laws : (nw, 1) SX in (x, u, t, p) of the slots left, all of them dependent on the states."""

    model: Model
    core: LinearCore
    laws: ca.SX


@lru_cache(maxsize=64)
def split(model: Model) -> Split | None:
    """The split of a model, or None for a model without a useful linear core."""
    model = _timed_drives_as_laws(model)
    if model.linear is None:
        read = _known_outputs(model)
        own = None if read is None else _own_slots(read)
        if own is None:
            return None
        model = own
    model = _without_simple_laws(model)
    core = model.linear
    # An output that shows a law's torque at once (a delayed sensor) is evaluated beside the states: see ``observed``.
    if core is None or not core.H.is_zero():
        return None
    return Split(model, core, _closed(model, model.slot_laws))


def _closed(model: Model, laws: ca.SX) -> ca.SX:
    """Laws with the drives put in: in (x, u, t, p)."""
    return ca.substitute(laws, model.d, model.drive_expressions) if model.d.numel() else laws


def _is_affine(model: Model, row: ca.SX) -> bool:
    """True if ``row`` is affine in states, drives and slots with factors of parameters alone."""
    return is_affine(row, ca.vertcat(model.x, model.d, model.w), ca.vertcat(model.u, model.t))


def _known_outputs(model: Model) -> Model | None:
    """The model with drives in place of what its outputs show of channels and time; None if that is not all."""
    inside = ca.vertcat(model.x, model.w)
    outputs, drives = ca.SX(model.output_expressions), []
    for row in range(int(outputs.numel())):
        if _is_affine(model, outputs[row]):
            continue
        parts = affine_parts(outputs[row], inside, ca.vertcat(model.u, model.d, model.t))
        if parts is None:
            return None
        slope, rest = parts
        drive = ca.SX.sym(f"shown_{model.outputs[row].name}")
        drives.append((drive, _closed(model, rest)))
        outputs[row] = slope @ inside + drive
    return replace(_with_drives(model, drives), output_expressions=outputs) if drives else model


def _with_drives(model: Model, drives: list[tuple[ca.SX, ca.SX]]) -> Model:
    """The model with more drives behind its own: symbol and expression of each."""
    return replace(
        model,
        d=ca.vertcat(model.d, *[drive for drive, _ in drives]),
        drives=(*model.drives, *(Variable(drive.name()) for drive, _ in drives)),
        drive_expressions=ca.vertcat(model.drive_expressions, *[value for _, value in drives]),
    )


def timed_drives(model: Model) -> list[int]:
    """Numbers of the drives that depend on time itself."""
    return [j for j in range(model.d.numel()) if ca.depends_on(model.drive_expressions[j], model.t)]


def _timed_drives_as_laws(model: Model) -> Model:
    """The model with slots in its ode for drives that depend on time itself; outputs show these drives still."""
    timed = [j for j in timed_drives(model) if ca.depends_on(model.ode, model.d[j])]
    if not timed:
        return model
    slots = ca.vertcat(*[ca.SX.sym(f"w_{model.drives[j].name}") for j in timed])
    drives = ca.vertcat(*[model.d[j] for j in timed])
    laws = ca.vertcat(model.slot_laws, *[model.drive_expressions[j] for j in timed])
    ode = ca.substitute(model.ode, drives, slots)
    return replace(model, ode=ode, w=ca.vertcat(model.w, slots), laws=laws)


def _own_slots(model: Model) -> Model | None:
    """The model with a slot of its own for every equation that is not affine."""
    n = int(model.x.numel())
    bent = [row for row in range(n) if not _is_affine(model, model.ode[row])]
    if len(bent) >= _MOST_OWN * n:
        return None
    closed = model.closed_ode
    slots = ca.vertcat(*[ca.SX.sym(f"w_{model.states[row].name}") for row in bent])
    ode, laws = ca.SX(model.ode), []
    zero = [ca.SX.zeros(s.numel(), 1) for s in (model.x, model.d, model.w, model.t)]
    symbols = [model.x, model.d, model.w, model.t]
    for k, row in enumerate(bent):
        slope = ca.substitute([ca.jacobian(model.ode[row], model.x)], symbols, zero)[0]
        held = slope @ model.x if _finite(model, slope) else ca.SX(0)
        ode[row] = held + slots[k]
        laws.append(closed[row] - held)
    return replace(model, ode=ode, w=ca.vertcat(model.w, slots), laws=ca.vertcat(model.slot_laws, *laws))


def _finite(model: Model, row: ca.SX) -> bool:
    """True if the linear part of an equation is a number at the parameters' defaults, and so are its slopes by them; a
    square root's is not, and exp(-E/T) has none by E where T is zero."""
    parts = [ca.densify(part) for part in (row, ca.jacobian(row, model.p))]
    found = ca.Function("at", [model.p], parts)(model.parameter_vector())
    return all(np.isfinite(np.array(part)).all() for part in found)


def _without_simple_laws(model: Model) -> Model:
    """Affine laws put into the ode, known ones made drives; the slots that are left hold the other laws."""
    laws = ca.SX(model.slot_laws)
    count = int(model.w.numel())
    known = ca.vertcat(model.u, model.d, model.t)
    put, kept, drives = ca.SX(model.w), [], []
    for row in range(count):
        law = laws[row]
        if law.is_zero():
            put[row] = 0
            continue
        parts = affine_parts(law, model.x, known)
        if parts is None:
            kept.append(row)
            continue
        slope, rest = parts
        closed = _closed(model, rest)
        if ca.depends_on(closed, model.t):
            kept.append(row)
            laws[row], put[row] = rest, slope @ model.x + model.w[row]
        elif known.numel() and ca.depends_on(rest, known):
            drive = ca.SX.sym(f"known_{row}")
            drives.append((drive, closed))
            put[row] = slope @ model.x + drive
        else:
            put[row] = slope @ model.x + rest
    if not count:
        return model
    left = ca.vertcat(*[model.w[row] for row in kept]) if kept else ca.SX(0, 1)
    wider = _with_drives(model, drives)
    return replace(
        wider,
        ode=ca.substitute(model.ode, model.w, ca.densify(put)),
        output_expressions=ca.substitute(model.output_expressions, model.w, ca.densify(put)),
        w=left,
        laws=ca.vertcat(*[laws[row] for row in kept]) if kept else ca.SX(0, 1),
    )
