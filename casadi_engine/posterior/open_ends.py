"""Bounds for the parameters of effects that have none on one side: what an effect does may have either sign.

A flat prior without an end is no distribution. Where the data end it, the posterior is that of any flat prior which is
wider than all that is drawn; the log evidence alone counts with its width.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import PosteriorError
from casadi_engine.estimation.fit import Fit
from casadi_engine.parameters import Parameters

# Standard errors of the quadratic from the optimum to an end, and the share of that way within which all draws lie.
REACH, SHARE = 100.0, 0.5


def with_ends(fit: Fit) -> tuple[Parameters, dict[str, float]]:
    """A fit's parameters, those of effects with ends where they had none; and, of these, how far from the fit's value
    draws may lie."""
    pars = fit.parameters.copy()
    within: dict[str, float] = {}
    keys = tuple(f"{one.key}." for one in fit.model.effects)
    for bare in dict.fromkeys(name.partition("@")[0] for name in fit.free):
        one = pars[bare]
        if not keys or not bare.startswith(keys) or one.prior is not None or _is_closed(one.min, one.max):
            continue
        own = [name for name in fit.free if name.partition("@")[0] == bare]
        errors = [fit.estimates[name].stderr or fit.estimates[name].quadratic or np.nan for name in own]
        values, reach = [fit.values[name] for name in own], REACH * max(errors)
        if not np.isfinite(reach):
            continue
        low, high = min(values) - reach, max(values) + reach
        one.set(min=one.min if np.isfinite(one.min) else low, max=one.max if np.isfinite(one.max) else high)
        within |= dict.fromkeys(own, SHARE * reach)
    return pars, within


def check_ends(
    fit: Fit, within: dict[str, float], names: tuple[str, ...], values: NDArray[np.float64]
) -> None:
    """Raise PosteriorError where draws (k, d) of the numbers ``names`` come near an end that nobody stated."""
    for name, most in within.items():
        far = float(np.abs(values[:, names.index(name)] - fit.values[name]).max())
        if far > most:
            raise PosteriorError(
                "the data do not bound a parameter that has no bounds",
                seen=f"{name}: draws as far as {far:.3g} from {fit.values[name]:.3g}",
                allowed=f"draws within {most:.3g} of it, {SHARE * REACH:g} standard errors, or bounds",
                cure=f'give bounds, pars["{name.partition("@")[0]}"].set(min=..., max=...), or a prior, and fit again',
            )


def _is_closed(low: float, high: float) -> bool:
    return bool(np.isfinite([low, high]).all())
