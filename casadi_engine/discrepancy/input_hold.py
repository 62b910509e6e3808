"""An input that is held between its samples, as by a D/A converter, and was read as joined by lines, or the reverse.

Its record is then half a sample early (or late), which a delay of the sensors stands for. Where such a delay is found,
the model without it is fitted to the records with the other hold: what is more probable counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from casadi_engine.discrepancy.fresh import Portions
from casadi_engine.discrepancy.refit import merit
from casadi_engine.discrepancy.refits import FACTOR
from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import estimate
from casadi_engine.experiment import Experiment
from casadi_engine.problem.noise import Noise

_DELAY = "sensor_delay"
# A delay is about half a sample within so many standard errors and this share of it, as what else is missing moves it:
# the fits decide.
_ERRORS, _SHARE = 3.0, 0.25
# Logarithm of the largest odds that are told.
_MOST = 100.0
# Key of a repair's options: input -> how the answer takes it to go on between its samples, other than it was read.
TAKEN = "taken as held"
_WORDS = {"zero": "held between its samples", "first": "joined by lines between its samples"}


@dataclass(frozen=True)
class OtherHold:
    """holds : input -> how it goes on between its samples; gain : twice the log of how many times more probable the
    records are so than with the delay that was found; stands : that delay is one of the answer's effects."""

    holds: Mapping[str, str]
    gain: float
    stands: bool = True

    @property
    def better(self) -> bool:
        """True where the records are more probable so, as a delay of just half a sample would be a coincidence, and
        nobody said how the inputs go on: lines are what is taken where nothing is said, steps were asked for. Beside a
        delay that was withdrawn there is no coincidence, and the records have to tell it alone."""
        least = 0.0 if self.stands else 2 * math.log(FACTOR)
        return self.gain > least and all(hold == "zero" for hold in self.holds.values())

    def of(self, portion: Portions) -> Portions:
        """The records with this hold."""
        data, fresh = (tuple(_held(r, self.holds) for r in part) for part in (portion.data, portion.fresh))
        return replace(portion, data=data, fresh=fresh)

    def told(self, repair: Repair, *, again: bool) -> Repair:
        """The repair with what is to be said first; again : it is that of the records with this hold."""
        names = " and ".join(f"{name} is {_WORDS[hold]}" for name, hold in self.holds.items())
        read = ", ".join(f'{name}="{hold}"' for name, hold in self.holds.items())
        odds = f"{math.exp(min(0.5 * self.gain, _MOST)):.2g} times"
        if again:
            words = (
                f"{names}: the records are {odds} more probable so than as they were read, when they asked for a delay "
                f"of half a sample. This answer is for record.with_hold({read})"
            )
        else:
            words = (
                f"The delay is half a sample. If {names}, the records are {odds} as probable without it: where you "
                f"know that, give record.with_hold({read})"
            )
        taken = {TAKEN: dict(self.holds)} if again else {}
        return replace(repair, options={**repair.options, **taken, "hold": words})


def other_hold(
    repair: Repair, noise: Noise | None, options: Mapping[str, Any], memory: float
) -> OtherHold | None:
    """The hold of inputs that does what the delays of half a sample do that were found, or found and withdrawn; None
    where there are no such delays, or the data exclude it.

    noise, options : as the fits were made; memory : how many samples count for one
    """
    delays = [one for one in (*repair.effects, *repair.withdrawn) if one.name == _DELAY]
    if not delays:
        return None
    best: OtherHold | None = None
    for holds in _subsets(_matching(repair, delays)):
        gain = _gain(repair, delays, holds, noise, options, memory)
        if gain is not None and (best is None or gain > best.gain):
            best = OtherHold(holds, gain, any(one.name == _DELAY for one in repair.effects))
    return best if best is not None and best.gain > -2 * math.log(FACTOR) else None


def _matching(repair: Repair, delays: Sequence[FoundEffect]) -> dict[str, str]:
    """Input -> its other hold, of those of which half a sample is every delay."""
    found = {}
    for variable in repair.fit.model.inputs:
        every = [record[variable.name] for record in repair.data if variable.name in record]
        if not every or len({channel.hold for channel in every}) > 1:
            continue
        late = every[0].hold == "first"
        half = 0.5 * float(np.median(np.concatenate([np.diff(channel.time) for channel in every])))
        wanted = half if late else -half
        if all(_near(one, wanted) for one in delays):
            found[variable.name] = "zero" if late else "first"
    return found


def _near(one: FoundEffect, wanted: float) -> bool:
    off = abs(one.amplitude.value - wanted)
    error = one.amplitude.stderr or one.amplitude.quadratic or 0.0
    return off <= _ERRORS * error + _SHARE * abs(wanted)


def _subsets(holds: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """All of them together, and each alone."""
    for count in sorted({len(holds), 1} - {0}) if holds else ():
        for names in combinations(holds, count):
            yield {name: holds[name] for name in names}


def _gain(
    repair: Repair,
    delays: Sequence[FoundEffect],
    holds: Mapping[str, str],
    noise: Noise | None,
    options: Mapping[str, Any],
    memory: float,
) -> float | None:
    """Twice the log of the odds of the records with this hold and no delay; None where they cannot be fitted."""
    fit = repair.fit
    pars = fit.parameters.copy()
    gone = [name for one in delays for name in one.parameters if name in pars]
    for name in gone:
        pars.fix(name, 0.0)
    values = {name: value for name, value in fit.values.items() if name not in gone}
    data = [_held(record, holds) for record in repair.data]
    try:
        held = estimate(
            fit.model, data, parameters=pars, noise=noise, warm=Start(values, fit.initial, fit.noise), progress=False,
            **options,
        )  # fmt: skip
    except CasadiEngineError:
        return None
    if held.status == "interrupted":
        raise KeyboardInterrupt
    if not held.converged:
        return None
    # a number that need not be estimated counts by what it could have been (Schwarz 1978)
    return (merit(fit) - merit(held)) / memory + len(gone) * math.log(max(fit.n / memory, 2.0))


def _held(record: Experiment, holds: Mapping[str, str]) -> Experiment:
    own = {name: hold for name, hold in holds.items() if name in record}
    return record.with_hold(**own) if own else record
