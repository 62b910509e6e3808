"""How often do the tests alarm when nothing is missing, whatever the noise is like?

`python tests/benchmarks/noise_levels.py --work FOLDER [--part screens|residuals] [--cases a,b] [--records 400]`

screens: the score test of the whole library (``discrepancy.screen``, colour="auto", level estimated) at one inertia
sampled every 0.01 s, without an effect. The model is linearised once, its residuals are replaced by drawn noise: the
scores are free of what the parameters explain, so a refit would change nothing. A case is noise_samples.
residuals: ``whiteness`` and ``independence`` of residuals of a regression with five parameters, 25 lags unless said.

Finished pieces are kept in FOLDER; starting again goes on where it stopped. Prints Markdown: NOISE.md has its tables.
"""

import argparse
import sys
import time
from functools import cache
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from repair_engine import Store
from scipy import stats
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.compression import candidate_columns, compress
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.noise_choice import choose_noise
from casadi_engine.discrepancy.null_distribution import NullDistribution, library_rows
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.screening import Screened
from casadi_engine.validation import independence, whiteness

ALPHAS = (0.01, 0.05)
STEP = 0.01  # s
PIECE = 20
SCALES = 0.02 * 2.0 ** np.arange(9)  # s, of the wanders that sum up to 1/f
RESONANCE = (1.0, -1.5, 0.85)


def wander(rng, count, seconds):
    """An Ornstein-Uhlenbeck process of unit variance."""
    phi = np.exp(-STEP / seconds)
    drive = np.sqrt(1 - phi**2) * rng.standard_normal(count)
    drive[0] /= np.sqrt(1 - phi**2)
    return lfilter([1.0], [1.0, -phi], drive)


def quantised(rng, count):
    """An encoder that counts: a slow course and noise of 0.3 steps, rounded."""
    course = 3 * np.sin(np.arange(count) * STEP * 2 * np.pi * rng.uniform(1, 3) + rng.uniform(0, 6))
    return np.round(course + 0.3 * rng.standard_normal(count)) - course


def outliers(rng, count):
    """White noise, one sample in a hundred ten times as large."""
    return rng.standard_normal(count) * np.where(rng.random(count) < 0.01, 10.0, 1.0)


NOISES = {
    "white": lambda rng, n: rng.standard_normal(n),
    "ar0.5": lambda rng, n: lfilter([1.0], [1.0, -0.5], rng.standard_normal(n + 500))[500:],
    "ar0.9": lambda rng, n: lfilter([1.0], [1.0, -0.9], rng.standard_normal(n + 500))[500:],
    "resonance": lambda rng, n: lfilter([1.0], RESONANCE, rng.standard_normal(n + 500))[500:],
    "wander0.1": lambda rng, n: rng.standard_normal(n) + np.sqrt(0.1) * wander(rng, n, 0.5),
    "wander0.3": lambda rng, n: rng.standard_normal(n) + np.sqrt(0.3) * wander(rng, n, 0.5),
    "wander1": lambda rng, n: rng.standard_normal(n) + wander(rng, n, 0.5),
    "pink": lambda rng, n: sum(wander(rng, n, tau) for tau in SCALES),
    "t3": lambda rng, n: rng.standard_t(3, n),
    "t5": lambda rng, n: rng.standard_t(5, n),
    "outliers": outliers,
    "laplace": lambda rng, n: rng.laplace(size=n),
    "encoder": quantised,
}
SCREENS = (
    "white_50", "white_100", "white_200", "white_1000", "ar0.5_200", "ar0.5_1000", "ar0.9_200", "ar0.9_1000",
    "resonance_1000", "wander0.1_200", "wander0.1_1000", "wander0.3_200", "wander0.3_1000", "wander1_200",
    "wander1_1000", "wander0.1_3000", "wander1_3000", "pink_1000", "t3_100", "t3_1000", "t5_1000", "outliers_1000",
    "laplace_1000", "encoder_1000",
)  # fmt: skip


@cache
def linearised(count):
    """Null model, data, library and its columns at a run of one inertia."""
    t = np.arange(count) * STEP
    torque = 10 * np.sin(1.5 * t) + 6 * np.sin(4.1 * t)
    model, units = ce.one_inertia(), {"T": "N m"}
    exp = ce.Experiment.from_arrays("run", time=t, units=units, T=torque)
    speed = ce.simulate(model, exp, initial={"omega_eng": 0.0})["omega"].values
    speed = speed + 1e-3 * np.random.default_rng(0).standard_normal(count)
    data = ce.Experiment.from_arrays("run", time=t, units={**units, "omega": "rad/s"}, T=torque, omega=speed)
    fit = ce.estimate(model, data, noise=ce.Noise(omega="estimate"), progress=False)
    null = null_model(fit)
    candidates = tuple(library_candidates(null, fit.data, ce.effects.library()))
    return null, fit.data, candidates, {r.name: candidate_columns(r, candidates) for r in null.records}


def with_noise(null, noise):
    """The null model with other residuals."""
    from dataclasses import replace

    (record,) = null.records
    return replace(null, records=(replace(record, residual=dict.fromkeys(record.outputs, noise)),))


def screened(noise):
    """The screen of one drawn noise (N,)."""
    null, data, candidates, columns = linearised(len(noise))
    null = with_noise(null, noise)
    choice = choose_noise(null, candidates, columns, {"omega": (1.0, True)}, data=data)
    compressed = choice.compressed or compress(null, candidates, choice.noise, columns=columns)
    scores = score(compressed)
    law = NullDistribution(library_rows(scores))
    return Screened(null, candidates, columns, choice, compressed, scores, law, 0.01, 0.008, 0.0)


def one_screen(case, seed):
    """What the tests say of one record."""
    kind, count = case.rsplit("_", 1)
    clock = time.process_time()
    made = screened(NOISES[kind](np.random.default_rng([77, seed]), int(count)))
    best = float(made.scores.p_value[made.order[0]])
    white = [p for name, p in made.leftover.tests.items() if name.endswith("/whiteness")]
    freedom = made.scores.freedom[made.scores.testable]
    return {
        "library": made.pooled(made.order[0]) if best < 0.05 else 1.0,
        "whiteness": min(white, default=1.0),
        "families": 1.0 if made.leftover.family_p is None else made.leftover.family_p,
        "freedom": float(np.median(freedom)),
        "coloured": bool(made.noise.colour),
        "said": len(made.choice.messages) > 1,
        "cpu": time.process_time() - clock,
    }


def regression(rng, count, parameters=5):
    """(N, 5) slow regressors and a drive."""
    t = np.linspace(0, 1, count)
    jacobian = np.cos(np.pi * np.arange(parameters) * t[:, None])
    return jacobian, lfilter([1.0], [1.0, -0.8], rng.standard_normal(count))


# name -> noise, samples, share missing, parameters
RESIDUALS = {
    **{f"white_{n}": ("white", n, 0.0, 5) for n in (60, 100, 400)},
    "white_100_p20": ("white", 100, 0.0, 20),
    "white_200_missing": ("white", 200, 0.2, 5),
    **{f"{kind}_{n}": (kind, n, 0.0, 5) for kind in ("t3", "outliers", "laplace") for n in (60, 100, 400)},
    "t3_200_missing": ("t3", 200, 0.2, 5),
    "cauchy_200": ("cauchy", 200, 0.0, 5),
    "changing_400": ("changing", 400, 0.0, 5),
    "ar0.5_100": ("ar0.5", 100, 0.0, 5),
    "ar0.9_100": ("ar0.9", 100, 0.0, 5),
    "ar0.9_400": ("ar0.9", 400, 0.0, 5),
    "wander0.3_400": ("wander0.3", 400, 0.0, 5),
    "wander1_1000": ("wander1", 1000, 0.0, 5),
}
NOISES["cauchy"] = lambda rng, n: rng.standard_cauchy(n)
# the level of white noise grows fivefold during the record
NOISES["changing"] = lambda rng, n: rng.standard_normal(n) * np.linspace(1, 5, n)


def one_residual(case, seed):
    """p-values of both tests of a regression's residual, its Jacobian given; and lag one as in estimation/answer.py."""
    kind, count, missing, parameters = RESIDUALS[case]
    rng = np.random.default_rng([78, seed])
    clock = time.process_time()
    jacobian, drive = regression(rng, count, parameters)
    mask = rng.random(count) >= missing
    e = NOISES[kind](rng, count)
    e[mask] -= jacobian[mask] @ np.linalg.lstsq(jacobian[mask], e[mask], rcond=None)[0]
    if missing:
        e[~mask] = np.nan
    white, apart = whiteness(e, jacobian=jacobian), independence(e, drive, jacobian=jacobian)
    r = e[mask]
    return {
        "whiteness": 1.0 if white.p_value is None else white.p_value,
        "independence": 1.0 if apart.p_value is None else apart.p_value,
        "neighbours": float(r[1:] @ r[:-1] / (r @ r) * np.sqrt(len(r))),
        "cpu": time.process_time() - clock,
    }


PARTS = {"screens": (SCREENS, one_screen), "residuals": (tuple(RESIDUALS), one_residual)}


def cell(hits):
    """k/n, per cent and its 95 % interval (Clopper-Pearson)."""
    n, k = len(hits), int(sum(hits))
    low, high = stats.binomtest(k, n).proportion_ci(0.95)
    return f"{k}/{n} = {100 * k / n:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def table(part, folder, cases):
    """Markdown of what is done of a part."""
    kinds = ("library", "families", "whiteness") if part == "screens" else ("whiteness", "independence")
    extra = ("coloured", "said", "freedom") if part == "screens" else ("neighbours > 5",)
    out = [f"| case | {' | '.join(f'{kind}, {100 * a:g} %' for kind in kinds for a in ALPHAS)} | "
           f"{' | '.join(extra)} | CPU |"]  # fmt: skip
    out.append("|---" * (2 + len(kinds) * len(ALPHAS) + len(extra)) + "|")
    for case in cases:
        rows = [row for piece in Store(folder, f"{part}_{case}").done().values() for row in piece]
        if not rows:
            continue
        cells = [cell([row[kind] <= alpha for row in rows]) for kind in kinds for alpha in ALPHAS]
        if part == "screens":
            cells += [f"{sum(row[kind] for row in rows)}/{len(rows)}" for kind in ("coloured", "said")]
            cells.append(f"{np.median([row['freedom'] for row in rows]):.0f}")
        else:
            cells.append(f"{sum(row['neighbours'] > 5 for row in rows)}/{len(rows)}")
        cells.append(f"{1e3 * np.median([row['cpu'] for row in rows]):.0f} ms")
        out.append(f"| {case} | {' | '.join(cells)} |")
    return "\n".join(out)


def study(part, folder, cases, records, first=0, seconds=1e9):
    """Do what is not done yet."""
    begun, one = time.process_time(), PARTS[part][1]
    for case in cases:
        store = Store(folder, f"{part}_{case}")
        done = store.done()
        for start in range(first, first + records, PIECE):
            if time.process_time() - begun < seconds and str(start) not in done:
                store.add(str(start), [one(case, seed) for seed in range(start, start + PIECE)])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", required=True)
    parser.add_argument("--part", choices=PARTS, default="screens")
    parser.add_argument("--cases")
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seconds", type=float, default=1e9, help="stop after so much CPU time")
    chosen = parser.parse_args()
    cases = chosen.cases.split(",") if chosen.cases else PARTS[chosen.part][0]
    study(chosen.part, chosen.work, cases, chosen.records, chosen.first, chosen.seconds)
    print(table(chosen.part, chosen.work, cases))


if __name__ == "__main__":
    main()
