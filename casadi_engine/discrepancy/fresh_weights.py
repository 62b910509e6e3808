"""Fresh data weigh the structures that the data of the search do not tell apart.

The log probability of the fresh data by each structure, its parameters free within their errors, is added to its log
evidence: together they are the evidence of all data. A structure that the search left behind is not asked, unless the
data of the search found that something is missing and could not say what. One that fresh data alone exclude may lack
an effect of which the data of the search tell little: it is asked again with one more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from casadi_engine.deadline import late
from casadi_engine.discrepancy.choice import Choice
from casadi_engine.discrepancy.evidence import FACTOR
from casadi_engine.discrepancy.families import BEYOND, chosen_of, families_of
from casadi_engine.discrepancy.fresh_misfit import LARGER
from casadi_engine.discrepancy.membership import NOTHING, simpler
from casadi_engine.discrepancy.null_model import NullModel
from casadi_engine.discrepancy.pairs import with_one_more
from casadi_engine.discrepancy.parameter_doubt import doubted, left_within_errors, log_foretold
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.refit import Addition
from casadi_engine.discrepancy.tried import Key, Tried
from casadi_engine.estimation import Fit

# Structures that are asked at most.
_MOST = 6
# Of those that fresh data exclude, the most probable ones that are tried with one more effect.
_RIVALS = 2
# Where fresh data do not confirm the most probable structure, those that the data of the search make so many times as
# improbable, in logarithms, as is usually enough to exclude one (1 of 8000) are asked too.
WIDER = 3
Pairs = list[tuple[Fit, NullModel]]


@dataclass
class FreshWeights:
    """search : whose structures are weighed, and whose best one is what this leaves as such; sides : a fit with its
    effects on fresh data, or None; messages : takes what fresh data exclude"""

    search: Choice
    sides: Callable[[Fit, Sequence[Addition]], Pairs | None]
    messages: list[str]
    _near: float = math.log(FACTOR)

    def run(self, *, sure: bool) -> None:
        """Ask the most probable structures in turn, until none that is left comes near.

        sure : fresh data confirm the chosen one; else what is far less probable is asked too
        """
        self._near = (1 if sure else WIDER) * math.log(FACTOR)
        asked: dict[Key, tuple[Fit, list[NullModel]]] = {}
        failed: set[Key] = set()
        while len(asked) + len(failed) < _MOST and not late():
            rivals = self._rivals()
            if len(rivals) < 2:
                break
            one = next((t for t in rivals if t.key not in asked and t.key not in failed), None)
            if one is None:
                break
            found = self._asked(one)
            if found is None:
                failed.add(one.key)
                continue
            asked[one.key] = found
            self._weigh(asked)
        if self.search.best in asked and self.search.best:
            for one in self._with_one_more(asked):
                found = self._asked(one)
                if found is not None:
                    asked[one.key] = found
            self._weigh(asked)
        self._choose(asked)

    def _rivals(self) -> list[Tried]:
        """The structures that may be right, the most probable first: those with as many effects as the chosen one; or
        none and those of one effect, where something is missing and no structure is better than none."""
        search = self.search
        now = search.pool[search.best]
        ready = [t for t in search.pool.values() if t.effects and t.beyond > BEYOND and math.isfinite(t.log)]
        if not now.effects:
            if not search.null.screened.significant:
                return []
            alike = [t for t in ready if len(t.key) == 1]
            least = now.log - self._wanted
            return [now, *sorted((t for t in alike if t.log > least), key=lambda t: -t.log)]
        alike = [t for t in ready if len(t.key) == len(now.key)]
        least = max(t.log for t in alike) - self._near if alike else math.inf
        return sorted((t for t in alike if t.log > least), key=lambda t: -t.log)

    def _with_one_more(self, asked: Collection[Key]) -> list[Tried]:
        """Structures that fresh data alone exclude, with one more effect: two laws may do in all data what one with a
        shape of its own does, and in those of the search one of the two did as well by itself."""
        search = self.search
        now, screened = search.pool[search.best], search.null.screened
        if len(now.key) >= search.most:
            return []
        most = math.log(FACTOR)
        out = [t for t in map(search.pool.__getitem__, asked) if t.log < now.log - most < t.log - t.fresh]
        made: list[Tried] = []
        least = now.counted - WIDER * most + search.price  # as fresh data may say it
        for one in sorted(out, key=lambda t: -t.log)[:_RIVALS]:
            families = families_of(screened)
            others = {key: own for key, own in families.items() if key not in one.key | now.key}
            chosen = partial(chosen_of, screened)
            made += with_one_more(
                search.refits, one, screened, others, chosen, search.tell, least - one.counted
            )
        search.refits.weigh()
        return [t for t in made if not late() and t.counted > least and t.beyond > NOTHING]

    @property
    def _wanted(self) -> float:
        """What an effect has to gain in log probability beside none."""
        return math.log(FACTOR) + self.search.price

    def _asked(self, one: Tried) -> tuple[Fit, list[NullModel]] | None:
        """A structure's fit, and its residuals on fresh data with slopes; None where either fails."""
        fit = self.search.fit_of(one)
        pairs = None if fit is None else self.sides(fit, one.effects)
        if fit is None or not pairs or not all(held.converged for held, _ in pairs):
            return None
        try:
            with np.errstate(all="ignore"):
                return fit, [doubted(fit, held) for held, _ in pairs]
        except FAILURES:
            return None

    def _weigh(self, asked: dict[Key, tuple[Fit, list[NullModel]]]) -> None:
        """Log probabilities beside that of the structure which foretells the fresh data best. None is weighed where the
        fresh data hold more than noise that none of them knows: what imitates that best is not the more probable."""
        levels = {n: 1 / self.search.refits.levels.weight(n) for n in self.search.refits.levels.sigma}
        least = min(
            sum(left_within_errors(fit, null, self.search.refits.levels.sigma) for null in nulls) / len(nulls)
            for fit, nulls in asked.values()
        )
        if least > LARGER:
            logs = dict.fromkeys(asked, 0.0)
        else:
            logs = {
                key: sum(log_foretold(fit, null, levels) for null in nulls)
                for key, (fit, nulls) in asked.items()
            }
        top = max(logs.values())
        for key, log in logs.items():
            self.search.pool[key].fresh = log - top if math.isfinite(log - top) else -math.inf

    def _choose(self, asked: dict[Key, tuple[Fit, list[NullModel]]]) -> None:
        search = self.search
        now = search.pool[search.best]
        if search.best not in asked or len(asked) < 2:
            for key in asked:  # one alone is held against nothing
                search.pool[key].fresh = 0.0
            return
        more = [t for t in map(search.pool.__getitem__, asked) if len(t.key) > len(now.key) > 0]
        alike = [search.pool[key] for key in asked if search.pool[key] not in more]
        two = max((t for t in more if t.beyond > BEYOND), key=lambda t: t.log, default=None)
        if two is not None and two.log - search.price > max(t.log for t in alike):
            alike = [two]  # alone: rivals of as many effects were not asked
        ready = sorted(alike, key=lambda t: -t.log)
        best = ready[0]
        if now.effects:  # all of them are fitted: of those that are not told apart the simplest costs nothing
            order = [simpler(best, ready, FACTOR), *ready]
        else:
            order = [best] if best.log > now.log + self._wanted else []
        search.best = next((one.key for one in order if search.way(one.key) is not None), search.best)
        top = search.pool[search.best]
        for one in (search.pool[key] for key in asked if len(key) == len(search.best) > 0):
            if one is not top and one.log < top.log - math.log(FACTOR):
                self.messages.append(
                    f"fresh data tell {top.name} from {one.name}: with them it is {_times(top.log - one.log)} "
                    "as probable"
                )


def _times(log: float) -> str:
    return f"{math.exp(log):.2g} times" if log < 14 else "more than a million times"
