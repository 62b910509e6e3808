"""How much of an output's motion the simulation of a fit follows: a wrong optimum follows little."""

from __future__ import annotations

from casadi_engine.estimation.fit import Fit

# Share of an output's motion, in per cent, below which a fit may well be lost: at a wrong resonance it is.
FOLLOWED = 70.0


def not_followed(fit: Fit) -> dict[str, float]:
    """``record/output`` -> per cent of its motion that is followed, of the outputs of which a good part is left."""
    return {
        f"{record}/{output}": own["simulation"]
        for record, outputs in fit.fit_percent.items()
        for output, own in outputs.items()
        if own["simulation"] is not None and own["simulation"] < FOLLOWED
    }
