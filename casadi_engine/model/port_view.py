"""What an effect's law sees of its port: signals, time, typical magnitudes and states of its own."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EffectError
from casadi_engine.experiment.units import NOT_STATED, read_unit
from casadi_engine.model.declarations import ParameterDeclaration, Port
from casadi_engine.model.port_side import acts_right
from casadi_engine.model.rates import shows_at_once
from casadi_engine.parameters import near_matches

# Dimensions of what drives a flow: a level, a pressure.
_HEADS = ("m", read_unit("Pa").dimension)
# Dimensions of what is between that of two streams where they mix: a temperature, a concentration.
_CONTENTS = tuple(read_unit(unit).dimension for unit in ("mol/m3", "kg/m3", "1/m3", "mol/kg"))
_MIXED = ("K", *_CONTENTS)
# An SX scalar -> its values (N,) along every record.
Courses = Callable[[Any], Sequence[NDArray[np.float64]]]

if TYPE_CHECKING:
    from casadi_engine.model.model import Model


class MissingSignalError(EffectError):
    """An effect reads signals that its port does not have.

    missing : their names        has : the signals of the port
    """

    def __init__(self, effect: str, port: Port, missing: Sequence[str]):
        self.missing, self.has = tuple(missing), tuple(port.signals)
        words = ", ".join(missing)
        made = ", ".join(f"{name!r}: ..." for name in missing)
        cure = (
            f"give {' and '.join(port.ends)} what the law reads: a first signal of the right unit, of which it is made"
            if port.ends
            else "give the port what the law reads where the model is written: "
            f"b.port({port.name!r}, {port.kind!r}, {{{made}}})"
        )
        super().__init__(
            f"{effect or 'the effect'} cannot act at the port {port.name}, which has no signal {words}",
            seen=f"{port.name} has the signals {', '.join(self.has) or '(none)'}",
            allowed=near_matches(missing[0], self.has) if self.has else "a port that has them",
            cure=cure,
        )


class PortView:
    """A port as a law reads it; every signal is an attribute (``port.speed``).

    name, kind : of the port        time : SX symbol [s]
    courses : what gives the values (N,) of an SX scalar along the model's simulation of each record, if there is one
    effect : name of the effect that looks at it, for messages and for its states
    free : names of the parameters that are estimated
    """

    def __init__(
        self,
        model: Model,
        port: Port,
        courses: Courses | None = None,
        *,
        effect: str = "",
        free: Collection[str] = (),
    ):
        self._free = free
        self.name, self.kind, self.time = port.name, port.kind, model.t
        self._model, self._port, self._courses, self._effect = model, port, courses, effect
        self.states: dict[str, Any] = {}

    def has(self, signal: str) -> bool:
        """True if the port has a signal of that name."""
        return signal in self._port.signals

    @property
    def is_mechanical(self) -> bool:
        """True where a torque or a force acts."""
        return self._port.is_mechanical

    @property
    def quantity(self) -> str:
        """What acts there, in words: torque, volume flow ..., "rate" or "term" where that is not told."""
        return self._port.quantity

    def is_temperature(self, signal: str) -> bool:
        """True if the unit of a signal is one of temperature."""
        unit = self._port.units.get(signal)
        return unit is not None and read_unit(unit).dimension == "K"

    def is_concentration(self, signal: str) -> bool:
        """True if a signal is a concentration."""
        unit = self._port.units.get(signal, NOT_STATED)
        return unit != NOT_STATED and read_unit(unit).dimension in _CONTENTS

    def is_mixed(self, signal: str) -> bool:
        """True if a signal is a temperature or a concentration: where two streams mix, it lies between theirs."""
        unit = self._port.units.get(signal, NOT_STATED)
        return unit != NOT_STATED and read_unit(unit).dimension in _MIXED

    def absolute_zero(self, signal: str) -> float:
        """Absolute zero in the unit of a signal that is a temperature: -273.15 in degC; 0 of anything else."""
        unit = read_unit(self._port.units[signal]) if self.is_temperature(signal) else None
        return 0.0 if unit is None else float(-unit.offset / unit.factor)

    def is_head(self, signal: str) -> bool:
        """True if a signal of no machine is a pressure or, as its unit is one of length, a level."""
        unit = self._port.units.get(signal, NOT_STATED)
        return unit != NOT_STATED and not self.is_mechanical and read_unit(unit).dimension in _HEADS

    @property
    def declaration(self) -> ParameterDeclaration | None:
        """What the model declares of the parameter at this port; None at a port of another kind."""
        return next((one for one in self._model.declarations if one.name == self._port.parameter), None)

    def __getattr__(self, signal: str) -> Any:
        if signal.startswith("__"):
            raise AttributeError(signal)
        if signal not in self._port.signals:
            return self._absent(signal)
        return self._port.signals[signal]

    def _absent(self, signal: str) -> Any:
        raise MissingSignalError(self._effect, self._port, (signal,))

    def state(self, name: str) -> Any:
        """The SX symbol of a state of the effect's own; its start and rate go into `Law(states=...)`."""
        if name not in self.states:
            stem = f"{self.name}.{self._effect}" if self._effect else self.name
            self.states[name] = ca.SX.sym(f"{stem}.{name}")
        return self.states[name]

    def width(self, default: float, *, unit: str = "1") -> Any:
        """The width over which a corner of the law is rounded: a fixed parameter ``port.effect.width`` of the model.

        default : its value before there is a record, in ``unit``; ``estimate`` sets it by the motion on the records,
        see ``Effect.narrowed``. Outside a law this is the default itself.
        """
        del unit
        return default

    def number(self, signal: str, values: Mapping[str, float]) -> float:
        """The number of a signal that is made of parameters alone, at these values by name."""
        expression = getattr(self, signal)
        symbols = ca.symvar(expression)
        function = ca.Function("number", [ca.vertcat(*symbols)], [expression])
        return float(function([values[symbol.name()] for symbol in symbols]))

    @property
    def shows_at_once(self) -> bool:
        """True for a sensor that shows an input, or what acts at a port, without a state between."""
        sensors = [port.name for port in self._model.ports if port.kind == "sensor"]
        return shows_at_once(self._model, sensors.index(self.name))

    @property
    def has_courses(self) -> bool:
        """True if there is a simulation of the records to look at."""
        return self._courses is not None

    @property
    def has_free_constant(self) -> bool:
        """True if a parameter that is estimated acts as a constant torque in the port's slot does, and nowhere else."""
        model = self._model
        return any(
            name in model.parameter_names
            and _is_constant(model, self._port, model.p[model.parameter_names.index(name)])
            for name in self._free
        )

    def same_constant(self, kinds: Collection[str]) -> str:
        """The port of one of these kinds at which a constant does what one of this input does, and nothing else; ""
        where there is none."""
        name = self.name.partition("_")[2]
        known = [variable.name for variable in self._model.inputs]
        if name not in known:
            return ""
        symbol = self._model.channels[known.index(name)]
        ports = [one for one in self._model.ports.with_slot if one.kind in kinds]
        same = (one for one in ports if _is_constant(self._model, one, symbol))
        return next((one.name for one in same if acts_right(self._model, one)), "")

    @property
    def in_engine(self) -> bool:
        """True for the port of a model with cylinders."""
        return any(port.kind == "cylinder" for port in self._model.ports)

    def response(self, signal: str, values: Mapping[str, float]) -> float:
        """How fast a signal changes per unit of what is added in the port's slot, or the ends' slots of a pipe: the
        largest, at these values by name and at the scales of the states.

        >>> from casadi_engine import one_inertia
        >>> port_view(one_inertia(), "engine").response("speed", {"J_eng": 0.5, "C_eng": 0.1})
        2.0
        """
        model, slots = self._model, [self._model.ports[name].slot for name in self._port.ends or (self.name,)]
        rate = ca.jtimes(getattr(self, signal), model.x, model.ode)
        slope = ca.jacobian(rate, ca.vertcat(*slots))
        x = [variable.scale for variable in model.states]
        known = [model.x, model.d, model.w, model.t, model.p]
        p = [values[name] for name in model.parameter_names]
        found = ca.Function("response", known, [slope])(x, 0, 0, 0.0, p)
        return float(np.abs(np.array(found)).max())

    @property
    def place(self) -> Any:
        """The angle or position that the port's speed moves, in the speed's unit times seconds: a signal or a state."""
        speed, model, signals = self.speed, self._model, self._port.signals
        shown = [signals[name] for name in ("angle", "position") if name in signals]
        for one in (*shown, *ca.vertsplit(model.x)):
            share = _constant_share(ca.jtimes(one, model.x, model.ode), speed)
            if share is not None:
                return one if share == 1 else one / share
        return self._absent("angle")

    def along(self, expression: Any) -> tuple[NDArray[np.float64], ...]:
        """An expression along the simulation of each record, (N,) at its samples; empty where nothing was simulated."""
        return () if self._courses is None else tuple(self._courses(expression))

    def courses(self, signal: str, *, stored: bool = False) -> tuple[NDArray[np.float64], ...]:
        """The signal along the simulation of each record, (N,) at its samples; empty where nothing was simulated.

        stored : as ``stored`` has it
        """
        return self.along(self.stored(signal) if stored else getattr(self, signal))

    def stored(self, signal: str) -> Any:
        """What the storage in which the port's slot acts makes of a signal, up to a constant: of a temperature above an
        ambient the temperature. The signal itself where its shares cannot be told apart."""
        expression, model, slot = getattr(self, signal), self._model, self._port.slot
        rows = [] if slot is None else ca.jacobian(model.ode, slot).row()
        own = [model.x[k] for k in rows]
        others = [model.x[k] for k in range(model.x.numel()) if k not in rows]
        others += [model.u, model.d, model.w, model.t]
        if not own or not ca.depends_on(expression, ca.vertcat(*own)):
            return expression
        states = ca.vertcat(*own)
        slope = ca.jacobian(expression, states)
        if ca.depends_on(slope, ca.vertcat(*others)):
            return expression
        if not ca.depends_on(slope, states):
            return ca.mtimes(slope, states)
        scales = [model.states[k].scale for k in rows]
        return expression - ca.substitute(expression, states, ca.DM(scales))

    def around(self, signal: str) -> Any:
        """What the port's storage is beside, in the unit of a signal of it: what the signal is the difference to, else
        the one drive of that unit by which the storage changes; None where there is none, or there are several."""
        expression, own = ca.SX(getattr(self, signal)), ca.SX(self.stored(signal))
        other, model, slot = ca.simplify(own - expression), self._model, self._port.slot
        if not other.is_constant():
            return other
        if slot is None or not other.is_zero():
            return None
        rate = model.ode[ca.jacobian(model.ode, slot).row()]
        unit = self._port.units.get(signal)
        alike = [model.d[k] for k, one in enumerate(model.drives) if one.unit == unit]
        beside = [one for one in alike if ca.depends_on(rate, one)]
        return beside[0] if len(beside) == 1 else None

    def typical(self, signal: str) -> float:
        """Typical magnitude of a signal, from the scales of the states or channels that it is made of.

        A signal that is not affine in them counts 1.
        """
        return self.size(getattr(self, signal))

    def size(self, expression: Any) -> float:
        """The same of an expression."""
        model = self._model
        for column, variables in ((model.x, model.states), (model.channels, model.inputs)):
            slope = ca.jacobian(expression, column)
            if slope.nnz() and not ca.symvar(slope):
                scales = np.array([variable.scale for variable in variables])
                found = float(np.linalg.norm(np.array(ca.DM(ca.densify(slope))).ravel() * scales))
                return found if found > 0 else 1.0
        return 1.0


def _constant_share(one: Any, other: Any) -> float | None:
    """The number by which one expression is another one; None where it is no number but 0."""
    symbols = ca.symvar(ca.vertcat(one, other))
    both = ca.Function("both", [ca.vertcat(*symbols)], [one, other])
    rng = np.random.default_rng(0)
    drawn = [[float(part) for part in both(rng.uniform(0.5, 1.5, len(symbols)))] for _ in range(3)]
    if not np.isfinite(drawn).all() or not all(own and base for own, base in drawn):
        return None
    shares = [own / base for own, base in drawn]
    return float(shares[0]) if np.ptp(shares) <= 1e-9 * abs(shares[0]) else None


def _is_constant(model: Model, port: Port, symbol: Any) -> bool:
    """True if a parameter or channel acts as a constant in the port's slot does, and nowhere else."""
    return constant_of(model, port, symbol) is not None


def constant_of(
    model: Model, port: Port, symbol: Any, values: Mapping[str, float] | None = None
) -> float | None:
    """What one unit of a parameter or channel adds in the port's slot, where the slope of all equations by it is that
    by the slot times a constant other than 0; None elsewhere.

    values : of the parameters, those that the model declares where they are not given
    """
    if port.slot is None:
        return None
    slot = ca.jacobian(ca.vertcat(model.ode, model.output_expressions), port.slot)
    both = ca.vertcat(model.closed_ode, model.closed_outputs)
    unknown = [model.x, model.u, model.d, model.w, model.t]
    known = {} if values is None else values
    at = ca.vertcat(*[known.get(one.name, one.value) for one in model.declarations])
    function = ca.Function("slopes", [*unknown, model.p], [slot, ca.jacobian(both, symbol)])
    rng = np.random.default_rng(0)
    # on both sides of zero, where the equations have numbers there: a sign is constant on one
    drawn = [
        [side * rng.uniform(0.5, 1.5, one.numel()) for one in unknown] for _ in range(3) for side in (1, -1)
    ]
    points = [[np.array(part).ravel() for part in function(*point, at)] for point in drawn]
    points = [
        point
        for k, point in enumerate(points)
        if k % 2 == 0 or all(np.isfinite(part).all() for part in point)
    ]
    unit, own = (np.concatenate([point[k] for point in points]) for k in range(2))
    if not (np.isfinite(own).all() and np.isfinite(unit).all() and unit.any() and own.any()):
        return None
    ratio = float(own @ unit) / float(unit @ unit)
    return ratio if np.abs(own - ratio * unit).max() < 1e-9 * np.abs(own).max() else None


class TrialView(PortView):
    """A port that notes the signals which a law reads and it does not have, and gives a symbol in their place: one call
    of the law tells them all."""

    def __init__(self, model: Model, port: Port, *, effect: str):
        super().__init__(model, port, effect=effect)
        self._stand_ins: dict[str, Any] = {}
        # symbol, default and unit of the width of the law's corners, once the law has asked for one
        self.corner: tuple[Any, float, str] | None = None

    def _absent(self, signal: str) -> Any:
        return self._stand_ins.setdefault(signal, ca.SX.sym(signal))

    def width(self, default: float, *, unit: str = "1") -> Any:
        if self.corner is None:
            self.corner = (ca.SX.sym(f"{self.name}.{self._effect}.width"), default, unit)
        return self.corner[0]

    def check(self) -> None:
        """Raise MissingSignalError if a signal was read that is not there."""
        if self._stand_ins:
            raise MissingSignalError(self._effect, self._port, tuple(self._stand_ins))


def port_view(model: Model, at: str) -> PortView:
    """The port of that name as a law sees it; ModelError if the model has none."""
    return PortView(model, model.ports[at])


class Values:
    """The amplitude and nuisance parameters of an effect as attributes, SX symbols or numbers."""

    def __init__(self, effect: str, values: dict[str, Any]):
        self._effect, self._values = effect, values

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._values:
            raise EffectError(
                f"the effect {self._effect} has no such parameter",
                seen=repr(name),
                allowed=near_matches(name, self._values),
                cure="declare it as the amplitude or in nuisance",
            )
        return self._values[name]
