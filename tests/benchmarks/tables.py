"""What was measured, as JSON beside this file, and the tables of RESULTS.md made of it."""

from __future__ import annotations

import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
from cases import LIMIT_CRANKSHAFT, LIMIT_TWO_MASS
from solvers import SOLVERS

HERE = Path(__file__).resolve().parent
STORE, RESULTS, FIGURE = HERE / "measured.json", HERE / "RESULTS.md", HERE / "scaling.png"
BEGIN, END = "<!-- begin of what run.py writes -->", "<!-- end of what run.py writes -->"
MACHINE = "two x86 cores, one thread"

ABOUT = {
    "A": "Two masses, five parameters and three initial states, 14 400 samples, starts ±40 %.",
    "B": "Seven inertias, linear form like against like, six tied parameters and 13 initial states, one normal "
    "record of 14 400 samples, starts ±20 %.",
    "B6": "The same six parameters from normal and misfire records at 1000, 1200 and 1400 RPM jointly (88 064 samples, "
    "78 initial states), starts ±20 %.",
    "B21": "Those six records and all parameters but J7 and K76, C2 = … = C5 (18 values), prior N(2.5, 1.25) on "
    "C32, C43, C54, C65; starts ±20 %.",
}


def read_store() -> dict[str, Any]:
    """Measurements so far."""
    empty: dict[str, Any] = {"problems": {}, "scaling": {}, "precision": {}}
    return empty | (json.loads(STORE.read_text(encoding="utf-8")) if STORE.exists() else {})


def write_store(store: dict[str, Any]) -> None:
    """Keep the measurements; a run of some problems leaves those of the others."""
    STORE.write_text(json.dumps(store, indent=None, separators=(",", ":")) + "\n", encoding="utf-8")


def best_of(case: str, store: dict[str, Any]) -> float:
    """Least chi-squared per sample that anybody found."""
    everybody = store["problems"].get(case, {}).values()
    return min((row["chi2"] for one in everybody for row in one["rows"] if "chi2" in row), default=np.inf)


def counted(case: str, rows: list[dict[str, Any]], store: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that ended close enough to the best."""
    limit = LIMIT_TWO_MASS if case == "A" else LIMIT_CRANKSHAFT
    best = best_of(case, store)
    return [row for row in rows if "chi2" in row and row["chi2"] <= best + limit]


def seconds(value: float) -> str:
    """Three figures of a time."""
    return f"{1e3 * value:.3g} ms" if value < 0.1 else f"{value:.3g} s"


def total(row: dict[str, Any]) -> float:
    return float(row.get("setup", 0.0) + row.get("solve", 0.0))


def cells(case: str, one: dict[str, Any], store: dict[str, Any]) -> list[str]:
    """Cells of one solver's line."""
    rows = one["rows"]
    good = counted(case, rows, store)
    timed = [row for row in rows if "solve" in row and "chi2" in row]
    finite = [row["chi2"] for row in rows if "chi2" in row]
    words = f"{len(good)}/{len(rows)}"
    if any(
        "NonIpopt" in row.get("words", "") or total(row) > 0.99 * one.get("limit", np.inf) for row in rows
    ):
        words += ", out of time"
    if not timed:
        reason = rows[-1].get("words", "") if rows else "did not run"
        return [words, f"not converged ({reason})", "", "", "", "", ""]
    times = [total(row) for row in timed]
    counts = [row["iterations"] for row in timed if row.get("iterations") is not None]
    return [
        words,
        f"{min(finite):.6f}" + (f" … {max(finite):.6f}" if max(finite) - min(finite) > 5e-7 else ""),
        seconds(float(np.median([row["setup"] for row in timed]))),
        seconds(float(np.median([row["solve"] for row in timed]))),
        f"**{seconds(float(np.median(times)))}**",
        seconds(max(times)),
        f"{np.median(counts):.0f}" if counts else "",
    ]


def one_line(case: str, rows: list[dict[str, Any]], store: dict[str, Any]) -> str:
    """For the terminal."""
    return " | ".join(cells(case, {"rows": rows}, store))


def optima(case: str, store: dict[str, Any]) -> str:
    """The distinct optima that runs ended in, by rising chi-squared, with how many runs of whom."""
    groups: list[tuple[float, dict[str, int]]] = []
    found = [
        (row["chi2"], name)
        for name, one in store["problems"][case].items()
        for row in one["rows"]
        if "chi2" in row
    ]
    for value, name in sorted(found):
        if not groups or value - groups[-1][0] > 3e-6:
            groups.append((value, {}))
        groups[-1][1][name] = groups[-1][1].get(name, 0) + 1
    if len(groups) < 2:
        return ""
    parts = [
        f"{value:.6f} ({', '.join(f'{name} {n}' for name, n in who.items())})" for value, who in groups[:8]
    ]
    more = f", {len(groups) - 8} more up to {groups[-1][0]:.4g}" if len(groups) > 8 else ""
    return f"Where the runs ended, χ²/N: {'; '.join(parts)}{more}."


def problem_table(case: str, store: dict[str, Any]) -> list[str]:
    """Section of one problem."""
    limit = LIMIT_TWO_MASS if case == "A" else LIMIT_CRANKSHAFT
    head = ["who", "counts", "χ²/N", "set-up", "solve", "in all", "slowest", "iterations", "date"]
    lines = [f"### {case}", "", ABOUT[case] + f" A run counts within {limit:g} of the best χ²/N.", ""]
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, solver in SOLVERS.items():
        one = store["problems"][case].get(name)
        if one:
            lines.append("| " + " | ".join([solver.title, *cells(case, one, store), one["date"]]) + " |")
    if text := optima(case, store):
        lines += ["", text]
    if text := agreement_line(case, store):
        lines += ["", text]
    return [*lines, ""]


def agreement_line(case: str, store: dict[str, Any]) -> str:
    """How far the runs that count lie apart in the combinations that the data determine to 20 %."""
    if case not in ("B6", "B21") or "ours" not in store["problems"].get(case, {}):
        return ""
    import opponent_spectral
    from cases import CASES

    rows = counted(case, store["problems"][case]["ours"]["rows"], store)
    if len(rows) < 2:
        return ""
    problem = CASES[case]()
    points = np.log([row["values"] for row in rows])
    best = np.exp(points[np.argmin([row["chi2"] for row in rows])])
    spread = opponent_spectral.covariance(problem, best) / np.outer(best, best)
    size, turn = np.linalg.eigh(spread)
    errors = np.sqrt(size)
    known = errors < 0.2
    apart = np.ptp(points @ turn, axis=0) / errors
    return (
        f"Of {known.size} combinations (principal axes of the relative covariance) {known.sum()} have a standard error "
        f"below 20 %; in these the {len(rows)} runs of casadi-engine that count agree within "
        f"{apart[known].max():.1g} standard errors."
    )


def precision_line(one: dict[str, Any]) -> str:
    """For the terminal and the table."""
    return (
        f"χ²({one['freedom']}) = {one['chi2']:.1f}, p = {one['p']:.3f}, largest error {one['worst']:.1f} standard "
        f"errors, converged {one['converged']}/{one['seeds']}, median {one['seconds']:.2f} s"
    )


def precision_table(store: dict[str, Any]) -> list[str]:
    """Errors against the Cramér-Rao bound."""
    if not store["precision"]:
        return []
    first = next(iter(store["precision"].values()))
    lines = ["### Errors against the Cramér-Rao bound", ""]
    lines += [f"B6 with {first['seeds']} seeds of the noise; relative, in %.", ""]
    lines += ["| | " + " | ".join(first["free"]) + " |", "|---|" + "---|" * len(first["free"])]
    lines.append("| bound, these records | " + " | ".join(f"{v:.2f}" for v in first["bound"]) + " |")
    lines.append("| bound, published for records of this kind | 1.3 | 0.7 | 0.8 | 1.1 | 1.0 | 2.8 |")
    for name, one in store["precision"].items():
        title = f"{SOLVERS[name].title}, {one['date']}"
        lines.append(f"| scatter, {title} | " + " | ".join(f"{v:.2f}" for v in one["scatter"]) + " |")
        lines.append(f"| mean error, {title} | " + " | ".join(f"{v:+.2f}" for v in one["mean"]) + " |")
    lines += [""]
    lines += [f"{SOLVERS[name].title}: {precision_line(one)}.\n" for name, one in store["precision"].items()]
    return lines


def point(rows: list[dict[str, Any]]) -> tuple[float, float, float] | None:
    """Median seconds, seconds an iteration and peak memory [MB] of a point of the scaling study."""
    good = [row for row in rows if "chi2" in row]
    if not good:
        return None
    times = [total(row) for row in good]
    each = [total(row) / max(row["iterations"] or 1, 1) for row in good]
    return float(np.median(times)), float(np.median(each)), max(row["peak_mb"] for row in good)


def point_line(rows: list[dict[str, Any]]) -> str:
    """For the terminal."""
    found = point(rows)
    return (
        "no answer" if found is None else f"{found[0]:.3g} s, {found[1]:.3g} s/iteration, {found[2]:.0f} MB"
    )


def slope(x: list[float], y: list[float]) -> float:
    """Exponent of a power law, least squares on logarithms."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0]) if len(x) > 1 else np.nan


def series(one: dict[str, Any], axis: str) -> list[tuple[int, float, float, float]]:
    """(abscissa, seconds, seconds an iteration, MB) along an axis of the study."""
    other, fixed = ("samples", 14_400) if axis == "cylinders" else ("cylinders", 4)
    found = [(p[axis], point(p["rows"])) for p in one["points"] if p[other] == fixed]
    return sorted((x, *f) for x, f in found if f is not None)


def scaling_table(store: dict[str, Any]) -> list[str]:
    """Cost against cylinders and samples, with exponents."""
    if not store["scaling"]:
        return []
    lines = ["### Cost against size", "", f"![Cost against cylinders and samples]({FIGURE.name})", ""]
    lines += [
        "Crankshafts of 1 to 12 cylinders (4 to 15 inertias) and 14 400 samples, then 4 cylinders and up to "
        "1.44 million samples; six tied parameters, starts ±10 %. Memory is the peak of the process, interpreter, "
        "libraries and data included.",
        "",
    ]
    for axis in ("cylinders", "samples"):
        for name, one in store["scaling"].items():
            points = series(one, axis)
            if not points:
                continue
            x = [float(p[0]) for p in points]
            # the exponent of the large sizes is what matters: the last three points
            high = [slope(x[-3:], [p[k] for p in points][-3:]) for k in (1, 2)]
            lines += [f"| {SOLVERS[name].title} · {axis} | " + " | ".join(f"{p[0]:,}" for p in points) + " |"]
            lines += ["|---|" + "---|" * len(points)]
            lines += ["| CPU | " + " | ".join(seconds(p[1]) for p in points) + " |"]
            lines += ["| CPU an iteration | " + " | ".join(seconds(p[2]) for p in points) + " |"]
            lines += ["| peak memory [MB] | " + " | ".join(f"{p[3]:.0f}" for p in points) + " |"]
            lines += [
                "",
                f"Exponent of the last three: {high[0]:.2f} in all, {high[1]:.2f} an iteration.",
                "",
            ]
    return lines


def draw(store: dict[str, Any]) -> None:
    """The scaling figure."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    colours = {"ours": "#1f5fa8", "scipy": "#c4622d"}
    for name, one in store["scaling"].items():
        for panel, axis in zip(axes[:2], ("cylinders", "samples"), strict=True):
            points = np.array(series(one, axis), dtype=float)
            if not points.size:
                continue
            style = {"color": colours.get(name, "0.4"), "marker": "o", "markersize": 4}
            exponent = slope(points[-3:, 0].tolist(), points[-3:, 2].tolist())
            title = "casadi-engine" if name == "ours" else "SciPy, frequency domain"
            panel.loglog(points[:, 0], points[:, 1], **style, label=f"{title}, in all")
            panel.loglog(
                points[:, 0], points[:, 2], **style, ls=":", label=f"an iteration, exponent {exponent:.2f}"
            )
            if axis == "samples":
                axes[2].loglog(points[:, 0], points[:, 3], **style, label=title)
    for panel, label in zip(axes, ("cylinders", "samples", "samples"), strict=True):
        panel.set_xlabel(label)
        panel.grid(True, which="major", alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(fontsize=7, frameon=False)
    axes[0].set_xticks([1, 2, 3, 4, 6, 8, 12], ["1", "2", "3", "4", "6", "8", "12"])
    axes[0].minorticks_off()
    axes[0].set_ylabel("CPU time [s], one thread")
    axes[2].set_ylabel("peak memory of the process [MB]")
    axes[0].set_title("14 400 samples", fontsize=9)
    axes[1].set_title("4 cylinders", fontsize=9)
    axes[2].set_title("4 cylinders", fontsize=9)
    figure.savefig(FIGURE, dpi=140)
    plt.close(figure)


def generated(store: dict[str, Any]) -> str:
    """All tables."""
    used: dict[str, set[str]] = {}
    for solvers in store["problems"].values():
        for one in solvers.values():
            for package, version in one["versions"].items():
                used.setdefault(package, set()).add(version)
    packages = ", ".join(f"{name} {' and '.join(sorted(v))}" for name, v in sorted(used.items()))
    lines = [
        f"Machine: {MACHINE} ({platform.machine()}), Python {platform.python_version()}; {packages}.",
        "CPU seconds; medians over the starts; set-up and solution apart (covariance included where a solver makes "
        "it). χ²/N of every answer is worked out by one yardstick, the initial states at their best.",
        "",
    ]
    for case in ABOUT:
        if case in store["problems"]:
            lines += problem_table(case, store)
    return "\n".join([*lines, *precision_table(store), *scaling_table(store)]).rstrip() + "\n"


def write_results(store: dict[str, Any]) -> None:
    """Put the tables into RESULTS.md between its marks, and draw the figure."""
    text = RESULTS.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    if store["scaling"]:
        draw(store)
    RESULTS.write_text(f"{before}{BEGIN}\n\n{generated(store)}\n{END}{after}", encoding="utf-8")
