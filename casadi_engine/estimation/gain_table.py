"""The predictor of a fit in words and as rows of a table."""

from __future__ import annotations

import math
from collections.abc import Callable

from casadi_engine.estimation.fit import Fit

# What each kind of gain is called.
KINDS = {
    "stated": "given",
    "innovations": "estimated (innovations form)",
    "process": "by the Riccati equation from the noise covariances",
}


def predictor_words(fit: Fit) -> str:
    """One sentence on how the gain came about, the innovations' size and how fast the predictor forgets."""
    found = fit.innovations
    if found is None:
        return "none: the model is simulated (output error)"
    units = {variable.name: variable.unit for variable in fit.model.outputs}
    sizes = ", ".join(f"{name} {sigma:.4g} {units[name]}" for name, sigma in found.sigma.items())
    text = f"gain {KINDS[found.kind]}; innovations sigma {sizes}; spectral radius {found.radius:.6f}"
    if found.radius >= 1:
        text += " (NOT stable)"
    return text + (f"; corrected at every {found.every}. step" if found.every > 1 else "")


def gain_rows(fit: Fit, write: Callable[[float, float | None], str]) -> list[tuple[str, str, str]]:
    """State, output, K with its standard error and unit; ``write`` makes text of a value and its error."""
    found = fit.innovations
    if found is None:
        return []
    units = {variable.name: variable.unit for variable in (*fit.model.states, *fit.model.outputs)}
    rows = []
    for i, state in enumerate(found.states):
        for j, output in enumerate(found.outputs):
            error = float(found.stderr[i, j])
            number = write(float(found.kalman[i, j]), error if math.isfinite(error) else None)
            unit = "1" if units[state] == units[output] else f"{units[state]}/({units[output]})"
            rows.append((state, output, f"{number} {unit}"))
    return rows
