"""What the pages of this folder share: simulated records, the published tables, printing and figures.

The thesis's records are not public. Those used here come from the simulator in data/simulator, which integrates the
thesis's equations and shares no code with casadi_engine.
"""

import argparse
import hashlib
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.figure import Figure

import casadi_engine as ce
from casadi_engine.estimation import Fit

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results" / "thesis"
sys.path.insert(0, str(ROOT / "data"))

import simulator  # noqa: E402

UNITS = {"theta": "rad", **dict.fromkeys(("p1", "p2", "p3", "p4"), "Pa"), "T_load": "N m", "omega": "rad/s"}
SIGMA = 0.1  # rad/s, the thesis's measurement noise
RATE = simulator.simulate.SAMPLE_RATE  # Hz
MEASURED, OURS, THESIS = "0.6", "#0072B2", "#D55E00"

# Tables 4.1 and 4.7: the thesis prints the reciprocals 2.557 and 5.646 of the inertias.
TABLE_4_1 = {"J_eng": 1 / 2.557, "C_el": 2.5, "K_el": 1992.0, "C_eng": 0.1541, "J_load": 1 / 5.646}
TABLE_4_12 = {"J1": 1 / 33.39, "J2": 1 / 22.3, "J6": 1 / 5.968, "K21": 241.8e3, "K32": 1270e3, "K65": 1427e3}
TABLE_4_13 = {  # natural frequency [Hz]: |deformation| of the couplings 21, 32, 43, 54, 65, 76
    20.5: (0.0007, 0.0003, 0.0005, 0.0007, 0.0008, 1),
    335: (1, 0.3229, 0.4038, 0.4216, 0.3322, 0.6414),
    548: (1, 0.0692, 0.1030, 0.2109, 0.2085, 0.1501),
    936: (1, 0.7600, 0.7693, 0.1636, 0.7937, 0.1953),
    1340: (0.4898, 1, 0.4202, 0.7870, 0.7273, 0.0873),
    1604: (0.2091, 0.6531, 1, 0.9355, 0.4324, 0.0363),
}


DEG, CYCLE = math.pi / 180, 4 * math.pi
TDC = {1: 0.0, 3: math.pi, 4: 2 * math.pi, 2: 3 * math.pi}  # crank angle of each cylinder's combustion
GEOMETRY = {
    "r": 0.043,
    "L": 0.145,
    "A_p": 0.0058,
    "ratio": 10.0,
}  # Table 4.2; the compression ratio is assumed
# Burn law of Eriksson and Andersson: default, unit, bounds. k: polytropes; soc, dur, m: Wiebe function.
BURN = {"p_im": (0.6e5, "Pa", 1e4, 2e5), "p_em": (1e5, "Pa", 5e4, 2e5), "k_c": (1.3, "1", 1.1, 1.5),
        "k_e": (1.3, "1", 1.1, 1.5), "soc": (-10 * DEG, "rad", -1, 0.5), "dur": (60 * DEG, "rad", 0.2, 3),
        "m": (1.5, "1", 0.2, 6)}  # fmt: skip


@dataclass(frozen=True)
class Road:
    """A load [N m] shaken below about 10 Hz, with a half sine of 30 ms at a time [s]."""

    mean: float = 57.0
    rough: float = 0.0
    jolt: float = 0.0
    at: float = 0.0

    def __call__(self, seconds):
        hz = np.linspace(0.2, 40, 40)
        size, phase = 1 / np.sqrt(1 + (hz / 10) ** 2), 100 * np.sin(hz * self.mean)
        shaken = np.sqrt(2 / np.sum(size**2)) * np.sum(size * np.sin(2 * np.pi * hz * seconds + phase))
        inside = 0 < seconds - self.at < 0.03
        return (
            self.mean + self.rough * shaken + self.jolt * inside * np.sin(np.pi * (seconds - self.at) / 0.03)
        )


@dataclass(frozen=True)
class Switched:
    """A load [N m] at the engine from one time to another [s]; a dynamometer that holds the speed [RPM]."""

    torque: float
    on: float
    off: float
    rpm: float = 1200.0

    def __call__(self, seconds, state):
        return np.array([-self.torque * (self.on <= seconds < self.off), self.rpm * np.pi / 30 - state[2]])


@dataclass(frozen=True)
class Line:
    """One result of the thesis beside ours; ``holds`` says whether our numbers bear the conclusion out."""

    place: str
    published: str
    ours: str
    conclusion: str
    holds: bool


def record(kind: str = "two_mass", rpm: float = 1200.0, **options) -> dict[str, np.ndarray]:
    """A record of the simulator, "two_mass" or "crankshaft", kept in results/thesis/records once it was made."""
    source = b"".join(path.read_bytes() for path in sorted((ROOT / "data" / "simulator").glob("*.py")))
    asked = repr((kind, rpm, sorted(options.items()))).encode()
    path = RESULTS / "records" / f"{hashlib.sha256(source + asked).hexdigest()[:20]}.npz"
    if not path.is_file():
        made = getattr(simulator, f"simulate_{kind}")(rpm, **options)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.npz")
        np.savez(part, **made)
        part.replace(path)
    with np.load(path) as arrays:
        return dict(arrays)


def noisy(made: dict[str, np.ndarray], seed: int, sigma: float = SIGMA) -> dict[str, np.ndarray]:
    """The record with fresh white measurement noise [rad/s]."""
    return simulator.add_noise(made, sigma=sigma, seed=seed)


def experiment(made: dict[str, np.ndarray], name: str = "record", hold: str = "first") -> ce.Experiment:
    """The record as casadi_engine takes it; hold "zero" keeps the inputs constant between samples."""
    return ce.Experiment.from_arrays(
        name, time=made["time"], units=UNITS, hold=hold, **{channel: made[channel] for channel in UNITS}
    )


def conditioned(
    data: ce.Experiment, every: int, cutoff: float | None = 400.0, hold: str = "zero"
) -> ce.Experiment:
    """The thesis's conditioning: zero-phase filter, everything resampled behind an anti-alias filter, torques held.

    cutoff : of the filter of the speed [Hz], None for no filter; the thesis does not print its own
    """
    data = data.with_hold(**dict.fromkeys([name for name in UNITS if name in data], hold))
    data = data.low_pass(cutoff_hz=cutoff, channels=("omega",)) if cutoff else data
    if every > 1:
        data = data.low_pass(cutoff_hz=0.4 * RATE / every, channels=("omega", "p1", "p2", "p3", "p4"))
    return data.resample(**dict.fromkeys(UNITS, every))


def pressure(u: Any, p: Mapping[str, Any], x: Any, g: Mapping[str, float]) -> Any:
    """Absolute pressure [Pa] at a cylinder's own angle u in [-2 pi, 2 pi), after Eriksson and Andersson.

    p : the numbers of BURN; x : rise of temperature by combustion, over that after compression; g : as GEOMETRY
    """

    def volume(at: Any) -> Any:
        lift = g["r"] * (1 - ca.cos(at)) + g["L"] * (1 - ca.sqrt(1 - (g["r"] / g["L"] * ca.sin(at)) ** 2))
        return g["A_p"] * (2 * g["r"] / (g["ratio"] - 1) + lift)

    def rise(centre: float, width: float) -> Any:
        return 0.5 * (1 + ca.tanh((u - centre * DEG) / (width * DEG)))

    compressed = p["p_im"] * (volume(-140 * DEG) / volume(u)) ** p["k_c"]
    top = p["p_im"] * (volume(-140 * DEG) / volume(0.0)) ** p["k_c"]
    expanded = top * (1 + x) * (volume(0.0) / volume(u)) ** p["k_e"]
    since = 0.5 * (u - p["soc"] + ca.sqrt((u - p["soc"]) ** 2 + DEG**2))  # smooth where combustion starts
    burned = 1 - ca.exp(-6.9 * (since / p["dur"]) ** (p["m"] + 1))
    ports = p["p_em"] + (1 - rise(0, 9)) * (p["p_im"] - p["p_em"])
    shut = rise(-140, 8) - rise(160, 10)
    return ports + shut * (compressed + burned * (expanded - compressed) - ports)


def own_angle(theta: np.ndarray, cylinder: int = 1) -> np.ndarray:
    """A cylinder's own angle in [-2 pi, 2 pi), 0 at its combustion TDC."""
    return (theta - TDC[cylinder] + CYCLE / 2) % CYCLE - CYCLE / 2


def error(fit: Fit, name: str, truth: Mapping[str, float]) -> float:
    """Error of an estimate [%]."""
    return 100 * abs(fit.values[name] / truth[name] - 1)


def stderr(fit: Fit, name: str, *, own: bool = False) -> float:
    """Standard error of an estimate [%] by the curvature at the optimum and white noise of the fit's level, which is
    what the thesis's covariances are, also where the fit doubts it; infinite where there is none, as at a bound.

    own : count with the noise that the residual shows, as the fit itself does
    """
    one = fit.estimates[name]
    size = one.quadratic or one.stderr
    if size is None or one.at_bound:
        return float("inf")
    return 100 * size / abs(one.value) / (1.0 if own else fit.own_noise.get(name, 1.0))


def squares(fit: Fit, truth: Mapping[str, float]) -> float:
    """Square of the errors of all these over their covariance: as many as they are on average, if it is right."""
    own = [fit.free.index(name) for name in truth]
    off = fit.z[own] - np.array(list(truth.values()))
    return float(off @ np.linalg.solve(fit.covariance[np.ix_(own, own)], off))


def print_table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table with a title, columns aligned."""
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    print(f"\n{title}")
    for row in (head, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def print_errors(title: str, truth: Mapping[str, float], fits: Mapping[str, Fit]) -> None:
    """Print error and standard error [%] of every parameter of every fit."""
    rows = []
    for way, fit in fits.items():
        words = [f"{error(fit, name, truth):.2f} ± {stderr(fit, name):.2g}" for name in truth]
        bound = {name for name in truth if fit.estimates[name].at_bound}
        words = ["at bound" if name in bound else word for name, word in zip(truth, words, strict=True)]
        known = ["fixed" if name not in fit.free else word for name, word in zip(truth, words, strict=True)]
        rows.append([way, *known])
    print_table(f"{title}: error ± standard error [%]", ["way", *truth], rows)


def panels(rows: int, columns: int, width: float = 10.0, height: float = 3.0):
    """A figure and its (rows, columns) axes."""
    figure = Figure(figsize=(width, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.grid(True, color="0.92", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
        ax.title.set_fontsize(9)
    return figure, axes


def run(page: Callable[[bool, Path], list[Line]], name: str, about: str) -> int:
    """Run a page from the command line: print its comparison, keep it as JSON beside the figure."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the part that a test runs")
    quick = parser.parse_args().quick
    out = RESULTS / "quick" if quick else RESULTS
    out.mkdir(parents=True, exist_ok=True)
    lines = page(quick, out)
    rows = [
        (
            line.place,
            line.published,
            line.ours,
            line.conclusion if line.holds else f"NOT BORNE OUT: {line.conclusion}",
        )
        for line in lines
    ]
    print_table("Published and ours", ("where", "thesis", "ours", "conclusion"), rows)
    plain = [{**asdict(line), "holds": bool(line.holds)} for line in lines]
    (out / f"{name}.json").write_text(json.dumps(plain, indent=1), "utf-8")
    return 0 if all(line.holds for line in lines) else 1
