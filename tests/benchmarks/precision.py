"""Is the claimed error the real one? B6 (six records, six tied parameters) for many seeds of the noise.

    python precision.py SOLVER SEEDS

Every seed is another noise on the same engine; starts ±20 %. Prints one JSON line: for each parameter the Cramér-Rao
bound, the scatter and the mean error found, all relative in %, and the joint chi-squared of the errors in the
covariance claimed by each fit, which should be that of seeds × parameters degrees of freedom.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import opponent_spectral
import ours
from cases import Case, case_b6
from chain import Array
from scipy.stats import chi2
from yardstick import covariance_bound

FIRST_SEED = 100  # the records of the timed problems have seed 1


def fit(solver: str, case: Case, start: Array) -> tuple[Array, Array, str]:
    """Values, claimed covariance and status."""
    if solver == "ours":
        found = ours.estimate(case, start)
        order = [found.free.index(name) for name in case.free]
        return ours.values_of(case, found), found.covariance[np.ix_(order, order)], found.status
    values = opponent_spectral.fit(case, start, lambda: None)["values"]
    return values, opponent_spectral.covariance(case, values), "converged"


def main() -> None:
    solver, seeds = sys.argv[1], int(sys.argv[2])
    errors, total, worst, statuses, seconds = [], [], 0.0, [], []
    for seed in range(seeds):
        case = case_b6(FIRST_SEED + seed)
        begun = time.process_time()
        values, covariance, status = fit(solver, case, case.start(seed))
        seconds.append(time.process_time() - begun)
        error = values - case.true_values
        total.append(float(error @ np.linalg.solve(covariance, error)))
        worst = max(worst, float(np.abs(error / np.sqrt(np.diag(covariance))).max()))
        errors.append(error / case.true_values)
        statuses.append(status)
    bound = np.sqrt(np.diag(covariance_bound(case))) / case.true_values
    relative = np.array(errors)
    freedom = relative.size
    answer = {
        "free": list(case.free),
        "bound": (100 * bound).tolist(),
        "scatter": (100 * np.sqrt((relative**2).mean(axis=0))).tolist(),
        "mean": (100 * relative.mean(axis=0)).tolist(),
        "chi2": float(np.sum(total)),
        "freedom": freedom,
        "p": float(chi2.sf(np.sum(total), freedom)),
        "each": total,
        "worst": worst,
        "converged": statuses.count("converged"),
        "seeds": seeds,
        "seconds": float(np.median(seconds)),
    }
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
