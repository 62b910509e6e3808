"""Is a fit right when it doubts its standard errors, and right when it does not?

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/doubt_study.py [NAME ...] [--fits N] [--folder PLACE] [--write]

NAME : A (two masses), B (crankshaft, one record), pendulum (swung to 2.5 rad, its angle measured), each at several
noise levels. The errors of the quadratic are counted in fits that print them and in those that do not, and what these
print in their place; a doubt is right where the quadratic would have covered less (or more) than it claims. Finished
fits are kept in `doubt-*.jsonl`; ``--write`` puts the dated table into CALIBRATION.md.
"""

from __future__ import annotations

import argparse
import datetime
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import calibration_cases  # noqa: E402

import casadi_engine as ce  # noqa: E402
from casadi_engine.estimation import doubted  # noqa: E402
from casadi_engine.estimation.study import study  # noqa: E402

Rows = list[dict[str, Any]]
# name -> variant of the calibration study (none for the pendulum), noise levels in the output's unit, fits of each
PROBLEMS: dict[str, tuple[str, tuple[float, ...], int]] = {
    "A": ("known", (0.1, 1.0, 3.0, 8.0), 100),
    "B": ("crankshaft_plain", (0.003, 0.01, 0.03, 0.1), 60),
    "pendulum": ("", (0.01, 0.1, 0.3, 1.0), 100),
}
TRUTH = {"g_l": 9.81, "c": 0.1}
LEVEL = 1.959964


@cache
def swing() -> tuple[np.ndarray, np.ndarray]:
    """Times (400,) s and angles (400,) rad of the pendulum, by an independent integrator."""
    from scipy.integrate import solve_ivp

    at = 0.02 * np.arange(400)
    found = solve_ivp(
        lambda _, q: [q[1], -TRUTH["g_l"] * np.sin(q[0]) - TRUTH["c"] * q[1]], (0, 8), [2.5, 0.0], t_eval=at,
        rtol=1e-10, atol=1e-10,
    )  # fmt: skip
    return at, found.y[0]


@cache
def pendulum() -> ce.Model:
    """Its angle is measured; gravity over length and the damper are unknown."""
    b = ce.Blueprint("pendulum")
    g_l, c = b.parameter("g_l", 9.0, min=1, max=100), b.parameter("c", 0.12, min=1e-3, max=10)
    x, w = b.state("x"), b.state("w")
    b.ode("x", w)
    b.ode("w", -g_l * ca.sin(x) - c * w)
    b.output("angle", x)
    return b.model()


def fit_of(name: str, sigma: float, seed: int) -> tuple[ce.Fit, dict[str, float]]:
    """A fit, and the truth by the names of its free parameters."""
    variant = PROBLEMS[name][0]
    if not variant:
        at, angle = swing()
        noisy = angle + sigma * np.random.default_rng([18, seed]).standard_normal(len(at))
        data = ce.Experiment.from_arrays("swing", time=at, units={"angle": "rad"}, angle=noisy)
        return ce.estimate(pendulum(), data, noise=ce.Noise(angle=sigma), progress=False), TRUTH
    kept = calibration_cases.VARIANTS[variant]
    calibration_cases.VARIANTS[variant] = replace(kept, sigma=sigma)
    try:
        case = calibration_cases.case_of(variant, 10_000 + seed)
    finally:
        calibration_cases.VARIANTS[variant] = kept
    case = replace(case, records=case.records[2:3]) if name == "B" else case
    fit = calibration_cases.fit_of(case, seed)
    names = calibration_cases.TWO_MASS_NAMES if name == "A" else {key: key for key in case.free}
    truth = dict(zip(case.shape.names, case.truth.tolist(), strict=True))
    return fit, {names[key]: truth[key] for key in case.free}


def row(piece: dict[str, Any]) -> dict[str, Any]:
    """One fit as plain numbers: z of the quadratic, and for each parameter what was printed."""
    spent, asked = [0.0], doubted.doubts_of

    def timed(*arguments: Any, **options: Any) -> Any:
        begun = time.process_time()
        found = asked(*arguments, **options)
        spent[0] += time.process_time() - begun
        return found

    doubted.doubts_of = timed
    begun = time.process_time()
    try:
        fit, truth = fit_of(piece["problem"], piece["sigma"], piece["seed"])
    finally:
        doubted.doubts_of = asked
    whole, answer = time.process_time() - begun, {}
    for name, right in truth.items():
        one = fit.estimates[name]
        error = one.quadratic or one.stderr
        answer[name] = {
            "z": None if not error else (one.value - right) / error,
            "doubted": one.quadratic is not None,
            "held": None if one.interval is None else one.interval[0] <= right <= one.interval[1],
        }
    return {"status": fit.status, "check": spent[0], "seconds": whole, "of": answer}


def table(found: dict[tuple[str, float], Rows]) -> str:
    """The study as Markdown."""
    lines = [
        "| problem | noise | fits | ± printed | 95 % of it holds | ± doubted | 95 % of it would hold | interval in its "
        "place | holds | check, share of the fit |",
        "|---" * 10 + "|",
    ]
    for (name, sigma), rows in found.items():
        fits = [row["of"].values() for row in rows if row["status"] == "converged"]
        good = [[one for one in fit if one["z"] is not None] for fit in fits]
        sure, other = (
            [[one for one in fit if one["doubted"] == word] for fit in good] for word in (False, True)
        )
        ends = [[one["held"] for one in fit if one["held"] is not None] for fit in other]
        whole = max(sum(map(len, good)), 1)
        share = np.median([row["check"] / (row["seconds"] - row["check"]) for row in rows])
        cells = [name, f"{sigma:g}", len(rows), *_cells(sure, whole), *_cells(other, whole),
                 f"{100 * sum(map(len, ends)) / whole:.0f} %", _share(ends), f"{100 * share:.0f} %"]  # fmt: skip
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def _cells(part: list[Rows], whole: int) -> tuple[str, str]:
    held = [[abs(one["z"]) <= LEVEL for one in fit] for fit in part]
    return f"{100 * sum(map(len, part)) / whole:.0f} %", _share(held)


def _share(held: list[list[bool]]) -> str:
    """Share of intervals that hold the truth, given fit by fit, and what it scatters by where 95 % are expected.

    The parameters of a fit go together: its intervals are worth as many independent ones as their sums scatter like.
    """
    each = np.array([one for fit in held for one in fit], dtype=float)
    if not len(each):
        return "-"
    p = each.mean()
    sums = np.array([sum(fit) - p * len(fit) for fit in held])
    alone = np.square(each - p).sum()
    together = np.square(sums).sum() / alone if alone else np.mean([len(fit) for fit in held if fit])
    return f"{p:.3f} ± {np.sqrt(0.0475 * together / len(each)):.3f}"


def write(text: str) -> None:
    """CALIBRATION.md: the table between its marks, what is said of it stays."""
    path, begin, end = (
        HERE / "CALIBRATION.md",
        "<!-- begin of what doubt_study.py writes -->",
        "<!-- end of that -->",
    )
    old = path.read_text("utf-8") if path.exists() else ""
    if begin not in old:
        old += f"\n## Is the doubt right?\n\n{begin}\n{end}\n"
    before, after = old.split(begin)[0], old.split(end)[1]
    dated = f"{datetime.date.today():%Y-%m-%d}, `python tests/benchmarks/doubt_study.py --write`."
    path.write_text(f"{before}{begin}\n\n{dated}\n\n{text}\n\n{end}{after}", "utf-8")


def main() -> None:
    """Run what is not done, print the table, write it if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", default=[])
    parser.add_argument("--fits", type=int)
    parser.add_argument("--folder", type=Path, default=HERE)
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    found: dict[tuple[str, float], Rows] = {}
    for name in asked.names or PROBLEMS:
        _, levels, count = PROBLEMS[name]
        for sigma in levels:
            pieces = [{"problem": name, "sigma": sigma, "seed": seed} for seed in range(asked.fits or count)]
            path = asked.folder / f"doubt-{name}-{sigma:g}.jsonl"
            found[name, sigma] = study(row, pieces, name=f"{name} {sigma:g}", setting=1, checkpoint=path)
    text = table(found)
    print(text)
    if asked.write:
        write(text)


if __name__ == "__main__":
    main()
