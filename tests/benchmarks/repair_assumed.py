"""Hidden effects beside assumed pressures: are they still found where p3 and p4 are p1 and p2 shifted?

`python tests/benchmarks/repair_assumed.py --work FOLDER [--seeds 4] [--sizes 4] [--jobs 1]`

Records as in the setting "assumed" of repair_nothing.py, with one effect hidden. Its size is a multiple of the one that
the scores of three records without effects say is found with 95 % probability. The same record is searched with all
pressures measured, for comparison. Null fit and scores as there; no refits. Counted are alarms at 1 %, the right name
first, and the right name in the class: candidates that one cannot tell from the best (their z less than the best's by
2.3 at most, squared).
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import repair_engine as engine
from repair_nothing import RATE
from scipy import stats
from simulator.hidden import hidden
from simulator.hidden_runs import Case

from casadi_engine.discrepancy.null_distribution import NullDistribution, library_rows
from casadi_engine.discrepancy.score import scores_of

# effect, port, details: what the data can show at all
PLACES = (
    ("coulomb_friction", "coupling", {}),
    ("cubic_stiffness", "coupling", {}),
    ("backlash", "coupling", {}),
    ("misfire", "cylinder_1", {"cycles": [5]}),
    ("misfire", "cylinder_3", {"cycles": [5]}),
    ("cylinder_imbalance", "cylinder_1", {}),
    ("load_step", "load", {"time": 0.5}),
    ("sensor_delay", "sensor_omega", {}),
)
ALPHA, KEEP = 0.01, 2.326**2
PLAIN = range(60_000, 60_003)


def scored(record, *, assumed=True):
    """Null fit and scores of a record."""
    data = engine.experiment(record, assumed=assumed)
    if assumed:
        fitted, _ = engine.assumed_fit(data)
    else:
        fitted = engine.null_fit(data, engine.first_state(record))
    candidates = engine.candidates_of(fitted)
    reduced = engine.compressed(fitted, candidates, engine.white()).reduced()
    return fitted, scores_of(reduced, tuple(candidates), fitted.null.turn)


def members(scores, name, at, details):
    """Numbers of the candidates that are the hidden effect; of an event the nearest in its grid."""
    found = [k for k, c in enumerate(scores.candidates) if c.key == (name, at)]
    if "cycles" in details:
        first, last = details["cycles"][0], details["cycles"][-1]
        return [k for k in found if scores.candidates[k].nuisance == {"first": first, "last": last}]
    if "time" in details:
        gap = [abs(scores.candidates[k].nuisance["time"] - details["time"]) for k in found]
        return [found[int(np.argmin(gap))]]
    return found


def detectable():
    """Effect -> smallest detectable sizes with assumed and with measured pressures, medians of three records."""
    sizes = {}
    for record in engine.simulated([Case((), seed, seed) for seed in PLAIN], rate=RATE):
        for assumed in (True, False):
            _, scores = scored(record, assumed=assumed)
            limit = NullDistribution(library_rows(scores, engine.groups_of(scores.candidates))).threshold(
                ALPHA
            )
            found = scores.detectable(float(stats.norm.isf(limit / 2)))
            for name, at, details in PLACES:
                own = np.sort(found[members(scores, name, at, details)])
                own = own[np.isfinite(own)]
                sizes.setdefault(f"{name} at {at}", {True: [], False: []})[assumed].append(own[len(own) // 2])
    return {key: [float(np.median(own[True])), float(np.median(own[False]))] for key, own in sizes.items()}


def one_record(name, at, details, size, seed):
    """What the scores of one record with one hidden effect say."""
    clock = time.process_time()
    # an effect that cannot be larger than 1 is not
    size = min(size, 1.0) if name == "misfire" else size
    record = engine.simulated([Case((hidden(name, at, size, **details),), seed, seed)], rate=RATE)[0]
    answer = {"size": size, "seed": seed}
    for kind, assumed in (("assumed", True), ("measured", False)):
        fitted, scores = scored(record, assumed=assumed)
        answer[kind] = _said(fitted, scores, name, at)
    return answer | {"cpu": time.process_time() - clock}


def _said(fitted, scores, name, at):
    _, row, pooled = engine.library_test(scores)
    best = int(np.argmin(np.where(scores.testable, scores.p_value, 2.0)))
    drop = scores.drop
    alike = {scores.candidates[k].key for k in np.flatnonzero(scores.testable & (drop[best] - drop <= KEEP))}
    return {
        "pooled": pooled,
        "row": row,
        "best": scores.candidates[best].label,
        "first": scores.candidates[best].key == (name, at),
        "in_class": (name, at) in alike,
        "class": len(alike),
        "scatter": fitted.scatter,
        "chi2": fitted.cost / fitted.null.count,
    }


def table(store):
    """Markdown."""
    done = store.done()
    out = [
        "| hidden | detectable: p3, p4 assumed | all measured | size | pressures | alarm at 1 % | right name first"
        " | in the class | otherwise first | scatter found |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups = {}
    for piece, result in done.items():
        if piece != "detectable":
            groups.setdefault(piece.rpartition(" seed ")[0], []).append(result)
    for key, answers in groups.items():
        effect, _, times = key.rpartition(" x ")
        known, measured = done["detectable"][effect]
        n = len(answers)
        for kind in ("assumed", "measured"):
            rows = [answer[kind] for answer in answers]
            other = ", ".join(r["best"] for r in rows if not r["first"])
            alarms = sum(r["pooled"] <= ALPHA for r in rows)
            first, inside = sum(r["first"] for r in rows), sum(r["in_class"] for r in rows)
            tau = f"{100 * np.mean([r['scatter'] for r in rows]):.1f} %" if kind == "assumed" else ""
            size = answers[0]["size"]
            out.append(
                f"| {effect} | {known:.3g} | {measured:.3g} | {size:.3g} ({times} x) | {kind} | {alarms}/{n} | "
                f"{first}/{n} | {inside}/{n} | {other} | {tau} |"
            )
    return "\n".join(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--sizes", default="4")
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    store = engine.Store(chosen.work, "assumed_hidden")
    engine.run_pieces(store, {"detectable": ()}, detectable)
    sizes = store.done()["detectable"]
    pieces = {
        f"{name} at {at} x {times} seed {k}": (
            name,
            at,
            details,
            float(times) * sizes[f"{name} at {at}"][0],
            61_000 + 100 * number + k,
        )
        for k in range(chosen.seeds)
        for times in chosen.sizes.split(",")
        for number, (name, at, details) in enumerate(PLACES)
    }
    engine.run_pieces(store, pieces, one_record, jobs=chosen.jobs)
    print(table(store))


if __name__ == "__main__":
    main()
