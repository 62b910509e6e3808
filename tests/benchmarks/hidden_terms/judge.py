"""What an answer is worth: right, in a class, unnamed, wrong, a false alarm.

``answer_of`` alone reads the result of ``ce.repair``; the rest counts plain numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from hidden_terms.kind import Kind, Task
from hidden_terms.records import Case

# Share of the gap on fresh data that an effect under another name must close to count as alike.
ALIKE = 0.9


def answer_of(found: Any, case: Case) -> dict[str, Any]:
    """A Repair as plain numbers: verdict, effects with their classes and amplitudes, the gap on fresh data."""
    effects = []
    for one in found.effects:
        members = [[_names(m), float(m.probability)] for m in one.members]
        amplitude = one.amplitude
        effects.append(
            {
                "lead": one.key,
                "members": members or [[one.key, 1.0]],
                "amplitude": float(amplitude.value),
                "stderr": None if amplitude.stderr is None else float(amplitude.stderr),
            }
        )
    return {
        "verdict": found.verdict,
        "status": found.status,
        "confirmed": found.confirmed,
        "effects": effects,
        "withdrawn": [one.key for one in found.withdrawn],
        "gap": _gap(found, case),
    }


def _gap(found: Any, case: Case) -> dict[str, float] | None:
    """Root mean square of simulation less noise-free fresh data, in standard deviations of the noise, and the rmse."""
    if found.gaps is None or found.gaps.validation_before is None:
        return None
    made: dict[str, float] = {}
    for word, side in (("before", found.gaps.validation_before), ("after", found.gaps.validation_after)):
        if side is None:
            return None
        off, noisy = [], []
        for name, clean in case.clean.items():
            for traces in side.traces.values():  # of the record, or of its pieces
                trace = traces[name]
                true = np.interp(trace.time, case.fresh[name].time, clean)
                off.append((trace.simulated - true) / case.sigma[name])
                noisy.append(trace.residual[trace.mask] / case.sigma[name])
        made[word] = float(np.sqrt(np.mean(np.concatenate(off) ** 2)))
        made[f"rmse {word}"] = float(np.sqrt(np.mean(np.concatenate(noisy) ** 2)))
    return made


def names_of(kind: Kind, term: str) -> tuple[str, ...]:
    """The answers that count as right for a term."""
    return (term, *kind.terms[term].right)


def judged(kind: Kind, task: Task, answer: Mapping[str, Any]) -> str:
    """One word for an answer."""
    if answer["verdict"] is None:
        return "no answer"
    if task.null:
        return "right" if answer["verdict"] == "nothing missing" else "false alarm"
    if not answer["effects"]:
        named = all(kind.terms[one].in_library for one in task.deleted)
        return (
            "missed" if answer["verdict"] == "nothing missing" else "unnamed" if named else "right (unnamed)"
        )
    classes = [[name for name, _ in one["members"]] for one in answer["effects"]]
    wrong = [one for one in classes if not any(_fits(kind, term, one) for term in task.deleted)]
    if wrong:
        if alike(kind, task, answer):
            return "alike"
        return "wrong single" if any(len(one) == 1 for one in wrong) else "wrong class"
    if not all(any(_fits(kind, term, one) for one in classes) for term in task.deleted):
        return "partly"
    return "right" if all(hit for _, hit in members(kind, task, answer)) else "in class"


def _names(member: Any) -> str:
    """``PORT.EFFECT``; of two effects in the place of one both, joined by a plus."""
    _, two, second = member.more.partition(" with ")
    name, _, at = second.partition(" at ")
    return f"{member.at}.{member.name}" + (f"+{at}.{name}" if two else "")


def _fits(kind: Kind, term: str, names: Sequence[str]) -> bool:
    own = [part for name in names for part in name.split("+")]
    return any(fnmatchcase(name, wanted) for name in own for wanted in names_of(kind, term))


def alike(kind: Kind, task: Task, answer: Mapping[str, Any]) -> bool:
    """True for another name, confirmed, that closes nine tenths of the fresh gap, where the library lacks the truth."""
    if all(kind.terms[one].in_library for one in task.deleted) or not answer["confirmed"]:
        return False
    gap = answer["gap"]
    return gap is not None and gap["after"] < (1 - ALIKE) * gap["before"]


def members(kind: Kind, task: Task, answer: Mapping[str, Any]) -> list[tuple[float, bool]]:
    """The stated probability of every member of every class, and whether it is true."""
    return [
        (p, all(any(_fits(kind, term, [part]) for term in task.deleted) for part in name.split("+")))
        for one in answer["effects"]
        for name, p in one["members"]
    ]


def amplitudes(task: Task, case: Case, answer: Mapping[str, Any]) -> list[dict[str, Any]]:
    """True and estimated sizes of the terms that were found under their own names."""
    return [
        {"term": one["lead"], "true": case.values[one["lead"]]}
        | {key: one[key] for key in ("amplitude", "stderr")}
        for one in answer["effects"]
        if one["lead"] in task.deleted
    ]
