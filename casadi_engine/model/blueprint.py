"""The Blueprint: how a model is written down, by the builders and by users alike."""

from __future__ import annotations

import keyword
import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import casadi as ca

from casadi_engine.effects.protocol import PORT_KINDS
from casadi_engine.errors import ModelError
from casadi_engine.experiment.units import NOT_STATED
from casadi_engine.model.constants import constants
from casadi_engine.model.declarations import ParameterDeclaration, Port, Ports, Variable
from casadi_engine.model.declared_units import (
    check_crank_angle,
    check_output_units,
    check_shared_units,
    refuse_other_clocks,
    seconds_in,
)
from casadi_engine.model.model import Model
from casadi_engine.model.port_places import check_slots_act, check_slots_are_used
from casadi_engine.model.rates import with_rates
from casadi_engine.model.slot_units import with_units
from casadi_engine.model.symbol_checks import check_symbols, column, hashes
from casadi_engine.parameters import near_matches


class Blueprint:
    """A model in the making: declare symbols, write equations with them, then call `model()`.

    A Duffing oscillator, m q̈ + c q̇ + k q + k3 q³ = F:

    >>> b = Blueprint("duffing", description="mass on a hardening spring")
    >>> m, c = b.parameter("m", 1.0, unit="kg", min=1e-3), b.parameter("c", 0.1, unit="N s/m", min=0)
    >>> k, k3 = b.parameter("k", 4.0, unit="N/m", min=0), b.parameter("k3", 2.0, unit="N/m3")
    >>> q, v = b.state("q", unit="m"), b.state("v", unit="m/s")
    >>> force = b.input("F", unit="N")
    >>> b.ode("q", v)
    >>> b.ode("v", (force - c * v - k * q - k3 * q**3) / m)
    >>> b.output("position", q, unit="m")
    >>> model = b.model()
    >>> model.linear is None
    True
    >>> [variable.name for variable in model.drives]
    ['F']

    ``time_unit`` : unit of time of the odes, rate constants and `time`, s if left out. With "h" an ode is a rate per
    hour; the finished model divides it by 3600, for its own time, that of data and results, stays in s.
    A unit that is declared for an input or output is the one that its data arrive in, whatever they were recorded in;
    left out, they arrive in SI. Noise levels, initial values and bounds are in the declared units too.

    Written as a law of a port, the cubic spring leaves a linear core, which simulates faster:
    ``spring = b.port("spring", "coupling", {"twist": q, "twist_rate": v}); b.law("spring", k3 * q**3)``, and then
    ``- spring`` in the ode instead of the cubic term: what acts in a coupling pulls its two sides together.
    """

    def __init__(self, name: str, *, description: str = "", time_unit: str | None = None):
        self.name = _identifier("model", name)
        self.description = description
        self._seconds = seconds_in(time_unit)
        self._time_unit = time_unit
        self._states: dict[str, tuple[Variable, Any]] = {}
        self._inputs: dict[str, tuple[Variable, Any]] = {}
        self._drives: dict[str, tuple[Variable, Any, Any]] = {}
        self._outputs: dict[str, tuple[Variable, Any]] = {}
        self._parameters: dict[str, tuple[ParameterDeclaration, Any]] = {}
        self._ports: dict[str, Port] = {}
        self._odes: dict[str, Any] = {}
        self._laws: dict[str, Any] = {}
        self._stated: set[str] = set()  # ports whose unit was given
        self._time = ca.SX.sym("t")

    @property
    def time(self) -> Any:
        """SX expression of time, in the ``time_unit`` of the blueprint (s)."""
        return self._time if self._seconds == 1 else self._time / self._seconds

    # ---- declarations: each returns the symbol to write equations with

    def parameter(
        self,
        name: str,
        value: float,
        *,
        unit: str = "1",
        min: float = -math.inf,
        max: float = math.inf,
        vary: bool = True,
        description: str = "",
    ) -> Any:
        """Declare a parameter (`value`, `min`, `max` in `unit`; fixed by default if not `vary`)."""
        declaration = ParameterDeclaration(name, value, unit, min, max, vary, description)
        self._free_name("parameter", name)
        symbol = ca.SX.sym(name)
        self._parameters[name] = (declaration, symbol)
        return symbol

    def state(self, name: str, *, unit: str = NOT_STATED, scale: float = 1.0, description: str = "") -> Any:
        """Declare a state; `scale` is its typical magnitude in `unit`."""
        self._free_name("state", _identifier("state", name))
        symbol = ca.SX.sym(name)
        self._states[name] = (Variable(name, unit, description, scale), symbol)
        return symbol

    def input(self, name: str, *, unit: str = NOT_STATED, scale: float = 1.0, description: str = "") -> Any:
        """Declare an input channel; its data arrive in `unit`, whatever they were recorded in.

        A channel that is used directly in an ode or output becomes a drive of the same name by itself.
        """
        self._free_name("input", _identifier("input", name))
        symbol = ca.SX.sym(name)
        self._inputs[name] = (Variable(name, unit, description, scale), symbol)
        return symbol

    def drive(
        self, name: str, expression: Any, *, unit: str = "N m", scale: float = 1.0, description: str = ""
    ) -> Any:
        """Declare a drive: `expression` of channels, time, parameters; it enters the ode by the symbol."""
        if _identifier("drive", name) in self._drives:
            raise _repeated("drive", name)
        symbol = ca.SX.sym(name)
        value = _scalar(f"the drive {name}", expression)
        self._drives[name] = (Variable(name, unit, description, scale), symbol, value)
        return symbol

    def port(
        self,
        name: str,
        kind: str,
        signals: Mapping[str, Any] | None = None,
        *,
        unit: str | None = None,
        description: str = "",
    ) -> Any:
        """Declare a port; returns its slot symbol to be put into the ode, or None if it takes none.

        kind : inertia, coupling, cylinder or internal; those of input, sensor and parameter are made by `model()`,
            and links and pipes between inertias, ``a_and_b``. At an internal port no effect of the library is looked
            for; unknown functions of its signals are, and of a port without any, nothing
        signals : name -> expression, what is known there. An effect can act where the signals are that its law reads:
            ``speed`` of an inertia, ``twist``, ``twist_rate`` and ``stiffness`` of a coupling serve those of the
            library, which ``print(ce.effects.table())`` lists one by one.

            On what moves in metres the names are the same: ``speed`` [m/s] of a mass, ``twist`` [m] and ``twist_rate``
            [m/s] of a spring or damper. The slot accelerates an inertia: it enters the ode of ``speed`` with +. At a
            coupling it pulls the sides together: it enters the ode of the side that a positive twist is ahead with -
        unit : of the slot; None takes that of what the slot is added to, ``I`` in ``R*(I + slot)``, else the one that
            the ode asks for, as far as the units that were declared tell; else N m, N where the signals are states in m
            or m/s, and "-" where they are in neither. It is "-" as well, and ``print(model.ports)`` says why, where a
            bare number stands between slot and rate that may convert units, as in ``1e3*slot/m``, unless it takes what
            it multiplies into SI (``1e-3*R`` for R in mOhm), or is one by which no unit converts (2, 3/4, the root of
            2); and where what the slot is added to is in units of two sizes. State it then: ``unit="N"``.
            Amplitudes of effects follow it and the signals: N s/m or W/K for N m s/rad

        Raises ModelError for a name that is taken, a kind or unit that does not exist, and a signal that is no scalar.

        Notes
        -----
        What stores something is an "inertia", whatever it stores, and its ``speed`` is what losses depend on:

        ==============================  ==========  ===================================  ========================
        system                          kind        the slot adds                        signals
        ==============================  ==========  ===================================  ========================
        a shaft, a rotor                inertia     a torque that drives it [N m]        speed [rad/s]
        a shaft between two of them     coupling    a torque, ends together [N m]        twist [rad], twist_rate,
                                                                                         stiffness [N m/rad]
        a mass                          inertia     a force that drives it [N]           speed [m/s]
        a spring or damper              coupling    a force, ends together [N]           twist [m], twist_rate,
                                                                                         stiffness [N/m]
        a capacitor, a node             inertia     a current into it [A]                speed: voltage [V]
        a coil, a branch                inertia     a voltage along it [V]               speed: current [A]
        a tank, a volume of oil         inertia     a flow into it [m3/s]                speed: level [m] or
                                                                                         pressure [Pa]
        a body that is heated           inertia     a heat flow into it [W]              speed: temperature less
                                                                                         that around it [K]
        a species in a reactor          inertia     a rate at which it is made,          speed: concentration
                                                    mol/(L s)
        anything else                   internal    what stands there in your ode        any
        ==============================  ==========  ===================================  ========================

        Two of a kind whose slots have the same unit have a pipe between them, ``a_and_b``, for what flows from one to
        the other. Give what is around a body as an input or a parameter in its unit: of a bare number, as in
        ``T - 293``, the unit is not known.

        Examples
        --------
        A room that may lose more heat than by G, by a law that is not known:

        >>> b = Blueprint("room")
        >>> C, G = b.parameter("C", 2e5, unit="J/K", min=1e3), b.parameter("G", 50.0, unit="W/K", min=0)
        >>> T, heat, outside = b.state("T", unit="K"), b.input("P", unit="W"), b.input("T_out", unit="K")
        >>> lost = b.port("walls", "inertia", {"speed": T - outside})
        >>> b.ode("T", (heat - G * (T - outside) + lost) / C)
        >>> b.output("T_room", T, unit="K")
        >>> walls = b.model().ports["walls"]
        >>> walls.quantity, walls.unit, walls.in_its_unit("N m s2/rad2")  # the last: of a quadratic loss
        ('power', 'W', 'W/K2')
        """
        if _identifier("port", name) in self._ports:
            raise _repeated("port", name)
        slot = ca.SX.sym(f"w_{name}") if isinstance(kind, str) and PORT_KINDS.get(kind, False) else None
        made = {key: _scalar(f"signal {key} of port {name}", value) for key, value in (signals or {}).items()}
        own = self._slot_unit(made) if unit is None else Variable("slot", unit).unit
        self._ports[name] = Port(name, kind, description, made, slot, own)
        if unit is not None:
            self._stated.add(name)
        return slot

    def _slot_unit(self, signals: Mapping[str, Any]) -> str:
        """The unit of a slot by the states among the signals, where its equation does not tell."""
        if {made.unit for made, _ in self._states.values()} <= {"1", "rad", "rad/s"}:
            return "N m"  # whichever states the signals are made of
        everything = ca.vertcat(ca.SX(0, 1), *signals.values())
        symbols = {symbol.element_hash() for symbol in ca.symvar(everything)}
        units = {made.unit for made, symbol in self._states.values() if symbol.element_hash() in symbols} - {
            "1"
        }
        if units <= {"rad", "rad/s"}:
            return "N m"
        return "N" if units <= {"m", "m/s"} else "-"

    # ---- equations

    def ode(self, state: str, expression: Any) -> None:
        """Write the derivative of `state` by time, in states, channels or drives, slots, time, parameters.

        Time runs in the ``time_unit`` of the blueprint (s).
        """
        if state not in self._states:
            raise _unknown("state", state, self._states)
        if state in self._odes:
            raise _repeated("ode of", state)
        rate = _scalar(f"the ode of {state}", expression)
        self._odes[state] = rate if self._seconds == 1 else rate / self._seconds

    def law(self, port: str, expression: Any) -> None:
        """Set the torque that acts in the slot of `port` [N m]; it may use other slots' symbols too."""
        able = [name for name, made in self._ports.items() if made.slot is not None]
        if port not in able:
            raise _unknown("port that takes a torque", port, able)
        if port in self._laws:
            raise _repeated("law of port", port)
        self._laws[port] = _scalar(f"the law of port {port}", expression)

    def output(
        self, name: str, expression: Any, *, unit: str = NOT_STATED, scale: float = 1.0, description: str = ""
    ) -> None:
        """Declare a measured output as an expression of states, channels or drives, and parameters."""
        if _identifier("output", name) in self._outputs:
            raise _repeated("output", name)
        value = _scalar(f"the output {name}", expression)
        self._outputs[name] = (Variable(name, unit, description, scale), value)

    # ---- the finished model

    def model(self) -> Model:
        """Check everything and return the Model.

        Raises ModelError for a model without states or outputs, a state without ode, an undeclared symbol, a
        symbol where it may not be used, a slot in no ode or in one that says what a speed is, laws that depend on
        each other in a circle, one name declared in two units, an output that is a state as it stands in another unit
        than the state's, or units per hour in equations of which nobody said whether they are per hour.
        """
        self._check_complete()
        inputs, outputs = ([made[0] for made in group.values()] for group in (self._inputs, self._outputs))
        check_shared_units(inputs, outputs)
        check_output_units(list(self._outputs.values()), list(self._states.values()))
        check_crank_angle(inputs)
        check_slots_are_used(self._ports, self._odes, self._laws)
        stated = {name: self._ports[name].unit for name in self._stated}
        check_slots_act(self._ports, self._states, self._odes, stated)
        if self._time_unit is None:
            others = [made[0] for group in (self._parameters, self._states) for made in group.values()]
            refuse_other_clocks(self.name, [*others, *inputs])
        drives = self._with_direct_inputs()
        x, u, p = (
            column(made[1] for made in group.values())
            for group in (self._states, self._inputs, self._parameters)
        )
        d = column(symbol for _, symbol, _ in drives.values())
        slots = {name: port.slot for name, port in self._ports.items() if port.slot is not None}
        w = column(slots.values())
        # A channel that enters directly is read through its drive, so that the core never sees a channel.
        through = self._passed_on(drives)
        swap_from = column(channel for channel, _ in through.values())
        swap_to = column(symbol for _, symbol in through.values())
        ode, outputs = (
            ca.substitute(own, swap_from, swap_to) if through else own
            for own in (
                column(self._odes[name] for name in self._states),
                column(value for _, value in self._outputs.values()),
            )
        )
        model = Model(
            name=self.name,
            description=self._description(),
            states=tuple(variable for variable, _ in self._states.values()),
            inputs=tuple(variable for variable, _ in self._inputs.values()),
            drives=tuple(variable for variable, _, _ in drives.values()),
            outputs=tuple(variable for variable, _ in self._outputs.values()),
            declarations=tuple(declaration for declaration, _ in self._parameters.values()),
            ports=self._all_ports(),
            x=x,
            u=u,
            d=d,
            w=w,
            t=self._time,
            p=p,
            ode=ode,
            drive_expressions=column(value for _, _, value in drives.values()),
            laws=column(self._laws.get(name, ca.SX(0)) for name in slots),
            output_expressions=outputs,
            time_unit=self._time_unit or "s",
        )
        check_symbols(model)
        if w.numel() and ca.depends_on(model.slot_laws, w):
            raise ModelError(
                "the laws of the slots depend on each other in a circle",
                seen=", ".join(self._laws),
                allowed="laws that use other slots' torques only one way",
                cure="solve the laws for each other on paper, or put them into one port",
            )
        return with_rates(model)

    def _description(self) -> str:
        """The description, and how the equations come by a number that the user did not write."""
        if self._seconds == 1:
            return self.description
        said = f"odes per {self._time_unit}, divided by {self._seconds:g} for time in s"
        return f"{self.description}; {said}" if self.description else said

    def _check_complete(self) -> None:
        for what, group, cure in (
            ("states", self._states, 'b.state("name", unit=...)'),
            ("outputs", self._outputs, 'b.output("name", expression, unit=...)'),
        ):
            if not group:
                raise ModelError(
                    f"the model {self.name} has no {what}", seen="none", allowed="one or more", cure=cure
                )
        missing = [name for name in self._states if name not in self._odes]
        if missing:
            raise ModelError(
                "a state has no ode",
                seen=", ".join(missing),
                allowed="one ode for each state",
                cure=f'b.ode("{missing[0]}", expression)',
            )

    def _with_direct_inputs(self) -> dict[str, tuple[Variable, Any, Any]]:
        """The drives, with one more for each channel that an ode or output uses directly."""
        drives = dict(self._drives)
        used = hashes(column([*self._odes.values(), *(value for _, value in self._outputs.values())]))
        passed_on = self._passed_on(drives)
        for name, (variable, symbol) in self._inputs.items():
            key = symbol.element_hash()
            if key not in used or key in passed_on:
                continue
            if name in drives:
                raise ModelError(
                    f"the channel {name} is used directly, and a drive of its name is another expression",
                    seen=f"{name} = {drives[name][2]}",
                    allowed="a drive of that name that passes the channel on unchanged",
                    cure="use the drive's symbol in the equations, or rename the drive",
                )
            drives[name] = (variable, ca.SX.sym(name), symbol)
        return drives

    def _passed_on(self, drives: Mapping[str, tuple[Variable, Any, Any]]) -> dict[int, tuple[Any, Any]]:
        """The channels that are a drive unchanged: channel and drive symbol by the channel's hash."""
        channels = {symbol.element_hash() for _, symbol in self._inputs.values()}
        found: dict[int, tuple[Any, Any]] = {}
        for _, symbol, value in drives.values():
            if value.is_symbolic() and value.element_hash() in channels:
                found.setdefault(value.element_hash(), (value, symbol))
        return found

    def _all_ports(self) -> Ports:
        groups = (self._states, self._inputs, self._drives, self._parameters)
        units = [(made[1], made[0].unit) for group in groups for made in group.values()]
        # those that have a unit if none was given
        defaults = ((self._parameters, "1"), (self._drives, "N m"))
        may_lack = {
            made[1].element_hash()
            for group, unit in defaults
            for made in group.values()
            if made[0].unit == unit
        }
        odes = {
            name: (state.unit, self._odes[name] * self._seconds) for name, (state, _) in self._states.items()
        }
        per = self._time_unit or "s"
        ports = with_units(
            self._ports, [*units, (self._time, "s")], odes, stated=self._stated, may_lack=may_lack, per=per
        )
        added = [
            Port(f"input_{name}", "input", f"channel {name}", {"value": symbol}, units=_of(one.unit))
            for name, (one, symbol) in self._inputs.items()
        ]
        added += [
            Port(f"sensor_{name}", "sensor", f"output {name}", units=_of(one.unit))
            for name, (one, _) in self._outputs.items()
        ]
        added += [
            Port(f"parameter_{name}", "parameter", f"parameter {name}", {"value": symbol, "time": self._time})
            for name, (_, symbol) in self._parameters.items()
        ]
        for port in added:
            if port.name in ports:
                raise _repeated("port", port.name)
            ports[port.name] = port
        return Ports(ports.values())

    def _free_name(self, kind: str, name: str) -> None:
        for group in (self._states, self._inputs, self._parameters):
            if name in group:
                raise _repeated(kind, name)


def _of(unit: str) -> dict[str, str]:
    """The unit of a port's value, where it was stated."""
    return {} if unit == NOT_STATED else {"value": unit}


def _scalar(what: str, expression: Any) -> Any:
    """Return a number or SX scalar as SX, dense; ModelError for anything else."""
    if isinstance(expression, Real) and not isinstance(expression, bool):
        expression = ca.SX(float(expression))
    if not isinstance(expression, ca.SX) or expression.numel() != 1:
        raise ModelError(
            f"{what} is not a scalar expression",
            seen=f"{type(expression).__name__} {getattr(expression, 'shape', '')}".strip(),
            allowed="a number, or a scalar CasADi SX expression of the symbols that the blueprint returned",
            cure="write one equation for each quantity",
        )
    if any(map(math.isnan, constants(expression))):
        raise ModelError(
            f"{what} holds a constant that is no number",
            seen="nan",
            allowed="numbers, and symbols that the blueprint returned",
            cure="write casadi.sin(x) in place of math.sin(x), which is nan of any symbol; or look for a division by 0",
        )
    return expression if expression.is_dense() else ca.densify(expression)


def _identifier(kind: str, name: str) -> str:
    if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name):
        raise ModelError(
            f"the name of a{'n' * (kind[0] in 'aeiou')} {kind} is not acceptable",
            seen=repr(name),
            allowed="an identifier: letters, digits and _, not starting with a digit",
            cure="rename it",
        )
    return name


def _repeated(kind: str, name: str) -> ModelError:
    return ModelError(
        f"the {kind} {name} is declared twice or its name is taken",
        seen=repr(name),
        allowed="names unique among states, channels and parameters; and among drives, outputs, ports each",
        cure="rename one of them",
    )


def _unknown(kind: str, name: str, allowed: Any) -> ModelError:
    return ModelError(
        f"there is no {kind} of that name",
        seen=repr(name),
        allowed=near_matches(name, allowed),
        cure="declare it first",
    )
