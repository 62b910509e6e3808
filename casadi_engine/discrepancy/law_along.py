"""Functions of a signal along the motion that another function gives.

Over windows so short that the measurement leads, a spring behind a drive moves next to nothing, and a function of time
follows whatever is slow: the one that arrives on the whole record says how the system moved, not what moved it. Along
that motion every other function is told in one step, and what serves as well there is refitted from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.discrepancy.evidence import Levels, Prior, evidence
from casadi_engine.discrepancy.law_race import Begun, Race, Whole, horizons_of, whole_of
from casadi_engine.discrepancy.law_rival import SIZES, beside_it, counted_with, names_of, of_size
from casadi_engine.discrepancy.law_setups import TERMS, Setup, over_range
from casadi_engine.discrepancy.law_step import without_terms
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import (
    Signal,
    along,
    family_columns,
    smooth_family,
    term_candidate,
    terms_at,
)
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.estimation.refit_problem import RefitProblem

# So many of those that serve best in one step are refitted; steps of a refit.
_REFITTED, _STEPS = 3, 30


def told_along(refits: Refits, best: Whole, missing: Sequence[Begun]) -> None:
    """Refit functions that did not arrive by themselves from the motion of one that did; the race has them then.

    best : the function that arrived; missing : others at a port that knows their signal
    """
    gone = without_terms(refits, best)
    if gone is None:
        return
    found = []
    for one in missing:
        ask()
        try:
            with np.errstate(all="ignore"):
                told = _in_one_step(refits, gone, one.setup)
        except FAILURES:
            continue
        if told is not None:
            found.append((*told, one))
    found.sort(key=lambda each: -each[0])
    race = Race.of(refits)
    for _, setup, start, one in found[:_REFITTED]:
        arrived = _refitted(refits, best, setup, start)
        if arrived is not None:
            race.whole[one.at] = arrived


def _in_one_step(
    refits: Refits, gone: NullModel, setup: Setup
) -> tuple[float, Setup, Mapping[str, float]] | None:
    """The log evidence of a function in the place of the one that led, the function over the range of that motion, and
    the values from which its refit starts; None for one that moves nothing."""
    port = gone.model.ports[setup.family.port]
    symbol = port.signals.get(setup.family.signal)
    if symbol is None:
        return None
    values = along(gone, symbol)
    if not np.ptp(values) > 0:
        return None
    family = smooth_family(port.name, setup.family.signal, values, terms=TERMS)
    signal = Signal(setup.family.signal, symbol, values)
    terms = [
        term_candidate(gone.model, port, signal, k, term) for k, term in enumerate(terms_at(family, symbol))
    ]
    beside = beside_it(gone, family_columns(gone, terms))
    priors: dict[str, Prior] = priors_of(gone, refits.path.parameters(()), ())
    made = counted_with(beside, priors, family, frozenset(), None)
    if made is None:
        return None
    levels = Levels(refits.path.levels)
    sized = [of_size(made, names_of(family), share) for share in SIZES]
    logs = [evidence(one, levels).log for one in sized]
    best = sized[int(np.argmax(logs))]
    rows = best.rows(levels)
    step = np.asarray(np.linalg.pinv(rows[:, :-1]), dtype=float) @ rows[:, -1]
    again = over_range(refits, setup, family)
    return max(logs), again, _start(beside, again, step)


def _start(beside: NullModel, setup: Setup, step: Array) -> dict[str, float]:
    """Values after one step: of the parameters, and of the terms."""
    n = beside.turn.shape[1] - len(setup.terms)
    kept = beside.parameters[: len(beside.parameters) - len(setup.terms)]
    moved = beside.values[: len(kept)] + beside.turn[: len(kept), :n] @ step[:n]
    found = dict(zip(kept, map(float, moved), strict=True))
    return found | dict(zip(setup.terms, map(float, step[n : n + len(setup.terms)]), strict=True))


def _refitted(refits: Refits, best: Whole, setup: Setup, start: Mapping[str, float]) -> Whole | None:
    """A function on the whole record from values and the states of another one; None where it does not arrive."""
    ask()
    try:
        with np.errstate(all="ignore"):
            problem = RefitProblem(
                setup.model,
                refits.refitter.data,
                setup.parameters,
                levels=refits.path.levels,
                interval=refits.refitter.interval,
            )
            with Deadline(work=refits.path.allowed(problem)):
                found = problem.run(
                    start={**best.found.values, **start}, initial=best.found.initial, near=best.found.nodes,
                    horizons=horizons_of(problem)[-1:], most=_STEPS,
                )  # fmt: skip
            return whole_of(refits, problem, setup, found)
    except FAILURES:
        return None
    except TimeUp:
        ask()
        return None
