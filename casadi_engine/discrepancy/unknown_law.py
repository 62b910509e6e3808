"""An unknown law as a rival of what was named: a function of one signal at one port in the place of the effects.

The laws that were found are taken out along their own simulation, and a smooth function takes their place, with the
same noise, the same priors of everything else, and the size of its own averaged over. Where the function takes most of
the colour that the effects leave, each is also held against the noise that it leaves itself. Where the data make the
function more probable, what acts has a name that the library lacks, and effects that are bent to look alike are no
finding, unless they explain most of what the function does: then they stay, and the answer says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from casadi_engine.discrepancy.all_data import AllData
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.elsewhere_families import elsewhere, functions_of
from casadi_engine.discrepancy.evidence import (
    FACTOR,
    Columns,
    Digest,
    Levels,
    Prior,
    digest,
    evidence,
)
from casadi_engine.discrepancy.fresh_misfit import SEEN
from casadi_engine.discrepancy.law_rival import (
    SIZES,
    Rival,
    bare_digest,
    beside_it,
    counted_with,
    is_told,
    names_of,
    of_size,
    with_own_colour,
    without_effects,
)
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.priors import priors_of
from casadi_engine.discrepancy.random_families import (
    TIME,
    Course,
    Family,
    course_of,
    family_candidates,
    family_columns,
)
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.tried import Tried

# The most probable functions of either kind, which are held against the noise that they leave themselves.
_COLOURED = 3
# The most probable functions of what a port does not know that are refitted too.
_REFITTED = 3
# Difference of log evidence of a function and itself, by another name.
_SAME = 0.01
# Powers of the usual factor by which a law may be less probable than the effects that add up to it.
_WORSE = 5
# Effects that explain this share of what a function does stay the answer, whatever is more probable: dry friction of a
# real machine is never all that depends on its speed.
_NEAR = 0.8
# Numbers of shape of a law that is a law of its own.
_SHAPES = 1
# The same of what is no law of the motion at that port: a constant is the mean of any law, an event bends in time to
# one that is not there all the time, effects elsewhere are another explanation. They stay where they leave no more of
# the gap (rmse) than a person would see; or twice as much, where fresh data confirm them and show as much: of other
# motions the mean is another.
_NEAR_OF_OTHERS, _CONFIRMED = 1 - SEEN**2, 1 - (2 * SEEN) ** 2


@dataclass(frozen=True)
class UnknownLaw:
    """The function that is most probable: its course, the log of how much more probable the model is with it than with
    the effects, the share of what it takes from chi-squared that these take too, and whether they are several.

    near : the share from which on effects come near
    beside : the log of how much more probable the function is with the effects beside it than without them, where none
        of them is a law there itself: what they do is no imitation of it then
    price : the part of the log that is paid for further names, not told by the data
    others : the functions that come first, the most probable one among them
    rivals : functions that the data do not tell from the most probable one, the best first
    unheard : functions that were begun beside one of time, and whose refits did not arrive
    imitators : how many of the effects do nothing beside the function: one name that comes near is worth keeping,
        several that together imitate a function are not
    """

    course: Course
    log: float
    share: float
    several: bool = False
    near: float = _NEAR
    beside: float = -math.inf
    price: float = 0.0
    imitators: int = 0
    others: tuple[Family, ...] = ()
    rivals: tuple[Family, ...] = ()
    unheard: tuple[Family, ...] = ()

    @property
    def is_beside(self) -> bool:
        """True where the effects do what the function does not: it is missing too, not in their place."""
        return self.log >= math.log(FACTOR) and self.beside >= math.log(FACTOR)

    @property
    def is_curve(self) -> bool:
        """True where several effects do no more than a smooth function of one signal: two laws of it add up to many a
        curve, as do one and an error of what it is measured by, and that they are fewer numbers is all that speaks for
        them. A smooth function of finitely many terms may leave what a person would not see; not what makes it so
        improbable that nothing else would be asked of it, as a step and a delay of another channel do."""
        return self.several and self.share <= 1 + SEEN**2 and self.log > -_WORSE * math.log(FACTOR)

    def on_fresh(self, closed: float) -> UnknownLaw:
        """The same with what effects explain by fresh data, which confirm them and of whose gap they close a share."""
        if self.near == _NEAR:
            return replace(self, share=max(self.share, closed))
        return replace(self, near=_CONFIRMED) if closed >= _CONFIRMED else self

    @property
    def excludes(self) -> bool:
        """True where the effects are no answer: far less probable, and much of what the function does is left; or
        that by the data alone, and several of them do nothing beside it."""
        if self.log < math.log(FACTOR) or self.is_beside:
            return False
        imitated = self.imitators > 1 and self.log - self.price >= math.log(FACTOR)
        return self.share < self.near or imitated


def near_of(tried: Tried, port: str, signal: str) -> float:
    """Share of what a function of a signal at a port does that effects have to explain to stay the answer: no law of
    the motion is nearly what drifts."""
    # a wrong value is the mean of what a parameter is that changes
    laws = [one for one in tried.effects if one.is_law and not port.startswith("parameter_")]
    # one with several numbers of shape, as an overflow, bends to any curve and is to explain it all
    there = signal != TIME and any(
        one.candidate.port == port and len(one.nuisance) <= _SHAPES for one in laws
    )
    return _NEAR if there else _NEAR_OF_OTHERS


def unknown_law(
    refits: Refits, tried: Tried, further: float, *, everywhere: bool = False, along: AllData | None = None
) -> UnknownLaw | None:
    """The most probable function of one signal in the place of a structure's effects; None where it cannot be told.

    further : what a further effect has to gain in log probability; everywhere : look at parameters that are not
    constant, and at what acts by the signals of others, too; along : the structure along all data, where these are to
    tell, not those of the search alone
    """
    null = refits.null(tried) if along is None else along.null
    if null is None:
        return None
    effects = tried.effects
    priors = priors_of(null, refits.path.parameters(effects), effects)
    random = refits.random(null) if along is None else None
    choices = float(np.prod([one.choices for one in effects]))
    held = tried.arrived.held
    named = evidence(digest(null, priors, random=random, held=held, choices=choices), refits.levels)
    own = {name for name in null.parameters if any(name.startswith(f"{one.key}.") for one in effects)}
    # What the effects alone drive to a bound leaves it where they go.
    others = held & refits.pool[frozenset()].arrived.held - own
    bare, here = without_effects(null, [one.amplitude for one in effects], own), null
    if bare is None and along is not None:
        return unknown_law(
            refits, tried, further, everywhere=everywhere
        )  # whose model without them has that data alone
    if bare is None:  # an amplitude is not free: along the motion that the model has without them
        bare = refits.null(refits.pool[frozenset()])
        here = null if bare is None else bare
    if bare is None or not math.isfinite(named.log):
        return None
    none = refits.pool[frozenset()].evidence.cost + (0.0 if along is None else along.without)
    linear = evidence(bare_digest(bare, priors, others, random), refits.levels).cost
    if effects and not is_told(linear, named.cost, none):
        return None
    # a function of an input that acts by these effects alone has them as its special case, and is no rival
    idle = {f"input_{name}" for name in refits.refitter.model.idle_inputs} if effects else set()
    found, columns = _functions(here, bare, refits.levels, everywhere, idle, (priors, others, random))
    for one in found:
        one.log -= named.log
    if not found:
        return None
    if refits.levels.memory and random is None:
        of_effects = digest(null, priors, held=held, choices=choices)
        _held_to_colour(found, null, of_effects, frozenset(own))
    best = max(found, key=lambda one: one.log)
    # that it is any of them
    price = (len(effects) - 1) * further
    log = float(np.logaddexp.reduce([one.log for one in found])) + price
    least = evidence(best.digest, refits.levels).cost
    share = (none - named.cost) / (none - least) if none > least else 1.0
    course = _course(best.digest, best.family, refits.levels)
    port = best.family.port
    further_by = -math.inf
    bends = [one for one in effects if one.candidate.port == port and one.is_law]
    if here is null and not any(
        not depends_on_more(one, best.family.signal) for one in bends
    ):  # else to a part of it
        both = counted_with(beside_it(null, columns[best.family.name]), priors, best.family, held, random)
        further_by = _further(both, best, refits.levels) - math.log(choices)
    several = len(effects) > 1
    return UnknownLaw(
        course,
        log,
        share,
        several,
        near_of(tried, port, best.family.signal),
        further_by,
        price,
        others=_first_of(found),
        rivals=not_told_from(best.family, [(one.family, one.log) for one in found]),
    )


def _functions(
    null: NullModel,
    bare: NullModel,
    levels: Levels,
    everywhere: bool,
    idle: set[str],
    counts: tuple[dict[str, Prior], frozenset[str], Columns | None],
) -> tuple[list[Rival], dict[str, Columns]]:
    """Every function in the place of the effects, none at a port of ``idle``, its log probability with what choosing it
    costs; and the members of each.

    counts : priors, parameters that are held, and what else of the model is random
    """
    priors, others, random = counts
    columns: dict[str, Columns] = {}
    found: list[Rival] = []
    for k, (candidates, families, among) in enumerate(_offered(null, bare, levels, everywhere)):
        every = family_columns(null, candidates)
        for family in (one for one in families if one.port not in idle):
            columns[family.name] = _members(every, family)
            beside = beside_it(bare, columns[family.name])
            made = counted_with(beside, priors, family, others, random)
            if made is not None:
                rival = _rival(beside, made, family, levels)
                rival.log -= math.log(among)
                found.append(replace(rival, price=math.log(among), far=k > 0))
    return found, columns


def not_told_from(best: Family, found: Sequence[tuple[Family, float]]) -> tuple[Family, ...]:
    """The functions that are not excluded beside the best of those found, which come with their log evidence; no other
    name of the same function, which has the same evidence."""
    top = next(log for family, log in found if family is best)
    near = [
        (log, family)
        for family, log in found
        if family is not best and log > top - math.log(FACTOR) and abs(log - top) > _SAME
    ]
    return tuple(family for _, family in sorted(near, key=lambda one: -one[0]))


def _first_of(found: Sequence[Rival]) -> tuple[Family, ...]:
    """The most probable functions of what a port does not know itself."""
    far = sorted((one for one in found if one.far), key=lambda one: -one.log)
    return tuple(one.family for one in far[:_REFITTED])


def _rival(beside: NullModel, made: Digest, family: Family, levels: Levels) -> Rival:
    """A function of the sizes that it may have, and its log evidence averaged over these."""
    logs = [evidence(of_size(made, names_of(family), share), levels).log for share in SIZES]
    sized = of_size(made, names_of(family), SIZES[int(np.argmax(logs))])
    return Rival(float(np.logaddexp.reduce(logs)) - math.log(len(SIZES)), family, beside, made, sized)


def _held_to_colour(found: Sequence[Rival], null: NullModel, effects: Digest, own: frozenset[str]) -> None:
    """Let the most probable functions have the odds beside the noise that they leave themselves, where these are
    better: of those of what a port itself knows, and of the others, as what comes first beside colour says little."""
    for far in (False, True):
        kind = sorted((one for one in found if one.far is far), key=lambda one: -one.log)
        for one in kind[:_COLOURED]:
            one.log = max(one.log, with_own_colour(one, null, effects, own) - one.price)


def _offered(
    null: NullModel, bare: NullModel, levels: Levels, everywhere: bool
) -> list[tuple[list[Candidate], list[Family], int]]:
    """The terms of functions, these functions, and among how many each of them is one: half of the prior is for those
    of what a port itself knows."""
    candidates, families = family_candidates(null)
    if not everywhere:
        return [(candidates, families, len(families))]
    far, others, among = elsewhere(bare, levels)
    return [(candidates, families, 2 * len(families)), (far, others, 2 * among)]


def does_more(refits: Refits, tried: Tried, last: Addition, port: str, signal: str) -> bool:
    """True where an effect is no part of an imitation of a law that the library lacks, a function of one signal at a
    port: it depends on something else as well, and beside the function that serves best, and the other effects, the
    model is still far more probable with it than without it."""
    null = refits.null(tried) if depends_on_more(last, signal) else None
    if null is None:
        return False
    own = {name for name in null.parameters if name.startswith(f"{last.key}.")}
    bare = without_effects(null, [last.amplitude], own)
    candidates, families = functions_of(null, port, signal)
    if bare is None or not families:
        return False
    columns = family_columns(null, candidates)
    priors, random = (
        priors_of(null, refits.path.parameters(tried.effects), tried.effects),
        refits.random(null),
    )
    beside = _Beside(columns, families, priors, random, refits.levels)
    most = beside.log(null, tried.arrived.held), beside.log(bare, tried.arrived.held - own)
    return math.isfinite(most[1]) and most[0] - most[1] - math.log(last.choices) >= math.log(FACTOR)


def imitators(refits: Refits, tried: Tried, port: str, signal: str) -> int:
    """How many effects of a structure do nothing beside a function of one signal at a port that takes the place of all:
    each by itself makes the model with the function hardly more probable. Two or more of them only imitate it."""
    null, effects = refits.null(tried), tried.effects
    amplitudes = [one.amplitude for one in effects]
    own = (
        {one.key: {n for n in null.parameters if n.startswith(f"{one.key}.")} for one in effects}
        if null
        else {}
    )
    every = set().union(*own.values())
    bare = None if null is None else without_effects(null, amplitudes, every)
    if null is None or bare is None:
        return 0
    candidates, families = functions_of(null, port, signal)
    if not families:
        return 0
    priors, random = priors_of(null, refits.path.parameters(effects), effects), refits.random(null)
    beside = _Beside(family_columns(null, candidates), families, priors, random, refits.levels)
    held, count = tried.arrived.held, 0
    alone = beside.log(bare, held - every)
    for one in effects:
        others = every - own[one.key]
        gone = [name for name in amplitudes if name != one.amplitude]
        rest = without_effects(null, gone, others)
        more = -math.inf if rest is None else beside.log(rest, held - others)
        count += more - alone - math.log(one.choices) < math.log(FACTOR)
    return count


@dataclass(frozen=True)
class _Beside:
    """Functions beside which models are counted: the columns of their terms, the priors, and the noise."""

    columns: Mapping[str, Mapping[str, Array]]
    families: Sequence[Family]
    priors: dict[str, Prior]
    random: Columns | None
    levels: Levels

    def log(self, model: NullModel, held: frozenset[str]) -> float:
        """The log evidence of a model with the function, of the size, that serves best beside it."""
        made = [
            (
                counted_with(
                    beside_it(model, _members(self.columns, one)), self.priors, one, held, self.random
                ),
                one,
            )
            for one in self.families
        ]
        return max((_most(d, f, self.levels) for d, f in made if d is not None), default=-math.inf)


def depends_on_more(one: Addition, signal: str) -> bool:
    """True for an effect that depends on more of the motion and inputs than what a signal of its port is made of."""
    return bool(moving(one.candidate) - _made_of(one.candidate, signal))


def depends_on(candidate: Candidate, signal: str) -> bool:
    """True for a candidate that depends on a signal of its port, and on nothing else that moves."""
    own = moving(candidate)
    return bool(own) and own <= _made_of(candidate, signal)


def moving(candidate: Candidate) -> set[str]:
    """The names of the states and inputs on which a candidate depends."""
    own = candidate.source
    acts = ca.vertcat(own.slots, own.drives, own.outputs)
    return {
        s.name()
        for s in ca.symvar(ca.vertcat(own.model.x, own.model.u, own.model.d))
        if ca.depends_on(acts, s)
    }


def _made_of(candidate: Candidate, signal: str) -> set[str]:
    """The names of the symbols of which a signal of its port is made."""
    known = candidate.source.model.ports[candidate.port].signals.get(signal, ca.SX())
    return {symbol.name() for symbol in ca.symvar(known)}


def _members(columns: Mapping[str, Mapping[str, Array]], family: Family) -> dict[str, dict[str, Array]]:
    """The columns of a family's own terms."""
    members = list(family.members)
    return {r: {o: c[:, members] for o, c in made.items()} for r, made in columns.items()}


def _most(made: Digest, family: Family, levels: Levels) -> float:
    """The log evidence beside a function of the size that serves best."""
    return max(evidence(of_size(made, names_of(family), share), levels).log for share in SIZES)


def _further(both: Digest | None, alone: Rival, levels: Levels) -> float:
    """The log of how much more probable a function is with effects beside it, of the size that serves best, than
    alone."""
    if both is None:
        return -math.inf
    return _most(both, alone.family, levels) - evidence(alone.digest, levels).log


def _course(made: Digest, family: Family, levels: Levels) -> Course:
    """The most likely course of the function, with its band."""
    rows = made.rows(levels)
    inverse = np.asarray(np.linalg.pinv(rows[:, :-1]), dtype=float)
    n = made.turn.shape[1] - len(made.held)
    own = slice(n - len(family.members), n)
    return course_of(family, inverse[own] @ rows[:, -1], inverse[own])
