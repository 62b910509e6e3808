"""Experiments chosen by the tool, confirmed by fits to records of the independent simulator.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/chosen_experiments.py [--fits 300] [--crankshaft 300] [--jobs 2]

Two masses: all five parameters under 1 %. Crankshaft: C21, C76 and the sum of the absolute dampers under 5 %, with
C32.. and C65 free beside them. The chosen runs are then simulated with the truth, fitted with as many draws of
noise, and the 95 % intervals counted. Fits are kept line by line in results/chosen_experiments/ so that a study that
was stopped goes on where it was. Writes chosen_experiments.md beside this file.
"""

from __future__ import annotations

import argparse
import datetime
import json
import multiprocessing
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "data"))
from simulator import add_noise, simulate_crankshaft, simulate_two_mass

import casadi_engine as ce
from casadi_engine.identifiability import ExperimentChoice, PlannedExperiment, choose_experiments, plan
from casadi_engine.model import thesis_ties

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / "results" / "chosen_experiments"
RPM = np.pi / 30
SIGMA = 0.1
NORMAL_95 = 1.959964
SEARCHES = 5
UNITS = {"theta": "rad"} | dict.fromkeys(("p1", "p2", "p3", "p4"), "Pa") | {"T_load": "N m", "omega": "rad/s"}
TWO_MASS = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
CRANKSHAFT = {
    "J1": 1 / 33.39, "J2": 1 / 22.3, "J6": 1 / 5.968, "K21": 241.8e3, "K32": 1270e3, "K65": 1427e3,
    "C21": 15.0, "C32": 2.5, "C65": 2.5, "C76": 2.5, "C_eng": 0.1541,
}  # fmt: skip
# The run-up of the simulated crankshaft: part of the load is let go, and the speed rises by itself.
LET_GO, RUN_UP_SECONDS, RUN_UP_CYCLES = 33.0, 5.0, 120


# ---- what is chosen -----------------------------------------------------------------------------------


def choose_two_mass() -> ExperimentChoice:
    """From speeds, loads, misfires, a load step and a run-up, planned from the normal record at 1200 RPM."""
    model = ce.two_mass(reciprocating_speed="measured", outputs=("omega", "omega_load"))
    record = ce.read_experiment(ROOT / "data" / "normal_1200rpm.csv.gz")
    make = partial(plan, model, record)
    wheel = ("omega",)
    candidates = {f"normal {n} RPM": make(speed=n * RPM, outputs=wheel) for n in (1000, 1200, 1400, 1800)}
    candidates |= {
        f"misfire {n} RPM": make(speed=n * RPM, misfire={2: "all"}, outputs=wheel)
        for n in (1000, 1200, 1400, 1800)
    }
    candidates |= {
        "load 90 N m": make(load=90.0, outputs=wheel),
        "load step of 30 N m": make(load_step=(0.3, 30.0), outputs=wheel),
        "one cycle misfires": make(misfire={2: [4]}, outputs=wheel),
        "run-up 1000-2000 RPM in 1 s": make(run_up=(1000 * RPM, 2000 * RPM), duration=1.0, outputs=wheel),
        "normal 1200 RPM, load speed too": make(),
    }
    return choose_experiments(
        model,
        candidates,
        noise=ce.Noise(omega=SIGMA, omega_load=SIGMA),
        criterion=dict.fromkeys(TWO_MASS, 0.01),
    )


def crankshaft_parameters(model: ce.Model, *, belief: bool = False) -> ce.Parameters:
    """The thesis's ties; the six of Table 4.12 and the tied dampers free, the dynamometer known.

    belief : hold C32 and C65 within 50 % of their table value by a prior, for no record of seconds tells them
    """
    parameters = thesis_ties(model.parameters())
    for name in ("C21", "C32", "C65", "C76", "C_eng"):
        parameters[name].set(vary=True)
    for name in ("C32", "C65") if belief else ():
        parameters[name].set(prior=(2.5, 1.25))
    return parameters


def crankshaft_plans(model: ce.Model) -> dict[str, PlannedExperiment]:
    record = ce.read_experiment(ROOT / "data" / "crankshaft" / "normal_1200rpm.csv.gz")
    make = partial(plan, model, record, parameters=crankshaft_parameters(model))
    wheel = ("omega",)
    found = {f"normal {n} RPM": make(speed=n * RPM, outputs=wheel) for n in (1000, 1200, 1400, 1800)}
    found |= {
        f"misfire {n} RPM": make(speed=n * RPM, misfire={2: "all"}, outputs=wheel)
        for n in (1000, 1200, 1400, 1800)
    }
    found |= {
        "load step of 30 N m": make(load_step=(0.3, 30.0), outputs=wheel),
        "run-up 1000-2600 RPM in 5 s": make(run_up=(1000 * RPM, 2600 * RPM), duration=5.0, outputs=wheel),
        "run-up 800-3000 RPM in 20 s": make(run_up=(800 * RPM, 3000 * RPM), duration=20.0, outputs=wheel),
        "misfire 1200 RPM, load speed too": make(misfire={2: "all"}),
    }
    return found


def choose_crankshaft() -> ExperimentChoice:
    model = ce.crankshaft(reciprocating_speed="measured", outputs=("omega", "omega_load"))
    return choose_experiments(
        model,
        crankshaft_plans(model),
        parameters=crankshaft_parameters(model),
        noise=ce.Noise(omega=SIGMA, omega_load=SIGMA),
        criterion={"C21": 0.02, "C76": 0.01, "C_eng": 0.01},
    )


# ---- the confirmation ---------------------------------------------------------------------------------


@cache
def misfire_record() -> dict[str, np.ndarray]:
    return simulate_two_mass(1200.0, misfire={2: "all"}, scatter_seed=102, sigma=0.0)


def _let_go(time: float) -> float:
    return 57.0 if time <= 0.0 else 57.0 - LET_GO * min(time / 0.2, 1.0)


@cache
def run_up_record() -> dict[str, np.ndarray]:
    """A run-up of the simulated crankshaft from 1000 RPM; kept, for it takes a while."""
    path = KEPT / "run_up.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        made = simulate_crankshaft(
            1000.0,
            load=_let_go,
            duration=RUN_UP_SECONDS,
            cycles=RUN_UP_CYCLES,
            scatter_seed=121,
            sigma=0.0,
            rtol=1e-9,
        )
        keep = {
            name: made[name] for name in (*UNITS, "time", "omega_true", "omega_load_true") if name != "omega"
        }
        np.savez(path, **keep)
    with np.load(path) as stored:
        return dict(stored)


def fitted(kind: str, seed: int) -> dict[str, Any]:
    """One fit from starts 20 % off: estimates and standard errors.

    Where the cost is far from what the noise allows, the search ended beside the optimum and is begun again from
    other starts: what anyone would do who looks at the residual.
    """
    begun = time.process_time()
    truth = TWO_MASS if kind == "two_mass" else CRANKSHAFT
    clean = misfire_record() if kind == "two_mass" else run_up_record()
    record = add_noise(clean, sigma=SIGMA, seed=10_000 + seed)
    data = ce.Experiment.from_arrays(
        "run", time=record["time"], units=UNITS, **{name: record[name] for name in UNITS}
    )
    build = ce.two_mass if kind == "two_mass" else ce.crankshaft
    model = build(reciprocating_speed="measured")
    parameters = model.parameters() if kind == "two_mass" else crankshaft_parameters(model, belief=True)
    draw = np.random.default_rng(seed)
    plausible, searches = False, 0
    while not plausible and searches < SEARCHES:
        searches += 1
        for (name, value), sign in zip(truth.items(), draw.choice([-1, 1], len(truth)), strict=True):
            parameters[name].set(value * (1 + 0.2 * sign))
        fit = ce.estimate(model, data, parameters=parameters, noise=ce.Noise(omega=SIGMA), progress=False)
        plausible = fit.converged and fit.cost < fit.n + 5 * np.sqrt(2 * fit.n)
    return {
        "seed": seed,
        "searches": searches,
        "status": fit.status,
        "values": {name: fit.values[name] for name in truth},
        "errors": {name: fit.stderr[name] for name in truth},
        "seconds": time.process_time() - begun,
    }


def study(kind: str, count: int, jobs: int) -> list[dict[str, Any]]:
    """`count` fits, those kept from before included; with no jobs those kept alone."""
    KEPT.mkdir(parents=True, exist_ok=True)
    path = KEPT / f"{kind}.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    kept = list({one["seed"]: one for one in map(json.loads, lines)}.values())
    done = {one["seed"] for one in kept}
    missing = [seed for seed in range(count) if seed not in done] if jobs else []
    work: Callable[[int], dict[str, Any]] = partial(fitted, kind)
    if missing:
        _ = misfire_record() if kind == "two_mass" else run_up_record()  # once, before the processes part
        with multiprocessing.get_context("fork").Pool(jobs) as pool, path.open("a") as file:
            for one in pool.imap_unordered(work, missing):
                file.write(json.dumps(one) + "\n")
                file.flush()
                kept.append(one)
    return sorted((one for one in kept if one["seed"] < count), key=lambda one: one["seed"])


@dataclass(frozen=True)
class Coverage:
    """Of one parameter: shares of 95 % intervals that hold the truth, by the fit's own error and by the planned one.

    scatter : standard deviation of the estimates; bias : mean error, both in planned errors; without : fits in which
    it has no symmetric error, most at a bound
    """

    name: str
    by_fit: float
    by_plan: float
    scatter: float
    bias: float
    without: int


def coverage(
    fits: list[dict[str, Any]], truth: dict[str, float], planned: dict[str, float | None]
) -> list[Coverage]:
    found = []
    for name, value in truth.items():
        pairs = [
            (one["values"][name], one["errors"][name]) for one in fits if one["errors"][name] is not None
        ]
        own = np.array([(estimate - value) / error for estimate, error in pairs])
        whole = np.array([one["values"][name] - value for one in fits]) / (value * (planned[name] or np.nan))
        found.append(
            Coverage(
                name,
                float(np.mean(np.abs(own) <= NORMAL_95)) if len(own) else float("nan"),
                float(np.mean(np.abs(whole) <= NORMAL_95)),
                float(whole.std(ddof=1)),
                float(whole.mean()),
                len(fits) - len(pairs),
            )
        )
    return found


def coverage_rows(
    fits: list[dict[str, Any]], truth: dict[str, float], planned: dict[str, float | None]
) -> list[str]:
    rows = coverage(fits, truth, planned)
    lines = [
        "| parameter | planned error % | claimed by the fit % (median) | scatter found % | bias in planned errors "
        "| 95 % by the plan | 95 % by the fit |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        values = np.array([one["values"][row.name] for one in fits])
        errors = [one["errors"][row.name] for one in fits if one["errors"][row.name] is not None]
        cells = [
            row.name,
            f"{100 * (planned[row.name] or np.nan):.2g}",
            f"{100 * np.median(errors) / truth[row.name]:.2g}" if errors else "-",
            f"{100 * values.std(ddof=1) / truth[row.name]:.2g}",
            f"{row.bias:+.2f}",
            f"{100 * row.by_plan:.1f}",
            f"{100 * row.by_fit:.1f}" + (f" ({row.without} at a bound)" if row.without else ""),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    plan_, fit = (np.nanmean([getattr(row, key) for row in rows]) for key in ("by_plan", "by_fit"))
    words = f"All intervals together: {100 * plan_:.1f} % by the planned errors, {100 * fit:.1f} % by the fits' own."
    return [*lines, "", words]


def planned_run_up() -> dict[str, float | None]:
    """Expected errors of the run-up that was simulated, from its own channels at the true values."""
    model = ce.crankshaft(reciprocating_speed="measured")
    record = add_noise(run_up_record(), sigma=SIGMA, seed=0)
    data = ce.Experiment.from_arrays(
        "run", time=record["time"], units=UNITS, **{name: record[name] for name in UNITS}
    )
    from casadi_engine.identifiability import fisher

    return fisher(
        model, data, parameters=crankshaft_parameters(model, belief=True), noise=ce.Noise(omega=SIGMA)
    ).relative


REMARKS = (
    "C21 and C76 are covered as planned. C_eng is not: it is told to 0.012 %, not to the 0.0017 % of the plan. That "
    "is a bias of the linear form, which puts all cylinders at the wheel's angle, while the shaft between is "
    "twisted, and so misses 0.003 N m of 29 (one fit with each cylinder's own angle took 50 s and gave C_eng at "
    "1.05 of its error, 0.0018 %). J1, J2, J6 and K32 are covered too rarely: they scatter by 10 to 20 % more than "
    "planned, and by 20 to 40 % more than the fits claim. The likely cause, not proven: the start's 13 states are "
    "fitted to noise, and fast modes, hardly damped, ring on and seem to tell more than the motion that repeats, "
    "which the plan is made of. What flatters the table: the prior of C32 and C65 is centred on their true values. "
    "It was added after a first round without it, 192 fits, in which C21 was covered in 90.1 % by the plan and 83.9 "
    "% by the fits, C76 in 89.6 % and 90.6 %, all together in 82.9 % and 74.7 %; C32 and C65 ended at a bound in 52 "
    "and 83 of them, and three searches in a false optimum. The run confirmed is a shorter one than the set chosen "
    "(5 s against 20 s)."
)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fits", type=int, default=300, help="fits of the two masses")
    parser.add_argument("--crankshaft", type=int, default=300, help="fits of the crankshaft")
    parser.add_argument("--jobs", type=int, default=2, help="processes; 0: the table of the fits kept so far")
    options = parser.parse_args(arguments)
    two, crank = choose_two_mass(), choose_crankshaft()
    lines = [
        f"# Chosen experiments and their confirmation ({datetime.datetime.now(tz=datetime.UTC).date()})",
        "",
    ]
    lines += ["Made by `chosen_experiments.py`; noise 0.1 rad/s on each speed, 14 402 samples a second.", ""]
    lines += ["## Two masses, all five under 1 %", "", "```", str(two), "```", ""]
    if options.fits:
        fits = study("two_mass", options.fits, options.jobs)
        lines += [f"{len(fits)} fits to records of the simulator (misfire at 1200 RPM, starts 20 % off):", ""]
        lines += coverage_rows(fits, TWO_MASS, two.relative)
        lines += [_work(fits), ""]
    lines += [
        "## Crankshaft: C21 under 2 %, C76 and the sum of the absolute dampers under 1 %",
        "",
        "```",
        str(crank),
        "```",
        "",
    ]
    lines += [_lengths(crank), ""]
    if options.crankshaft:
        fits = study("crankshaft", options.crankshaft, options.jobs)
        lines += [
            f"{len(fits)} fits to a {RUN_UP_SECONDS:g} s run-up of the simulator (load let go at 1000 RPM, starts "
            "20 % off, C32 and C65 with a prior of 50 %):",
            "",
        ]
        lines += coverage_rows(fits, CRANKSHAFT, planned_run_up())
        lines += [_work(fits), "", REMARKS, ""]
    text = "\n".join(lines)
    Path(__file__).with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    return 0


def _work(fits: list[dict[str, Any]]) -> str:
    good = sum(one["status"] == "converged" for one in fits)
    seconds = np.median([one["seconds"] for one in fits])
    again = sum(one["searches"] > 1 for one in fits)
    return f"{good} of {len(fits)} converged, {again} after further starts; {seconds:.2f} s of processor time a fit."


def _lengths(choice: ExperimentChoice) -> str:
    words = []
    for name in ("C32", "C65"):
        seconds = choice.length_for(name, 0.05)
        words.append(
            f"{name} to 5 % would take {seconds:.3g} s of it" if seconds else f"{name} cannot be had"
        )
    return f"Of data like the chosen set's ({choice.information.duration:.3g} s): {'; '.join(words)}."


if __name__ == "__main__":
    sys.exit(main())
