"""Large effects: does the refit from the one-step start converge?

`python tests/benchmarks/repair_large.py --work FOLDER [--seeds 12]`

A cubic stiffness of 1e6 N m/rad3 and a lost combustion, each hidden by the independent simulator: null fit, score,
refit of the effect with all parameters free, from the score's amplitude or a share of it where the model fails there.
Converged: chi-squared per sample within 2 % of 1, and the amplitude within five standard errors and 2 % of the truth.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import repair_engine as engine
import repair_hidden
from repair_detectable import Place
from repair_hidden_theory import truth_of
from simulator.hidden_runs import Case

from casadi_engine.discrepancy.score import score

LARGE = {
    "cubic_stiffness 1e6": (Place("cubic_stiffness", "coupling", 0, 0), 1e6),
    "misfire, full": (Place("misfire", "cylinder_2", 0, 0, {"cycles": (4,)}), 1.0),
}
RATE = 2880.4


def one_piece(name, seed):
    """One record: first by score, and how the refit of the truth ended."""
    place, size = LARGE[name]
    (record,) = engine.simulated([Case((place.hidden(size),), seed, seed)], rate=RATE)
    noise = engine.white()
    fitted = engine.null_fit(engine.experiment(record), engine.first_state(record))
    candidates = engine.candidates_of(fitted)
    scores = score(engine.compressed(fitted, candidates, noise))
    truth = truth_of(candidates, place, size)
    first = int(np.argmax(scores.statistic))
    drop, amplitude, error = repair_hidden.refit(fitted, scores, truth, noise)
    after = (fitted.cost - drop) / fitted.null.count
    return {
        "before": fitted.cost / fitted.null.count,
        "after": after,
        "amplitude": amplitude,
        "error": error,
        "score": float(scores.amplitude[truth]),
        "first": candidates[first].label,
        "right": candidates[first].key == candidates[truth].key,
        "converged": bool(
            abs(after - 1) < 0.02 + 5 * np.sqrt(2 / fitted.null.count)
            and abs(amplitude - size) < max(5 * error, 0.02 * size)
        ),
    }


def table(folder):
    """Markdown."""
    out = [
        "| effect | records | first by score | refit converged | chi2/N before | after | one-step size | refitted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    done = engine.Store(folder, "large").done()
    for name in LARGE:
        rows = [row for piece, row in done.items() if piece.startswith(name)]
        if rows:
            n = len(rows)
            middle = {
                k: float(np.median([r[k] for r in rows])) for k in ("before", "after", "score", "amplitude")
            }
            out.append(
                f"| {name} | {n} | {sum(r['right'] for r in rows)}/{n} | {sum(r['converged'] for r in rows)}/{n} | "
                f"{middle['before']:.3g} | {middle['after']:.4f} | {middle['score']:.4g} | {middle['amplitude']:.4g} |"
            )
    return "\n".join(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    store = engine.Store(chosen.work, "large")
    pieces = {f"{name}, {seed}": (name, 700_000 + seed) for seed in range(chosen.seeds) for name in LARGE}
    engine.run_pieces(store, pieces, one_piece, jobs=chosen.jobs)
    print(table(chosen.work))


if __name__ == "__main__":
    main()
