"""Models with a smooth function of one signal in their equations, whose terms are parameters: at a port, of what its
signals say or of another state or input, between two ports, or in the place of a constant parameter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.elsewhere_families import DROP, SHOWN, drops_of, felt_by, shown_at_ports
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.random_families import TIME, Family, smooth_family, terms_at
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried
from casadi_engine.effects import Amplitude, Effect, Grid
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.model import Model, Port
from casadi_engine.model.attach import replaced, with_drive
from casadi_engine.model.declarations import Ports
from casadi_engine.parameters import Parameters
from casadi_engine.simulation.null_path import NullPath

# Kinds of ports at which something acts, or that may act otherwise than they say.
KINDS = ("inertia", "coupling", "internal", "input", "link", "pipe")
# Terms of a function.
TERMS = 20
# Values of a signal of which nothing is known yet.
_UNIT = np.array([0.0, 1.0])
# Factor of all terms, which is one: they are what is estimated.
_WHOLE = "whole"
# What stands in a parameter's law for the signal until the model has it.
_PLACE = "place"


class _Function(Effect):
    """A smooth function of a signal: cosines over the range that the records visit."""

    def __init__(self, port: Port, family: Family) -> None:
        self.name = f"function_of_{family.signal}"  # type: ignore[misc]
        self.attaches = (port.kind,)  # type: ignore[misc]
        self.amplitude = Amplitude(_WHOLE, unit=None)  # type: ignore[misc]
        terms = [f"c{k}" for k in range(len(family.variances))]
        own = [_PLACE] if port.kind == "parameter" else []  # whose law may not read a signal
        self.nuisance: Mapping[str, Grid] = MappingProxyType(  # type: ignore[misc]
            {name: Grid() for name in [*terms, *own]}
        )
        self._family = family

    def law(self, port: Any, p: Any, math: Any) -> Any:
        del math
        at = getattr(p, _PLACE) if _PLACE in self.nuisance else getattr(port, self._family.signal)
        terms = terms_at(self._family, at)
        return p.whole * sum((getattr(p, f"c{k}") * term for k, term in enumerate(terms)), 0.0)


@dataclass(frozen=True, eq=False)
class Setup:
    """A model with a function: its parameters, the names of the terms, and their prior standard deviations.

    each : True for one that is another one in every record
    """

    family: Family
    model: Model
    parameters: Parameters
    terms: tuple[str, ...]
    deviations: Array
    each: bool = False

    @property
    def at(self) -> tuple[str, str]:
        """Its port and its signal, by which it is known."""
        return self.family.port, f"{self.family.signal} of each record" if self.each else self.family.signal


def setups_at(refits: Refits, tried: Tried, port: Port) -> list[Setup]:
    """A function of every signal of a port at which something acts, over the range that the records visit.

    Its prior is as large as all that moves the states there, or as an input itself.
    """
    able = port.slot is not None or port.kind == "input" or port.ends
    if port.kind not in KINDS or not able or not port.signals:
        return []
    if port.kind == "input":
        values = _as_read(refits, port)
        if not _moves(values):
            return []
        family = smooth_family(port.name, next(iter(port.signals)), values, terms=TERMS)
        size = float(np.std(values))
        return [_attached(refits, tried, family, size)]
    first = smooth_family(port.name, next(iter(port.signals)), _UNIT, terms=TERMS)
    probe = _attached(refits, tried, first, 1.0)
    problem = RefitProblem(probe.model, refits.refitter.data, probe.parameters, levels=refits.path.levels)
    try:
        with np.errstate(all="ignore"):
            paths = problem.measured_paths(tried.arrived.values)
            size = _size(probe, paths)
            told = {"difference": port.signals["difference"]} if port.ends else port.signals
            visited = {name: _along(paths, own) for name, own in told.items()}
    except FAILURES:
        return []
    found = []
    for name, values in visited.items():
        if _moves(values) and math.isfinite(size):
            found.append(_attached(refits, tried, smooth_family(port.name, name, values, terms=TERMS), size))
    return found


def setups_elsewhere(refits: Refits, tried: Tried, family: Family) -> list[Setup]:
    """A function of a state, an input or time that is no signal of its port: at a parameter as large as its value, at a
    sensor as what it shows varies, at an input as that varies."""
    plain = refits.refitter.extended(tried.effects)
    known = {TIME: plain.t} | {u.name: plain.u[k] for k, u in enumerate(plain.inputs)}
    known |= {s.name: plain.x[k] for k, s in enumerate(plain.states)}
    if family.port not in plain.ports.names:
        return []
    port = plain.ports[family.port]
    known |= drops_of(plain, port) if family.signal.startswith(DROP) else {}
    known |= shown_at_ports(plain) if family.signal.startswith(SHOWN) else {}
    known |= felt_by(plain, port) if port.kind == "sensor" else {}
    if family.signal not in known:
        return []
    symbol = known[family.signal]
    constant = port.parameter in plain.parameter_names and _in_equations_alone(plain, port)
    if port.slot is None and port.kind not in ("sensor", "input") and not constant:
        return []
    seen = replace(port, signals={**port.signals, family.signal: symbol})
    model = replace(plain, ports=Ports([seen if one.name == port.name else one for one in plain.ports]))
    try:
        with np.errstate(all="ignore"):
            probe = _attached(
                refits, tried, smooth_family(port.name, family.signal, _UNIT, terms=TERMS), 1.0, model
            )
            problem = RefitProblem(
                probe.model, refits.refitter.data, probe.parameters, levels=refits.path.levels
            )
            paths = problem.measured_paths(tried.arrived.values)
            values = _along(paths, symbol)
            if port.kind == "sensor":
                name = port.name.removeprefix("sensor_")
                shown = [np.asarray(r[name].values)[r[name].mask] for r in refits.refitter.data if name in r]
                size = float(np.std(np.concatenate(shown)))
            elif port.kind == "input":
                size = float(np.std(_as_read(refits, port)))
            else:
                size = abs(probe.parameters[port.parameter].value) if port.parameter else _size(probe, paths)
    except FAILURES:
        return []
    if not (_moves(values) and math.isfinite(size) and size > 0):
        return []
    return [
        _attached(refits, tried, smooth_family(port.name, family.signal, values, terms=TERMS), size, model)
    ]


def _in_equations_alone(model: Model, port: Port) -> bool:
    """Whether no drive, which is made of inputs and time, has the parameter of a port."""
    symbol = model.p[model.parameter_names.index(port.parameter)]
    return not ca.depends_on(ca.vertcat(ca.SX(0, 1), model.drive_expressions, ca.SX(0)), symbol)


def _moves(values: Array) -> bool:
    return bool(np.ptp(values) > 1e-9 * max(float(np.abs(values).max()), 1e-300))


def _as_read(refits: Refits, port: Port) -> Array:
    """What an input says in all records."""
    name = port.name.removeprefix("input_")
    return np.concatenate([np.asarray(record[name].values, dtype=float) for record in refits.refitter.data])


def _attached(refits: Refits, tried: Tried, family: Family, size: float, model: Model | None = None) -> Setup:
    """The model with a function of such a size; model : with a port that knows its signal, where its own does not."""
    model = refits.refitter.extended(tried.effects) if model is None else model
    effect = _Function(model.ports[family.port], family)
    wider = model.with_effect(effect, at=family.port)
    if _PLACE in effect.nuisance:
        place = wider.p[wider.parameter_names.index(f"{family.port}.{effect.name}.{_PLACE}")]
        signal = model.ports[family.port].signals[family.signal]
        for k, one in enumerate(model.inputs):  # which the equations see as a drive
            if ca.depends_on(signal, model.u[k]):
                drive = ca.SX.sym(f"{family.port}_{family.signal}_{one.name}")
                wider = with_drive(wider, drive, model.u[k], family.name)
                signal = ca.substitute(signal, model.u[k], drive)
        wider = replaced(wider, place, signal)
    terms = tuple(f"{family.port}.{effect.name}.c{k}" for k in range(len(family.variances)))
    parameters = refits.refitter.parameters_of(model, tried.effects).unconstrained().extended(wider)
    parameters.fix(f"{family.port}.{effect.name}.{_WHOLE}", 1.0)
    if _PLACE in effect.nuisance:
        parameters.fix(f"{family.port}.{effect.name}.{_PLACE}", 0.0)
    deviations = size * np.sqrt(family.variances)
    for name, deviation in zip(terms, deviations, strict=True):
        parameters[name].set(0.0, min=None, max=None, prior=(0.0, float(deviation)))
    return Setup(family, wider, parameters, terms, deviations)


def _size(probe: Setup, paths: Sequence[NullPath]) -> float:
    """The amplitude at which what acts at a port moves some state as much as all does; inf where it moves none."""
    model = probe.model
    symbol = model.p[list(model.parameter_names).index(probe.terms[0])]
    pushes = ca.densify(ca.jacobian(model.closed_ode, symbol))
    size = math.inf
    for k in range(len(model.states)):
        gain = float(np.sqrt(np.mean(_along(paths, pushes[k]) ** 2)))
        moved = float(np.std(np.concatenate([path.slope[k] for path in paths])))
        if gain > 0 and moved > 0:
            size = min(size, moved / gain)
    return size


def _along(paths: Sequence[NullPath], expression: ca.SX) -> Array:
    """An expression along all records."""
    found = [path.function([expression])(*path.at_samples().arguments)[0][0] for path in paths]
    return np.concatenate(
        [np.broadcast_to(own, path.grid.time.shape) for own, path in zip(found, paths, strict=True)]
    )
