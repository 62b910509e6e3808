"""What the posterior's constants do when they are halved and doubled: problems A and B, one simulation each.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/posterior_constants.py [NAME ...]

NAME : A, B (posterior_study.py). Prints how far medians move in standard deviations, the ratio of the spreads, the
change of the log evidence, and evaluations.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from posterior_study import drawn, fit_of  # noqa: E402

import casadi_engine as ce  # noqa: E402
from casadi_engine.errors import CasadiEngineError  # noqa: E402

CONSTANTS = {
    "importance": ("ROUNDS", "EACH", "WORTH", "ENOUGH"),
    "mixture": ("FREEDOM", "_GUARD", "_WIDER"),
    "valley": ("STEP", "HOLDS", "DEPTH"),
    "modes": ("WEAK", "IDLE", "_WIDER", "_SAME", "_FAR"),
    "left_out": ("LOOKED_AT", "FELT"),
    "drawing": ("HIGHER", "SCATTER", "FEW"),
    "states": ("WIDTHS", "_ALONE", "_STILL"),
    "alike": ("_COMPARED", "_STATES", "_FEWEST"),
    "box": ("_NEAR", "_OFF"),
    "posterior": ("WIDE", "NEARER"),
}


def changed(value: Any, factor: float) -> Any:
    """Half or twice a constant; of the widths of a prior the largest one."""
    if isinstance(value, np.ndarray):
        return np.asarray(np.geomspace(value[0], factor * value[-1], len(value)))
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def row(words: str, found: Any, base: Any) -> str:
    """One line of the table."""
    spread = {name: base[name].std() for name in base.names}
    moved = max(abs(found.median[name] - base.median[name]) / spread[name] for name in base.names)
    ratio = [found[name].std() / spread[name] for name in base.names]
    return (
        f"| {words} | {moved:.2f} | {min(ratio):.2f} to {max(ratio):.2f} | "
        f"{found.log_evidence - base.log_evidence:+.2f} | {found.evaluations} |"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=["A", "B"])
    for name in parser.parse_args().names:
        case, _ = drawn(name, 0)
        fit = fit_of(case, 0)
        base = ce.posterior(fit)
        print(f"\n| {name} | medians move [sd] | spreads | log evidence | evaluations |\n" + "|---" * 5 + "|")
        print(row("as it is", base, base), row("another seed", ce.posterior(fit, seed=1), base), sep="\n")
        for module, constants in CONSTANTS.items():
            room = import_module(f"casadi_engine.posterior.{module}")
            for constant in constants:
                value = getattr(room, constant)
                for factor in (0.5, 2.0):
                    setattr(room, constant, changed(value, factor))
                    words = f"`{module}.{constant}` × {factor:g}"
                    try:
                        print(row(words, ce.posterior(fit), base), flush=True)
                    except CasadiEngineError as error:
                        print(f"| {words} | refused: {error.problem} | | | |", flush=True)
                setattr(room, constant, value)


if __name__ == "__main__":
    main()
