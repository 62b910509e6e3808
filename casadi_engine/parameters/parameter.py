"""One parameter: its value, bounds, prior, and whether it is estimated, fixed or tied."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import TYPE_CHECKING, Any

from casadi_engine.errors import ParameterError, TieError
from casadi_engine.parameters.names import check_name

if TYPE_CHECKING:
    from casadi_engine.parameters.collection import Parameters

# "Leave this as it is" in ``Parameter.set``, whose None takes something away.
_KEEP: Any = type("_Keep", (), {"__repr__": lambda _: "..."})()


class Parameter:
    """A named number with bounds, as the model declares it and the user sets it.

    Parameters
    ----------
    name : identifiers joined by dots
    value : start value of the estimation, or the value kept when fixed, in `unit`
    unit : text, "1" if dimensionless
    min, max : bounds in `unit`, min <= value <= max and min < max; infinite if there are none
    vary : True if it is estimated
    prior : (mean, sigma) in `unit`, or None; `sigma` > 0
    description : one clause for tables

    Raises ParameterError if a number is not finite or the order is broken. ``p.value = 3``, and the same of `min`,
    `max`, `vary`, `prior` and `tie`, is `set` of that one (or the set's `tie`); name, unit and description stay.
    """

    __slots__ = (
        "_description", "_explicit", "_max", "_min", "_name", "_own", "_owner",
        "_prior", "_tie", "_unit", "_value", "_varies", "_vary",
    )  # fmt: skip

    def __init__(
        self,
        name: str,
        value: float,
        *,
        unit: str = "1",
        min: float = -math.inf,
        max: float = math.inf,
        vary: bool = True,
        prior: tuple[float, float] | None = None,
        description: str = "",
    ):
        self._name = check_name(name)
        self._unit = _text(name, "unit", unit)
        self._description = _text(name, "description", description)
        self._tie: str | None = None
        self._varies = False
        self._own: Mapping[str, tuple[float, float, float]] = {}  # record -> value, min, max
        self._explicit = False  # fixed by the user's own word, not by the model's default
        self._owner: Parameters | None = None
        self._value = _number(name, "value", value)
        self._min = _number(name, "min", min, infinite=-1)
        self._max = _number(name, "max", max, infinite=1)
        self._vary = _flag(name, vary)
        self._prior = _prior(name, prior)
        _check_order(name, self._value, self._min, self._max)

    name = property(
        lambda self: self._name, lambda self, new: self._refuse("name", new), doc="Name in the set."
    )
    unit = property(lambda self: self._unit, lambda self, new: self._refuse("unit", new), doc="Unit as text.")
    description = property(
        lambda self: self._description,
        lambda self, new: self._refuse("description", new),
        doc="One clause for tables.",
    )
    min = property(
        lambda self: self._min, lambda self, new: self.set(min=new), doc="Lower bound, -inf if there is none."
    )
    max = property(
        lambda self: self._max, lambda self, new: self.set(max=new), doc="Upper bound, inf if there is none."
    )
    prior = property(
        lambda self: self._prior, lambda self, new: self.set(prior=new), doc="(mean, sigma) or None."
    )

    @property
    def value(self) -> float:
        """The number itself; for a tied parameter what the tie gives with the set's present values."""
        if self._tie is not None and self._owner is not None:
            return self._owner.as_dict()[self._name]
        return self._value

    @value.setter
    def value(self, new: float) -> None:
        self.set(new)

    @property
    def vary(self) -> bool:
        """True if it is estimated: neither fixed nor tied."""
        return self._vary and self._tie is None

    @vary.setter
    def vary(self, new: bool) -> None:
        self.set(vary=new)

    @property
    def tie(self) -> str | None:
        """Text of the expression that it is tied to, or None."""
        return self._tie

    @tie.setter
    def tie(self, new: Any) -> None:
        owner = self._owner
        if owner is None:
            raise TieError(
                f"the parameter {self._name} is in no set, so there is nothing to tie it to",
                seen=repr(new),
                allowed="a tie of a parameter in a set",
                cure="put it into Parameters([...]) first",
            )
        if new is not None:
            owner.tie(self._name, new)
        elif self._tie is not None:
            owner.untie(self._name)

    @property
    def fixed_by_user(self) -> bool:
        """True if it was fixed by ``fix`` or ``set``, not by the model's declaration."""
        return self._explicit

    @property
    def varies_by_experiment(self) -> bool:
        """True if every record has its own value; has no effect while the parameter is tied, nor while it is fixed
        unless the values were given."""
        return self._varies and (self.vary or (bool(self._own) and self._tie is None))

    @varies_by_experiment.setter
    def varies_by_experiment(self, new: Any) -> None:
        self._refuse("varies_by_experiment", new)

    @property
    def own_records(self) -> tuple[str, ...]:
        """The records for which a value of its own was given."""
        return tuple(self._own)

    def in_record(self, record: str) -> tuple[float, float, float]:
        """Value, min and max in a record: those given to ``vary_by_experiment``, else those of all records."""
        own = self._own.get(record) if self.varies_by_experiment else None
        return (self.value, self._min, self._max) if own is None else own

    def _refuse(self, name: str, new: Any) -> None:
        cure = (
            f'call vary_by_experiment("{self._name}") of the set'
            if name == "varies_by_experiment"
            else "declare it where the parameter is made: Blueprint.parameter(...), or Parameters.add(...)"
        )
        raise ParameterError(
            f"the {name} of the parameter {self._name} cannot be changed",
            seen=f"{name} = {new!r}",
            allowed="value, min, max, vary, prior and tie",
            cure=cure,
        )

    def set(
        self,
        value: float = _KEEP,
        *,
        min: float | None = _KEEP,
        max: float | None = _KEEP,
        vary: bool = _KEEP,
        prior: tuple[float, float] | tuple[()] | None = _KEEP,
    ) -> Parameter:
        """Change what is given, leave the rest, and return the parameter itself.

        None takes away: `prior=None` the prior, `min=None` and `max=None` that bound. Nothing is changed when
        ParameterError is raised: numbers that are not finite, or not min <= value <= max and min < max, or a frozen
        set. TieError if a value or `vary` is set on a tied parameter.
        """
        name = self._name
        if self._owner is not None:
            self._owner._check_open()
        if self._tie is not None and (value is not _KEEP or vary is not _KEEP):
            raise TieError(
                f"the parameter {name} is tied, so it has no value of its own and cannot be fixed or freed",
                seen=f"{name} == {self._tie}",
                allowed="min, max and prior",
                cure=f'call untie("{name}") first',
            )
        new_value = self._value if value is _KEEP else _number(name, "value", value)
        new_min = self._min if min is _KEEP else _bound(name, "min", min, -1)
        new_max = self._max if max is _KEEP else _bound(name, "max", max, 1)
        new_vary = self._vary if vary is _KEEP else _flag(name, vary)
        new_prior = (
            self._prior
            if prior is _KEEP
            else _prior(name, None if isinstance(prior, tuple) and not prior else prior)
        )
        if self._tie is not None:  # the stored value is out of use: it only has to fit when untied
            new_value = clip(new_value, new_min, new_max)
        _check_order(name, new_value, new_min, new_max)
        self._value, self._min, self._max = new_value, new_min, new_max
        self._vary, self._prior = new_vary, new_prior
        if value is not _KEEP or vary is not _KEEP:
            self._own = {}  # one word for all records
        if vary is not _KEEP:
            self._explicit = not new_vary
        self._touch()
        return self

    def _settled_value(self) -> float:
        """The value to keep when a tie goes: the tie's own, moved into the bounds."""
        value = self.value
        return clip(value, self._min, self._max) if math.isfinite(value) else self._value

    def _touch(self) -> None:
        if self._owner is not None:
            self._owner._changed()

    def _copy(self, owner: Parameters | None) -> Parameter:
        other = object.__new__(Parameter)
        for slot in Parameter.__slots__:
            setattr(other, slot, getattr(self, slot))
        other._owner = owner
        return other

    def __copy__(self) -> Parameter:
        """A parameter outside any set: a tie is text without meaning there, so it is left behind."""
        other = self._copy(None)
        other._value, other._tie = self._settled_value(), None
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Parameter:
        return self.__copy__()

    def __repr__(self) -> str:
        state = f"== {self._tie}" if self._tie is not None else "" if self._vary else "fixed"
        bounds = f"[{self._min:.6g}, {self._max:.6g}]"
        return f"<Parameter {self._name} = {self.value:.6g} {self._unit} {bounds}{state and ' ' + state}>"


def clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def number(what: str, value: object, *, infinite: int = 0) -> float:
    """Return `value` as a float; infinite = -1 or 1 allows the infinity of that sign, 2 both.

    Raises ParameterError that names `what` if it is not such a real number.
    """
    allowed = "a finite number" + {0: "", -1: " or -inf", 1: " or inf", 2: ", -inf or inf"}[infinite]
    # numpy's zero-dimensional arrays are numbers to everyone but the number tower
    found = value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else value
    if isinstance(found, Real) and not isinstance(found, bool):
        try:
            converted = float(found)
        except OverflowError:
            converted = math.nan
        if math.isfinite(converted) or (
            math.isinf(converted) and (infinite == 2 or (infinite != 0 and (converted > 0) == (infinite > 0)))
        ):
            return converted
    raise ParameterError(
        f"{what} is not acceptable", seen=repr(value), allowed=allowed, cure="give one number"
    )


def own_values(parameter: Parameter, values: object) -> dict[str, tuple[float, float, float]]:
    """Record -> (value, min, max) from what a user gave: a number, or the three of them; {} for None."""
    name, found = parameter.name, {}
    if values is not None and not isinstance(values, Mapping):
        raise ParameterError(
            f"the values of the parameter {name} by experiment are no mapping",
            seen=repr(values),
            allowed="name of the record -> value, or (value, min, max)",
            cure='write {"record": 1.0}, for instance',
        )
    for record, given in (values or {}).items():
        parts = (
            given if isinstance(given, tuple) and len(given) == 3 else (given, parameter.min, parameter.max)
        )
        what = f"value in {record}"
        value = _number(name, what, parts[0])
        low, high = (_number(name, what, part, infinite=2) for part in parts[1:])
        _check_order(name, value, low, high)
        found[str(record)] = (value, low, high)
    return found


def _number(name: str, what: str, value: object, *, infinite: int = 0) -> float:
    return number(f"the {what} of the parameter {name}", value, infinite=infinite)


def _bound(name: str, what: str, value: object, side: int) -> float:
    """A bound; None is none, the infinity of its side."""
    return side * math.inf if value is None else _number(name, what, value, infinite=side)


def _flag(name: str, value: object) -> bool:
    if value is True or value is False or type(value).__name__ in ("bool_", "bool"):
        return bool(value)
    raise ParameterError(
        f"vary of the parameter {name} is not acceptable",
        seen=repr(value),
        allowed="True or False",
        cure="give one",
    )


def _text(name: str, what: str, value: object) -> str:
    if isinstance(value, str):
        return value
    raise ParameterError(
        f"the {what} of the parameter {name} is not text",
        seen=repr(value),
        allowed="text",
        cure="put it in quotes",
    )


def _prior(name: str, prior: object) -> tuple[float, float] | None:
    if prior is None:
        return None
    try:
        mean, sigma = prior  # type: ignore[misc]
    except (TypeError, ValueError):
        mean = sigma = math.nan
    bad = ParameterError(
        f"the prior of the parameter {name} is not acceptable",
        seen=repr(prior),
        allowed="(mean, sigma), both finite, sigma > 0",
        cure="give such a pair in the parameter's unit, or leave the prior out",
    )
    try:
        pair = (number("mean", mean), number("sigma", sigma))
    except ParameterError:
        raise bad from None
    if pair[1] <= 0:
        raise bad
    return pair


def _check_order(name: str, value: float, low: float, high: float) -> None:
    if low == high:
        raise ParameterError(
            f"the bounds of the parameter {name} are equal",
            seen=f"min = max = {low:.6g}",
            allowed="min < max",
            cure=f'fix it instead: fix("{name}", {low:.6g})',
        )
    if low > high:
        raise ParameterError(
            f"the bounds of the parameter {name} are in the wrong order",
            seen=f"min = {low:.6g}, max = {high:.6g}",
            allowed="min < max",
            cure="exchange them",
        )
    if not low <= value <= high:
        raise ParameterError(
            f"the value of the parameter {name} is outside its bounds",
            seen=f"{value:.6g}",
            allowed=f"{low:.6g} to {high:.6g}",
            cure="change the value, or the bounds in the same call",
        )
