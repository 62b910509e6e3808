"""Which step of the thesis's procedure loses C_el, although its Cramér-Rao bound is below 1 % (misfire)?

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/lost_damper.py

Records of the independent simulator (two masses, 1200 RPM, 57 N m) are fitted and swept with one step of the thesis's
procedure switched on at a time. Writes the dated table lost_damper.md beside this file, and two figures:
.pictures/loss_sweeps.png (Figure 4.6 again, beside profiles) and .pictures/lost_damper.png (the sweep of C_el with
each step). About a minute of processor time.
"""

from __future__ import annotations

import datetime
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "data"))
from simulator import add_noise, simulate_two_mass

import casadi_engine as ce
from casadi_engine.identifiability import LossSweep, Profile, loss_sweep, profile
from casadi_engine.report import panels
from casadi_engine.report.identifiability_figures import draw_profile, draw_sweep
from casadi_engine.report.matplotlib_figure import drawn, figure_of
from casadi_engine.report.sketch import Sketch

ROOT = Path(__file__).resolve().parents[2]
SIGMA = 0.1
UNITS = {"theta": "rad"} | dict.fromkeys(("p1", "p2", "p3", "p4"), "Pa") | {"T_load": "N m", "omega": "rad/s"}
TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
SWEPT = ("1/J_eng", "C_eng", "K_el", "1/J_load", "C_el")  # the order of Figure 4.6
RUNS = {"normal": {"scatter_seed": 105}, "misfire": {"scatter_seed": 102, "misfire": {2: "all"}}}
LINEAR = ce.two_mass(reciprocating_speed="measured")
NONLINEAR = ce.two_mass(reciprocating_speed="model")
RIGHT = "start estimated"


@dataclass(frozen=True)
class Step:
    """One way to treat a record; the defaults are the right procedure in the linear form.

    start : "estimated", "thesis" (speeds as measured, twist 0), or the same with the true "twist" or "load" speed
    every : samples of all channels kept, one in so many; outputs : of the output alone
    """

    name: str
    model: Any = LINEAR
    hold: str = "first"
    start: str = "estimated"
    every: int = 1
    outputs: int = 1
    shifted: bool = False
    low_pass: float = 0.0
    noise: bool = True
    curve: bool = False


STEPS = (
    Step("none (own speed in the reciprocating torque, first-order hold, full rate)", model=NONLINEAR),
    Step("measured speed in the reciprocating torque (linear form)", curve=True),
    Step("  and zero-order hold", hold="zero", curve=True),
    Step("  and speed resampled by 20", outputs=20),
    Step("  and all channels resampled by 20, zero-order hold", every=20, hold="zero", curve=True),
    Step("  and speed low-passed at 400 Hz, zero phase", low_pass=400.0),
    Step("  and pressures 3, 4 made of 1, 2 by shifting", shifted=True),
    Step("  and start taken as known: speeds as measured, twist 0", start="thesis", curve=True),
    Step("    but with the true twist", start="twist"),
    Step("    but with the true speed of the load", start="load"),
    Step(
        "noise-free, zero-order hold, start known (thesis 4.2.2)",
        hold="zero",
        start="thesis",
        noise=False,
        curve=True,
    ),
    Step("the same, start estimated", hold="zero", noise=False),
)


@dataclass
class Row:
    """What one step makes of one record: the sweep of C_el and the joint fit of all five."""

    step: Step
    sweep: LossSweep
    fit: Any
    seconds: float = field(default=0.0)

    @property
    def sweep_words(self) -> str:
        """Where the sweep is lowest, in units of the true value."""
        at = self.sweep.minimum("C_el")[0] / TRUTH["C_el"]
        return f"{at:.2f}" if self.sweep.has_minimum("C_el") else f"none (falls to {at:.1f})"

    @property
    def fit_words(self) -> str:
        """The fitted C_el in units of the true value."""
        one = self.fit.estimates["C_el"]
        if one.at_bound or one.stderr is None:
            return f"{one.value / TRUTH['C_el']:.3g} ({one.at_bound or one.why})"
        return f"{one.value / TRUTH['C_el']:.3f} ± {one.stderr / TRUTH['C_el']:.3f}"


def experiment(record: dict[str, np.ndarray], step: Step) -> ce.Experiment:
    """The record as a step treats it."""
    arrays = {name: record[name] for name in UNITS}
    if step.shifted:
        arrays |= {"p3": record["p3_assumed"], "p4": record["p4_assumed"]}
    made = ce.Experiment.from_arrays("run", time=record["time"], units=UNITS, hold=step.hold, **arrays)
    if step.low_pass:
        made = made.low_pass(cutoff_hz=step.low_pass, channels=("omega",))
    if step.every > 1:
        made = made.resample(**dict.fromkeys(UNITS, step.every))
    return made.resample(omega=step.outputs) if step.outputs > 1 else made


def start_of(record: dict[str, np.ndarray], step: Step) -> dict[str, float] | None:
    """The initial state that a step takes as known, or None."""
    if step.start == "estimated":
        return None
    speed = float(record["omega_true"][0])
    load = float(record["omega_load_true"][0]) if step.start == "load" else speed
    twist = float(record["states"][-1, 0]) if step.start == "twist" else 0.0
    return {"omega_eng": speed, "omega_load": load, "twist": twist}


def run(record: dict[str, np.ndarray], step: Step) -> Row:
    """Sweep C_el and fit all five, from the true values."""
    data, known, begun = experiment(record, step), start_of(record, step), time.process_time()
    points = 51 if step.model is LINEAR else 6  # the nonlinear form takes a hundred times as long
    sweep = loss_sweep(step.model, data, "C_el", points=points, start=known or "fitted")
    fit = ce.estimate(step.model, data, noise=ce.Noise(omega=SIGMA), initial=known, progress=False)
    return Row(step, sweep, fit, time.process_time() - begun)


def records(kind: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """(noisy, noise-free)."""
    clean = simulate_two_mass(1200, sigma=0.0, **RUNS[kind])
    return add_noise(clean, sigma=SIGMA, seed=201), clean


def table(rows: dict[str, list[Row]]) -> str:
    lines = [
        f"# The lost damper ({datetime.datetime.now(tz=datetime.UTC).date()})",
        "",
        "C_el in units of its true value, one step of the thesis's procedure at a time (made by `lost_damper.py`).",
        "Sweep: where the loss is lowest over [0, 2.5], the other parameters at their true values. Fit: all five free.",
        "N V is the summed loss of the sweep's lowest point in (rad/s)²; 72 is noise alone at the full rate.",
        "",
        "| step | normal: sweep | N V | fit | misfire: sweep | N V | fit |",
        "|---|---|---|---|---|---|---|",
    ]
    for normal, misfire in zip(rows["normal"], rows["misfire"], strict=True):
        cells = [normal.step.name.replace("  ", "&nbsp;&nbsp;")]
        for row in (normal, misfire):
            floor = row.sweep.minimum("C_el")[1] * row.sweep.samples
            cells += [row.sweep_words, f"{floor:.3g}", row.fit_words]
        lines.append("| " + " | ".join(cells) + " |")
    seconds = sum(row.seconds for kind in rows.values() for row in kind)
    return "\n".join([*lines, "", SENTENCE, "", f"{seconds:.0f} s of processor time.", ""])


SENTENCE = (
    "**The start loses it.** The thesis simulates from a state that it takes as known, speeds as measured and the "
    "coupling relaxed, while the coupling carries the load (twist −0.028 rad) and the load turns at another speed: "
    "the false 20 Hz oscillation that this sets off costs more than C_el can, and a large C_el ends it sooner. From "
    "normal combustion the sweep then has no minimum, and the summed loss at the true values is about 10³ even without "
    "noise, as in Figure 4.6; from misfire the sweep keeps one, and the joint fit ends 55 % off, as C_el in Table "
    "4.3(b) does not converge. With the three initial states estimated all is well, normal combustion included: the "
    "measured speed in the reciprocating torque, the filter and the noise do no harm. Zero-order hold moves the "
    "minimum by half a sample's worth of phase. Two more steps lose C_el, but belong to the measured data of 4.2.3: "
    "resampling the torques with zero-order hold, and shifting pressures between cylinders that differ (in the "
    "simulated study the same pressures drive data and model)."
)


def save(sketch: Sketch, title: str, name: str) -> None:
    figure = figure_of(sketch)
    figure.suptitle(title, fontsize=11)
    (ROOT / ".pictures" / name).write_bytes(drawn(figure, "png", dpi=110))


def draw_steps(rows: dict[str, list[Row]]) -> None:
    """The sweep of C_el with each step, normal and misfire."""
    sketch = Sketch(10, 4.4, (1, 2), key=True)
    colours = ("#0072B2", "#56B4E9", "#009E73", "#D55E00", "#000000")
    for panel, (kind, all_rows) in zip(sketch.cells(), rows.items(), strict=True):
        shown = [row for row in all_rows if row.step.curve]
        for row, colour in zip(shown, colours, strict=True):
            values, loss = row.sweep.values["C_el"], row.sweep.loss["C_el"]
            dash = "-" if row.step.start == "estimated" else "--"
            label = row.step.name.strip().removeprefix("and ")
            panel.plot(values, loss, color=colour, linestyle=dash, linewidth=1.6, label=label)
            at, lowest = row.sweep.minimum("C_el")
            panel.plot([at], [lowest], "o", color=colour, markersize=5)
        panel.axvline(TRUTH["C_el"], color="0.5", linewidth=0.8, linestyle=":")
        panel.yscale = "log"
        panels.dress(panel, x="C_el [N m s/rad]", y="loss V [(rad/s)²]", title=f"{kind} combustion")
    words = "C_el is lost where the initial state is taken as known (dashed); dots: lowest points, dotted line: truth"
    save(sketch, words, "lost_damper.png")


def draw_figure_46(found: dict[str, tuple[LossSweep, LossSweep, Profile]]) -> None:
    """Figure 4.6 for both records, with the start estimated and as the thesis takes it, above the profiles."""
    sketch = Sketch(13, 9.6, (4, 5), key=True)
    for pair, (kind, (right, thesis, curves)) in zip((0, 2), found.items(), strict=True):
        for k, name in enumerate(SWEPT):
            above, below = sketch.panel(pair, k), sketch.panel(pair + 1, k)
            words = "start known: speeds measured, twist 0"
            draw_sweep(above, thesis, name, label=words, colour=panels.PREDICTED)
            draw_sweep(above, right, name, label=RIGHT)
            words = "U-shape" if thesis.has_minimum(name) else "lost, known start"
            above.title = f"{kind}, {name}: {words}"
            plain = name.removeprefix("1/")
            line = curves.lines[plain]
            share = 100 * (line.estimate.stderr or np.nan) / line.estimate.value
            draw_profile(below, line, level=curves.level, title=f"{kind}, {plain}: ± {share:.2g} %")
            above.y, below.y = ("loss V [(rad/s)²]", "rise of the cost [1]") if k == 0 else ("", "")
    words = "Figure 4.6 again: one parameter at a time over [0, 2.5 p], and profile likelihoods"
    save(sketch, words, "loss_sweeps.png")


def figure_46(record: dict[str, np.ndarray]) -> tuple[LossSweep, LossSweep, Profile]:
    """Sweeps with the start estimated and as the thesis takes it, and profiles."""
    data, known = experiment(record, STEPS[1]), start_of(record, Step("", start="thesis"))
    right, thesis = (loss_sweep(LINEAR, data, *SWEPT, points=51, start=start) for start in ("fitted", known))
    fit = ce.estimate(LINEAR, data, noise=ce.Noise(omega=SIGMA), progress=False)
    return right, thesis, profile(fit, points=5)


FIGURES = (
    "![The sweep of C_el with and without each step](../../.pictures/lost_damper.png)\n\n"
    "![Figure 4.6 again: one parameter at a time, start known and start estimated, beside profiles]"
    "(../../.pictures/loss_sweeps.png)\n"
)


def main() -> None:
    rows: dict[str, list[Row]] = {}
    found: dict[str, tuple[LossSweep, LossSweep, Profile]] = {}
    for kind in RUNS:
        noisy, clean = records(kind)
        rows[kind] = [run(noisy if step.noise else clean, step) for step in STEPS]
        found[kind] = figure_46(noisy)
    text = table(rows).rstrip("\n") + "\n\n" + FIGURES
    Path(__file__).with_suffix(".md").write_text(text, encoding="utf-8")
    print(text)
    draw_steps(rows)
    draw_figure_46(found)


if __name__ == "__main__":
    main()
