"""A fit that ended a step short of an optimum goes on by itself."""

import importlib
from types import SimpleNamespace

import pytest

from casadi_engine.estimation.ipopt import ONE_STEP

estimate = importlib.import_module("casadi_engine.estimation.estimate")
SHORT = f"not converged: {ONE_STEP} would still lower chi-squared by 0.04, more than 0.001"


def ended(status):
    return SimpleNamespace(status=status, converged=status == "converged", parameters=None)


@pytest.mark.parametrize(
    ("first", "further", "runs", "status"),
    [
        ("converged", [], 0, "converged"),
        (SHORT, ["converged"], 1, "converged"),
        (SHORT, [SHORT, SHORT, "converged"], 3, "converged"),
        (SHORT, [SHORT] * 20, estimate._FURTHER, SHORT),
        (SHORT, ["not converged: another word"], 1, SHORT),
    ],
)
def test_it_goes_on_from_there_until_it_has_converged(first, further, runs, status):
    """Along a ridge 11 of 34 fits of a thermistor had ended so, and going on from there as they said mended them."""
    left, warm = list(further), []

    def run(changed):
        warm.append(changed["warm"])
        return ended(left.pop(0))

    begun = ended(first)
    found = estimate._gone_on(begun, run)
    assert found.status == status
    assert len(warm) == runs
    assert warm[:1] == [begun][:runs]
