"""What chance may have made of the data of the search, and fresh data do not show.

A finding that fresh data confirm is one that chance makes with probability alpha on the data of the search, and in
2.3 % on the fresh ones. What these do not confirm has to be as improbable by both together: else nothing is missing
that these data could show.
"""

from __future__ import annotations

import math

import numpy as np

from casadi_engine.discrepancy.claim import above_stated
from casadi_engine.discrepancy.confirmation import CHANCE
from casadi_engine.discrepancy.fresh_misfit import SURE, fresh_misfit
from casadi_engine.discrepancy.no_noise import why_no_noise
from casadi_engine.discrepancy.repaired import UNCONFIRMED, Repair
from casadi_engine.discrepancy.withdrawal import withdrawn
from casadi_engine.distributions import p_words


def held_to_chance(repair: Repair, log_odds: float = -math.inf) -> Repair:
    """The repair without what chance may have made, where fresh data were asked and show nothing of it.

    log_odds : of the structure that the search chose, over none, what its names cost taken off
    """
    if not _may_be_chance(repair, log_odds):
        return repair
    tests, fresh = _tests(repair), _p_of_fresh_data(repair)
    what = min(tests, key=lambda name: tests[name])
    against = "" if fresh is None else f" (p = {fresh:.2g}, of both together {_both(tests[what], fresh):.2g})"
    beyond = "is beyond chance on" if tests[what] < repair.alpha else "came by a refit to"
    words = (
        f"{what} {beyond} the data of the search ({p_words(tests[what])}), and fresh data do not confirm it{against}: "
        f"then it has to be as improbable as what they confirm, p < {CHANCE * repair.alpha:.2g}"
    )
    bare = withdrawn(repair, UNCONFIRMED, None, words)
    sure = (
        fresh_misfit(bare) is not None or _leaves_no_noise(bare) or above_stated(repair.null_fit) is not None
    )
    return repair if sure else bare


def _leaves_no_noise(repair: Repair) -> bool:
    """True if the model without effects leaves what no sensor's noise is, whatever names it: ``why_no_noise``."""
    fit, noise = repair.null_fit, repair.noise
    for record, outputs in fit.traces.items():
        for output, trace in outputs.items():
            sigma, estimated = (0.0, False) if noise is None else noise.sigma.get(output, (0.0, False))
            if noise is None or not estimated or f"{record}/{output}" not in noise.colour:
                continue
            e = trace.residual[np.isfinite(trace.residual)]
            if (
                why_no_noise(record, output, e, fit.fit_percent[record][output]["simulation"], sigma)
                is not None
            ):
                return True
    return False


def _may_be_chance(repair: Repair, log_odds: float) -> bool:
    """True if fresh data were asked and confirm nothing, and no test says more than chance and they would together.

    A fresh residual that is not white says something is missing, whatever its name; where the noise is coloured,
    nothing can be told from that.
    """
    gaps = repair.gaps
    if gaps is None or gaps.validation_before is None or repair.confirmed or repair.stopped:
        return False
    if (
        not repair.effects and not repair.withdrawn
    ):  # tests beside the library have a false-alarm rate of their own
        return False
    if repair.noise is None or repair.verdict not in ("unnamed", "named", "class"):
        return False
    # odds are larger than k by chance in one of k cases at most (Markov's inequality), and what fresh data say of the
    # effects that such a law takes the place of says nothing of it
    odds = None if repair.unknown is None else repair.unknown.odds
    if odds is not None and odds * CHANCE * repair.alpha > 1:
        return False
    if log_odds + math.log(CHANCE * repair.alpha) > 0:
        return False
    tests = _tests(repair)
    white = [p for one in gaps.validation_before.whiteness_p.values() for p in one.values() if p is not None]
    quiet = bool(repair.noise.colour) or min(white, default=1.0) >= SURE
    fresh = _p_of_fresh_data(repair)
    least = min(tests.values())
    return quiet and (least if fresh is None else _both(least, fresh)) >= CHANCE * repair.alpha


def _p_of_fresh_data(repair: Repair) -> float | None:
    """How often chance makes a gain on fresh data as large as that found; None where they cannot tell."""
    gain = None if repair.gaps is None else repair.gaps.gain_per_cycle
    if gain is None or gain.chance is None:
        return None
    return gain.chance


def _both(one: float, other: float) -> float:
    """The p-value of two independent tests together (Fisher 1925: -2 ln of their product is chi-squared of 4)."""
    product = max(one * other, 1e-300)
    return product * (1 - math.log(product))


def _tests(repair: Repair) -> dict[str, float]:
    """What says that something is missing -> its p-value: effects, scores, tests of the residual."""
    found = {f"{one.name} at {one.at}": one.p_value for one in (*repair.effects, *repair.withdrawn)}
    if repair.unknown is None:
        return found
    own = repair.unknown.p_value
    law = {} if own is None else {f"a law at {repair.unknown.port} of {repair.unknown.signal}": own}
    return {**found, **repair.unknown.tests, **law}
