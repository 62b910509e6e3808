"""The equations of one experiment as a tape with its derivatives: states, free parameters, and what drives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import casadi as ca

from casadi_engine.errors import IdentifiabilityError
from casadi_engine.identifiability.tape import Lifted, Tape, lift
from casadi_engine.model import Model
from casadi_engine.model.lags import lagged, with_delays
from casadi_engine.parameters import ParameterMap, near_matches, parse_expression

STATES, FREE, DRIVEN, CLOCK, CONSTANTS = range(5)  # the arguments of the tape


@dataclass(frozen=True, eq=False)
class Equations:
    """ẋ = f(x, z, v, t), y = h(x, z, v, t) of a model with a parameter map put in.

    z : the free parameters, ties put in, fixed ones numbers
    v : what drives the model, named `driven`: its drives, and channels where a law, or a drive with a free
        parameter in it, takes them
    f : (n, 1) SX; h : name of an output, or of a state as a further sensor -> SX scalar
    reported : every parameter of the set as an expression of z
    opened : the drives that are written in channels, because a free parameter is in them
    """

    model: Model
    z: Any
    free: tuple[str, ...]
    v: Any
    driven: tuple[str, ...]
    f: Any
    h: Mapping[str, Any]
    reported: Mapping[str, Any]
    opened: tuple[str, ...] = ()
    _tapes: dict[tuple[tuple[str, ...], tuple[str, ...]], Derivatives] = field(default_factory=dict)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(variable.name for variable in self.model.states)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the outputs, and of the states that could be measured."""
        return tuple(self.h)

    def derivatives(self, outputs: Sequence[str], unknown: Sequence[str] = ()) -> Derivatives:
        """The tape of f, h and their Jacobians for these outputs and these unknown drives; made once."""
        key = (tuple(outputs), tuple(unknown))
        if key not in self._tapes:
            self._tapes[key] = self._make(*key)
        return self._tapes[key]

    @cached_property
    def _lifted(self) -> Lifted:
        names = self.states
        where = [[f"the ode of {name}" for name in names], [f"the output {name}" for name in self.h]]
        inputs = [self.model.x, self.z, self.v, self.model.t]
        return lift(inputs, [self.f, ca.vertcat(*self.h.values())], where=where)

    def _make(self, outputs: tuple[str, ...], unknown: tuple[str, ...]) -> Derivatives:
        lifted = self._lifted
        f, every = lifted.expressions
        order = list(self.h)
        rows = [order.index(name) for name in outputs]
        both = ca.vertcat(f, every[rows]) if rows else f
        w = self.v[[self.driven.index(name) for name in unknown]] if unknown else ca.SX(0, 1)
        jacobians = [ca.jacobian(both, column) for column in (self.model.x, self.z, w)]
        inputs = [self.model.x, self.z, self.v, self.model.t, lifted.constants]
        dense = ca.densify(both)
        function = ca.Function("derivatives", inputs, [dense, *jacobians])
        places = [
            list(zip(*map(list, function.sparsity_out(i + 1).get_triplet()), strict=True)) for i in range(3)
        ]
        return Derivatives(Tape(function), len(self.states), outputs, unknown, lifted.values, places)


@dataclass(frozen=True, eq=False)
class Derivatives:
    """The tape of [f; h] and its Jacobians by x, z and the unknown drives.

    places : for each Jacobian (row, column) of every structural nonzero, in the tape's order
    """

    tape: Tape
    states: int
    outputs: tuple[str, ...]
    unknown: tuple[str, ...]
    constants: tuple[Fraction, ...]
    places: Sequence[Sequence[tuple[int, int]]]


def equations_of(model: Model, parameters: ParameterMap, record: str) -> Equations:
    """Put laws, ties and fixed parameters into a model's equations.

    A drive whose expression has a free parameter in it is no known function of time: it is written in channels.
    """
    physical = parameters.physical[record]
    model = with_delays(lagged(model, {}), of_rates=False)  # nobody knows the rates of channels here
    moving = [i for i in range(model.p.numel()) if not physical[i].is_constant()]
    opened = [
        j
        for j in range(model.d.numel())
        if moving and ca.depends_on(model.drive_expressions[j], model.p[moving])
    ]
    h = ca.vertcat(model.output_expressions, model.x)
    both = ca.vertcat(model.ode, h)
    if model.w.numel():
        both = ca.substitute(both, model.w, model.slot_laws)
    if opened:
        both = ca.substitute(both, model.d[opened], model.drive_expressions[opened])
    both = ca.substitute(both, model.p, physical)
    if model.late and ca.depends_on(both, model.late_channels):
        raise IdentifiabilityError(
            "the exact test has no rule for an input that acts late",
            seen=", ".join(name for name, _ in model.late),
            allowed="outputs of states, channels and parameters",
            cure="test the model without the delay of that input, or ask fisher for its precision",
        )
    if ca.depends_on(both, model.channel_rates):
        raise IdentifiabilityError(
            "the exact test has no rule for the rate of a channel, which a delayed sensor shows",
            seen=", ".join(model.rates),
            allowed="outputs of states, channels and parameters",
            cure="test the model without the delay of that sensor, or ask fisher for its precision",
        )
    used = {symbol.element_hash() for symbol in ca.symvar(both)}
    driven: dict[str, Any] = {}
    for variables, column in ((model.drives, model.d), (model.inputs, model.u)):
        for row, variable in enumerate(variables):
            if column[row].element_hash() in used:
                # a drive that has a channel's name passes it on, and both may be in use
                driven.setdefault(variable.name, column[row])
                if driven[variable.name].element_hash() != column[row].element_hash():
                    both = ca.substitute(both, column[row], driven[variable.name])
    n = model.x.numel()
    sensors = {variable.name: both[n + row] for row, variable in enumerate(model.outputs)}
    for row, variable in enumerate(model.states):
        sensors.setdefault(variable.name, model.x[row])
    return Equations(
        model=model,
        z=parameters.z,
        free=parameters.free,
        v=ca.vertcat(*driven.values()) if driven else ca.SX(0, 1),
        driven=tuple(driven),
        f=both[:n],
        h=sensors,
        reported=dict(zip(parameters.reported, ca.vertsplit(parameters.reported_expressions), strict=True)),
        opened=tuple(model.drives[j].name for j in opened),
    )


def gradient_tape(equations: Equations, texts: Mapping[str, str]) -> tuple[Tape, tuple[Fraction, ...]]:
    """Values (len(texts), 1) and gradients by z (len(texts), nz) of expressions in parameter names.

    texts : what it is, for messages -> expression. ExpressionError for an unknown name or text outside the grammar.
    """
    made = ca.vertcat(*(parse_expression(text, equations.reported) for text in texts.values()))
    return _gradient_tape(equations, made, list(texts))


def _gradient_tape(
    equations: Equations, made: Any, where: Sequence[str]
) -> tuple[Tape, tuple[Fraction, ...]]:
    lifted = lift([equations.z], [made], where=[where])
    (expression,) = lifted.expressions
    jacobian = ca.densify(ca.jacobian(expression, equations.z))
    function = ca.Function("gradients", [equations.z, lifted.constants], [ca.densify(expression), jacobian])
    return Tape(function), lifted.values


def unknown_name(what: str, name: object, allowed: Sequence[str], cure: str) -> IdentifiabilityError:
    """The error for a name that the model does not have."""
    return IdentifiabilityError(what, seen=repr(name), allowed=near_matches(name, allowed), cure=cure)
