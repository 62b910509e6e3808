"""Fits of models with late sensors: the samples are read at the times that they show, as the delays turn out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from casadi_engine.estimation.fit import Fit
from casadi_engine.model import Model
from casadi_engine.model.lags import delays, far_from_lags, with_nearest_lags

# Times that samples are read anew. A delay as long as the motion takes to turn arrives after three.
_AGAIN = 8


def begun_late(arguments: Mapping[str, Any]) -> Model:
    """The model of a search with the lags that the delays it starts from ask for."""
    model, pars, warm = arguments["model"], arguments["parameters"], arguments["warm"]
    if not delays(model):
        return model
    known = {name: pars[name].value for name in delays(model).values() if name in pars}
    known |= {name: value for name, value in getattr(warm, "values", {}).items() if name in known}
    return with_nearest_lags(model, known, arguments["data"])


def follow_delays(fit: Fit, again: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit with lags within a sample of its delays; again(changed arguments) : makes a fit."""
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
