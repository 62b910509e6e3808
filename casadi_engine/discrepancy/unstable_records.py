"""Records along which an unstable motion cannot be followed, in pieces for the search.

A machine that a controller balances is measured with what drives it, and its model alone falls over. A fit follows such
a motion from one shooting interval to the next, whatever the length of the record. Effects are looked for along
simulations, which no start keeps near the measurement for long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from casadi_engine.discrepancy.clocks import clock_of
from casadi_engine.discrepancy.fresh import Portions
from casadi_engine.estimation import Fit
from casadi_engine.experiment import Experiment


def in_pieces(portion: Portions, fit: Fit) -> Portions | None:
    """The records in pieces along which the motion of a fit can be followed; None where it can along all of them."""
    length = fit.followed
    if length is None:
        return None

    names = [one.name for one in fit.model.inputs]

    def cut(records: Sequence[Experiment]) -> tuple[Experiment, ...]:
        return tuple(
            piece for one in records for piece in one.pieces(length, inputs=[n for n in names if n in one])
        )

    return replace(portion, data=cut(portion.data), fresh=cut(portion.fresh))


def cut_words(fit: Fit) -> str:
    """That it was done, and why."""
    longest = clock_of(fit.model).instant(float(f"{fit.followed:.2g}"))
    return (
        f"the motion is unstable, and no simulation follows it for more than {longest}: the records were "
        "searched in pieces as short, each with initial states of its own"
    )
