"""The options of ``estimate``, read and checked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import CasadiEngineError, EstimationError
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.loss import loss_of
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import near_matches
from casadi_engine.simulation.grid import Grid

Array = NDArray[np.float64]

# The solver counts its iterations in 32 bits.
_MOST = 2**31 - 1
# "auto" cuts a record into about this many intervals; into the second number where the search begins at the optimum in
# the frequency domain, and the solver's work is that of its variables.
_AUTO, _FEW = 100, 20
# Processor time that intervals by profile may take where the quadratic fails [s].
USUAL = 3.0
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
_TEXT = re.compile(r"^\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(s|ms|us|samples|sample)\s*$")


def interval_length(interval: Any, grid: Grid, *, whole: bool = False, few: bool = False) -> int | None:
    """Samples of a shooting interval, or None for single shooting.

    interval : "auto", "single", a number of samples, or text such as "10 ms" or "144 samples"
    whole : "auto" is a single interval, for models that jump with their states: a start of an interval beside a switch
        that may move to its other side has no smooth influence
    few : "auto" is few intervals, for a search that begins at an optimum
    """
    if isinstance(interval, str) and interval == "auto" and whole:
        return None
    if isinstance(interval, str) and interval == "auto":
        return max(16, 16 * round(grid.samples / (_FEW if few else _AUTO) / 16))
    if interval is None or (isinstance(interval, str) and interval == "single"):
        return None
    found: float | None = None
    if isinstance(interval, (int, np.integer)) and not isinstance(interval, bool):
        found = as_number(interval)
    elif isinstance(interval, str) and (match := _TEXT.match(interval)):
        number, unit = float(match[1]), match[2]
        found = number * _UNITS[unit] / grid.step if unit in _UNITS else number
        found = float(round(found)) if unit in _UNITS and math.isfinite(found) else found
    if found is None or not 1 <= found < math.inf or found != int(found):
        raise EstimationError(
            "the shooting interval is not acceptable",
            seen=repr(interval),
            allowed='"auto", "single", a whole number of samples >= 1, or a time such as "10 ms"',
            cure='leave it out for "auto"',
        )
    return int(found)


def initial_bounds(
    initial: Any, model: Model, record: str, records: Sequence[str]
) -> tuple[Array, Array, Array]:
    """(lower, upper, start) of the initial state (n,), in the states' units; NaN start where it is free.

    initial : None; state -> number (fixed; an Estimate counts as one), (low, high) or "free"; or record -> such a
        mapping, as ``fit.initial`` is
    """
    names = [state.name for state in model.states]
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    start = np.full(len(names), np.nan)
    if initial is None:
        return lower, upper, start
    if not isinstance(initial, Mapping):
        raise _bad_initial(initial, names)
    if initial and all(isinstance(value, Mapping) for value in initial.values()):
        for key in initial:
            if key not in records:
                raise EstimationError(
                    "initial states are given for a record that is not there",
                    seen=repr(key),
                    allowed=", ".join(records),
                    cure="use the record's name",
                )
        initial = initial.get(record, {})
    for name, value in initial.items():
        if name not in names:
            raise EstimationError(
                f"the model {model.name} has no such state",
                seen=repr(name),
                allowed=near_matches(name, names),
                cure="print(model.table()) lists the states",
            )
        k = names.index(name)
        if isinstance(value, str) and value == "free":
            continue
        fixed = as_number(value)
        pair = [as_number(part) for part in value] if isinstance(value, (tuple, list)) else []
        if fixed is not None and math.isfinite(fixed):
            lower[k] = upper[k] = start[k] = fixed
        elif len(pair) == 2 and pair[0] is not None and pair[1] is not None and pair[0] < pair[1]:
            lower[k], upper[k] = pair
        else:
            raise _bad_initial({name: value}, [name])
    return lower, upper, start


def begun_at(record: Experiment, initial: Any, model: Model, records: Sequence[str]) -> Experiment:
    """The record, told at which instant its initial states hold.

    Numbers given for initial states hold where the inputs begin, or the times of the outputs where there are none;
    estimates of a fit at their own instant; states that are all free at the first valid sample of the outputs.
    """
    if not isinstance(initial, Mapping):
        return record
    if initial and all(isinstance(value, Mapping) for value in initial.values()):
        initial = initial.get(record.name, {}) if record.name in records else {}
    times = [
        value.time for value in initial.values() if isinstance(value, Estimate) and value.time is not None
    ]
    inputs = [record[v.name].span[0] for v in model.inputs if v.name in record]
    outputs = [record[v.name].span[0] for v in model.outputs if v.name in record]
    known = [max(inputs)] if inputs else [min(outputs)] if outputs else []
    fixed = any(as_number(value) is not None for value in initial.values())
    begin = min(times) if times else known[0] if fixed and known else None
    return replace(record, begin=begin)


def as_number(value: Any) -> float | None:
    """A real number of any kind, or the value of an Estimate such as ``fit.initial[record][state]``, else None."""
    value = value.value if isinstance(value, Estimate) else value
    if isinstance(value, (bool, np.bool_, str)) or np.ndim(value) or value is None:
        return None
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return None


def _bad_initial(seen: Any, names: Sequence[str]) -> EstimationError:
    return EstimationError(
        "the initial states are not acceptable",
        seen=repr(seen),
        allowed='a mapping of state to a number (fixed), a pair (low, high) with low < high, or "free"',
        cure=f'write initial={{"{names[0]}": 0.5}} or initial={{"{names[0]}": (0.1, 0.9)}}, for instance',
    )


def whole(name: str, value: Any, least: int) -> int:
    """A whole number >= least, or an error that names the option; a seed may have any size."""
    most = math.inf if name == "seed" else _MOST
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and least <= value <= most:
        return int(value)
    raise EstimationError(
        f"{name} is not acceptable",
        seen=repr(value),
        allowed=f"a whole number >= {least}" + (" and < 2**31" if math.isfinite(most) else ""),
        cure=f"leave {name} out",
    )


def chosen(name: str, value: Any, words: Sequence[str]) -> str:
    """One of the words, or an error that names the option."""
    if isinstance(value, str) and value in words:
        return value
    raise EstimationError(
        f"{name} is not acceptable",
        seen=repr(value),
        allowed=" or ".join(f'"{word}"' for word in words),
        cure=f"leave {name} out",
    )


def seconds_for_intervals(errors: Any) -> float | None:
    """Seconds of processor time for intervals by profile, None where errors are not to be checked."""
    seconds = as_number(errors)
    if seconds is not None and 0 <= seconds < math.inf:
        return seconds
    words = {"checked": USUAL, "quadratic": None}
    if isinstance(errors, str) and errors in words:
        return words[errors]
    raise EstimationError(
        "errors is not acceptable",
        seen=repr(errors),
        allowed='"checked", "quadratic", or seconds >= 0',
        cure="leave errors out",
    )


def small(tolerance: Any) -> float:
    """A tolerance > 0, or an error."""
    value = as_number(tolerance)
    if value is not None and 0 < value < math.inf:
        return value
    raise EstimationError(
        "the tolerance is not acceptable",
        seen=repr(tolerance),
        allowed="a number > 0, such as 1e-9",
        cure="leave it out",
    )


def check_likelihood(fit: Any, what: str, error: type[CasadiEngineError] = EstimationError) -> None:
    """Raise ``error`` for what has no likelihood of normal noise at an optimum, for "a profile" or "a posterior"."""
    if not isinstance(fit, Fit):
        raise error(
            f"{what} needs a fit",
            seen=type(fit).__name__,
            allowed="a Fit",
            cure="give what ce.estimate returned",
        )
    if not fit.converged or not fit.free:
        raise error(
            f"{what} needs a fit that converged, with free parameters",
            seen=fit.status if fit.free else "no free parameter",
            allowed="a converged fit",
            cure="fit again with other start values, more iterations, or more free parameters",
        )
    if loss_of(fit).robust:
        raise error(
            f"{what} needs the likelihood of normal noise",
            seen=f"loss={fit.options['loss']}",
            allowed='loss="square"',
            cure='fit again with loss="square", outliers masked',
        )


def check_level(level: Any, error: type[CasadiEngineError] = EstimationError) -> None:
    """Raise ``error`` for what is no probability of an interval."""
    number = isinstance(level, int | float | np.floating) and not isinstance(level, bool)
    if not (number and 0 < level < 1):
        raise error(
            "the level of the intervals is not acceptable",
            seen=repr(level),
            allowed="a number between 0 and 1, such as 0.95",
            cure="leave it out for 0.95",
        )
