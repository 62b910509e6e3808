"""From a parameter set to the vector that is estimated: numbers, bounds, and CasADi expressions of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from casadi_engine.errors import ConstraintError, ParameterError, TieError
from casadi_engine.parameters.collection import Parameters
from casadi_engine.parameters.constraint import FrequencyConstraint
from casadi_engine.parameters.feasibility import check_feasible, check_priors
from casadi_engine.parameters.names import near_matches

Ties = Literal["substitute", "constraint"]


@dataclass(frozen=True, eq=False)
class CompiledConstraint:
    """min <= expression <= max with `expression` an SX scalar of z."""

    label: str
    expression: Any
    min: float
    max: float


@dataclass(frozen=True, eq=False)
class CompiledPrior:
    """A normal prior on `expression`, an SX scalar of z: the cost gains ((expression - mean) / sigma)**2."""

    label: str
    expression: Any
    mean: float
    sigma: float


@dataclass(frozen=True, eq=False)
class ParameterMap:
    """The estimated vector z and everything that follows from it.

    free : names of z (nz): the plain free parameters in the set's order, then ``name@record`` name by name,
        then, with ties="constraint", the tied ones that depend on a free one
    start, lower, upper : (nz,) in the parameters' units; lower <= start <= upper
    scale : (nz,) > 0, the magnitude of each entry: abs(start), or 1 at 0. No bound is a magnitude: a search asks the
        data for that of an entry that starts at 0
    z : SX (nz, 1)
    physical : record -> SX (np, 1), the model's parameters in model order as expressions of z
    reported : names of every parameter of the set, with ``name@record`` where it varies
    reported_expressions : SX (len(reported), 1) of z
    constraints : on expressions of z; with ties="constraint" the scaled tie equalities come last
    frequency_constraints : as in the set, for every record
    priors : of all parameters that are not constant
    """

    names: tuple[str, ...]
    records: tuple[str, ...]
    free: tuple[str, ...]
    start: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    scale: NDArray[np.float64]
    z: Any
    physical: Mapping[str, Any]
    reported: tuple[str, ...]
    reported_expressions: Any
    constraints: tuple[CompiledConstraint, ...] = ()
    frequency_constraints: tuple[FrequencyConstraint, ...] = ()
    priors: tuple[CompiledPrior, ...] = ()
    _functions: dict[str, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def _reported_function(self) -> Any:
        return ca.Function("reported", [self.z], [self.reported_expressions])

    def values(self, z: ArrayLike) -> dict[str, float]:
        """Name -> value of everything in `reported`, at `z` : (nz,)."""
        found = self._reported_function(self._vector(z)).full().ravel()
        return dict(zip(self.reported, found.tolist(), strict=True))

    def unpack(self, z: ArrayLike, record: str | None = None) -> NDArray[np.float64]:
        """The model's parameters (np,) of `record` at `z` : (nz,); the first record if none is named.

        Raises ParameterError for an unknown record or a vector of another length.
        """
        key = self.records[0] if record is None else record
        if key not in self.physical:
            raise ParameterError(
                "unknown record",
                seen=repr(record),
                allowed=near_matches(record, self.records),
                cure="use a record that the parameters were compiled for",
            )
        function = self._functions.get(key)
        if function is None:
            function = self._functions[key] = ca.Function("physical", [self.z], [self.physical[key]])
        found: NDArray[np.float64] = function(self._vector(z)).full().ravel()
        return found

    def _vector(self, z: ArrayLike) -> NDArray[np.float64]:
        vector = np.asarray(z, dtype=float).reshape(-1)
        if vector.size != len(self.free):
            raise ParameterError(
                "the vector of free parameters has the wrong length",
                seen=f"{vector.size} numbers",
                allowed=f"{len(self.free)}: {', '.join(self.free)}",
                cure="give one number for each name of .free, in its order",
            )
        return vector


def compile(
    parameters: Parameters,
    names: Sequence[str],
    records: Sequence[str] = ("",),
    *,
    ties: Ties = "substitute",
) -> ParameterMap:
    """Map a parameter set to the vector z of an estimation.

    parameters : the set; it may hold more than the model's parameters (auxiliary ones)
    names : (np,) the model's parameter names in model order
    records : keys of the records; a parameter that varies by experiment becomes ``name@record``, or keeps
        its name for a single record ""
    ties : "substitute" removes tied parameters from z; "constraint" keeps those that depend on a free one
        in z and adds an equality for each, in units of the tied parameter's magnitude

    Raises ParameterError for unknown names, for free parameters that nothing depends on and for a prior outside the
    bounds, TieError for a tie without a finite value, and ConstraintError for a constraint that cannot be met: on fixed
    parameters alone, or, if all parts are linear, within the bounds.
    """
    _check_arguments(parameters, names, records, ties)
    layout = _Layout(parameters, names, tuple(records), ties)
    expanded = {record: layout.everything(record) for record in layout.distinct}
    index = {name: position for position, name in enumerate(parameters)}
    rows = [index[name] for name in names]
    # records without values of their own share one expression: what is made from it can be shared too
    shared = {record: source[rows] if rows else ca.SX(0, 1) for record, source in expanded.items()}
    physical = {record: shared.get(record, shared[layout.distinct[0]]) for record in layout.records}
    reported: list[str] = []
    expressions: list[Any] = []
    for name, position in index.items():
        for record in layout.records_of((name,)):
            reported.append(_at(name, record) if name in layout.varying else name)
            expressions.append(expanded[record][position])
    bounds, priors = _bounds_and_priors(layout, dict(zip(reported, expressions, strict=True)))
    start, lower, upper, scale = layout.numbers()
    equalities = _tie_equalities(layout, scale)
    constraints = (*_user_constraints(layout, expanded), *bounds, *equalities)
    z = layout.z
    check_feasible(z, constraints, start, lower, upper)
    check_priors(z, priors, lower, upper)
    return ParameterMap(
        names=tuple(names),
        records=layout.records,
        free=tuple(layout.free),
        start=start,
        lower=lower,
        upper=upper,
        scale=scale,
        z=z,
        physical=MappingProxyType(physical),
        reported=tuple(reported),
        reported_expressions=ca.vertcat(*expressions) if expressions else ca.SX(0, 1),
        constraints=constraints,
        frequency_constraints=parameters.frequency_constraints,
        priors=priors,
    )


class _Layout:
    """Which parameter sits where in z, and the expression of every parameter for a record."""

    def __init__(self, parameters: Parameters, names: Sequence[str], records: tuple[str, ...], ties: Ties):
        self.parameters, self.records = parameters, records
        self.values = parameters.as_dict()
        closure = {name: parameters.references((name,)) for name in parameters}
        plain = {name for name, parameter in parameters.items() if parameter.vary}
        own = {name for name in parameters if parameters[name].varies_by_experiment}
        # the tied ones move, and vary by experiment, with what they refer to
        self.moving = {name for name in parameters if not (plain | own).isdisjoint(closure[name])}
        self.varying = {name for name in parameters if not own.isdisjoint(closure[name])}
        self._check_used(names, plain, closure)
        self.distinct = records if self.varying else records[:1]
        self.order = parameters.tied_in_order()
        self.kept = [name for name in self.order if ties == "constraint" and name in self.moving]
        # entry of z -> (name, record): the plain ones, those of each record, the tied ones
        self.free: dict[str, tuple[str, str]] = {}
        for group in (
            [name for name in parameters if name in plain - own],
            [name for name in parameters if name in plain & own],
            self.kept,
        ):
            for name in group:
                for record in self.records_of((name,)):
                    self.free[_at(name, record) if name in self.varying else name] = (name, record)
        self.entries = {entry: ca.SX.sym(entry) for entry in self.free}
        self.z = ca.vertcat(*self.entries.values()) if self.entries else ca.SX(0, 1)
        self.symbols = ca.vertcat(*parameters._symbols.values())
        self.found: dict[str, dict[str, Any]] = {}  # record -> name -> expression of z or number

    def records_of(self, names: Iterable[str]) -> tuple[str, ...]:
        """The records that have to be told apart for something that refers to `names`."""
        return self.records if not self.varying.isdisjoint(names) else self.records[:1]

    def everything(self, record: str) -> Any:
        """SX (number of parameters, 1): every parameter of the set in its order, as expressions of z."""
        found: dict[str, Any] = {}
        for name in self.parameters:
            entry = _at(name, record) if name in self.varying else name
            found[name] = self.entries.get(entry, self.value_in(name, record))
        for name in self.order:
            if name in self.moving and name not in self.kept:
                found[name] = self.tie_of(name, found)
        self.found[record] = found
        return ca.SX(ca.vertcat(*found.values()))

    def value_in(self, name: str, record: str) -> float:
        """The number of a parameter in a record."""
        return self.parameters[name].in_record(record)[0] if name in self.varying else self.values[name]

    def tie_of(self, name: str, found: Mapping[str, Any]) -> Any:
        """A tie as an expression of z, from the expressions or numbers of the names that it refers to."""
        references = self.parameters._references[name]
        symbols = ca.vertcat(*(self.parameters._symbols[reference] for reference in references))
        values = ca.vertcat(*(found[reference] for reference in references))
        return ca.substitute(self.parameters._ties[name], symbols, values)

    def numbers(self) -> tuple[NDArray[np.float64], ...]:
        """start, lower, upper, scale, each (nz,)."""
        members = [self.parameters[name].in_record(record) for name, record in self.free.values()]
        start, lower, upper = np.array(members, dtype=float).reshape(-1, 3).T.copy()
        start = np.clip(start, lower, upper)  # a tied one's start may be outside its bounds
        scale = np.where(start != 0, np.abs(start), 1.0)
        for array in (start, lower, upper, scale):
            array.setflags(write=False)
        return start, lower, upper, scale

    def _check_used(self, names: Sequence[str], plain: set[str], closure: Mapping[str, set[str]]) -> None:
        """Refuse a free parameter without any effect: its column in the fit would be zero."""
        roots = [*names, *(name for constraint in self.parameters.constraints for name in constraint.names)]
        roots += [name for name, parameter in self.parameters.items() if parameter.prior is not None]
        used = set().union(*(closure[name] for name in roots)) if roots else set()
        idle = [name for name in self.parameters if name in plain - used]
        if idle:
            raise ParameterError(
                "free parameters without effect: neither the model nor a tie uses them",
                seen=", ".join(idle),
                allowed="free parameters that the model, a constraint or a prior depends on",
                cure=f'fix("{idle[0]}"), or tie a parameter of the model to it',
            )


def _at(name: str, record: str) -> str:
    """The name of a record's own parameter; plain for a single record without a name."""
    return f"{name}@{record}" if record else name


def _user_constraints(layout: _Layout, expanded: Mapping[str, Any]) -> list[CompiledConstraint]:
    given = layout.parameters.constraints
    if not given:
        return []
    stacked = ca.vertcat(*(constraint.expression for constraint in given))
    found = {record: ca.substitute(stacked, layout.symbols, all_) for record, all_ in expanded.items()}
    compiled = []
    for position, constraint in enumerate(given):
        records = layout.records_of(constraint.names)
        for record in records:
            label = _at(constraint.label, record) if len(records) > 1 else constraint.label
            expression = found[record][position]
            one = CompiledConstraint(label, expression, constraint.min, constraint.max)
            if not _settled(one, "free one of its parameters, or change the bounds"):
                compiled.append(one)
    return compiled


def _bounds_and_priors(
    layout: _Layout, reported: Mapping[str, Any]
) -> tuple[list[CompiledConstraint], tuple[CompiledPrior, ...]]:
    """The bounds of tied parameters that are not entries of z, where those of z do not imply them, and all priors."""
    bounds: list[CompiledConstraint] = []
    priors: list[CompiledPrior] = []
    for name, parameter in layout.parameters.items():
        bounded = parameter.tie is not None and (math.isfinite(parameter.min) or math.isfinite(parameter.max))
        if not bounded and parameter.prior is None:
            continue
        for record in layout.records_of((name,)):
            entry = _at(name, record) if name in layout.varying else name
            expression = reported[entry]
            if bounded and entry not in layout.entries:
                one = CompiledConstraint(f"{entry} (tied)", expression, parameter.min, parameter.max)
                if not _settled(one, f"change what {name} is tied to, or its bounds") and not _implied(
                    one, layout
                ):
                    bounds.append(one)
            if parameter.prior is not None and not expression.is_constant():
                priors.append(CompiledPrior(entry, expression, *parameter.prior))
    return bounds, tuple(priors)


def _implied(one: CompiledConstraint, layout: _Layout) -> bool:
    """True if an affine constraint is met wherever the entries of z are within their bounds."""
    slope = ca.densify(ca.jacobian(one.expression, layout.z))
    if not slope.is_constant():
        return False
    _, low, high, _ = layout.numbers()
    factor = np.array(ca.DM(slope)).ravel()
    used = factor != 0
    first = float(ca.DM(ca.substitute(one.expression, layout.z, ca.SX.zeros(layout.z.numel()))))
    ends = np.sort(factor[used] * np.array([low[used], high[used]]), axis=0).sum(axis=1) + first
    slack = 1e-9 * np.where(np.isfinite(ends), np.abs(ends), 0.0)
    return bool(ends[0] >= one.min - slack[0] and ends[1] <= one.max + slack[1])


def _settled(constraint: CompiledConstraint, cure: str) -> bool:
    """True if the constraint is on numbers alone and met; ConstraintError if it is not met."""
    if not constraint.expression.is_constant():
        return False
    value = float(constraint.expression)
    slack = 1e-9 * max(abs(value), *(abs(b) for b in (constraint.min, constraint.max) if math.isfinite(b)))
    if constraint.min - slack <= value <= constraint.max + slack:
        return True
    raise ConstraintError(
        f"the constraint {constraint.label} cannot be met, for all its parameters are fixed",
        seen=f"{value:.6g}",
        allowed=f"{constraint.min:.6g} to {constraint.max:.6g}",
        cure=cure,
    )


def _tie_equalities(layout: _Layout, scale: NDArray[np.float64]) -> list[CompiledConstraint]:
    """(tied - tie) / magnitude == 0 for every tied parameter that is an entry of z."""
    magnitude = dict(zip(layout.free, scale.tolist(), strict=True))
    found = []
    for name in layout.kept:
        for record in layout.records_of((name,)):
            entry = _at(name, record) if name in layout.varying else name
            rest = layout.entries[entry] - layout.tie_of(name, layout.found[record])
            label = f"{entry} == {layout.parameters[name].tie}"
            found.append(CompiledConstraint(label, rest / magnitude[entry], 0.0, 0.0))
    return found


def _check_arguments(
    parameters: Parameters, names: Sequence[str], records: Sequence[str], ties: object
) -> None:
    for name in names:
        parameters[name]  # raises with near matches
    if isinstance(records, str) or not records or len(set(records)) < len(records):
        raise ParameterError(
            "the records that parameters are compiled for are not acceptable",
            seen=repr(records),
            allowed="at least one name, each once",
            cure="give a tuple of different record names",
        )
    if not isinstance(ties, str) or ties not in ("substitute", "constraint"):
        raise ParameterError(
            "unknown treatment of ties",
            seen=repr(ties),
            allowed="substitute or constraint",
            cure="give one of the two",
        )
    values = parameters.as_dict()
    for name in parameters:
        if not math.isfinite(values[name]):
            raise TieError(
                f"the tie of {name} gives no finite number at the start values",
                seen=f"{name} == {parameters[name].tie} = {values[name]}",
                allowed="a finite number",
                cure="change the start values, or the expression",
            )
