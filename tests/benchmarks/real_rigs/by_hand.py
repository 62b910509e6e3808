"""Fit rigs by hand and keep what was found: python tests/benchmarks/real_rigs/by_hand.py [NAME ...]"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from rigs_common import HERE, NAMES, rig

KEPT = HERE / "by_hand.json"


def kept() -> dict[str, Any]:
    """Rig -> what was fitted by hand: date, CPU seconds, structure -> parameters, rmse (SI) on estimation and fresh."""
    return dict(json.loads(KEPT.read_text())) if KEPT.exists() else {}


def main(names: list[str]) -> None:
    for name in names or NAMES:
        begun = time.process_time()
        found = rig(name).by_hand()
        entry = {
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "cpu_s": round(time.process_time() - begun, 1),
            "structures": found,
        }
        whole = kept() | {name: entry}
        fresh = KEPT.with_suffix(".new")
        fresh.write_text(json.dumps(dict(sorted(whole.items())), indent=1) + "\n")
        fresh.replace(KEPT)
        for structure, one in found.items():
            print(f"{name:20} {structure:28} {one['estimation']:.4g} {one['fresh']:.4g} {one['parameters']}")


if __name__ == "__main__":
    main(sys.argv[1:])
