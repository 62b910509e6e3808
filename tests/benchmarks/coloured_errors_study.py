"""Do estimates scatter in coloured noise as their errors say?

    python tests/benchmarks/coloured_errors_study.py [NAME ...] [--fits N] [--folder PLACE] [--write]

NAME : rotor (linear, driven), pendulum (swung to 2.5 rad, its angle measured), servo (an axis on a spring, position and
speed measured, two records), tank (a level that empties through a hole, 150 samples), each in noise of several colours.
Records come from SciPy; levels of the noise are estimated by the fits. Counted is how often the printed interval of 95
% holds the truth, and the root mean square error in printed standard errors, beside those of the curvature. Finished
fits are kept in `coloured-*.jsonl`; ``--write`` puts the dated table into CALIBRATION.md.
"""

from __future__ import annotations

import argparse
import datetime
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import casadi_engine as ce  # noqa: E402
from casadi_engine.estimation.study import study  # noqa: E402

Rows = list[dict[str, Any]]
Array = np.ndarray
LEVEL, FITS = 1.959964, 150
# name -> numerator and denominator of the filter that colours white noise
COLOURS: dict[str, tuple[list[float], list[float]]] = {
    "white": ([1.0], [1.0]),
    "AR(1) 0.5": ([1.0], [1.0, -0.5]),
    "AR(1) 0.9": ([1.0], [1.0, -0.9]),
    "AR(1) 0.98": ([1.0], [1.0, -0.98]),
    "AR(2), resonant": ([1.0], [1.0, -1.8, 0.9]),
    "AR(1) 0.95 + white": ([1.0, -0.4], [1.0, -0.95]),
}


@dataclass(frozen=True)
class Plant:
    """What is simulated, and the model of it.

    truth : name -> value; outputs : name -> unit; level : name -> standard deviation of its noise
    records : simulated outputs, with times and inputs; model : makes the model
    """

    truth: dict[str, float]
    level: dict[str, float]
    units: dict[str, str]
    records: Callable[[], list[tuple[Array, dict[str, Array], dict[str, Array]]]]
    model: Callable[[], ce.Model]


def _solved(f: Callable[[float, Array, Array], list[float]], x: list[float], at: Array, u: Array) -> Array:
    """States (n, N) of dx/dt = f(t, x, u), u held from sample to sample."""
    from scipy.integrate import solve_ivp

    found = np.empty((len(x), len(at)))
    found[:, 0] = x
    for k in range(len(at) - 1):
        run = solve_ivp(f, (at[k], at[k + 1]), found[:, k], args=(u[k],), rtol=1e-9, atol=1e-11)
        found[:, k + 1] = run.y[:, -1]
    return found


def _steps(count: int, each: int, seed: int) -> Array:
    return np.repeat(np.random.default_rng(seed).standard_normal(-(-count // each)), each)[:count]


def _rotor() -> list[tuple[Array, dict[str, Array], dict[str, Array]]]:
    at = 0.02 * np.arange(600)
    u = _steps(600, 25, 1)
    x = _solved(lambda t, x, u: [(u - 0.4 * x[0]) / 0.5], [0.0], at, u)
    return [(at, {"T": u}, {"omega": x[0]})]


def _rotor_model() -> ce.Model:
    b = ce.Blueprint("rotor")
    inertia, damping = b.parameter("J", 0.4, unit="kg m2", min=0.01), b.parameter("c", 0.3, unit="N m s/rad")
    w, torque = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    b.ode("w", (torque - damping * w) / inertia)
    b.output("omega", w, unit="rad/s")
    return b.model()


def _pendulum() -> list[tuple[Array, dict[str, Array], dict[str, Array]]]:
    at = 0.02 * np.arange(400)
    x = _solved(lambda t, x, u: [x[1], -9.81 * np.sin(x[0]) - 0.1 * x[1]], [2.5, 0.0], at, at)
    return [(at, {}, {"angle": x[0]})]


def _pendulum_model() -> ce.Model:
    b = ce.Blueprint("pendulum")
    g_l, c = (
        b.parameter("g_l", 9.0, unit="1/s2", min=1, max=100),
        b.parameter("c", 0.12, unit="1/s", min=0, max=10),
    )
    x, w = b.state("x", unit="rad"), b.state("w", unit="rad/s")
    b.ode("x", w)
    b.ode("w", -g_l * ca.sin(x) - c * w)
    b.output("angle", x, unit="rad")
    return b.model()


def _servo() -> list[tuple[Array, dict[str, Array], dict[str, Array]]]:
    found = []
    for seed in (3, 4):
        at = 0.01 * np.arange(500)
        u = 5 * _steps(500, 40, seed)
        x = _solved(
            lambda t, x, u: [x[1], (u - 40 * x[0] - 30 * x[0] ** 3 - 1.5 * x[1]) / 2.0], [0.0, 0.0], at, u
        )
        found.append((at, {"F": u}, {"x": x[0], "v": x[1]}))
    return found


def _servo_model() -> ce.Model:
    b = ce.Blueprint("servo")
    mass, k = (
        b.parameter("m", 1.7, unit="kg", min=0.1),
        b.parameter("k", 35.0, unit="N/m", min=1),
    )
    k3, c = b.parameter("k3", 20.0, unit="N/m3", min=0), b.parameter("c", 1.0, unit="N s/m", min=0)
    x, v = b.state("pos", unit="m"), b.state("vel", unit="m/s")
    force = b.input("F", unit="N")
    b.ode("pos", v)
    b.ode("vel", (force - k * x - k3 * x**3 - c * v) / mass)
    b.output("x", x, unit="m")
    b.output("v", v, unit="m/s")
    return b.model()


def _tank() -> list[tuple[Array, dict[str, Array], dict[str, Array]]]:
    at = 2.0 * np.arange(150)
    u = 1 + 0.4 * _steps(150, 15, 5)
    x = _solved(lambda t, x, u: [(u - 0.8 * np.sqrt(x[0])) / 20], [1.0], at, u)
    return [(at, {"q": u}, {"h": x[0]})]


def _tank_model() -> ce.Model:
    b = ce.Blueprint("tank")
    area, hole = b.parameter("A", 15.0, unit="m2", min=1), b.parameter("a", 0.7, unit="m2.5/s", min=0.01)
    h, q = b.state("level", unit="m"), b.input("q", unit="m3/s")
    b.ode("level", (q - hole * ca.sqrt(h)) / area)
    b.output("h", h, unit="m")
    return b.model()


PLANTS = {
    "rotor": Plant({"J": 0.5, "c": 0.4}, {"omega": 0.03}, {"T": "N m", "omega": "rad/s"}, _rotor, _rotor_model),
    "pendulum": Plant(
        {"g_l": 9.81, "c": 0.1}, {"angle": 0.05}, {"angle": "rad"}, _pendulum, _pendulum_model
    ),
    "servo": Plant(
        {"m": 2.0, "k": 40.0, "k3": 30.0, "c": 1.5}, {"x": 0.01, "v": 0.05},
        {"F": "N", "x": "m", "v": "m/s"}, _servo, _servo_model,
    ),
    "tank": Plant({"A": 20.0, "a": 0.8}, {"h": 0.02}, {"q": "m3/s", "h": "m"}, _tank, _tank_model),
}  # fmt: skip


@cache
def simulated(name: str) -> list[tuple[Array, dict[str, Array], dict[str, Array]]]:
    """The records of a plant without noise."""
    return PLANTS[name].records()


@cache
def model_of(name: str) -> ce.Model:
    """The model of a plant."""
    return PLANTS[name].model()


def coloured(colour: str, count: int, random: np.random.Generator) -> Array:
    """(N,) stationary noise of unit standard deviation."""
    from scipy.signal import lfilter

    top, bottom = COLOURS[colour]
    answer = lfilter(top, bottom, np.eye(1, 4000)[0])
    return np.asarray(
        lfilter(top, bottom, random.standard_normal(count + 2000))[2000:] / np.linalg.norm(answer)
    )


def row(piece: dict[str, Any]) -> dict[str, Any]:
    """One fit as plain numbers."""
    plant, random = PLANTS[piece["plant"]], np.random.default_rng([41, piece["seed"]])
    data = []
    for number, (at, drives, outputs) in enumerate(simulated(piece["plant"])):
        noisy = {
            key: y + plant.level[key] * coloured(piece["colour"], len(y), random)
            for key, y in outputs.items()
        }
        hold = {"hold": "zero"} if drives else {}
        data.append(
            ce.Experiment.from_arrays(f"r{number}", time=at, units=plant.units, **hold, **drives, **noisy)
        )
    fit = ce.estimate(model_of(piece["plant"]), data, progress=False)
    found = {}
    for name, right in plant.truth.items():
        one = fit.estimates[name]
        error = one.stderr or one.quadratic
        inside = None
        if one.stderr is not None:
            inside = abs(one.value - right) <= LEVEL * one.stderr
        elif one.interval is not None:
            inside = one.interval[0] <= right <= one.interval[1]
        found[name] = {
            "z": None if not error else (one.value - right) / error,
            "ratio": fit.own_noise[name],
            "held": None if inside is None else bool(inside),
        }
    return {"status": fit.status, "of": found}


def table(found: dict[tuple[str, str], Rows]) -> str:
    """The study as Markdown."""
    lines = [
        "| plant | noise | fits | printed 95 % holds | rms error / printed | by the curvature, 95 % would hold | "
        "rms error / curvature's |",
        "|---" * 7 + "|",
    ]
    for (name, colour), rows in found.items():
        good = [one for row in rows if row["status"] == "converged" for one in row["of"].values()]
        good = [one for one in good if one["z"] is not None]
        z, ratio = (np.array([one[key] for one in good]) for key in ("z", "ratio"))
        held = [one["held"] for one in good if one["held"] is not None]
        cells = [name, colour, len(rows), f"{np.mean(held):.3f} ± {np.sqrt(0.0475 / len(held)):.3f}", f"{_rms(z):.2f}",
                 f"{np.mean(np.abs(z * ratio) <= LEVEL):.3f}", f"{_rms(z * ratio):.2f}"]  # fmt: skip
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def write(text: str) -> None:
    """CALIBRATION.md: the table between its marks, what is said of it stays."""
    path = HERE / "CALIBRATION.md"
    begin, end = "<!-- begin of what coloured_errors_study.py writes -->", "<!-- end of coloured errors -->"
    old = path.read_text("utf-8")
    if begin not in old:
        old += f"\n## In coloured noise\n\n{begin}\n{end}\n"
    before, after = old.split(begin)[0], old.split(end)[1]
    dated = f"{datetime.date.today():%Y-%m-%d}, `python tests/benchmarks/coloured_errors_study.py --write`."
    path.write_text(f"{before}{begin}\n\n{dated}\n\n{text}\n\n{end}{after}", "utf-8")


def main() -> None:
    """Run what is not done, print the table, write it if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", default=[])
    parser.add_argument("--fits", type=int, default=FITS)
    parser.add_argument("--folder", type=Path, default=HERE)
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    found: dict[tuple[str, str], Rows] = {}
    for name in asked.names or PLANTS:
        for colour in COLOURS:
            pieces = [{"plant": name, "colour": colour, "seed": seed} for seed in range(asked.fits)]
            word = "".join(c for c in colour if c.isalnum())
            path = asked.folder / f"coloured-{name}-{word}.jsonl"
            found[name, colour] = study(row, pieces, name=f"{name} {colour}", setting=1, checkpoint=path)
    text = table(found)
    print(text)
    if asked.write:
        write(text)


if __name__ == "__main__":
    main()
