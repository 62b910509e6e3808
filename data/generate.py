"""Make the records of this folder, or check that they are what the simulator makes.

python data/generate.py                 write every record and SHA256SUMS
python data/generate.py --check         make every record in memory and compare, write nothing
python data/generate.py --only 1200     only records whose path holds this text (also with --check)
"""

import argparse
import sys
import time
from pathlib import Path

from simulator.files import compare, compress, read_hashes, sha256, to_text, write_hashes
from simulator.records import PLANS, Plan

FOLDER = Path(__file__).resolve().parent


def write(plan: Plan) -> str:
    """Write one record and note its hash in SHA256SUMS; returns the hash."""
    content = compress(to_text(plan.record()))
    path = FOLDER / plan.path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    hashes = read_hashes(FOLDER) | {plan.path: sha256(content)}
    write_hashes(FOLDER, {p.path: hashes[p.path] for p in PLANS if p.path in hashes})
    return f"{len(content) / 1024:.0f} kB, sha256 {sha256(content)[:16]}..."


def check(plan: Plan) -> tuple[bool, str]:
    """Compare the kept file with its listed hash and with a freshly made record."""
    path = FOLDER / plan.path
    if not path.exists():
        return False, "the file is missing"
    kept = path.read_bytes()
    if read_hashes(FOLDER).get(plan.path) != sha256(kept):
        return False, "the file is not the one listed in SHA256SUMS"
    return compare(compress(to_text(plan.record())), kept)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    parser.add_argument("--only", default="", metavar="TEXT", help="only records whose path holds TEXT")
    options = parser.parse_args(arguments)
    plans = [plan for plan in PLANS if options.only in plan.path]
    if not plans:
        parser.error(f"no record's path holds {options.only!r}; there are {', '.join(p.path for p in PLANS)}")
    failed = 0
    for plan in plans:
        began = time.perf_counter()
        good, message = check(plan) if options.check else (True, write(plan))
        failed += not good
        print(
            f"{'ok  ' if good else 'FAIL'} {plan.path}: {message} ({time.perf_counter() - began:.1f} s)",
            flush=True,
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
