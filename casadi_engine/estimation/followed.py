"""How much of an output's motion the simulation of a fit follows: a wrong optimum follows little."""

from __future__ import annotations

from casadi_engine.estimation.fit import Fit

# Share of an output's motion, in per cent, below which a fit may well be lost: at a wrong resonance it is.
FOLLOWED = 70.0
# Samples from which on what passes for white is noise, however large it is; an oscillation that is missed altogether
# passes too, where there are fewer.
_TELLS = 100


def not_followed(fit: Fit) -> dict[str, float]:
    """``record/output`` -> per cent of its motion that is followed, of the outputs of which a good part is left."""
    return {
        f"{record}/{output}": own["simulation"]
        for record, outputs in fit.fit_percent.items()
        for output, own in outputs.items()
        if own["simulation"] is not None and own["simulation"] < FOLLOWED
    }


def lost(fit: Fit) -> dict[str, float]:
    """The same, where what is left is not white, or too few samples tell whether it is."""
    return {key: share for key, share in not_followed(fit).items() if not _is_noise(fit, key)}


def _is_noise(fit: Fit, key: str) -> bool:
    """True for a residual that is white as far as many samples tell."""
    masks = {f"{record}/{name}": one.mask for record, own in fit.traces.items() for name, one in own.items()}
    coloured = any(words.startswith(f"the residual of {key} is not white") for words in fit.messages)
    return not coloured and int(masks[key].sum()) >= _TELLS
