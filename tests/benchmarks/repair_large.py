"""Large effects: does the refit reach the optimum, from the fit without the effect and its one-step amplitude?

`python tests/benchmarks/repair_large.py --work FOLDER [--seeds 12]`

A stiffness of 1e6 N m/rad3 and a lost combustion, each hidden by the independent simulator. Every record goes through
what `ce.repair` does with it: the fit within the bounds of problems/two_mass.py from four starts, the scores, the refit
of the hidden effect by `Path` and `Refitter`. Converged: chi-squared no more than 6.6 (1 % at one number) above that of
a fit that starts at the true values; and the amplitude within 2.58 standard errors of the truth.

At 57 N m the coupling hardly bends, and the fit without the effect takes most of 1e6 N m/rad3 up: the size there is a
small one. It is large where the load swings the coupling, here by 60 N m at 3 Hz about 90 N m.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "problems"))

import repair_engine as engine
import two_mass as page
from repair_detectable import Place
from repair_hidden_theory import truth_of
from simulator.hidden_runs import Case
from single_shooting import settle

import casadi_engine as ce
from casadi_engine.discrepancy import path
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.refit import Refitter, addition, merit
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start

RATE = 1440.2
OPTIONS = {"interval": "auto", "initial": None, "method": "exact", "max_iterations": 200}


def swinging(t):
    """A load that bends the coupling to and fro [N m]."""
    return 90.0 + 60.0 * np.sin(2 * np.pi * 3.0 * t)


LARGE = {
    "cubic_stiffness 1e6": (Place("cubic_stiffness", "coupling", 0, 0), 1e6, 57.0),
    "cubic_stiffness 1e6, load swings": (Place("cubic_stiffness", "coupling", 0, 0), 1e6, swinging),
    "misfire, full": (Place("misfire", "cylinder_2", 0, 0, {"cycles": (4,)}), 1.0, 57.0),
}


def one_piece(name, seed):
    """One record: first by score, and how the refit of the truth ended."""
    clock = time.process_time()
    place, size, load = LARGE[name]
    (record,) = engine.simulated([Case((place.hidden(size),), seed, seed)], rate=RATE, load=load)
    data, model, noise = engine.experiment(record), engine.model(), ce.Noise(omega=engine.SIGMA)
    pars = page.parameters(model)
    fit = ce.estimate(model, data, parameters=pars, noise=noise, starts=4, progress=False)
    screened = screen(fit)
    scores, candidates = screened.scores, screened.candidates
    truth = truth_of(candidates, place, size)
    first = screened.order[0]
    refitter = Refitter(model, pars, (data,), noise, OPTIONS)
    one = addition(candidates[truth], float(scores.amplitude[truth]))
    clock_refit = time.process_time()
    found = refitter(fit, [one], start=arrival(refitter, fit, one))
    clock_refit = time.process_time() - clock_refit
    best, mu = from_the_truth(refitter, one, data, record, size)
    estimate = found.estimates.get(one.amplitude)
    amplitude, error = (None, None) if estimate is None else (estimate.value, estimate.stderr)
    inside = amplitude is not None and error is not None and abs(amplitude - size) < 2.58 * error
    return {
        "mu": mu,
        "null": fit.status,
        "before": fit.cost / fit.n,
        "after": found.cost / found.n,
        "above": merit(found) - merit(best),
        "amplitude": amplitude,
        "error": error,
        "score": float(scores.amplitude[truth]),
        "z": float(scores.z[truth]),
        "first": candidates[first].label,
        "right": candidates[first].key == candidates[truth].key,
        "refit": found.status,
        "optimum": bool(found.converged and merit(found) < merit(best) + 6.6),
        "inside": bool(inside),
        "refit cpu": clock_refit,
        "cpu": time.process_time() - clock,
    }


def arrival(refitter, fit, one):
    """Where the path of refits ends from the fit without the effect, as a start of the fit of all data."""
    refits = path.Path(refitter, {name: sigma for name, (sigma, _) in fit.noise.items()})
    refitter.base = fit
    there = refits.from_point([one], Start.of(fit))
    if there is not None:
        refitter.share = refits.sharpness([one], there, 1.0)
        there = refits.from_point([one], there) or there
    return Start.of(fit) if there is None else Start(there.values, there.initial, {}, there.settled)


def from_the_truth(refitter, one, data, record, size):
    """The fit that starts at the true values, and the size in units of its detectability, parameters free there."""
    model = refitter.extended([one])
    pars = refitter.parameters.copy().extended(model)
    for key, value in {**engine.TRUTH, one.amplitude: size}.items():
        pars[key].set(value)
    best = ce.estimate(model, data, parameters=pars, noise=refitter.noise, progress=False)
    null, _, _ = settle(
        engine.model(), [data], engine.model().parameters(), np.array(list(engine.TRUTH.values())),
        {data.name: engine.first_state(record)}, noise=engine.white(), iterations=0,
    )  # fmt: skip
    scores = score(compress(null, [one.candidate], engine.white()))
    return best, size * float(np.sqrt(scores.information[0]))


def table(folder):
    """Markdown."""
    out = [
        "| effect | mu | records | first by score | refit at the optimum | truth within 99 % | chi2/N before | after |"
        " one-step size | refitted | CPU of a refit [s] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    done = engine.Store(folder, "large").done()
    for name in LARGE:
        rows = [row for piece, row in done.items() if piece.rpartition(", ")[0] == name]
        if rows:
            n = len(rows)
            keys = ("mu", "before", "after", "score", "amplitude", "refit cpu")
            mid = {k: float(np.median([r[k] for r in rows if r[k] is not None])) for k in keys}
            hits = [sum(r[k] for r in rows) for k in ("right", "optimum", "inside")]
            out.append(
                f"| {name} | {mid['mu']:.3g} | {n} | {hits[0]}/{n} | {hits[1]}/{n} | {hits[2]}/{n} | "
                f"{mid['before']:.4g} | {mid['after']:.4f} | {mid['score']:.4g} | {mid['amplitude']:.4g} | "
                f"{mid['refit cpu']:.2g} |"
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
