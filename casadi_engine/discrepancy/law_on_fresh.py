"""Unknown laws by all data: functions that were refitted on the data of the search are refitted on the fresh ones too.

In one record a function of time, or of a signal that goes along with the right one, does what the right one does; in
another record, where the signals go other ways, it does not. A function of time begins again with every record, or is
another one in each and is paid for as often.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casadi_engine.deadline import TimeUp, ask
from casadi_engine.discrepancy.law_race import Begun, Followed, Race, followed, short
from casadi_engine.discrepancy.law_setups import Setup, setups_at, setups_elsewhere
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.random_families import TIME, Family
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.experiment import Experiment, with_unique_names


def by_all_data(
    refits: Refits, found: Sequence[Followed], fresh: Sequence[Experiment]
) -> list[Followed] | None:
    """Functions refitted on the data of the search and fresh ones together; None where one does not arrive, or in
    time: what was not tried is not excluded."""
    if not fresh or len(found) < 2:
        return None
    race = Race.of(refits)
    wide = race.wide = race.wide or _with(refits, fresh)
    made: list[Followed] = []
    try:
        for one in found:
            again = _again(wide, one.setup.family)
            if again is None:
                return None
            made.append(again)
    except (TimeUp, *FAILURES):
        return None
    return made


def _with(refits: Refits, fresh: Sequence[Experiment]) -> Refits:
    """Refits of all data, without a race of their own yet."""
    wide = copy.copy(refits)
    wide.refitter = replace(refits.refitter, data=with_unique_names([*refits.refitter.data, *fresh]))
    wide.race = None
    return wide


def _again(wide: Refits, family: Family) -> Followed | None:
    """A function on all data, over the range that they visit. Of time it begins with every record, as what wears or
    fills from the start of each, or is another one in each: whichever is more probable."""
    found = _refitted(wide, family)
    if family.signal != TIME:
        return found
    both = [one for one in (found, _refitted(wide, family, each=True)) if one is not None]
    if not both:
        return None
    levels = min(both, key=lambda one: one.left).levels
    return max(both, key=lambda one: one.log(levels)[0])


def _refitted(wide: Refits, family: Family, *, each: bool = False) -> Followed | None:
    ask()
    race, none = Race.of(wide), wide.pool[frozenset()]
    port = wide.refitter.model.ports[family.port]
    own = [one for one in setups_at(wide, none, port) if one.family.signal == family.signal]
    setup = next(iter(own or setups_elsewhere(wide, none, family)), None)
    if setup is None:
        return None
    if each:
        setup = _of_each_record(setup, [record.name for record in wide.refitter.data])
    known = race.begun.get(setup.at)
    if known is not None:
        return followed(wide, known)
    begun = short(wide, none, setup.model, setup.parameters)
    if begun is None:
        return None
    race.begun[setup.at] = Begun(setup, *begun, elsewhere=not own)
    return followed(wide, race.begun[setup.at])


def _of_each_record(setup: Setup, records: Sequence[str]) -> Setup:
    """The same with a function in every record that is its own."""
    parameters = setup.parameters.copy()
    parameters.vary_by_experiment(*setup.terms)
    terms = tuple(f"{term}@{name}" for name in records for term in setup.terms)
    return replace(
        setup,
        parameters=parameters,
        terms=terms,
        deviations=np.tile(setup.deviations, len(records)),
        each=True,
    )
