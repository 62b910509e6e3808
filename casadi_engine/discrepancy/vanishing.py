"""Declared terms that the repaired model no longer asks for: what stood for a missing effect may well be zero."""

from __future__ import annotations

import math

from casadi_engine.estimation import Fit

# A term may be left out where the data are so many times more probable without it.
_WITHOUT = 3.0
_WIDTH = math.sqrt(12)


def odds_without(fit: Fit, name: str) -> float | None:
    """How many times more probable the data are where a free parameter is zero than where it may be anything between
    its bounds; None where zero is not allowed, or nothing is known of its error.

    The ratio of the densities at zero after and before the data (Dickey 1971), the former by Laplace's method; without
    both bounds a uniform density ten times as wide as the start value is taken, as for its evidence.
    """
    own, found = fit.parameters[name.partition("@")[0]], fit.estimates[name]
    if found.fixed or found.stderr is None or not found.stderr > 0 or not own.min <= 0 <= own.max:
        return None
    width = own.max - own.min
    if not math.isfinite(width):
        width = 10 * _WIDTH * max(abs(float(own.value) or found.value), 1e-12)
    beyond = found.value / found.stderr
    inside = 0.5 * (
        math.erf((own.max - found.value) / found.stderr / math.sqrt(2))
        + math.erf((found.value - own.min) / found.stderr / math.sqrt(2))
    )
    if inside <= 0:
        return None
    return width / (found.stderr * math.sqrt(2 * math.pi) * inside) * math.exp(-0.5 * beyond**2)


def may_vanish(fit: Fit) -> list[str]:
    """What to say of free parameters of the model that are as good as zero."""
    added = {f"{one.at}.{one.effect.name}" for one in fit.model.effects}
    said = []
    for name in fit.free:
        if name.rpartition(".")[0] in added or name not in fit.estimates:
            continue
        odds = odds_without(fit, name)
        if odds is not None and odds > _WITHOUT:
            said.append(
                f"{name} may be left out of the repaired model: the data are {odds:.2g} times more probable where it "
                "is zero"
            )
    return said
