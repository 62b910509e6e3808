"""Where nothing is missing: the fit of the equations as they were written, whose jumps the search had rounded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from casadi_engine.discrepancy.checked_errors import no_smaller_errors
from casadi_engine.discrepancy.coloured_errors import with_colour_told
from casadi_engine.discrepancy.refit import merit
from casadi_engine.discrepancy.repaired import Repair
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.corner_widths import FELT, ROUNDED
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

# How what is said of rounded jumps begins.
JUMPED = "the equations jump with their states"


def with_own_jumps(
    found: Repair, model: Model, parameters: Parameters, noise: Noise | None, options: Mapping[str, Any]
) -> Repair:
    """The answer with a fit of the model as it was given, where nothing is missing and that fits as well; else itself.

    A rounded jump is a bias that the search for effects can bear, and who takes the parameters home cannot.
    """
    null = found.null_fit
    values = {name: value for name, value in null.values.items() if name in parameters}
    initial = {r: {n: e.value for n, e in states.items()} for r, states in null.initial.items()}
    # a record may begin beside a jump, on the other side of which its first states are better looked for anew
    for start in (Start(values, initial), Start(values)):
        try:
            with np.errstate(all="ignore"):
                fit: Fit = estimate(
                    model,
                    null.data,
                    parameters=parameters,
                    noise=noise,
                    warm=start,
                    progress=False,
                    **options,
                )
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            continue
        if fit.converged and merit(fit) <= merit(null) + FELT:
            break
    else:
        return found
    fit = no_smaller_errors(fit, found.fit)  # which know the colour of the noise
    if found.noise is not None and found.noise.colour:
        fit = with_colour_told(fit)
    kept = [words for words in found.messages if not words.startswith((JUMPED, ROUNDED))]
    said = "repair.fit is of the equations as they were written, jumps included"
    return replace(found, null_fit=fit, fit=fit, messages=(*kept, said))
