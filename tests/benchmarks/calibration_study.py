"""Are the claimed errors the real ones? Thousands of fits of simulated records with drawn noise.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/calibration_study.py [NAME ...] [--fits N] [--jobs N] [--write]

NAME : known, estimated, tied, prior, bound, missing, crankshaft, crankshaft_quiet, crankshaft_still, quiet, loud,
louder, crankshaft_plain, described in `calibration_cases.py`; all of them if none is given, 2000 fits of each with two
masses and 500 of each with the crankshaft unless --fits says otherwise. Every finished fit goes into a checkpoint
beside this file (`calibration-*.jsonl`, --folder for another place): a study that was stopped, or killed, goes on with
the same command.
`--write` puts the dated table into CALIBRATION.md from what the checkpoints hold, `--kept` runs nothing first. `--jobs`
takes processes; under `joblib.parallel_config(backend="dask")` `run(..., jobs=None)` works on a cluster.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from calibration_cases import MISSING, PRIOR_SHARES, VARIANTS, bound_of, case_of, row  # noqa: E402

from casadi_engine.estimation.study import study  # noqa: E402

SETTING = {"version": 2, "missing": MISSING, "prior": PRIOR_SHARES}
Rows = list[dict[str, Any]]
# Estimates further off than this many bounds are counted, for they alone can make a mean square.
FAR = 5.0


def run(name: str, count: int, *, folder: Path, jobs: int | None = 1, loud: bool = True) -> Rows:
    """The rows of a variant's first ``count`` seeds; what the checkpoint holds is not done again."""

    def watch(done: int, total: int) -> None:
        if loud and sys.stderr.isatty():
            print(f"\r{name} {done}/{total}", end="", file=sys.stderr, flush=True)

    pieces = [{"variant": name, "seed": seed} for seed in range(count)]
    path = folder / f"calibration-{name}.jsonl"
    return study(row, pieces, name=name, setting=SETTING, jobs=jobs, checkpoint=path, watch=watch)


def kept(name: str, folder: Path) -> Rows:
    """The rows that a checkpoint holds, without doing any."""
    path = folder / f"calibration-{name}.jsonl"
    if not path.exists():
        return []
    lines = [
        json.loads(line)
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True)
        if line.endswith("\n")
    ]
    return [line["row"] for line in sorted(lines[1:], key=lambda line: line["piece"]["seed"])]


# ---- the table


def within(value: float, limits: tuple[float, float]) -> str:
    """The number, marked where it is outside its limits."""
    low, high = limits
    return f"{value:.3f}" if low <= value <= high else f"**{value:.3f}**"


def covered(rows: Rows, key: str, *, one_sided: bool) -> tuple[float, int]:
    """Share of 95 % intervals that hold the truth, and how many fits claim one.

    With the truth on its lower bound the interval is one-sided: an estimate on the bound holds it, another one if it is
    within 1.645 standard errors.
    """
    limit = 1.6449 if one_sided else 1.95996
    held = []
    for one in rows:
        error, stderr = one["error"][key], one["stderr"][key]
        if one_sided and key in one["at_bound"]:
            held.append(True)
        elif stderr is not None:
            held.append(error <= limit * stderr if one_sided else abs(error) <= limit * stderr)
    return (float(np.mean(held)) if held else float("nan")), len(held)


def lines_of(name: str, rows: Rows) -> list[str]:
    """The lines of a variant: one for each parameter."""
    variant, bound = VARIANTS[name], bound_of(name)
    good = [one for one in rows if one["status"] == "converged"]
    lines = []
    for key in variant.reported:
        one_sided = key == variant.one_sided
        share, count = covered(good, key, one_sided=one_sided)
        error = np.array([one["error"][key] for one in good]) / bound[key]
        rmse = float(np.sqrt(np.mean(error**2)))
        lines.append(
            f"| {variant.words} | {key}{' (one-sided)' if one_sided else ''} | {len(good)}/{len(rows)} "
            f"| {100 * bound[key] / _size(name, key):.3g} % "
            f"| {within(share, variant.coverage)} "
            f"± {np.sqrt(0.0475 / max(count, 1)):.3f} "
            f"| {within(rmse, variant.ratio) if not one_sided else f'{rmse:.3f}'} "
            f"| {error.mean():+.3f} | {int((np.abs(error) > FAR).sum())} |"
        )
    return lines


def _size(name: str, key: str) -> float:
    from cases import CRANKSHAFT_TRUTH, TWO_MASS_TRUTH

    shape = case_of(name, 0).shape
    return float((TWO_MASS_TRUTH if shape.size == 2 else CRANKSHAFT_TRUTH)[shape.names.index(key)])


def printed_of(name: str, rows: Rows) -> list[str]:
    """What the fits of a variant print by default, for each parameter: how often ±, an interval or nothing, and how
    often what is printed holds the truth."""
    variant, lines = VARIANTS[name], []
    good = [one for one in rows if one["status"] == "converged"]
    for key in variant.reported:
        plain = [one for one in good if one["printed"][key] == "stderr"]
        ends = [one for one in good if isinstance(one["printed"][key], list)]
        held = [abs(one["error"][key]) <= 1.95996 * one["stderr"][key] for one in plain]
        held += [one["printed"][key][0] <= -one["error"][key] <= one["printed"][key][1] for one in ends]
        at_bound = sum(key in one["at_bound"] for one in good)
        lines.append(
            f"| {variant.words} | {key} | {len(good)} | {_share(len(plain), good)} | {_share(len(ends), good)} "
            f"| {_share(at_bound, good)} | {_share(len(good) - len(plain) - len(ends) - at_bound, good)} "
            f"| {_hold(held)} |"
        )
    return lines


def _share(count: int, rows: Rows) -> str:
    return f"{100 * count / max(len(rows), 1):.3g} %"


def _hold(held: list[bool]) -> str:
    """The share that hold the truth, marked where chance does not bring it there from between 93 and 97 %."""
    if not held:
        return "-"
    share, few = float(np.mean(held)), 2 * np.sqrt(0.0475 / len(held))
    return f"{within(share, (0.93 - few, 0.97 + few))} ± {few / 2:.3f}"


def joint_of(name: str, rows: Rows) -> str:
    """What all parameters of a variant say together."""
    good = [one for one in rows if one["status"] == "converged"]
    words = [f"median CPU {np.median([one['seconds'] for one in rows]):.2f} s a fit"]
    if good and "region" in good[0]:
        region, freedom = np.array([one["region"] for one in good]), _freedom(name)
        share = float(np.mean(region <= stats.chi2.ppf(0.95, freedom)))
        words.append(
            f"the 95 % likelihood region (chi-squared, {freedom} degrees of freedom) holds the truth in {share:.3f}, "
            f"mean {region.mean():.2f}"
        )
    if good and "behind" in good[0]:
        behind = np.array([one["behind"] for one in good])
        words.append(
            f"a search from the truth ends lower by more than 0.01 in {int((behind > 0.01).sum())}, higher in "
            f"{int((behind < -0.01).sum())}, median {np.median(behind):.2g}; "
            f"{sum(one['optima'] > 1 for one in good)} fits name several optima"
        )
    at_bound = sum(bool(one["at_bound"]) for one in good)
    if VARIANTS[name].one_sided:
        words.append(f"{at_bound} of {len(good)} estimates on the bound (half expected)")
    return f"- {VARIANTS[name].words}: {'; '.join(words)}."


def _freedom(name: str) -> int:
    return len(VARIANTS[name].reported) - (name == "tied")


def table(found: dict[str, Rows]) -> str:
    """The study as Markdown."""
    head = (
        "| variant | parameter | converged | Cramér-Rao bound | coverage of 95 % | RMSE / bound | mean error / bound "
        f"| beyond {FAR:g} bounds |\n|---|---|---|---|---|---|---|---|"
    )
    lines = [line for name, rows in found.items() for line in lines_of(name, rows)]
    default = (
        "What a fit prints by default: ± one standard error, an interval by profile, or no error and what to call.\n\n"
        "| variant | parameter | fits | ± | interval | at a bound | no error | what is printed holds the truth |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    printed = [line for name, rows in found.items() for line in printed_of(name, rows)]
    said = [joint_of(name, rows) for name, rows in found.items()]
    return "\n".join([head, *lines, "", default, *printed, "", *said])


def main() -> None:
    """Run what is not done, print the table, write it if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*VARIANTS, []], metavar="NAME", default=[])
    parser.add_argument("--fits", type=int, help="fits of each variant")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=HERE)
    parser.add_argument(
        "--kept", action="store_true", help="run nothing: the table of what the checkpoints hold"
    )
    parser.add_argument("--write", action="store_true", help="write CALIBRATION.md from all checkpoints")
    chosen = parser.parse_args()
    if not chosen.kept:
        for name in chosen.names or VARIANTS:
            run(name, chosen.fits or VARIANTS[name].count, folder=chosen.folder, jobs=chosen.jobs)
    names = VARIANTS if chosen.write or not chosen.names else chosen.names
    found = {name: rows for name in names if (rows := kept(name, chosen.folder))}
    text = table(found)
    print(text)
    if chosen.write:
        write(text)


def write(text: str) -> None:
    """CALIBRATION.md: the table between its marks, what is said of it stays."""
    path = HERE / "CALIBRATION.md"
    begin, end = "<!-- begin of what calibration_study.py writes -->", "<!-- end -->"
    old = path.read_text(encoding="utf-8") if path.exists() else f"# Calibration\n\n{begin}\n{end}\n"
    before, after = old.split(begin)[0], old.split(end)[1]
    dated = f"{datetime.date.today():%Y-%m-%d}, `python tests/benchmarks/calibration_study.py --write`."
    path.write_text(f"{before}{begin}\n\n{dated}\n\n{text}\n\n{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
