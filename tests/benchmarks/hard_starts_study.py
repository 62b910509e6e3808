"""Starts far off, and ways to arrive: `python tests/benchmarks/hard_starts_study.py [--starts 24] [--write]`.

Output-error fits of the two masses (innovations_data.py without process noise) from starts whose five parameters are
the truth times factors that are log-uniform in wider and wider ranges. A fit counts if its noise level is within 1e-4
of the best one's. CPU time covers everything, set-up and covariance too.
"""

import argparse
import datetime
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

import innovations_data as source
from innovations_study import NAMES, experiment, started, two_masses

import casadi_engine as ce

RANGES = ((0.2, 5.0), (0.05, 20.0), (0.02, 50.0))
# Strength of the process noise of a predictor that a fit begins with, in units of the known one's of the study.
STRONG = 3.0


def plain(model, data, pars, **options):
    """One fit."""
    return ce.estimate(model, data, parameters=pars, progress=False, **options)


def by_process_noise(model, data, pars):
    """A prediction-error fit whose Riccati gain belongs to strong process noise, then the simulation from its end."""
    process = {name: STRONG * level for name, level in source.PROCESS.items()}
    first = plain(model, data, pars, noise=ce.Noise(omega=source.SIGMA, process=process), max_iterations=60)
    for name in NAMES:
        pars[name].set(float(np.clip(first.values[name], pars[name].min, pars[name].max)))
    return plain(model, data, pars)


WAYS = {
    "direct (the default)": plain,
    "direct, intervals of 8 samples": lambda *given: plain(*given, interval=8),
    "direct, starts=4": lambda *given: plain(*given, starts=4),
    "predictor with strong process noise first": by_process_noise,
    'approach="prediction"': lambda *given: plain(*given, approach="prediction"),
}


def attempt(way, model, data, pars, level):
    """Whether the fit from this set arrives, and its CPU seconds."""
    clock = time.process_time()
    try:
        fit = way(model, data, pars)
        good = fit.converged and abs(fit.noise["omega"][0] / level - 1) < 1e-4
    except ce.CasadiEngineError:
        good = False
    return good, time.process_time() - clock


def study(starts, ranges=RANGES):
    """Rows (range, way, arrived, starts, median CPU, largest CPU)."""
    model, data = two_masses(), experiment(source.run(0, process=0.0))
    truth = model.parameters()
    for name in NAMES:
        truth[name].set(source.TRUTH[name])
    level = plain(model, data, truth).noise["omega"][0]
    rows = []
    for low, high in ranges:
        for words, way in WAYS.items():
            found = [
                attempt(way, model, data, started(model, np.random.default_rng(seed), low, high), level)
                for seed in range(starts)
            ]
            good, spent = zip(*found, strict=True)
            rows.append(
                (f"{low:g} .. {high:g}", words, sum(good), starts, float(np.median(spent)), max(spent))
            )
            print(rows[-1], flush=True)
    return rows


def table(rows):
    """The study as Markdown."""
    lines = [
        f"# Hard starts, {datetime.date.today():%Y-%m-%d}",
        "",
        f"By `python tests/benchmarks/hard_starts_study.py --write`: two masses, 3600 samples at {source.RATE:g} Hz,",
        "five parameters and three initial states, one thread. Compare ratios.",
        "",
        "| factors on the truth | way | arrived | median CPU of a start [s] | largest [s] |",
        "|---|---|---|---|---|",
        *(
            f"| {at} | {way} | {good}/{starts} | {cpu:.2f} | {most:.2f} |"
            for at, way, good, starts, cpu, most in rows
        ),
    ]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--write", action="store_true")
    chosen = parser.parse_args()
    text = table(study(chosen.starts))
    if chosen.write:
        Path(__file__).with_name("HARD_STARTS.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
