"""The Model: symbolic equations of motion with named variables, parameters and ports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.effects.protocol import Attachment
from casadi_engine.errors import ModelError
from casadi_engine.model import sheets
from casadi_engine.model.attach import attach
from casadi_engine.model.corners import Corner
from casadi_engine.model.declarations import ParameterDeclaration, Ports, Variable
from casadi_engine.model.jumps import Switch, has_jumps, jumps
from casadi_engine.model.linear import LinearCore, linear_core
from casadi_engine.model.modes import Modes, displacement_states, is_geometric, modes_of
from casadi_engine.parameters import Parameters, near_matches


@dataclass(frozen=True, eq=False)
class Model:
    """Continuous-time equations ẋ = f(x, d, w, t, p), y = g(x, d, p), made by `Blueprint` or a builder.

    Symbols (CasADi SX columns, in the order of the name tuples):
    x : (n, 1) states           u : (nu, 1) input channels in the units declared, then the rates
        of those named in `rates`
    d : (m, 1) drives, the torques made of the channels        p : (np, 1) parameters
    w : (nw, 1) slot torques [N m], one for each port that can take one        t : (1, 1) time [s]
    Expressions:
    ode : (n, 1) in (x, d, w, t, p)             drive_expressions : (m, 1) in (u, t, p)
    laws : (nw, 1) in (x, w, u, d, t, p); `slot_laws` is the same with w eliminated, zero where no law acts
    output_expressions : (ny, 1) in (x, d, p); with effects at sensors also in (w, u, t)
    effects : the effects that were added by `with_effect`
    rates : names of the channels that an output shows at once; the output's own rate needs theirs
    time_unit : in which the blueprint's odes were written, and in which times are told; all else runs in s
    corners : jumps of the equations that were rounded, see `with_rounded_jumps`
    lags : output -> seconds by which the times of its samples are read earlier, for a sensor that is late; its delay
        enters the equations less these
    late : (input, lag) [s] of inputs that act late, whose values before by about the lag are the last entries of u
    """

    name: str
    description: str
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    drives: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    declarations: tuple[ParameterDeclaration, ...]
    ports: Ports
    x: Any
    u: Any
    d: Any
    w: Any
    t: Any
    p: Any
    ode: Any
    drive_expressions: Any
    laws: Any
    output_expressions: Any
    effects: tuple[Attachment, ...] = ()
    rates: tuple[str, ...] = ()
    time_unit: str = "s"
    corners: tuple[Corner, ...] = ()
    lags: tuple[tuple[str, float], ...] = ()
    late: tuple[tuple[str, float], ...] = ()

    @property
    def channels(self) -> Any:
        """SX column of the input channels: u without rates and late values."""
        return self.u[: len(self.inputs)]

    @property
    def channel_rates(self) -> Any:
        """SX column of the channels' rates, in the order of `rates`."""
        return self._part(len(self.inputs), len(self.rates))

    @property
    def late_channels(self) -> Any:
        """SX column of what late inputs were, a line over their delay each, in the order of `late`."""
        return self._part(len(self.inputs) + len(self.rates), 2 * len(self.late))

    def _part(self, first: int, count: int) -> Any:
        """Entries of u, (0, 1) without any."""
        return ca.vertcat(ca.SX(0, 1), *[self.u[k] for k in range(first, first + count)])

    # ---- names and parameters

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of p."""
        return tuple(declaration.name for declaration in self.declarations)

    def parameters(self) -> Parameters:
        """Return a fresh, changeable set of the model's parameters at their defaults."""
        return Parameters(declaration.parameter() for declaration in self.declarations)

    def parameter_vector(self, parameters: Parameters | Mapping[str, float] | None = None) -> np.ndarray:
        """Return the numbers of p, (np,) in model order and SI units.

        parameters : a set that holds all of the model's names; or a mapping with numbers for some of them,
            the others at their defaults; or None for all defaults.
        Raises ModelError for a missing or unknown name, and for a value that is no finite number.
        """
        values = {declaration.name: declaration.value for declaration in self.declarations}
        if isinstance(parameters, Parameters):
            given = parameters.as_dict()
            missing = [name for name in values if name not in given]
            if missing:
                raise ModelError(
                    f"the parameter set lacks parameters of the model {self.name}",
                    seen=f"without {', '.join(missing)}",
                    allowed=f"a set with {', '.join(values)}",
                    cure="start from model.parameters(), or parameters.extended(model)",
                )
            values = {name: given[name] for name in values}
        elif parameters is not None:
            if not isinstance(parameters, Mapping):
                raise ModelError(
                    "the parameters are of the wrong kind",
                    seen=type(parameters).__name__,
                    allowed="Parameters, a mapping of names to numbers, or None",
                    cure='write {"' + next(iter(values), "J") + '": 0.4}, for instance',
                )
            for name, value in parameters.items():
                if name not in values:
                    raise ModelError(
                        f"the model {self.name} has no such parameter",
                        seen=repr(name),
                        allowed=near_matches(name, values),
                        cure="print(model.table()) lists them",
                    )
                values[name] = _finite(name, value)
        return np.array(list(values.values()), dtype=float)

    # ---- equations

    @cached_property
    def linear(self) -> LinearCore | None:
        """The linear core, or None for a general model."""
        return linear_core(self)

    @cached_property
    def slot_laws(self) -> Any:
        """(nw, 1) SX in (x, u, d, t, p): the torque that acts in each slot."""
        laws = self.laws
        for _ in range(self.w.numel()):
            if not ca.depends_on(laws, self.w):
                break
            laws = ca.substitute(laws, self.w, laws)
        return laws

    @cached_property
    def shared_drives(self) -> Any:
        """The drive expressions with what stands in them several times (a sine of the crank angle) as one node."""
        return ca.cse(self.drive_expressions)

    @property
    def has_slot_laws(self) -> bool:
        """True if a law acts in any slot: then the model is its linear core plus nonlinear torques."""
        return not self.laws.is_zero()

    @cached_property
    def closed_ode(self) -> Any:
        """(n, 1) SX f(x, u, t, p): the ode with laws and drives put in."""
        with_laws = ca.substitute(self.ode, self.w, self.slot_laws) if self.w.numel() else self.ode
        return ca.substitute(with_laws, self.d, self.drive_expressions) if self.d.numel() else with_laws

    @cached_property
    def closed_outputs(self) -> Any:
        """(ny, 1) SX g(x, u, t, p): the outputs with laws and drives put in."""
        outputs = self.output_expressions
        if self.w.numel() and ca.depends_on(outputs, self.w):
            outputs = ca.substitute(outputs, self.w, self.slot_laws)
        return ca.substitute(outputs, self.d, self.drive_expressions) if self.d.numel() else outputs

    @cached_property
    def jumps(self) -> tuple[Switch, ...]:
        """The switching functions of the closed equations and outputs, SX in (x, u, t, p); () for smooth ones."""
        return tuple(jumps(ca.vertcat(self.closed_ode, self.closed_outputs)))

    @cached_property
    def has_jumps(self) -> bool:
        """True if the closed equations or outputs jump anywhere; kinks are no jumps."""
        return has_jumps(ca.vertcat(self.closed_ode, self.closed_outputs))

    @cached_property
    def unused_inputs(self) -> tuple[str, ...]:
        """The inputs that were recorded and act on nothing: something may act by them, and a sensor may feel them."""
        acting = ca.vertcat(self.ode, self.laws, self.drive_expressions, self.output_expressions, ca.SX(0))
        return tuple(u.name for k, u in enumerate(self.inputs) if not ca.depends_on(acting, self.u[k]))

    @cached_property
    def idle_inputs(self) -> tuple[str, ...]:
        """The inputs that act on nothing, or by effects alone: what an input does in a model is what it does without
        these."""
        if not self.effects:
            return self.unused_inputs
        names = {one.amplitude for one in self.effects}
        gone = ca.vertcat(*[self.p[k] for k, name in enumerate(self.parameter_names) if name in names])
        acting = ca.vertcat(
            self.closed_ode, self.laws, self.drive_expressions, self.output_expressions, ca.SX(0)
        )
        left = ca.substitute(acting, gone, ca.SX.zeros(gone.shape))
        return tuple(u.name for k, u in enumerate(self.inputs) if not ca.depends_on(left, self.u[k]))

    # ---- effects

    def with_effect(
        self, effect: Any, *, at: Any, values: Mapping[str, float] | None = None, sharp: bool = False
    ) -> Model:
        """Return a new model with a physical effect at a port; the same equations where its amplitude is 0.

        effect : follows the protocol of `Effect`        at : name of a port, or the port
        values : start values of its parameters in their units; the amplitude is 0 if not given
        sharp : True takes the law as it is, for simulation; False rounds its switches and kinks, for fits
        The new parameters are called ``port.effect.parameter``; ``parameters.extended(new_model)`` adds them to
        a set, free. Where a law has corners, ``port.effect.width`` is what they are rounded over: a fixed parameter,
        which ``estimate`` makes as small as the motion on the records asks for unless it was set or fixed.
        EffectError for a port that does not exist, is of another kind or lacks a signal that the law reads, for a slot
        that acts the other way round, and for an effect that is there already.

        >>> from casadi_engine import effects, two_mass
        >>> model = two_mass(reciprocating_speed="measured").with_effect(effects.CubicStiffness(), at="coupling")
        >>> print(model.equations().splitlines()[7])
        w_coupling = coupling.cubic_stiffness.stiffness*twist*twist**2
        """
        return attach(self, effect, at=at, values=values, sharp=sharp)

    # ---- modes

    def modes(self, parameters: Parameters | Mapping[str, float] | None = None) -> Modes:
        """Return eigenvalues, natural frequencies [Hz] and shapes of the linear core; laws are left out.

        ModelError for a general model. `parameters` as in `parameter_vector`.
        """
        if self.linear is None:
            raise ModelError(
                f"the model {self.name} has no modes, because it has no linear core",
                seen="equations that are not affine in states and drives",
                allowed="a model with model.linear",
                cure="move the nonlinear terms into laws of ports (Blueprint.port, Blueprint.law)",
            )
        matrix = self._state_matrix(self.parameter_vector(parameters)).full()
        names = tuple(variable.name for variable in self.states)
        units = [declared.unit for declared in self.declarations]
        geometric = ca.vertcat(*[self.p[row] for row, unit in enumerate(units) if is_geometric(unit)])
        rates = np.array([variable.unit.endswith("/s") for variable in self.states])
        found = displacement_states(self.linear.A, ca.vertcat(ca.SX(0, 1), geometric), rates)
        return modes_of(matrix, states=names, displacements=found)

    def natural_frequency(
        self, mode: int = 1, parameters: Parameters | Mapping[str, float] | None = None
    ) -> float:
        """Return the natural frequency |λ|/2π [Hz] of oscillatory mode `mode`, numbered from 1.

        The rigid body mode does not count. ModelError if there is no such mode.
        """
        return self.modes(parameters).frequency(mode)

    @cached_property
    def _state_matrix(self) -> Any:
        """CasADi function p -> A."""
        return ca.Function("state_matrix", [self.p], [ca.densify(self.linear.A)]) if self.linear else None

    # ---- print

    def equations(self) -> str:
        """The equations as readable text."""
        return sheets.equations(self)

    def latex(self) -> str:
        """The equations as a LaTeX `aligned` environment."""
        return sheets.latex(self)

    def table(self) -> str:
        """States, inputs, drives, outputs and parameters with their units, as text."""
        return sheets.table(self)

    def __str__(self) -> str:
        return sheets.sheet(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """What other processes are sent."""
        from casadi_engine.model.parcel import pack, unpack

        return unpack, (pack(self),)

    def __repr__(self) -> str:
        return f"Model({self.name!r}, {len(self.states)} states, {len(self.declarations)} parameters)"

    def _repr_html_(self) -> str:
        return sheets.html_sheet(self)

    def _repr_latex_(self) -> str:
        return f"$$\n{self.latex()}\n$$"


def _finite(name: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ModelError(
            f"the value of the parameter {name} is not acceptable",
            seen=repr(value),
            allowed="a finite number",
            cure="give one number, in the unit of the parameter",
        )
    return number
