"""The effect protocol: what a physical effect that a model may lack has to say of itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EffectError
from casadi_engine.parameters import near_matches

# The kinds of ports, and whether a torque can be added there.
PORT_KINDS: Mapping[str, bool] = MappingProxyType(
    {
        "inertia": True,
        "coupling": True,
        "cylinder": True,
        "internal": True,
        "input": False,
        "sensor": False,
        "parameter": False,
        "link": False,
        "pipe": False,
        "path": False,
        "cross": False,
    }
)
# The kinds of ports that effects may attach to; those of the library leave internal ones alone.
KINDS = tuple(PORT_KINDS)
GRID_KINDS = ("value", "time", "cycle")


@dataclass(frozen=True)
class Amplitude:
    """The one number of an effect that is zero where the effect is absent.

    name : parameter name
    unit : of its numbers; None takes the unit of the port's value. A unit of N m, rad and s follows the port: N m/rad
        reads N/mm at a spring of N and mm. Any other one stays as it is, and has to go with the port's units: a law
        reads and gives the port's own numbers
    min, max : bounds in `unit` that hold 0; min = 0 (or max = 0) makes the effect one-sided
    description : one clause for tables
    """

    name: str
    unit: str | None = "1"
    min: float = -math.inf
    max: float = math.inf
    description: str = ""

    def __post_init__(self) -> None:
        _check_word("the amplitude", self.name)
        if not self.min <= 0.0 <= self.max or self.min == self.max:
            raise EffectError(
                f"the bounds of the amplitude {self.name} do not hold its null",
                seen=f"min = {self.min:.6g}, max = {self.max:.6g}",
                allowed="min <= 0 <= max and min < max",
                cure="write the law so that 0 switches the effect off",
            )

    @property
    def one_sided(self) -> int:
        """1 if only amplitudes >= 0 are allowed, −1 if only <= 0, else 0."""
        return 1 if self.min == 0.0 else -1 if self.max == 0.0 else 0


@dataclass(frozen=True)
class Grid:
    """The values that a nuisance parameter of an effect may take; it has no meaning while the amplitude is 0.

    start, stop : ends of the range in `unit`, or in multiples of a signal's typical magnitude (`of`)
    unit : of its numbers, as that of an `Amplitude`
    steps : number of values, from end to end        log : True spaces them evenly in the logarithm
    of : name of a signal of the port whose magnitude multiplies start and stop
    over : "value"; "time", when start and stop are shares of a record's time; "cycle", every engine cycle of a
        record (start, stop and steps are then not used)
    whole : True if it is a whole number: it is then given as a number and never estimated
    least : lower bound of the parameter, where searches may go below start; None for start

    >>> Grid(80, 180, steps=3, unit="rad/s").values()
    (80.0, 130.0, 180.0)
    """

    start: float = 0.0
    stop: float = 1.0
    steps: int = 9
    unit: str = "1"
    log: bool = False
    of: str | None = None
    over: str = "value"
    whole: bool = False
    least: float | None = None
    description: str = ""

    def __post_init__(self) -> None:
        if self.over not in GRID_KINDS:
            raise EffectError(
                "the grid runs over something unknown",
                seen=repr(self.over),
                allowed=near_matches(self.over, GRID_KINDS),
                cure="leave `over` out for a grid of values between start and stop",
            )
        least = 1e-300 if self.log else -math.inf
        good = math.isfinite(self.start) and math.isfinite(self.stop) and self.start >= least
        good = good and (self.start < self.stop if self.steps > 1 else self.start <= self.stop)
        if not good or isinstance(self.steps, bool) or self.steps != int(self.steps) or self.steps < 1:
            raise EffectError(
                "the grid of a nuisance parameter is not acceptable",
                seen=f"start = {self.start!r}, stop = {self.stop!r}, steps = {self.steps!r}, log = {self.log}",
                allowed="start < stop, both finite (and > 0 if log), steps a whole number >= 1",
                cure='give Grid(80, 180, steps=11, unit="rad/s"), for instance',
            )

    def values(
        self,
        *,
        magnitude: float = 1.0,
        time: tuple[float, float] = (0.0, 1.0),
        cycles: Sequence[int] = (1,),
    ) -> tuple[float, ...]:
        """The values in `unit`.

        magnitude : of the signal `of`        time : start and end of a record [s]        cycles : its cycles
        """
        if self.over == "cycle":
            return tuple(float(cycle) for cycle in cycles)
        low, high = self.ends(magnitude=magnitude, time=time)
        if self.steps == 1:
            return ((low * high) ** 0.5 if self.log else 0.5 * (low + high),)
        space = np.geomspace if self.log else np.linspace
        found: NDArray[np.float64] = space(low, high, int(self.steps))
        return tuple(float(value) for value in (np.unique(np.rint(found)) if self.whole else found))

    def ends(self, *, magnitude: float = 1.0, time: tuple[float, float] = (0.0, 1.0)) -> tuple[float, float]:
        """Both ends of the range in `unit`."""
        if self.over == "time":
            first, length = time[0], time[1] - time[0]
            return first + self.start * length, first + self.stop * length
        size = magnitude if self.of is not None else 1.0
        return self.start * size, self.stop * size


@dataclass(frozen=True, eq=False)
class Law:
    """What an effect adds, when it has states of its own, or loses something between the ends of a link.

    value : SX scalar, torque [N m] at an inertia, coupling or cylinder; else the change of the port's value
    arrives : SX scalar, what of `value` enters the second end of a link; None for all of it
    states : name -> (start, rate); start a number, rate an SX scalar. The law reads the state's symbol by
        ``port.state(name)``
    """

    value: Any
    states: Mapping[str, tuple[float, Any]] = field(default_factory=dict)
    arrives: Any = None


class Effect:
    """Base class of effects; a subclass says what these attributes are and writes `law`.

    name : identifier; parameters are called ``port.name.parameter``
    attaches : kinds of ports: inertia, coupling, cylinder, input, sensor, parameter, link (between two shafts
        or masses), pipe (between two of anything else), path (from an input to a port), cross (from an output, or an
        input, to the sensor of another output)
    kin : names of effects that look alike, for the reader of a class
    limit : name of the simpler effect that this one becomes at an end or in the middle of its
        grid; "" for none. limit_at : the nuisance parameter at whose bound it is that one, "" for none; limit_end :
        "min" or "max" where it is at that bound alone
    sentence : one clause with {port}, for reports; {effort} and {motion} stand for what acts there ("torque") and for
        what is read ("speed", or the signal's expression)
    neutral : the clause for ports where no torque or force acts; "" for the same
    negative : the clause where the amplitude is below 0 and that is another thing; "" for the same
    neutral_negative : the same where no torque and no force acts
    fixed_only : True if it is looked for at no parameter that is estimated, which would do the same
    slides : True for a law of what slides; elsewhere it is named after what the data do not tell from it
    delays : name of the parameter by which an input acts late [s], its law being one of three states: where the time
        is known the record holds the input's earlier values, and they stand for the law
    retards : True if the amplitude is the time [s] by which a sensor is late: whole samples of it are then read off
        the sensor's times, and the law holds the rest
    amplitude : Amplitude        nuisance : name -> Grid
    alike : settings that `fitted` reads off the first of several records for all of them, as they are a part of what
        the amplitude or the grids stand for

    >>> class FanTorque(Effect):
    ...     name, attaches, kin = "fan_torque", ("inertia",), ("quadratic_drag", "coulomb_friction")
    ...     sentence = "a fan on {port} that engages above a speed"
    ...     amplitude = Amplitude("coefficient", unit="N m s2/rad2", min=0)
    ...     nuisance = {"engage": Grid(80, 180, steps=11, unit="rad/s")}
    ...     def law(self, port, p, math):
    ...         on = math.step(port.speed - p.engage, width=2.0)
    ...         return -p.coefficient * on * port.speed**2
    >>> from casadi_engine import two_mass
    >>> two_mass().with_effect(FanTorque(), at="load").parameter_names[-2:]
    ('load.fan_torque.coefficient', 'load.fan_torque.engage')
    """

    name: ClassVar[str] = ""
    attaches: ClassVar[tuple[str, ...]] = ()
    kin: ClassVar[tuple[str, ...]] = ()
    limit: ClassVar[str] = ""
    limit_at: ClassVar[str] = ""
    limit_end: ClassVar[str] = ""
    sentence: ClassVar[str] = ""
    neutral: ClassVar[str] = ""
    negative: ClassVar[str] = ""
    neutral_negative: ClassVar[str] = ""
    fixed_only: ClassVar[bool] = False
    slides: ClassVar[bool] = False
    delays: ClassVar[str] = ""
    retards: ClassVar[bool] = False
    amplitude: ClassVar[Amplitude]
    nuisance: ClassVar[Mapping[str, Grid]] = MappingProxyType({})
    alike: ClassVar[tuple[str, ...]] = ()

    def law(self, port: Any, p: Any, math: Any) -> Any:
        """What the effect adds at the port: an SX scalar, or a `Law`.

        port : signals as attributes (``port.speed``), ``port.time``, ``port.typical(signal)``,
            ``port.width(default)`` for corners and ``port.state(name)``. A signal that is read is needed: the effect
            cannot act at a port without it. ``port.has(signal)`` asks first
        p : amplitude and nuisance parameters as attributes
        math : sign, step, abs, positive, dead_zone and elementary functions; smooth in fits, sharp in simulation
        """
        raise NotImplementedError

    def sizes(self, port: Any, values: Mapping[str, float]) -> tuple[float, ...]:
        """Amplitudes whose secants are tested besides the slope at 0, for laws that bend in the amplitude.

        Without any, a law that has no slope at 0, of a square or a magnitude of its amplitude, is tested by secants of
        all sizes from 1e-8 to 1e6 in its unit.

        values : numbers of the model's parameters by name
        """
        del port, values
        return ()

    def choices(self, port: Any, grids: Mapping[str, tuple[float, ...]]) -> tuple[dict[str, float], ...]:
        """The combinations of nuisance values that are tested; by default all of them."""
        del port
        found: list[dict[str, float]] = [{}]
        for name, values in grids.items():
            found = [one | {name: value} for one in found for value in values]
        return tuple(found)

    def placed(self, port: Any) -> Effect:
        """The effect as it is at a port before there is a record; by default itself."""
        del port
        return self

    def idle(self, port: Any) -> str:
        """Why records cannot show the effect at a port, one clause; "" where they may, which is the default.

        port : with its courses, and ``port.has_free_constant``: whether a torque there that is constant is estimated
        """
        del port
        return ""

    def fitted(self, port: Any, record: Any, values: Mapping[str, float]) -> Effect:
        """The effect with constants that are read off a record (an Experiment); by default itself.

        values : numbers of the model's parameters by name
        """
        del port, record, values
        return self

    def narrowed(self, port: Any, share: float = 1.0) -> Effect:
        """The effect with its corners' ``width`` as sharp as the records pass them; by default itself.

        port : with its courses, ``port.courses("speed")``: the signal (N,) along the simulation of each record
        share : of that width, where the refit finds that the data tell it from a sharper one
        """
        del port, share
        return self

    def parts(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Other effects that together are this one, and more where its nuisance parameters are at a bound: their names
        with the amplitudes at which they do what this one does; by default none.

        values : parameter name, without port and effect -> value
        """
        del values
        return {}

    def beyond(self, values: Mapping[str, float]) -> bool:
        """True where its nuisance parameters are out of what the records reach, so that it is hardly told from its
        ``limit``; by default never.

        values : nuisance name -> value
        """
        del values
        return False

    def describe(self, port: str) -> str:
        """The sentence for a port of that name at which a torque acts."""
        return self._filled(self.sentence, port, "torque", "speed")

    def worded(self, port: Any) -> str:
        """The sentence for a port of a model, in the words of what acts there.

        >>> from casadi_engine import effects, two_mass
        >>> effects.ConstantTorque().worded(two_mass().ports["load"])
        'a constant torque on load'
        """
        if type(self).describe is not Effect.describe:
            return self.describe(port.name)
        text = self.sentence if port.is_mechanical or not self.neutral else self.neutral
        return self._filled(text, port.name, port.quantity, port.motion)

    def worded_for(self, port: Any, size: float) -> str:
        """The same for an amplitude of this size."""
        acts = port.is_mechanical or port.ends
        other = self.negative if acts else self.neutral_negative or self.negative
        if size < 0 and other:
            return self._filled(other, port.name, port.quantity, port.motion)
        return self.worded(port)

    def _filled(self, text: str, port: str, effort: str, motion: str) -> str:
        if not text:
            return f"{self.name} at {port}"
        article = "an" if effort[0] in "aeiou" else "a"
        text = text.replace("a {effort}", f"{article} {effort}").replace("{effort}", effort)
        return text.replace("{motion}", motion).replace("{port}", self._called(port))

    def _called(self, port: str) -> str:
        """A port's name as it stands in the sentence."""
        return port

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"


@dataclass(frozen=True, eq=False)
class Attachment:
    """An effect that is in a model: the effect, its port, whether its law is sharp, and its parameters."""

    effect: Any
    at: str
    sharp: bool
    constants: Mapping[str, float]
    # name of the parameter that is the width of its corners, "" without one
    width: str = ""

    @property
    def key(self) -> str:
        """``port.effect``."""
        return f"{self.at}.{self.effect.name}"

    @property
    def amplitude(self) -> str:
        """Name of the amplitude among the model's parameters."""
        return f"{self.key}.{self.effect.amplitude.name}"


def settings_of(effect: Any) -> dict[str, Any]:
    """What an effect was made with beside its parameters, where that is not the default: numbers, and lists of them and
    of names, which a stored result has."""
    found = {}
    for one in fields(effect) if is_dataclass(effect) else ():
        value = getattr(effect, one.name)
        if value != one.default and _is_plain(value):
            found[one.name] = value
    return found


def with_settings(effect: Any, settings: Mapping[str, Any]) -> Any:
    """The effect made with stored settings; those that it does not have are left out."""
    if not is_dataclass(effect):
        return effect
    known = {one.name for one in fields(effect)}
    return replace(effect, **{name: _frozen(own) for name, own in settings.items() if name in known})  # type: ignore[type-var]


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return all(map(_is_plain, value))
    return isinstance(value, str | bool) or (isinstance(value, int | float) and math.isfinite(value))


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


def moves(effect: Any) -> bool:
    """True for an event that may happen at another time in another record."""
    grids = effect.nuisance.values()
    return bool(grids) and all(grid.over == "time" and not grid.whole for grid in grids)


def check_effect(effect: Any) -> None:
    """Raise EffectError unless `effect` follows the protocol."""
    if isinstance(effect, type):
        raise EffectError(
            "an effect is needed, not its class",
            seen=effect.__name__,
            allowed="an instance",
            cure=f"write {effect.__name__}()",
        )
    if isinstance(effect, str):
        raise EffectError(
            "an effect is needed, not its name",
            seen=repr(effect),
            allowed="an instance",
            cure=f"write ce.effects.library({effect!r})[0]",
        )
    for attribute in ("name", "attaches", "amplitude", "nuisance", "law"):
        if not hasattr(effect, attribute):
            raise EffectError(
                f"the effect {type(effect).__name__} lacks an attribute",
                seen=f"no {attribute}",
                allowed="name, attaches, amplitude, nuisance and law",
                cure="derive it from ce.Effect and set the attribute on the class",
            )
    _check_word(f"the name of the effect {type(effect).__name__}", effect.name)
    kinds = effect.attaches
    if isinstance(kinds, str) or not kinds or not set(kinds) <= set(KINDS):
        raise EffectError(
            f"the effect {effect.name} attaches to kinds of ports that do not exist",
            seen=repr(kinds),
            allowed=f"a tuple of one or more of {', '.join(KINDS)}",
            cure='set attaches = ("inertia",), for instance',
        )
    if not isinstance(effect.amplitude, Amplitude):
        raise EffectError(
            f"the effect {effect.name} has no amplitude",
            seen=repr(effect.amplitude),
            allowed='ce.effects.Amplitude("name", unit="N m", min=0)',
            cure="say which number is zero where the effect is absent",
        )
    _check_width(effect)
    for name, grid in effect.nuisance.items():
        _check_word(f"a nuisance parameter of the effect {effect.name}", name)
        if not isinstance(grid, Grid) or name == effect.amplitude.name:
            raise EffectError(
                f"the nuisance parameter {name} of the effect {effect.name} is not acceptable",
                seen=repr(grid),
                allowed="a ce.effects.Grid, under another name than the amplitude's",
                cure=f'set nuisance = {{"{name}": ce.effects.Grid(start, stop, steps=9, unit="...")}}',
            )


def _check_width(effect: Any) -> None:
    """A width below 0 turns the sign of a law: dry friction would drive."""
    width = getattr(effect, "width", None)
    known = isinstance(width, int | float) and not isinstance(width, bool)
    if width is not None and known and not 0 <= width < math.inf:
        raise EffectError(
            f"the width over which corners of the effect {effect.name} are rounded is not acceptable",
            seen=repr(width),
            allowed="a number from 0 on, or None for what the records can follow",
            cure=f"write {type(effect).__name__}(), or give a width in the unit of the signal",
        )


def _check_word(what: str, name: object) -> None:
    if not isinstance(name, str) or not name.isidentifier():
        raise EffectError(
            f"{what} is not acceptable",
            seen=repr(name),
            allowed="an identifier: letters, digits and _, not starting with a digit",
            cure="rename it",
        )
