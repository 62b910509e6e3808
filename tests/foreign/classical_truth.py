"""Make classical_truth.json again: the stiff problems by SciPy's Radau, held against the published end values.

OPENBLAS_NUM_THREADS=1 python tests/foreign/classical_truth.py
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from classical import STIFF, TRUTH


def main() -> None:
    """Solve, compare with the published values, write."""
    made = {}
    for problem in STIFF:
        begun = time.process_time()
        y = problem.solved(problem.time)
        off = np.abs(y[:, -1] - np.array(problem.published)) / np.abs(y).max(axis=1)
        print(f"{problem.name}: {off.max():.1e} from the published end, {time.process_time() - begun:.1f} s")
        made[problem.name] = [[float(f"{value:.14g}") for value in row] for row in y]
    TRUTH.write_text(json.dumps(made, separators=(",", ":")).replace("]],", "]],\n") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
