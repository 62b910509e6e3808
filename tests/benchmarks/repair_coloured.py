"""Coloured noise and no effect: how often do the scores, and the tests beside the library, say that one is missing?

`python tests/benchmarks/repair_coloured.py --work FOLDER [--records 300] [--cases one_400,two] [--friction 0,1,2]`

Every record is a run of its own, fitted anew, all parameters and initial states free and the level "estimate", and is
screened with colour="auto". An alarm of the library is a pooled p-value of at most alpha; the whiteness test and the
families of functions are counted at the same level each; "any" is Screened.alarm: the three at their shares of alpha.

    one_400, one_1000, one_3000    one inertia, noise an autoregression of 0.9 from sample to sample
    one_resonance                  one inertia, 1000 samples, autoregression of order two: a resonance of the sensor
    one_white_400, one_white_1000  one inertia, white noise
    two, two_white                 two masses on a shaft, 1500 samples, 0.9 and white

With --friction dry friction of so many N m is hidden in the records, and "named" counts the alarms whose first name is
a friction. Finished records are kept in FOLDER; starting again goes on where it stopped.
"""

import argparse
import sys
import time
from functools import cache
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from repair_engine import Store
from repair_nothing import _interval
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.compression import candidate_columns, compress
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.noise_choice import choose_noise
from casadi_engine.discrepancy.null_distribution import NullDistribution, library_rows
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import Screened

ALPHAS = (0.01, 0.05)
SLOW = (0.9,)
RESONANCE = (1.5, -0.85)  # a pole pair of radius 0.92 at a tenth of the sampling rate
CASES = {
    "one_400": (1, 400, SLOW),
    "one_1000": (1, 1000, SLOW),
    "one_3000": (1, 3000, SLOW),
    "one_resonance": (1, 1000, RESONANCE),
    "one_white_400": (1, 400, ()),
    "one_white_1000": (1, 1000, ()),
    "two": (2, 1500, SLOW),
    "two_white": (2, 1500, ()),
}
STEP, SPREAD = 0.01, 0.05  # s; rad/s
PIECE = 10


def noise_of(seed, count, coefficients):
    """(count,) of an autoregression with standard deviation SPREAD."""
    rng = np.random.default_rng(seed)
    predictor = np.concatenate([[1.0], -np.asarray(coefficients)])
    long = lfilter([1.0], predictor, rng.standard_normal(count + 2000))[2000:]
    response = lfilter([1.0], predictor, np.eye(1, 4000)[0])
    return SPREAD * long / np.sqrt((response**2).sum())


@cache
def model_of(masses):
    """The model of the fits."""
    if masses == 1:
        return ce.one_inertia()
    b = ce.Blueprint("shaft", description="two masses on a shaft")
    one = b.parameter("J_eng", 0.4, unit="kg m2", min=0.01, max=10)
    two = b.parameter("J_load", 0.2, unit="kg m2", min=0.01, max=10)
    stiff = b.parameter("K_el", 20.0, unit="N m/rad", min=0.1, max=1e4)
    damp = b.parameter("C_el", 0.3, unit="N m s/rad", min=1e-3, max=1e2)
    drag = b.parameter("C_eng", 0.2, unit="N m s/rad", min=1e-3, max=1e2)
    first, second = b.state("omega_eng", unit="rad/s", scale=1), b.state("omega_load", unit="rad/s", scale=1)
    twist = b.state("twist", unit="rad", scale=0.1)
    torque = b.input("T", unit="N m", scale=10)
    inside = stiff * twist + damp * (first - second)
    engine = b.port("engine", "inertia", {"speed": first})
    load = b.port("load", "inertia", {"speed": second})
    b.ode("omega_eng", (torque - inside - drag * first + engine) / one)
    b.ode("omega_load", (inside + load) / two)
    b.ode("twist", first - second)
    b.output("omega", first, unit="rad/s", scale=1)
    return b.model()


def record_of(masses, count, seed, coefficients, friction):
    """A run with noise; the hidden friction acts on the engine."""
    time_ = np.arange(count) * STEP
    torque = 10 * np.sin(1.5 * time_) + 6 * np.sin(4.1 * time_)
    units = {"T": "N m"}
    exp = ce.Experiment.from_arrays("run", time=time_, units=units, T=torque)
    model = model_of(masses)
    initial = {state.name: 0.0 for state in model.states}
    if friction:
        model = model.with_effect(ce.effects.CoulombFriction(), at="engine", values={"torque": friction})
    clean = ce.simulate(model, exp, initial=initial)["omega"].values
    measured = clean + noise_of(seed, count, coefficients)
    return ce.Experiment.from_arrays(
        "run", time=time_, units={**units, "omega": "rad/s"}, T=torque, omega=measured
    )


_LIBRARY = {}


def one_record(case, seed, friction):
    """What the tests say of one record."""
    masses, count, coefficients = CASES[case]
    clock = time.process_time()
    data = record_of(masses, count, seed, coefficients, friction)
    fit = ce.estimate(model_of(masses), data, noise=ce.Noise(omega="estimate"), progress=False)
    fitted = time.process_time()
    null = null_model(fit)
    if case not in _LIBRARY:
        _LIBRARY[case] = tuple(library_candidates(null, fit.data, ce.effects.library()))
    candidates = _LIBRARY[case]
    columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    choice = choose_noise(null, candidates, columns, fit.noise, data=fit.data)
    compressed = choice.compressed or compress(null, candidates, choice.noise, columns=columns)
    scores = score(compressed)
    law = NullDistribution(library_rows(scores))
    # the shares of alpha do not matter: p-values are kept
    made = Screened(null, candidates, columns, choice, compressed, scores, law, 0.01, 0.008, 0.0)
    lead = made.order[0]
    best = float(scores.p_value[lead])
    left = made.leftover
    white = [p for name, p in left.tests.items() if name.endswith("/whiteness")]
    freedom = scores.freedom[scores.testable] if scores.freedom is not None else np.array([np.inf])
    return {
        "seed": seed,
        "converged": fit.converged,
        "library": law.pooled(best) if best < 0.05 else 1.0,
        "name": candidates[lead].effect,
        "white": min(white) * len(white) if white else 1.0,
        "family": 1.0 if left.family_p is None else left.family_p,
        "coloured": bool(choice.noise.colour),
        "order": max((c.order for c in choice.noise.colour.values()), default=0),
        "freedom": float(min(np.median(freedom), 1e9)),
        "cpu": [fitted - clock, time.process_time() - fitted],
    }


def one_piece(case, first, count, friction):
    """Some records of a case."""
    base = 1_000_000 * (1 + list(CASES).index(case))
    return {"rows": [one_record(case, base + k, friction) for k in range(first, first + count)]}


def alarms(rows, alpha):
    """How many records each kind of test alarms in."""
    library = [r["library"] <= alpha for r in rows]
    white, family = [r["white"] <= alpha for r in rows], [r["family"] <= alpha for r in rows]
    total = [
        r["library"] <= 0.8 * alpha or r["white"] <= 0.1 * alpha or r["family"] <= 0.1 * alpha for r in rows
    ]
    named = [hit and "friction" in r["name"] for hit, r in zip(library, rows, strict=True)]
    return {"library": library, "white": white, "family": family, "any": total, "named": named}


def _cell(hits):
    n, k = len(hits), sum(hits)
    low, high = _interval(k, n)
    return f"{k}/{n} = {100 * k / n:.2f} % ({100 * low:.1f} to {100 * high:.1f})"


def tables(folder, cases, frictions):
    """Markdown of all that is done."""
    kinds = ("library", "white", "family", "any")
    out = [
        "| case | friction | alpha | library | whiteness | families | any | friction named | coloured | freedom |"
    ]
    out.append("|---" * 10 + "|")
    for case in cases:
        for friction in frictions:
            done = Store(folder, f"coloured_{case}_{friction:g}").done()
            rows = [row for piece in done.values() for row in piece["rows"] if row["converged"]]
            if not rows:
                continue
            for alpha in ALPHAS:
                found = alarms(rows, alpha)
                cells = [_cell(found[kind]) for kind in kinds]
                named = _cell(found["named"]) if friction else "-"
                coloured = f"{sum(r['coloured'] for r in rows)}/{len(rows)}"
                freedom = f"{np.median([r['freedom'] for r in rows]):.0f}"
                out.append(
                    f"| {case} | {friction:g} | {100 * alpha:g} % | {' | '.join(cells)} | {named} | {coloured} | "
                    f"{freedom} |"
                )
            cpu = np.median([r["cpu"] for r in rows], axis=0)
            out.append(f"<!-- {case}: CPU {cpu[0]:.2f} s run and fit, {cpu[1]:.2f} s screen -->")
    return "\n".join(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--friction", default="0")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after so long by the clock")
    chosen = parser.parse_args()
    cases, frictions = chosen.cases.split(","), [float(f) for f in chosen.friction.split(",")]
    begun = time.time()
    for case in cases:
        for friction in frictions:
            store = Store(chosen.work, f"coloured_{case}_{friction:g}")
            for first in range(0, chosen.records, PIECE):
                if str(first) in store.done() or time.time() - begun > chosen.seconds:
                    continue
                store.add(str(first), one_piece(case, first, PIECE, friction))
    print(tables(chosen.work, cases, frictions))


if __name__ == "__main__":
    main()
