"""What would bring lost parameters back: one change of the experiment or of the question, or two."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations

import numpy as np

from casadi_engine.errors import CasadiEngineError, IdentifiabilityError
from casadi_engine.identifiability.draw import Drawn, draw
from casadi_engine.identifiability.echelon import echelon_of
from casadi_engine.identifiability.field import Field, Matrix
from casadi_engine.identifiability.question import Question
from casadi_engine.identifiability.settings import InputClass, Start

# What a change costs the one who makes it, roughly: the order in which equally good ones are listed.
COST = {"drive": 0, "start": 1, "sensor": 2, "fix": 3, "tie": 4}
# How many candidates are tested in full before the list is closed.
_TESTED = 30
# How many of one kind are listed: after them the next kind is more of a help.
_OF_A_KIND = 4


@dataclass(frozen=True)
class Change:
    """One change. kind : drive, start, sensor, fix or tie; what : the name it is about; sentence : in words."""

    kind: str
    what: str
    sentence: str
    to: str = ""

    def __str__(self) -> str:
        return self.sentence


@dataclass(frozen=True)
class Remedy:
    """Changes made together, and what they restore.

    restored : the lost parameters that can be told then, or need not be told any more (fixed or tied)
    lost : those that still cannot
    """

    changes: tuple[Change, ...]
    restored: tuple[str, ...]
    lost: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """True if nothing is lost any more."""
        return not self.lost

    def __str__(self) -> str:
        words = ", and ".join(change.sentence for change in self.changes)
        count = len(self.restored)
        if self.complete:
            what = "all" if count > 1 else "it"
            return f"{words}: restores {what}"
        return f"{words}: restores {count}, not {', '.join(self.lost)}"

    @property
    def _rank(self) -> tuple[bool, int, int, int, int]:
        kinds = sorted((COST[change.kind] for change in self.changes), reverse=True)
        given_up = sum(change.kind in ("fix", "tie") for change in self.changes)
        return (not self.complete, len(self.changes), given_up - len(self.restored), kinds[0], sum(kinds))


def find_remedies(
    question: Question, lost: Sequence[str], *, most: int = 10, seed: int = 0
) -> tuple[Remedy, ...]:
    """Search single changes, then pairs if no single one restores all, and confirm each by the full test.

    Changes of the question (a fixed or tied parameter, a known start, one more sensor, a drive that is measured)
    only restrict the directions that nothing shows, so they and their pairs are tried by linear algebra on one
    drawing; changes of what happens (an excited drive, a start from rest) take a drawing each.
    """
    if not lost:
        return ()
    base = _Space(question, draw(question, seed, keep=True))
    drawn = {change: _drawn(question, [change], seed) for change in _events(question)}
    others = {change: space for change, space in drawn.items() if space is not None}
    found = [remedy for change, space in others.items() for remedy in space.remedies([change], lost, 0)]
    found += base.remedies([], lost, 1)
    good = _confirmed(question, found, lost, most, seed)
    if not any(remedy.complete for remedy in good):
        pairs = base.remedies([], lost, 2)
        for change, found_there in others.items():
            pairs += found_there.remedies([change], lost, 1)
        for one, other in combinations(others, 2):
            if one.what != other.what and (one.kind, other.kind) != ("start", "start"):
                space = _drawn(question, [one, other], seed)
                pairs += [] if space is None else space.remedies([one, other], lost, 0)
        good = _confirmed(question, pairs + [one for one in good if not one.complete], lost, most, seed)
    return tuple(good)


def _events(question: Question) -> list[Change]:
    """Changes of what happens in the experiment."""
    found: dict[str, Change] = {}
    for setting in question.settings:
        for name, one in setting.inputs.items():
            if one.known and one.word != "generic":
                found[name] = Change("drive", name, f"excite {name} (now {one})")
    changes = list(found.values())
    moved = any(one.word != "zero" for setting in question.settings for one in setting.inputs.values())
    if moved and any(setting.free_states for setting in question.settings):
        changes.append(Change("start", "rest", "start from rest, all states zero and known"))
    return changes


def apply(question: Question, changes: Iterable[Change]) -> Question:
    """The question with the changes made. Errors of the parameters' room come through."""
    parameters = None
    inputs: dict[str, InputClass] = {}
    start: Start | None = None
    sensors: list[str] = []
    for change in changes:
        if change.kind == "drive":
            inputs[change.what] = InputClass(change.to or "generic")
        elif change.kind == "start":
            start = Start("rest", Fraction(0)) if change.what == "rest" else Start("known")
        elif change.kind == "sensor":
            sensors.append(change.what)
        else:
            parameters = (question.parameters if parameters is None else parameters).copy()
            if change.kind == "fix":
                parameters.fix(change.what)
            else:
                parameters.tie(change.what, change.to)
    return question.changed(parameters=parameters, inputs=inputs, start=start, sensors=sensors)


def _drawn(question: Question, changes: Sequence[Change], seed: int) -> _Space | None:
    """None where the changed experiment cannot be told of: an empty tank as a start has no power series."""
    changed = apply(question, changes)
    try:
        return _Space(changed, draw(changed, seed, keep=True))
    except IdentifiabilityError:
        return None


class _Space:
    """The directions that one drawing does not see, and what changes of the question would restrict."""

    def __init__(self, question: Question, drawn: Drawn) -> None:
        assert drawn.work is not None
        self.question, self.drawn, self.work = question, drawn, drawn.work
        self.field: Field = drawn.field
        self.vectors = self.work.echelon.null_space()
        self.first = self.work.unknown + drawn.states  # row of the first parameter
        self.needed = echelon_of(self.field, np.ascontiguousarray(self.vectors[self.first :].T)).rank

    def remedies(self, made: Sequence[Change], lost: Sequence[str], more: int) -> list[Remedy]:
        """What `more` further changes of the question (0, 1 or 2) restore, beside those `made`."""
        if more == 0 or not self.vectors.shape[1]:
            return self._remedy(made, [], self.vectors, lost)
        limits = {change: self._limit(change) for change in self._changes()}
        if more == 1:
            groups: Iterable[tuple[Change, ...]] = ((change,) for change in limits)
        else:
            # two changes take away no more directions than both do alone
            groups = (
                (one, other)
                for one, other in combinations(limits, 2)
                if len(limits[one]) + len(limits[other]) >= self.needed and one.what != other.what
            )
        found: list[Remedy] = []
        for group in groups:
            limit = np.vstack([limits[change] for change in group])
            left = self.field.product(self.vectors, _kernel(self.field, limit))
            found += self._remedy(made, group, left, lost)
        return found

    def _remedy(
        self, made: Sequence[Change], group: Sequence[Change], left: Matrix, lost: Sequence[str]
    ) -> list[Remedy]:
        changes = (*made, *group)
        settled = {change.what for change in changes if change.kind in ("fix", "tie")}
        unseen = _moved(left[self.first :])
        still = tuple(
            name for name, bad in zip(self.question.free, unseen, strict=True) if bad and name not in settled
        )
        restored = tuple(name for name in lost if name not in still)
        return [Remedy(changes, restored, still)] if restored and set(restored) - settled else []

    def _changes(self) -> list[Change]:
        """The changes of the question that could help."""
        question, found = self.question, []
        unseen = _moved(self.vectors[self.first :])
        names = [name for name, bad in zip(question.free, unseen, strict=True) if bad]
        for name in self._unmeasured():
            words = {variable.name: variable.description for variable in question.model.states}
            more = f" ({words[name]})" if words.get(name) else ""
            found.append(Change("sensor", name, f"measure {name} too{more}"))
        for name in dict.fromkeys(name for setting in question.settings for name in setting.unknown):
            word = next(str(s.inputs[name]) for s in question.settings if name in s.unknown)
            to = "constant" if word == "unknown constant" else "generic"
            found.append(Change("drive", name, f"measure {name} (now {word})", to))
        if any(setting.free_states for setting in question.settings):
            found.append(Change("start", "known", "know all initial states"))
        own = [name for name in names if name in question.parameters]
        found += [Change("fix", name, f"fix {name} at a value from elsewhere") for name in own]
        unit = {name: question.parameters[name].unit for name in own}
        for one, other in combinations(own, 2):
            if unit[one] == unit[other] and unit[one] != "1":
                found.append(Change("tie", other, f"tie {other} to {one}", one))
        return found

    def _unmeasured(self) -> list[str]:
        """Outputs and states that no experiment measures, each quantity once."""
        equations = self.question.equations[0]
        taken = {equations.h[name].element_hash() for s in self.question.settings for name in s.outputs}
        found = []
        for name, expression in equations.h.items():
            if expression.element_hash() not in taken and name in equations.states:
                taken.add(expression.element_hash())
                found.append(name)
        return found

    def _limit(self, change: Change) -> Matrix:
        """(independent rows, directions): what a change asks of the coefficients of the unseen directions."""
        vectors, names, first = self.vectors, self.question.free, self.first
        if change.kind == "fix":
            rows = vectors[[first + names.index(change.what)]]
        elif (
            change.kind == "tie"
        ):  # in relative terms; whether it holds for equal values is tested afterwards
            one, other = (first + names.index(name) for name in (change.what, change.to))
            point = [self.drawn.point[self.drawn.states + place - first] for place in (one, other)]
            parts = [
                self.field.scaled(vectors[[place]], self.field.inverse(value))
                for place, value in zip((one, other), point, strict=True)
            ]
            rows = self.field.difference(*parts)
        elif change.kind == "start":
            rows = vectors[self.work.unknown : first]
        elif change.kind == "drive":
            rows = vectors[self._columns_of(change.what)]
        else:
            rows = self._seen_by(change.what)
        return echelon_of(self.field, np.ascontiguousarray(rows)).rows

    def _columns_of(self, drive: str) -> list[int]:
        """Columns of an unknown drive's coefficients."""
        found: list[int] = []
        for setting, run, columns in zip(
            self.question.settings, self.work.runs, self.work.columns, strict=True
        ):
            first = 0
            for name, height in zip(setting.unknown, run.heights, strict=True):
                if name == drive:
                    found += columns[first : first + height]
                first += height
        return found

    def _seen_by(self, state: str) -> Matrix:
        """What the derivatives of a state, as a sensor in every experiment, see of the unseen directions."""
        parts = []
        for equations, run, columns in zip(
            self.question.equations, self.work.runs, self.work.columns, strict=True
        ):
            row = equations.states.index(state)
            rows = np.array([sensitivity[row] for sensitivity in run.sensitivity], dtype=np.int64)
            parts.append(self.field.product(rows, self.vectors[columns]))
        return np.vstack(parts)


def _moved(rows: Matrix) -> list[bool]:
    """For each row: is there an entry other than zero?"""
    return [bool(row.any()) for row in rows]


def _kernel(field: Field, rows: Matrix) -> Matrix:
    return echelon_of(field, np.ascontiguousarray(rows)).null_space()


def _confirmed(
    question: Question, found: Sequence[Remedy], lost: Sequence[str], most: int, seed: int
) -> list[Remedy]:
    """The best ones, as the full test of the changed question sees them."""
    good: list[Remedy] = []
    seen: set[frozenset[Change]] = set()
    kinds: Counter[tuple[str, ...]] = Counter()
    tested = 0
    for remedy in sorted(found, key=lambda one: one._rank):
        kind = tuple(sorted(change.kind for change in remedy.changes))
        if len(good) >= most or tested >= max(_TESTED, most):
            break
        if frozenset(remedy.changes) in seen or kinds[kind] >= _OF_A_KIND:
            continue
        seen.add(frozenset(remedy.changes))
        tested += 1
        try:
            changed = apply(question, remedy.changes)
            drawn = draw(changed, seed + 1)
        except CasadiEngineError:  # a tie of what is fixed, a start at a pole
            continue
        told = dict(zip(changed.initial + changed.free, drawn.identifiable, strict=True))
        still = tuple(name for name in changed.free if not told[name])
        restored = tuple(name for name in lost if name not in still)
        if restored:
            good.append(Remedy(remedy.changes, restored, still))
            kinds[kind] += 1
    return sorted(good, key=lambda one: one._rank)
