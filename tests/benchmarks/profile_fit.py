"""Where the package spends its time on a problem: the functions with the most time of their own, and with their calls.

python profile_fit.py CASE [--start 0] [--lines 25]
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time

import ours
from worker import case_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--lines", type=int, default=25)
    options = parser.parse_args()
    case = case_of(options.case)
    ours.experiments(case)
    ours.estimate(case, case.start(1000))
    begun = time.process_time()
    found = ours.estimate(case, case.start(options.start))
    spent = time.process_time() - begun
    print(f"{found.status}, {found.iterations} iterations, {spent:.2f} s without the profiler")
    profile = cProfile.Profile(time.process_time)
    profile.runcall(ours.estimate, case, case.start(options.start))
    stats = pstats.Stats(profile).strip_dirs()
    stats.sort_stats("tottime").print_stats(options.lines)
    stats.sort_stats("cumulative").print_stats(options.lines)


if __name__ == "__main__":
    main()
