"""What becomes of each small model, as a dated Markdown table; names of models as arguments choose some of them.

OPENBLAS_NUM_THREADS=1 python tests/foreign/small_table.py --write
"""

from __future__ import annotations

import datetime
import platform
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from small_models import CASES
from small_outcome import Outcome, recovered, simulated

TABLE = Path(__file__).parents[1] / "benchmarks" / "SMALL_MODELS.md"


def main(arguments: list[str]) -> None:
    """Print the table; with --write keep it."""
    warnings.simplefilter("ignore")
    rows, count = [], Counter[str]()
    for name in [name for name in arguments if name in CASES] or list(CASES):
        begun = time.process_time()
        outcomes: list[Outcome] = [simulated(CASES[name]), recovered(CASES[name])]
        spent = time.process_time() - begun
        cells = [f"{outcome.kind}: {outcome.detail}".replace("|", "/")[:260] for outcome in outcomes]
        count.update(outcome.kind for outcome in outcomes)
        rows.append(f"| {name} | {cells[0]} | {cells[1]} | {spent:.1f} s |")
        print(rows[-1], flush=True)
    told = ", ".join(f"{kind} {number}" for kind, number in count.most_common())
    lines = [
        "# Small models, as a new user writes them",
        "",
        f"{datetime.date.today()}, `python tests/foreign/small_table.py --write`; "
        f"{platform.machine()}, one thread.",
        "",
        "Simulated: to 1e-5 of the largest value of SciPy's. Recovered: one parameter from noise of 0.2 % of the",
        "output's range, within three of its standard errors, and these within a factor of three of the expected ones.",
        "",
        f"Outcomes: {told}.",
        "",
        "| model | simulated | recovered | CPU |",
        "|---|---|---|---|",
        *rows,
    ]
    print(told)
    if "--write" in arguments:
        TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
