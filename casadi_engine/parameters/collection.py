"""The set of parameters that a model declares and a user works on."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import casadi as ca

from casadi_engine.errors import ConstraintError, ParameterError, TieError
from casadi_engine.parameters import storage, table, ties
from casadi_engine.parameters.constraint import (
    Constraint,
    FrequencyConstraint,
    check_bounds,
    check_frequency,
)
from casadi_engine.parameters.expression import write_expression
from casadi_engine.parameters.given import names_in, read_given, shown_text
from casadi_engine.parameters.names import near_matches
from casadi_engine.parameters.parameter import Parameter, own_values


class Parameters:
    """An ordered, mutable set of parameters with their ties, constraints and priors.

    Works like a mapping from name to Parameter (``pars["J_eng"].set(0.39, min=0.05)``, ``pars["J_eng"].value = 0.39``,
    ``pars.get("J_eng")``), except that an unknown name in brackets raises ParameterError with near matches. The
    parameters given are copied.

    >>> pars = Parameters([Parameter("C2", 0.04, unit="N m s/rad", min=0)])
    >>> pars.add("C_eng", 0.16, unit="N m s/rad", min=0)
    <Parameter C_eng = 0.16 N m s/rad [0, inf]>
    >>> pars.tie("C2", "C_eng/4")
    >>> print(pars)
    name   value  unit       min  max
    C2      0.04  N m s/rad    0  inf  == C_eng/4
    C_eng   0.16  N m s/rad    0  inf
    """

    # a misspelt or hopeful ``pars.K = 3`` must not vanish in an attribute that nobody reads
    __slots__ = (
        "_constraints", "_frequencies", "_frozen", "_items", "_references", "_resolved", "_symbols", "_text_ties",
        "_ties",
    )  # fmt: skip

    def __init__(self, parameters: Iterable[Parameter] = ()):
        self._items: dict[str, Parameter] = {}
        self._symbols: dict[str, Any] = {}
        self._ties: dict[str, Any] = {}  # name -> SX of the symbols
        self._references: dict[str, tuple[str, ...]] = {}  # name of a tied one -> names in its tie
        self._text_ties: set[str] = set()  # the ties that the user wrote as text
        self._constraints: list[Constraint] = []
        self._frequencies: list[FrequencyConstraint] = []
        self._frozen = False
        self._resolved: dict[str, float] | None = None
        for parameter in parameters:
            self._insert(parameter)

    # ---- reading -------------------------------------------------------------------------------

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._items[name]
        except (KeyError, TypeError):
            raise self._unknown(name) from None

    def __setitem__(self, name: str, value: float) -> None:
        """``pars["K"] = 3`` is ``pars["K"].set(3)``; only `add` makes a new parameter."""
        self[name].set(value)

    def get(self, name: str, default: Any = None) -> Any:
        """The parameter of that name, or ``default``."""
        return self._items[name] if name in self else default

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._items

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def keys(self) -> tuple[str, ...]:
        """The names in order, so that ``dict(parameters)`` works."""
        return tuple(self._items)

    names = property(keys, doc="The names in order.")

    def items(self) -> tuple[tuple[str, Parameter], ...]:
        """(name, Parameter) pairs in order."""
        return tuple(self._items.items())

    @property
    def symbols(self) -> Mapping[str, Any]:
        """Name -> SX scalar, for ties and constraints written in CasADi; read only."""
        return MappingProxyType({name: ca.SX(symbol) for name, symbol in self._symbols.items()})

    def symbol(self, name: str) -> Any:
        """The SX scalar that stands for a parameter in ties and constraints; copies of the set share it."""
        self[name]  # raises for an unknown name
        return ca.SX(self._symbols[name])

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """The constraints on expressions, in the order they were given."""
        return tuple(self._constraints)

    @property
    def frequency_constraints(self) -> tuple[FrequencyConstraint, ...]:
        """The constraints on natural frequencies, in the order they were given."""
        return tuple(self._frequencies)

    def as_dict(self) -> dict[str, float]:
        """Name -> value with every tie worked out; nan or inf where a tie gives no finite number."""
        if self._resolved is None:
            values = {name: parameter._value for name, parameter in self._items.items()}
            if self._ties:
                symbols = ca.vertcat(*self._symbols.values())
                for name in self.tied_in_order():
                    own = ca.substitute(self._ties[name], symbols, ca.vertcat(*values.values()))
                    values[name] = float(own)
            self._resolved = values
        return dict(self._resolved)

    def tied_in_order(self) -> tuple[str, ...]:
        """The tied names, each after the tied ones that its own tie refers to."""
        return ties.in_order(self._references)

    def references(self, names: Iterable[str]) -> set[str]:
        """`names` and all that their ties refer to, directly or through other ties."""
        return ties.closure(self._references, names)

    # ---- changing ------------------------------------------------------------------------------

    def add(
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
    ) -> Parameter:
        """Add a parameter (see `Parameter`) and return it; one that the model lacks serves in ties."""
        self._check_open()
        return self._insert(
            Parameter(
                name, value, unit=unit, min=min, max=max, vary=vary, prior=prior, description=description
            )
        )

    def fix(self, name: str, value: float | None = None) -> None:
        """Keep a parameter at `value` (in its unit), or at its present value."""
        self._check_open()
        parameter = self[name]
        if parameter.tie is not None:
            raise TieError(
                f"the parameter {name} cannot be both tied and fixed",
                seen=f"{name} == {parameter.tie}",
                allowed="one of the two",
                cure=f'call untie("{name}") first, or fix what it is tied to',
            )
        if value is not None:
            parameter.set(value, vary=False)
        else:
            parameter.set(vary=False)

    def free(self, *names: str) -> None:
        """Have parameters estimated."""
        self._check_open()
        for name in names:
            if self[name].tie is not None:
                raise TieError(
                    f"the parameter {name} is tied and cannot be freed",
                    seen=f"{name} == {self[name].tie}",
                    allowed="parameters that are not tied",
                    cure=f'call untie("{name}") first',
                )
        for name in names:
            self._items[name].set(vary=True)

    def tie(self, name: str, expression: Any) -> None:
        """Make a parameter an expression of others: text, or a CasADi SX scalar of `symbol(name)`.

        A tie given before is replaced. Raises TieError for an unknown name in the expression, a cycle, or a
        parameter that was fixed; ExpressionError for text outside the grammar.
        """
        self._check_open()
        parameter = self[name]
        if parameter._explicit:
            raise TieError(
                f"the parameter {name} cannot be both tied and fixed",
                seen=f"{name} is fixed at {parameter._value:.6g}",
                allowed="one of the two",
                cure=f'call free("{name}") first, or leave the tie out',
            )
        tied, text = read_given(expression, self._symbols, f"the tie of {name}", TieError)
        references = names_in(tied)
        cycle = ties.cycle(self._references, name, references)
        if cycle:
            raise TieError(
                "ties close a cycle",
                seen=" -> ".join(cycle),
                allowed="ties that end at free or fixed parameters",
                cure=f"leave out one of them, such as the tie of {cycle[-2]}",
            )
        self._ties[name], self._references[name] = tied, references
        parameter._tie = text if text is not None else shown_text(tied)
        (self._text_ties.discard if text is None else self._text_ties.add)(name)
        self._changed()

    def untie(self, name: str) -> None:
        """Take a tie away; the parameter keeps the value it had by the tie, moved into its bounds."""
        self._check_open()
        parameter = self[name]
        if parameter.tie is None:
            raise TieError(
                f"the parameter {name} is not tied",
                seen=name,
                allowed=", ".join(self._ties) or "(no parameter is tied)",
                cure="leave the call out",
            )
        parameter._value, parameter._tie = parameter._settled_value(), None
        del self._ties[name], self._references[name]
        self._changed()

    def constrain(
        self, expression: Any, min: float = -math.inf, max: float = math.inf, *, name: str | None = None
    ) -> None:
        """Keep min <= expression <= max in every fit; min = max makes an equality.

        `expression` is text or a CasADi SX scalar of `symbol(name)`; `min` and `max` are in its unit; `name`
        stands for it in tables. With parameters that vary by experiment it holds for every record. Raises
        ConstraintError for bounds that are no bounds or a name given twice.
        """
        self._check_open()
        if name is not None and (not isinstance(name, str) or not name):
            raise ConstraintError(
                "the name of a constraint is not acceptable",
                seen=repr(name),
                allowed="text, or None for the expression itself",
                cure="give a short text in quotes",
            )
        read, text = read_given(expression, self._symbols, "a constraint", ConstraintError)
        shown = text if text is not None else shown_text(read)
        label = shown if name is None else name
        lower, upper = check_bounds(label, min, max)
        if name is not None and any(name == constraint.name for constraint in self._constraints):
            raise ConstraintError(
                "two constraints have one name",
                seen=name,
                allowed="a name of its own for each",
                cure="give another name",
            )
        self._constraints.append(
            Constraint(label, read, lower, upper, names_in(read), shown, name, readable=text is not None)
        )

    def constrain_frequency(self, mode: int, min: float = 0.0, max: float = math.inf) -> None:
        """Keep natural frequency number `mode` between `min` and `max` [Hz] in every fit.

        Modes are numbered from 1 by rising undamped frequency; the rigid body mode (0 Hz) is not counted.
        """
        self._check_open()
        constraint = check_frequency(mode, min, max)
        if any(constraint.mode == other.mode for other in self._frequencies):
            raise ConstraintError(
                f"natural frequency {mode} is constrained twice",
                seen=str(constraint),
                allowed="one pair of bounds for each mode",
                cure="give both bounds in one call",
            )
        self._frequencies.append(constraint)

    def vary_by_experiment(
        self, *names: str, values: Mapping[str, float | tuple[float, float, float]] | None = None
    ) -> None:
        """Give every record its own value of free parameters, estimated as ``name@record``.

        values : record -> where its search starts, or (start, min, max); records left out take those of the set. A
            fixed parameter can have its own value in every record too, if they are given.
        """
        self._check_open()
        for name in names:
            parameter = self[name]
            if not parameter.vary and (values is None or parameter.tie is not None):
                tie = parameter.tie
                raise ParameterError(
                    f"the parameter {name} cannot vary by experiment, for it is not free",
                    seen=f"{name} == {tie}" if tie is not None else f"{name} is fixed",
                    allowed="free parameters, and fixed ones with `values`",
                    cure=f'call {"untie" if tie is not None else "free"}("{name}") first',
                )
        found = {name: own_values(self[name], values) for name in names}
        for name, own in found.items():
            self._items[name]._varies, self._items[name]._own = True, own
            self._changed()

    # ---- copies --------------------------------------------------------------------------------

    def copy(self) -> Parameters:
        """An independent set that can be changed; it shares the symbols."""
        other = Parameters()
        other._items = {name: parameter._copy(other) for name, parameter in self._items.items()}
        other._symbols, other._ties = dict(self._symbols), dict(self._ties)
        other._references, other._text_ties = dict(self._references), set(self._text_ties)
        other._constraints, other._frequencies = list(self._constraints), list(self._frequencies)
        other._resolved = self._resolved
        return other

    __copy__ = copy

    def __deepcopy__(self, memo: dict[int, Any]) -> Parameters:
        return self.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        """What other processes are sent; symbols are made anew there."""
        return storage.received, (self.to_dict(), self._frozen)

    def frozen(self) -> Parameters:
        """A copy on which every change raises ParameterError; ``copy()`` of it can be changed again."""
        other = self.copy()
        other._frozen = True
        return other

    def extended(self, other: Any) -> Parameters:
        """A copy with all settings kept and the names that only `other` has added, free.

        `other` is a set, or a model, whose fresh set is taken (``model.parameters()``); what a model declares as fixed,
        such as the width of an effect's corners, stays so.

        Ties of the added names come along, and constraints of `other` that refer to one of them.
        """
        declared = not isinstance(other, Parameters)
        if declared and callable(getattr(other, "parameters", None)):
            other = other.parameters()
        if not isinstance(other, Parameters):
            raise ParameterError(
                "a set of parameters can only be extended by another",
                seen=type(other).__name__,
                allowed="Parameters, or a model",
                cure="give model.parameters()",
            )
        result = self.copy()
        new = [name for name in other._items if name not in self._items]
        for name in new:
            added = other._items[name]._copy(None)
            added._vary, added._explicit, added._tie = not declared or added._vary, False, None
            result._insert(added, other._symbols[name])
        mine = [result._symbols.get(name, symbol) for name, symbol in other._symbols.items()]
        theirs = ca.vertcat(*other._symbols.values())

        def moved(expression: Any) -> Any:
            return ca.substitute(expression, theirs, ca.vertcat(*mine))

        for name in new:
            if name in other._ties:
                result.tie(name, moved(other._ties[name]))
                result._items[name]._tie = other._items[name]._tie
                result._text_ties |= other._text_ties & {name}
        for constraint in other._constraints:
            if not set(new).isdisjoint(constraint.names):
                expression = moved(constraint.expression)
                result._constraints.append(dataclasses.replace(constraint, expression=expression))
        return result

    # ---- writing and printing ------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """The whole set as JSON-able data (infinite bounds as None).

        Raises ParameterError if a tie or constraint given as SX cannot be written in the grammar.
        """
        return storage.to_dict(self)

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Parameters:
        """The set that `to_dict` wrote; ParameterError names the place in `data` that does not fit."""
        return storage.from_dict(data, Parameters())

    def __str__(self) -> str:
        return table.text_table(self)

    def _repr_html_(self) -> str:
        return table.html_table(self)

    def __repr__(self) -> str:
        free = sum(parameter.vary for parameter in self._items.values())
        return f"<Parameters: {len(self)}, {free} free, {len(self._ties)} tied>"

    # ---- inside --------------------------------------------------------------------------------

    def _insert(self, parameter: Parameter, symbol: Any = None) -> Parameter:
        if not isinstance(parameter, Parameter):
            raise ParameterError(
                "a set of parameters is made of Parameter objects",
                seen=repr(parameter),
                allowed="Parameter(name, value, unit=..., min=..., max=...)",
                cure="wrap it in Parameter(...)",
            )
        name = parameter.name
        if name in self._items:
            raise ParameterError(
                f"the parameter {name} is there already",
                seen=name,
                allowed="a name of its own for each parameter",
                cure=f'give another name, or change it with parameters["{name}"].set(...)',
            )
        if parameter._owner is not None:
            parameter = parameter.__copy__()
        own = parameter._copy(self)
        self._items[name] = own
        self._symbols[name] = ca.SX.sym(name) if symbol is None else symbol
        self._changed()
        return own

    def _tie_text(self, name: str) -> str | None:
        """The tie of a parameter as text that can be read again, or None if it is not tied."""
        if name not in self._ties:
            return None
        text = self._items[name]._tie
        return text if name in self._text_ties else write_expression(self._ties[name])

    def _check_open(self) -> None:
        if self._frozen:
            raise ParameterError(
                "this set of parameters is frozen: it is part of a result",
                seen="an attempt to change it",
                allowed="changes of a copy",
                cure='pars = fit.parameters.copy(), for instance, and then pars["K"].value = 3',
            )

    def _changed(self) -> None:
        self._resolved = None

    def _unknown(self, name: object) -> ParameterError:
        return ParameterError(
            "unknown parameter",
            seen=repr(name),
            allowed=near_matches(name, self._items),
            cure="use one of these names, or add(...) it",
        )
