"""One repair of a rig as a row of numbers: what was said, whether it is right, how far from the fit by hand."""

from __future__ import annotations

import inspect
import itertools
import math
import resource
import time
import traceback
from collections.abc import Iterable
from types import ModuleType
from typing import Any

from by_hand import kept
from rigs_common import rig, to_si

import casadi_engine as ce
from casadi_engine.errors import CasadiEngineError


def repaired(name: str, writing: int, budget: float) -> dict[str, Any]:
    """Repair a rig with the whole library, and judge the answer."""
    one = rig(name)
    row: dict[str, Any] = {"rig": name, "writing": writing, "version": ce.__version__, "budget_s": budget}
    row["date"] = time.strftime("%Y-%m-%dT%H:%MZ", time.gmtime())
    estimation, fresh = one.records()
    model, parameters = one.build(writing)
    options = {"noise": ce.Noise(**{out.name: "estimate" for out in model.outputs}), "progress": False}
    for word in ("budget", "time_budget", "time_limit"):
        if word in inspect.signature(ce.repair).parameters:
            options[word] = budget
    begun = _cpu()
    try:
        found = ce.repair(model, estimation, parameters=parameters, fresh=fresh, **options)
    except CasadiEngineError as error:
        return row | {
            "outcome": "crashed",
            "cpu_s": _cpu() - begun,
            "error": f"{type(error).__name__}: {error}",
        }
    except Exception as error:  # noqa: BLE001 (a crash is an outcome of the benchmark)
        return row | {
            "outcome": "crashed",
            "cpu_s": _cpu() - begun,
            "error": f"{type(error).__name__}: {error}",
            "traceback": traceback.format_exc(limit=-4),
        }
    return row | {"cpu_s": round(_cpu() - begun, 2)} | described(one, model, found) | {"printed": str(found)}


def described(one: ModuleType, model: Any, found: Any) -> dict[str, Any]:
    """Verdict, effects with their classes, rmse in SI, and the outcome by the rig's truth."""
    factor = to_si(model)
    row: dict[str, Any] = {"status": found.status, "verdict": found.verdict, "confirmed": found.confirmed}
    row["effects"] = [_effect(effect) for effect in found.effects]
    row["withdrawn"] = [effect.key for effect in found.withdrawn]
    row["values"] = {key: float(f"{value:.5g}") for key, value in found.fit.values.items()}
    row["unknown"] = None if found.unknown is None else found.unknown.sentence
    gaps = found.gaps
    if gaps is not None:
        sides = {
            "null": gaps.estimation_before, "estimation": gaps.estimation_after,
            "null_fresh": gaps.validation_before, "fresh": gaps.validation_after,
        }  # fmt: skip
        for key, side in sides.items():
            if side is not None:
                rmse = {name: value * factor[name] for name, value in side.gap.rmse.items()}
                row[key] = float(f"{next(iter(rmse.values())):.5g}")
    row["outcome"] = judged(row, one.truth)
    row["timing"] = {key: round(value, 2) for key, value in found.timing.items()}
    row["messages"] = list(found.messages)
    return row


def _effect(effect: Any) -> dict[str, Any]:
    amplitude = effect.amplitude
    return {
        "key": effect.key,
        "amplitude": _number(amplitude.value),
        "error": _number(amplitude.stderr),
        "unit": amplitude.unit,
        "class": {f"{m.at}.{m.name}": round(float(m.probability), 4) for m in effect.members},
        "explains": _number(effect.share_explained),
    }


def _number(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.4g}")


def judged(row: dict[str, Any], truth: Iterable[set[str]]) -> str:
    """The outcome of a row: that of its effects, or what ended it."""
    if "verdict" not in row:
        return str(row["outcome"])
    return outcome(row["verdict"], [_keys(effect) for effect in row["effects"]], truth)


def _keys(effect: dict[str, Any]) -> list[str]:
    """Keys of a class, the lead first; a parameter that is freed is known by its port."""
    keys = [effect["key"], *effect["class"]]
    return list(dict.fromkeys(key.partition(".")[0] if key.startswith("parameter_") else key for key in keys))


def outcome(verdict: str | None, classes: list[list[str]], truth: Iterable[set[str]]) -> str:
    """The answer in one word, by the truth: each member of it is a complete right answer, an empty one "unnamed".

    A parameter that is freed is known by its port, ``parameter_NAME``, whatever the effect is called.

    >>> outcome("named", [["a.x"]], [{"a.x"}]), outcome("class", [["a.y", "a.x"]], [{"a.x"}])
    ('right', 'in class')
    >>> outcome("named", [["a.x"], ["b.y"]], [{"a.x"}]), outcome("named", [["a.x"]], [{"a.x", "b.y"}])
    ('right and more', 'in part')
    >>> outcome("class", [["a.y", "a.x"], ["a.x"]], [{"a.x"}])
    'right and more'
    >>> outcome("unnamed", [], [{"a.x"}]), outcome("named", [["b.z"]], [{"a.x"}]), outcome("unnamed", [], [set()])
    ('unnamed', 'wrong', 'right')
    """
    right = [frozenset(one) for one in truth]
    if verdict is None:
        return "no answer"
    if not classes:
        return "right" if verdict == "unnamed" and frozenset() in right else verdict
    right = [one for one in right if one]
    leads = frozenset(one[0] for one in classes)
    if leads in right:
        return "right"
    every = itertools.islice(itertools.product(*classes), 10_000)
    answers = {frozenset(one) for one in every if len(set(one)) == len(one)}
    if any(one in answers for one in right):
        return "in class"
    if any(one < leads for one in right):
        return "right and more"
    if any(one < answer for one in right for answer in answers):
        return "in class and more"
    return "in part" if any(one & leads for one in right) else "wrong"


def beside_by_hand(row: dict[str, Any]) -> dict[str, float]:
    """rmse of a row over that of the fit by hand in the right structure, on estimation and fresh data."""
    entry = kept().get(row["rig"])
    if entry is None or "estimation" not in row:
        return {}
    hand = entry["structures"][rig(row["rig"]).same]
    return {part: row[part] / hand[part] for part in ("estimation", "fresh") if part in row}


def line(row: dict[str, Any]) -> str:
    """A row on one line of a terminal."""
    head = f"{row['rig']:18} {row['writing']}  {row['outcome']:16} "
    if "error" in row:
        return f"{head}{row['error'].splitlines()[0][:120]}  ({row['cpu_s']:.0f} s CPU)"
    said = "; ".join(
        f"{e['key']} {e['amplitude']}±{e['error']} {e['unit']}{_members(e)}" for e in row["effects"]
    )
    gone = f" withdrawn {', '.join(row['withdrawn'])}" if row.get("withdrawn") else ""
    ratio = beside_by_hand(row)
    numbers = " ".join(
        f"{part} {row.get(null, math.nan):.3g}→{row[part]:.3g} (hand ×{ratio.get(part, math.nan):.2f})"
        for part, null in (("estimation", "null"), ("fresh", "null_fresh"))
        if part in row
    )
    sure = {True: "confirmed", False: "refused", None: "-"}[row.get("confirmed")]
    return f"{head}{row.get('verdict')} [{said}]{gone} {sure} | {numbers} | {row['cpu_s']:.1f} s CPU"


def _members(effect: dict[str, Any]) -> str:
    if len(effect["class"]) < 2:
        return ""
    return " {" + ", ".join(f"{key} {share:.2f}" for key, share in effect["class"].items()) + "}"


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
