"""--set, --free and --fix: changes of a problem's parameters from the command line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from casadi_engine.errors import ParameterError
from casadi_engine.parameters import Parameters


def apply_settings(
    parameters: Parameters, *, set: Sequence[str] = (), free: Sequence[str] = (), fix: Sequence[str] = ()
) -> Parameters:
    """Return a copy with values set, parameters freed, and parameters fixed, in this order.

    set : NAME=VALUE; free : NAME; fix : NAME or NAME=VALUE; values in the parameter's unit.
    ParameterError for text of another form, a name that is not there, a name given twice, one that is both
    freed and fixed, and values outside the bounds.
    """
    result = parameters.copy()
    known = next(iter(parameters), "NAME")
    values = [_pair(text, "--set", known, needed=True) for text in set]
    fixed = [_pair(text, "--fix", known, needed=False) for text in fix]
    _no_repeats("--set", [name for name, _ in values])
    _no_repeats("--free", free)
    _no_repeats("--fix", [name for name, _ in fixed])
    _apart("--free", free, "--fix", [name for name, _ in fixed], "a parameter is either free or fixed")
    _apart(
        "--set",
        [name for name, _ in values],
        "--fix",
        [name for name, value in fixed if value is not None],
        "one value for each parameter",
    )
    for name, value in values:
        if value is not None:  # which _pair has seen to
            result[name].set(value)
    result.free(*free)
    for name, value in fixed:
        result.fix(name, value)
    return result


def _pair(text: str, option: str, known: str, *, needed: bool) -> tuple[str, float | None]:
    form = "NAME=VALUE" if needed else "NAME or NAME=VALUE"
    name, equals, number = (part.strip() for part in text.partition("="))
    cure = f"write for instance {option} {known}=0.4"
    if not name or (needed and not equals):
        raise ParameterError(f"{option} is not of the form {form}", seen=repr(text), allowed=form, cure=cure)
    if not equals:
        return name, None
    try:
        return name, float(number)
    except ValueError:
        raise ParameterError(
            f"the value of {option} is not a number",
            seen=repr(text),
            allowed="one number with a decimal point, in the unit of the parameter",
            cure=cure,
        ) from None


def _no_repeats(option: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(
                f"{option} names a parameter twice", seen=name, allowed="each once", cure="leave one out"
            )


def _apart(first: str, names: Iterable[str], second: str, others: Iterable[str], allowed: str) -> None:
    both = [name for name in names if name in set(others)]
    if both:
        raise ParameterError(
            f"{first} and {second} name the same parameter",
            seen=", ".join(both),
            allowed=allowed,
            cure="leave one of the two out",
        )
