"""Names of parameters: what is accepted, and how a message points at the one that was meant."""

from __future__ import annotations

import difflib
import keyword
import unicodedata
from collections.abc import Iterable

from casadi_engine.errors import ParameterError

# Names that the text expressions of ties and constraints use themselves.
RESERVED = frozenset({"sqrt", "exp", "log", "sin", "cos", "tan", "tanh", "abs", "min", "max", "pi"})
SHOWN = 12


def near_matches(name: object, allowed: Iterable[str]) -> str:
    """Write the allowed names for a message, the ones most like `name` pointed out.

    The list is cut after twelve names. Upper and lower case are taken as equal when likeness is judged.

    >>> near_matches("j_eng", ["J_eng", "J_load", "K_el"])
    'J_eng, J_load, K_el (nearest: J_eng)'
    """
    names = list(allowed)
    if not names:
        return "(there are none)"
    lowered: dict[str, list[str]] = {}
    for candidate in names:
        lowered.setdefault(candidate.lower(), []).append(candidate)
    close = difflib.get_close_matches(str(name).lower(), lowered, n=3, cutoff=0.5)
    nearest = [candidate for key in close for candidate in lowered[key]]
    shown = ", ".join(names[:SHOWN]) + (f", … ({len(names) - SHOWN} more)" if len(names) > SHOWN else "")
    return f"{shown} (nearest: {', '.join(nearest)})" if nearest else shown


def check_name(name: object) -> str:
    """Return `name` if a parameter may be called so, or raise ParameterError.

    A name is an identifier or identifiers joined by dots (``coupling.coulomb_friction.torque``), in the
    normal form in which Python itself reads identifiers, so that text expressions can refer to it.
    """
    allowed = "identifiers joined by dots, such as J_eng or coupling.coulomb_friction.torque"
    if not isinstance(name, str):
        raise ParameterError(
            "a parameter's name must be text", seen=name, allowed=allowed, cure="give the name in quotes"
        )
    if not all(part.isidentifier() and not keyword.iskeyword(part) for part in name.split(".")):
        raise ParameterError(
            "a parameter's name is not acceptable",
            seen=repr(name),
            allowed=allowed,
            cure="use letters, digits and _, not starting with a digit, and no word of the Python language",
        )
    if name in RESERVED:
        raise ParameterError(
            "a parameter's name is taken by a function or constant of the expressions",
            seen=repr(name),
            allowed=f"any other name than {', '.join(sorted(RESERVED))}",
            cure=f"call it {name}_",
        )
    normal = unicodedata.normalize("NFKC", name)
    if normal != name:
        raise ParameterError(
            "a parameter's name holds letters that expressions read as other letters",
            seen=f"{name!r} ({', '.join(f'U+{ord(letter):04X}' for letter in name if ord(letter) > 127)})",
            allowed="letters in their normal form (NFKC)",
            cure=f"write it {normal!r}",
        )
    return name
