"""The classical test problems as a dated table: error, steps and CPU time beside SciPy's LSODA.

    OPENBLAS_NUM_THREADS=1 python tests/foreign/classical_table.py --write

CPU time of one call (`ce.simulate` builds its functions anew each time; the second number is the call alone that
SciPy makes with a right-hand side in NumPy). LSODA runs at a relative 1e-8 with absolute tolerances of 1e-10 of each
component's largest value, about what 1e-5 along the whole run asks of it.
"""

from __future__ import annotations

import datetime
import platform
import sys
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).parent))
from classical import LIMIT, PROBLEMS, Classical, relative_error, simulated

TABLE = Path(__file__).parents[1] / "benchmarks" / "CLASSICAL.md"


def lsoda(problem: Classical) -> tuple[float, int, float]:
    """SciPy's LSODA: error, steps and CPU seconds."""
    truth = problem.truth(problem.time)
    size = np.abs(truth).max(axis=1)
    begun = time.process_time()
    answer = solve_ivp(
        problem.numeric, (problem.time[0], problem.time[-1]), problem.start, method="LSODA", t_eval=None,
        dense_output=True, rtol=1e-8, atol=1e-10 * size,
    )  # fmt: skip
    spent = time.process_time() - begun
    return relative_error(answer.sol(problem.time), truth), len(answer.t) - 1, spent


def steps_of(answer: object) -> str:
    """Integration steps, if the run says how many it took."""
    history = getattr(getattr(answer, "run", None), "history", ())
    for step in reversed(history):
        for key in ("steps", "integrator"):
            if key in step.arguments:
                return str(step.arguments[key])
    return "not told"


def row(problem: Classical) -> str:
    """One line of the table."""
    begun = time.process_time()
    answer = simulated(problem)
    spent = time.process_time() - begun
    error, steps, other = lsoda(problem)
    if answer.refused is not None:
        found = f"refused: {answer.refused[:150]}".replace("|", "/")
    else:
        found = f"{answer.error:.1e}" if answer.error <= LIMIT else f"**{answer.error:.1e}**"
    return (
        f"| {problem.name} | {len(problem.start)} | {found} | {steps_of(answer)} | {spent:.3f} s "
        f"| {error:.1e} | {steps} | {other:.3f} s |"
    )


def main(arguments: list[str]) -> None:
    """Print the table; with --write keep it."""
    simulated(PROBLEMS["A1"])  # the first call of a process loads libraries
    names = [name for name in arguments if name in PROBLEMS] or list(PROBLEMS)
    lines = [
        "# The classical test problems",
        "",
        f"{datetime.date.today()}, `python tests/foreign/classical_table.py --write`; "
        f"{platform.machine()}, one thread.",
        "",
        "Error: largest along the run, relative to each component's largest value; above 1e-5 in bold.",
        "",
        "| problem | states | error | steps | CPU | LSODA: error | steps | CPU |",
        "|---|---|---|---|---|---|---|---|",
        *(row(PROBLEMS[name]) for name in names),
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if "--write" in arguments:
        TABLE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
