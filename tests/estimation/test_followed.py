"""Whether a fit is lost that follows little of an output."""

from types import SimpleNamespace as stub

import numpy as np
import pytest

from casadi_engine.estimation.followed import lost

NOISE = np.random.default_rng(0).standard_normal((3, 51))


def fit(last=1.0, *, messages=(), records=3, seen=90.0, sigma=(0.04, True)):
    """A fit of so many records of 51 samples, of the last of which little is followed."""
    sizes = [*[1.0] * (records - 1), last]
    traces = {
        f"r{k}": {"n": stub(residual=0.04 * size * NOISE[k], mask=np.ones(51, dtype=bool))}
        for k, size in enumerate(sizes)
    }
    shares = {f"r{k}": {"n": {"simulation": seen}} for k in range(records - 1)}
    shares[f"r{records - 1}"] = {"n": {"simulation": 60.0}}
    return stub(fit_percent=shares, traces=traces, messages=messages, noise={"n": sigma})


@pytest.mark.parametrize(
    ("own", "is_lost"),
    [
        ({}, False),  # as small as what is left of the others
        ({"last": 1.6}, True),
        ({"messages": ("the residual of r2/n is not white (neighbours correlate by 0.9)",)}, True),
        ({"seen": 60.0}, True),  # none is followed
        ({"records": 1}, True),  # too few samples
        ({"records": 1, "sigma": (0.04, False)}, False),  # as small as was stated
    ],
    ids=str,
)
def test_white_residuals_as_small_as_those_of_records_that_are_followed_are_noise(own, is_lost):
    assert bool(lost(fit(**own))) is is_lost
