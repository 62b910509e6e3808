"""Fits of models with late sensors, or inputs that act late: samples are read at the times that they show, or at which
they act, as the delays turn out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.deadline import late
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.ipopt import ONE_STEP
from casadi_engine.estimation.lower_optimum import merit
from casadi_engine.model import Model
from casadi_engine.model.lags import delays, far_from_lags, is_late, lagged, with_nearest_lags
from casadi_engine.model.late_inputs import input_lags, late_inputs, shortest_step
from casadi_engine.parameters import Parameters

# Times that samples are read anew. A delay as long as the motion takes to turn arrives after three.
_AGAIN = 8
# Chi-squared that a first state may well take away.
_FEWER = 4.0
# Optima that are followed, and the share of a delay up to which two of them are one.
_OPTIMA, _ALIKE = 4, 0.02


def begun_late(arguments: Mapping[str, Any]) -> Model:
    """The model of a search with the lags that the delays it starts from ask for."""
    model, pars, warm = arguments["model"], arguments["parameters"], arguments["warm"]
    if not is_late(model):
        return model
    names = [*delays(model).values(), *late_inputs(model).values()]
    known = {name: pars[name].value for name in names if name in pars}
    known |= {name: value for name, value in getattr(warm, "values", {}).items() if name in known}
    return with_nearest_lags(model, known, arguments["data"], begun=True)


def follow_delays(fit: Fit, parameters: Parameters, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit with lags within a sample of its delays; again(changed arguments) : makes a fit.

    By the lags of the start, the law of a long delay is far off, and so may be the lowest of several optima: each of
    them is followed, and the best end is the answer.
    """
    fit = _read_late(fit, again)
    names = set(delays(fit.model).values())
    if not names:
        return fit
    ends = [_followed(fit, again)]
    for other in fit.optima[1:]:
        if late() or len(ends) == _OPTIMA:
            break
        if not all(_apart(other.values, one.values, names) for one in (fit, *ends)):
            continue
        begun = parameters.copy()
        for name, value in other.values.items():
            if name in begun:
                begun[name].set(float(np.clip(value, begun[name].min, begun[name].max)))
        model = with_nearest_lags(fit.model, other.values, fit.data)
        with suppress(CasadiEngineError, FloatingPointError):
            made = again({"model": model, "parameters": begun, "warm": None})
            ends.append(_followed(made, again))
    return _best(ends)


def _read_late(fit: Fit, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit with inputs that act late read off the record, where that leaves no more than the law of their delay; the
    fit as it is elsewhere: what is no delay may look like that law."""
    # a step short of its optimum is near enough to read the record by
    if not late_inputs(fit.model) or not (fit.converged or ONE_STEP in fit.status):
        return fit
    lags, found = dict(fit.model.lags), fit
    for _ in range(_AGAIN):
        model = lagged(found.model, lags | input_lags(found.model, found.values, fit.data, begun=False))
        if model is found.model or late():
            break
        warm = None if found is fit else found
        with suppress(CasadiEngineError, FloatingPointError):
            made = again({"model": model, "parameters": found.parameters, "warm": warm})
            if made.converged:
                found = made
                continue
        break
    states = len(fit.model.states) - len(found.model.states)
    found = _with_long_errors(found)
    return found if merit(found) <= merit(fit) + _FEWER * states * len(fit.data) else fit


def _with_long_errors(fit: Fit) -> Fit:
    """The fit, with a word on errors of late inputs that are longer than the steps between which these go along a line:
    beyond them nothing of the record was looked at."""
    step, said = shortest_step(fit.model, fit.data), []
    for name, delay in late_inputs(fit.model).items():
        found = fit.estimates.get(delay)
        error = 0.0 if found is None else found.stderr or found.quadratic or 0.0
        if name in dict(fit.model.late) and 2 * error > step > 0:
            said.append(
                f"the error of {delay} is longer than a step of the record, over which {name} is taken to go along a "
                f'line: ce.profile(fit, "{delay}") reads the record at each of its values'
            )
    return replace(fit, messages=(*fit.messages, *said)) if said else fit


def _best(ends: list[Fit]) -> Fit:
    """Of the fits that describe their samples equally well, within chance, that of the most samples: what lies before
    the record by a delay, or behind it by a sensor that is early, is not counted."""
    ready = [one for one in ends if one.converged] or ends
    least = min(one.cost / one.n for one in ready)
    alike = [one for one in ready if one.cost / one.n <= least * (1 + 3 * math.sqrt(2 / one.n))]
    most = max(one.n for one in alike)
    best = min((one for one in alike if one.n == most), key=lambda one: one.cost)
    if len(ends) == 1:
        return best
    names = set(delays(best.model).values())
    optima = [best.optima[0]]
    for one in sorted(ends, key=lambda one: one.cost / one.n):
        if all(_apart(one.values, known.values, names) for known in optima):
            words = ", ".join(f"{name} = {one.values[name]:.4g} s" for name in sorted(names))
            optima.append(replace(one.optima[0], apart=words))
    return replace(best, optima=tuple(optima))


def _apart(one: Mapping[str, float], other: Mapping[str, float], names: Iterable[str]) -> bool:
    """True if the delays of two optima differ."""
    return any(abs(one[name] - other[name]) > _ALIKE * abs(other[name]) for name in names)


def _followed(fit: Fit, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit of one optimum, its samples read anew as the delays turn out."""
    for _ in range(_AGAIN):
        model = with_nearest_lags(fit.model, fit.values, fit.data)
        if model is fit.model:
            break
        fit = again({"model": model, "warm": fit})
    far = far_from_lags(fit.model, fit.values, fit.data)
    if not far:
        return fit
    late = ", ".join(f"{name} = {fit.values[name]:.4g} s" for name in far)
    words = (
        f"the samples of a late sensor are not read where they belong ({late}): a delay counts to second order beyond "
        "half of the longest record or nine tenths of the shortest, and where it does not settle"
    )
    return replace(fit, messages=(words, *fit.messages))
