"""Make the records of this folder, or check that they are what the simulator makes.

python data/generate.py                 write every record and SHA256SUMS
python data/generate.py --check         make every record in memory and compare, write nothing
python data/generate.py --only 1200     only records whose path holds this text (also with --check)
"""

import argparse
import sys
import time
from pathlib import Path

from simulator.files import (
    compare,
    compress,
    read_hashes,
    read_starts,
    sha256,
    starts_agree,
    to_text,
    write_hashes,
    write_starts,
)
from simulator.records import PLANS, Plan, start_of

FOLDER = Path(__file__).resolve().parent


def write(plan: Plan) -> str:
    """Write one record, note its hash in SHA256SUMS and its start in starts.json; returns the hash."""
    made = plan.simulated()
    content = compress(to_text(plan.columns(made)))
    path = FOLDER / plan.path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    hashes = read_hashes(FOLDER) | {plan.path: sha256(content)}
    write_hashes(FOLDER, {p.path: hashes[p.path] for p in PLANS if p.path in hashes})
    starts = read_starts(FOLDER) | {plan.path: start_of(made)}
    write_starts(FOLDER, {p.path: starts[p.path] for p in PLANS if p.path in starts})
    return f"{len(content) / 1024:.0f} kB, sha256 {sha256(content)[:16]}..."


def check(plan: Plan) -> tuple[bool, str]:
    """Compare the kept file with its listed hash, its start with a fresh warm-up, and it with a record made from there.

    A warm-up's steps are too rough to be repeated to the last digit on another processor; a record's are not.
    """
    path = FOLDER / plan.path
    if not path.exists():
        return False, "the file is missing"
    kept = path.read_bytes()
    if read_hashes(FOLDER).get(plan.path) != sha256(kept):
        return False, "the file is not the one listed in SHA256SUMS"
    start = read_starts(FOLDER).get(plan.path)
    if start is None:
        return False, "starts.json does not list its start"
    good, near = starts_agree(plan.warmed_up(), start)
    if not good:
        return False, near
    same, message = compare(compress(to_text(plan.record(start))), kept)
    return same, f"{message}; {near}"


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
