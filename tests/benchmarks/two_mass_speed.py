"""Problem A: the package against SciPy, in one run on one thread; prints a Markdown table.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/two_mass_speed.py

Two masses in the linear form, five parameters and three initial states, 14 400 samples, all starts 40 % off;
CPU time of set-up, solution and covariance (imports and reading excluded), median of five. Every run must end
within 1e-5 of the best chi-squared per sample.
"""

from __future__ import annotations

import datetime
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import opponent_lfilter
import opponent_two_mass
import two_mass_data

import casadi_engine as ce

STARTS = (
    (1.4, 1.4, 1.4, 1.4, 1.4),
    (0.6, 0.6, 0.6, 0.6, 0.6),
    (0.6, 1.4, 0.6, 1.4, 0.6),
    (1.4, 0.6, 1.4, 0.6, 1.4),
)
RUNS = 5
SIGMA = 0.1


def ours(record: ce.Experiment, start: dict[str, float]) -> tuple[float, int]:
    """Fit with the package: cost in rad^2/s^2 and iterations."""
    model = ce.two_mass(reciprocating_speed="measured")
    parameters = model.parameters()
    for name, value in start.items():
        parameters[name].set(value)
    fit = ce.estimate(model, record, parameters=parameters, noise=ce.Noise(omega=SIGMA), progress=False)
    return fit.cost * SIGMA**2, fit.iterations


def opponent(module: Any, data: Any) -> Callable[[dict[str, float]], tuple[float, int]]:
    """Fit with an opponent: the same figures."""

    def run(start: dict[str, float]) -> tuple[float, int]:
        found = module.fit(data.y, data.torque_eng, data.torque_load, data.step, start)
        return found["cost"], found["evaluations"]

    return run


def timed(run: Callable[[], tuple[float, int]]) -> tuple[float, float, int]:
    """Median CPU time [s] of the runs after a warm-up, cost and evaluations."""
    run()
    spent = []
    for _ in range(RUNS):
        begun = time.process_time()
        cost, count = run()
        spent.append(time.process_time() - begun)
    return float(np.median(spent)), cost, count


def main() -> None:
    data = two_mass_data.read_record()
    path = Path(__file__).parents[2] / "data" / "misfire_1200rpm.csv.gz"
    record = ce.read_experiment(path, optional=("omega_load",))
    ways: dict[str, Callable[[dict[str, float]], tuple[float, int]]] = {
        "casadi-engine": lambda start: ours(record, start),
        "least_squares, exact discretisation, lfilter, analytic Jacobian": opponent(opponent_lfilter, data),
        "least_squares, frequency domain, compressed": opponent(opponent_two_mass, data),
    }
    print(f"{datetime.date.today()}, {platform.machine()}, Python {platform.python_version()}\n")
    print("| formulation | " + " | ".join(" ".join(f"{f:g}" for f in s) for s in STARTS) + " |")
    print("|---|" + "---|" * len(STARTS))
    best = min(ways["casadi-engine"](dict(two_mass_data.TRUTH))[0], np.inf)
    for name, way in ways.items():
        cells = []
        for factors in STARTS:
            start = {
                key: value * factor
                for (key, value), factor in zip(two_mass_data.TRUTH.items(), factors, strict=True)
            }
            seconds, cost, count = timed(lambda start=start, way=way: way(start))  # type: ignore[misc]
            gap = abs(cost - best) / SIGMA**2 / data.y.size
            cells.append(f"{1e3 * seconds:.1f} ms ({count}){'' if gap < 1e-5 else ' FAILED'}")
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
