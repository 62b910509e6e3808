"""A mapping by name whose missing names are a named error."""

from __future__ import annotations

from typing import NoReturn, TypeVar

from casadi_engine.errors import UnknownNameError
from casadi_engine.parameters.names import near_matches

Value = TypeVar("Value")


class ByName(dict[str, Value]):
    """Name -> value; UnknownNameError, which is a KeyError too, for a name that is not there."""

    def __missing__(self, name: object) -> NoReturn:
        raise UnknownNameError(
            "there is nothing of this name here",
            seen=repr(name),
            allowed=near_matches(name, self),
            cure="correct the name; list(...) shows all of them",
        )
