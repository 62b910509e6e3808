"""Rivals of `ce.repair` on the same tasks: what a skilled person would do by hand.

    python tests/benchmarks/hidden_terms/rivals.py [KIND ...] [--tasks N] [--nulls N] [--rivals NAME ...]
        [--out FILE.jsonl] [--table FILE.md]

refit-all    the model with each candidate fitted by ``ce.estimate``, the best kept by BIC, at most two in turn; those
             within a factor of 20 (6 in BIC) form a class. It is given what `repair` is given.
stepwise     regression of the equation error on the columns of all free parameters and of the same candidates, forward
             by BIC, classes likewise. It is given all states, as noisy as the outputs, their best smoothing (known from
             the truth), and the fitted null model.
sindy        PySINDy (STLSQ) on the equation error, and on the derivatives, of all states; the threshold is the one at
             which it does best, known from the truth. Left out, with the reason, where it is not installed.

Tasks whose truth the library lacks are left out: no rival can say "unnamed".
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402

import casadi_engine as ce  # noqa: E402
from hidden_terms.equation_error import equation_error  # noqa: E402
from hidden_terms.judge import judged  # noqa: E402
from hidden_terms.kind import TASKS, Kind, Task, load_kinds, nulls_of, tasks_of  # noqa: E402
from hidden_terms.records import Case, case_of  # noqa: E402
from hidden_terms.tables import line, word_of  # noqa: E402

# Candidates within this of the best in BIC are as probable as it to a factor of 20.
_CLASS = 6.0
_MOST = 2
# Start values of an event's time, in shares of the record; refits of a second round.
_TIMES, _SECOND = (0.25, 0.5, 0.75), 6


def answer(classes: list[list[str]]) -> dict[str, Any]:
    """Classes of names as the judge reads them."""
    effects = [{"lead": one[0], "members": [[name, 1 / len(one)] for name in one]} for one in classes]
    return {
        "verdict": "named" if effects else "nothing missing",
        "confirmed": None,
        "effects": effects,
        "gap": None,
    }


def by_bic(scores: Mapping[str, float]) -> list[str]:
    """The best, and those that are as probable to a factor of 20."""
    best = min(scores.values())
    return sorted((name for name, bic in scores.items() if bic < best + _CLASS), key=scores.__getitem__)


# ---- every candidate refitted


def refit_all(case: Case) -> list[list[str]]:
    model, parameters, classes = case.model, case.parameters, []
    fit = _fitted(model, case, parameters)
    if fit is None:
        return []
    bic, names = _bic(fit), None
    for _ in range(_MOST):
        found = {name: one for name, one in _refits(fit.model, fit.parameters, case, names).items() if one}
        if not found:
            break
        scores = {name: _bic(one) for name, one in found.items()}
        if min(scores.values()) > bic - _CLASS:
            break
        classes.append(by_bic(scores))
        fit, bic = found[classes[-1][0]], min(scores.values())
        names = sorted(scores, key=scores.__getitem__)[1 : _SECOND + 1]
    return classes


def _refits(model: Any, parameters: Any, case: Case, names: list[str] | None) -> dict[str, Any]:
    """name -> the best fit with that candidate."""
    found: dict[str, Any] = {}
    effects = ce.effects.library() if case.effects is None else case.effects
    span = case.data.span
    for effect in effects:
        for port in ce.effects.ports_for(model, effect):
            key = f"{port.name}.{effect.name}"
            there = {one.key for one in model.effects}
            if key in there or any(grid.whole for grid in effect.nuisance.values()):
                continue
            if names is not None and key not in names:
                continue
            timed = [name for name, grid in effect.nuisance.items() if grid.over == "time"]
            shares = _TIMES if timed else (0.5,)
            for share in shares:
                values = dict.fromkeys(timed, span[0] + share * (span[1] - span[0]))
                _keep(found, key, _extended(model, effect, port, values, case, parameters))
    for one in model.declarations:
        key = f"parameter_{one.name}.wrong_value"
        if (
            not parameters[one.name].vary
            and not one.name.endswith(".width")
            and (names is None or key in names)
        ):
            free = parameters.extended(model)
            free[one.name].vary = True
            _keep(found, key, _fitted(model, case, free))
    return found


def _extended(
    model: Any, effect: Any, port: Any, values: dict[str, float], case: Case, parameters: Any
) -> Any:
    try:
        larger = model.with_effect(effect, at=port.name, values=values)
    except ce.CasadiEngineError:
        return None
    return _fitted(larger, case, parameters.extended(larger))


def _keep(found: dict[str, Any], key: str, fit: Any) -> None:
    if fit is not None and (found.get(key) is None or _bic(fit) < _bic(found[key])):
        found[key] = fit


def _fitted(model: Any, case: Case, parameters: Any) -> Any:
    try:
        return ce.estimate(model, case.data, parameters=parameters, progress=False)
    except ce.CasadiEngineError:
        return None


def _bic(fit: Any) -> float:
    """N log(mean square) by output, and log N for each free parameter."""
    total, count = 0.0, 0
    for traces in fit.traces.values():
        for trace in traces.values():
            e = trace.residual[trace.mask]
            total += len(e) * math.log(float(e @ e) / len(e))
            count += len(e)
    free = sum(fit.parameters[one.name].vary for one in fit.model.declarations)
    return total + free * math.log(count)


# ---- regression of the equation error


def stepwise(case: Case, task: Task) -> list[list[str]]:
    error = equation_error(case, task)
    base, classes = error.nuisance, []
    left = error.left(error.target, base)
    bic = error.bic(left, 0)
    for step in range(_MOST):
        scores = {}
        for name, columns in error.candidates.items():
            best = min((error.gain(left, base, column) for column in columns), default=None)
            if best is not None:
                scores[name] = error.bic_of(best, step + 1)
        if not scores or min(scores.values()) > bic - _CLASS:
            break
        classes.append(by_bic(scores))
        lead = classes[-1][0]
        column = min(error.candidates[lead], key=lambda one: error.gain(left, base, one))
        base = np.column_stack([base, column])
        left = error.left(error.target, base)
        bic = error.bic(left, step + 1)
    return classes


# ---- PySINDy


def sindy(case: Case, task: Task, kind: Kind, *, residual: bool) -> str:
    """The outcome at the best threshold."""
    import pysindy

    error = equation_error(case, task)
    order = ["right", "in class", "missed", "wrong single", "unable"]
    true = error.features_of(kind, task, case)
    if true is None:
        return "unable"
    target, needed = error.residual if residual else error.rates, error.needed(0.02, residual)
    scale = target.std(axis=0) + 1e-300
    found = []
    for threshold in np.geomspace(0.005, 1.0, 15):
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                optimizer.fit(error.features, target / scale)
            except (ValueError, np.linalg.LinAlgError):
                continue
        active = np.abs(optimizer.coef_) > 0
        extra = int((active & ~needed & ~true).sum())
        hit = bool(active[true].all())
        if not true.any():
            found.append("right" if not extra else "false alarm")
        elif hit:
            found.append("right" if not extra else "in class" if extra <= 2 else "wrong single")
        else:
            found.append("missed" if not extra else "wrong single")
    return min(found, key=lambda word: order.index(word) if word in order else 9, default="unable")


# ---- the runner


def _named(rival: Callable[[], list[list[str]]], kind: Kind, task: Task) -> tuple[str, list[list[str]]]:
    classes = rival()
    return judged(kind, task, answer(classes)), classes


def run_rival(name: str, kind: Kind, task: Task, case: Case) -> dict[str, Any]:
    begun, names = time.process_time(), []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if name == "refit-all":
                word, names = _named(lambda: refit_all(case), kind, task)
            elif name == "stepwise":
                word, names = _named(lambda: stepwise(case, task), kind, task)
            else:
                word = sindy(case, task, kind, residual=name == "sindy residual")
    except ImportError as fault:
        word = f"skipped: {fault}"
    except Exception as fault:  # noqa: BLE001 (a crash is an outcome)
        word = f"crashed: {type(fault).__name__}: {fault}"[:300]
    return {"rival": name, "outcome": word, "names": names, "seconds": time.process_time() - begun}


RIVALS = ("stepwise", "sindy residual", "sindy states", "refit-all")


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--tasks", type=int, default=TASKS)
    parser.add_argument("--nulls", type=int, default=0)
    parser.add_argument("--rivals", nargs="+", default=RIVALS, choices=RIVALS)
    parser.add_argument("--sealed", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("hidden_terms_rivals.jsonl"))
    parser.add_argument("--table", type=Path)
    given = parser.parse_args(argv)
    kinds = load_kinds(sealed=given.sealed)
    lines = given.out.read_text().splitlines() if given.out.exists() else []
    done = {(row["key"], row["rival"]) for row in map(json.loads, lines)}
    for name in given.kinds or kinds:
        kind = kinds[name]
        tasks = [
            one for one in tasks_of(kind)[: given.tasks] if all(kind.terms[t].in_library for t in one.deleted)
        ]
        for task in [*tasks, *nulls_of(kind)[: given.nulls]]:
            left = [rival for rival in given.rivals if (task.key, rival) not in done]
            case = case_of(kind, task) if left else None
            for rival in left:
                assert case is not None
                row = {"key": task.key, "kind": name, "null": task.null, "snr": task.snr}
                row |= run_rival(rival, kind, task, case)
                with given.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
                words = f"{row['seconds']:6.1f} s  {row['outcome'][:60]} {row['names'] or ''}"
                print(f"{task.key:60s} {rival:15s} {words}", flush=True)
    if given.table:
        rows = [json.loads(text) for text in given.out.read_text().splitlines()]
        given.table.write_text(table(rows), encoding="utf-8")


def table(rows: list[dict[str, Any]]) -> str:
    """Outcomes of every rival, a line each."""
    words = sorted({word_of(row) for row in rows if not row["null"]})
    heads = ["rival", "tasks", *words, "false alarms", "CPU s, median"]
    lines = [f"{datetime.date.today().isoformat()}\n", line(heads), line(["---"] * len(heads))]
    for rival in RIVALS:
        own = [row for row in rows if row["rival"] == rival]
        if not own:
            continue
        tasks, nulls = ([row for row in own if row["null"] == null] for null in (False, True))
        counted = Counter(word_of(row) for row in tasks)
        alarms = f"{sum(row['outcome'] != 'right' for row in nulls)} of {len(nulls)}"
        seconds = f"{np.median([row['seconds'] for row in own]):.1f}"
        lines.append(line([rival, len(tasks), *(counted[word] or "" for word in words), alarms, seconds]))
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
