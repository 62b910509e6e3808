"""Records in which nothing is missing: how often does the library say otherwise?

`python tests/benchmarks/repair_nothing.py --work FOLDER [--records 1500] [--jobs 2] [--settings one,two,assumed]`

Every record is a run of its own of the independent simulator: other combustions, other noise. It is fitted anew, all
parameters and initial states free, and the whole library is scored (candidates, and groups of cylinders), with the
noise level known and with it estimated. An alarm is a pooled p-value of at most alpha. Records with an alarm are
refitted with the effect that is blamed, to see whether chi-squared falls as the score promised.

    one, two    one and two speed sensors, all pressures measured
    assumed     one sensor; p3 and p4 are p1 and p2 shifted in crank angle, all combustions scatter by 2 %, and the
                cylinders differ in strength, timing and charge: the fit carries what may be wrong with p3 and p4, and
                finds its scatter

All records scatter, and all have unequal cylinders; the others are told so by their pressures.

Finished pieces are kept in FOLDER; starting again goes on where it stopped. `tables()` makes Markdown of them.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import repair_engine as engine
from scipy import stats
from simulator.hidden_runs import Case

from casadi_engine.discrepancy.score import saturated_variance, scores_of

PIECE = 25
RATE = 1440.2  # Hz
ALPHAS = (0.01, 0.05)
SETTINGS = {"one": (1, False), "two": (2, False), "assumed": (1, True)}
# A smallest p-value above this is pooled to far more than the largest alpha: its pooled value is not worked out.
LEAST = 3e-3


def one_piece(setting, first, count):
    """Records ``first`` to ``first + count``: for each the tests with known and with estimated noise."""
    sensors, assumed = SETTINGS[setting]
    # seeds of these studies are theirs alone
    seeds = [10_000 * (1 + list(SETTINGS).index(setting)) + k for k in range(first, first + count)]
    clock = time.process_time()
    records = engine.simulated([Case((), seed, seed) for seed in seeds], rate=RATE)
    made = time.process_time() - clock
    rows = []
    for seed, record in zip(seeds, records, strict=True):
        clock = time.process_time()
        data, start = engine.experiment(record, sensors=sensors, assumed=assumed), engine.first_state(record)
        if assumed:
            fitted, fit = engine.assumed_fit(data, sensors=sensors)
        else:
            fitted = engine.null_fit(data, start, sensors=sensors)
        row = {"seed": seed, "chi2": fitted.cost / fitted.null.count}
        row |= {"status": fit.status, "scatter": fitted.scatter} if assumed else {}
        row |= tests_of(fitted, engine.white(sensors), (), sensors=sensors)
        row["cpu"] = time.process_time() - clock
        rows.append(row)
    return {"rows": rows, "simulation_cpu": made}


def tests_of(fitted, noise, scatter, *, sensors):
    """The library's test with the noise level known, and with the level that parameters and library leave."""
    candidates = engine.candidates_of(fitted, sensors=sensors)
    reduced = engine.compressed(fitted, candidates, noise, scatter=scatter).reduced()
    scores = scores_of(reduced, tuple(candidates), fitted.null.turn)
    square = float(np.mean(scores.z[scores.testable] ** 2))
    levels = {"known": 1.0, "estimated": float(np.sqrt(saturated_variance(reduced)[0]))}
    found = {"square": square}
    for kind, level in levels.items():
        p, name, pooled = engine.library_test(scores, least=LEAST, level=level)
        found[kind] = {"p": p, "name": name, "pooled": pooled if pooled == pooled else None, "level": level}
        if kind == "known" and pooled <= min(ALPHAS):
            found[kind]["refit"] = engine.refitted_drop(fitted, scores, noise, scatter)
    return found


def table(store):
    """Markdown of one setting's results, or None if there are none."""
    rows = [row for piece in store.done().values() for row in piece["rows"]]
    if not rows:
        return None
    n = len(rows)
    lines = []
    for kind in ("known", "estimated"):
        cells = [kind]
        for alpha in ALPHAS:
            hits = sum(r[kind]["pooled"] is not None and r[kind]["pooled"] <= alpha for r in rows)
            low, high = _interval(hits, n)
            cells.append(f"{hits}/{n} = {100 * hits / n:.2f} % ({100 * low:.2f} to {100 * high:.2f})")
        found = [r[kind]["refit"] for r in rows if "refit" in r[kind]]
        kept = sum(f["significant"] for f in found)
        cells.append(f"{kept}/{len(found)}")
        blamed = {}
        for r in rows:
            if r[kind]["pooled"] is not None and r[kind]["pooled"] <= min(ALPHAS):
                effect = r[kind]["name"].split(" (")[0]
                blamed[effect] = blamed.get(effect, 0) + 1
        cells.append(", ".join(f"{k} {v}" for k, v in sorted(blamed.items(), key=lambda x: -x[1])))
        lines.append("| " + " | ".join(cells) + " |")
    chi2 = float(np.mean([r["chi2"] for r in rows]))
    cpu = float(np.median([r["cpu"] for r in rows]))
    return lines, f"{n} records, mean chi2/N {chi2:.4f}, {cpu:.2f} s CPU each (median)" + _assumed_words(rows)


def _assumed_words(rows):
    """Mean square of the scores, scatter found, and fits that did not converge, where they were written down."""
    squares = [r["square"] for r in rows if "square" in r]
    words = ""
    if squares:
        error = float(np.std(squares) / np.sqrt(len(squares)))
        words = f", mean square of the scores {np.mean(squares):.3f} +- {error:.3f} over {len(squares)}"
    found = [r["scatter"] for r in rows if "scatter" in r]
    if found:
        failed = sum(r["status"] != "converged" for r in rows if "status" in r)
        words += f", scatter found {100 * np.mean(found):.2f} % (from {100 * min(found):.2f} to {100 * max(found):.2f})"
        words += f", {failed} fits did not converge"
    return words


def _interval(hits, n):
    """The 95 % interval of a share (Clopper and Pearson)."""
    low = stats.beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = stats.beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return low, high


def tables(folder):
    """All settings as Markdown."""
    out = [
        "| setting | noise level | alarms at 1 % (95 % interval) | at 5 % | alarms at 1 % kept by a refit | blamed |",
        "|---|---|---|---|---|---|",
    ]
    notes = []
    for setting in SETTINGS:
        made = table(engine.Store(folder, f"nothing_{setting}"))
        if made:
            lines, words = made
            out += [f"| {setting} {line}" for line in lines]
            notes.append(f"{setting}: {words}")
    return "\n".join([*out, "", *notes])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--records", type=int, default=1500)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--settings", default="one,two,assumed")
    chosen = parser.parse_args()
    for setting in chosen.settings.split(","):
        store = engine.Store(chosen.work, f"nothing_{setting}")
        pieces = {
            f"{first}": (setting, first, min(PIECE, chosen.records - first))
            for first in range(0, chosen.records, PIECE)
        }
        engine.run_pieces(store, pieces, one_piece, jobs=chosen.jobs)
    print(tables(chosen.work))


if __name__ == "__main__":
    main()
