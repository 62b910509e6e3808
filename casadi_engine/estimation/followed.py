"""How much of an output's motion the simulation of a fit follows: a wrong optimum follows little."""

from __future__ import annotations

import numpy as np

from casadi_engine.estimation.fit import Fit

# Key of a fit's options: from how many other starts it was searched too, as it was lost.
OTHERS = "other starts"
# Share of an output's motion, in per cent, below which a fit may well be lost: at a wrong resonance it is.
FOLLOWED = 70.0
# Samples from which on what passes for white is noise, however large it is; an oscillation that is missed altogether
# passes too, where there are fewer.
_TELLS = 100
# Mean square of a residual, in that of the noise that was stated, up to which it is that noise.
_AS_STATED = 1.5


def not_followed(fit: Fit) -> dict[str, float]:
    """``record/output`` -> per cent of its motion that is followed, of the outputs of which a good part is left."""
    return {
        f"{record}/{output}": own["simulation"]
        for record, outputs in fit.fit_percent.items()
        for output, own in outputs.items()
        if own["simulation"] is not None and own["simulation"] < FOLLOWED
    }


def lost(fit: Fit) -> dict[str, float]:
    """The same, where what is left is not white, or is of so few samples that none tells, and of no stated level."""
    return {key: share for key, share in not_followed(fit).items() if not _is_noise(fit, key)}


def _is_noise(fit: Fit, key: str) -> bool:
    """True for a residual that is white as far as many samples tell, or as small as the noise that was stated, or as
    what is left of records that are followed."""
    traces = {
        f"{record}/{name}": (name, one) for record, own in fit.traces.items() for name, one in own.items()
    }
    if any(words.startswith(f"the residual of {key} is not white") for words in fit.messages):
        return False
    if key not in traces:
        return True
    output, trace = traces[key]
    sigma, estimated = fit.noise[output]
    e = trace.residual[trace.mask]
    size = float(np.mean(e**2)) / _AS_STATED
    if len(e) >= _TELLS or (not estimated and size <= sigma**2):
        return True
    followed = traces.keys() - not_followed(fit).keys()
    others = [
        one.residual[one.mask]
        for other, (name, one) in traces.items()
        if name == output and other in followed
    ]
    known = np.concatenate([np.zeros(0), *others])
    return len(known) >= len(e) and size <= float(np.mean(known**2))
