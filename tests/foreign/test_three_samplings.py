"""Fits at three samplings of one system agree with each other and with the truth within 0.2 standard errors."""

import numpy as np
import pytest
from three_samplings import COUNT, LAST, SIGMA, TRUE, fits, samplings

SPRINGS = [
    pytest.param(0.0, id="linear", marks=pytest.mark.slow),
    pytest.param(20.0, id="hardening spring"),
]


@pytest.mark.parametrize("hardening", SPRINGS)
@pytest.mark.parametrize("name", ["equal", "jittered", "teeth"])
def test_meets_the_truth(name, hardening):
    """Without noise what is left is the arithmetic."""
    fit = fits(hardening)[name]
    assert fit.status == "converged"
    for key, true in TRUE.items():
        found = fit.estimates[key]
        assert abs(found.value - true) < 0.2 * found.stderr, (
            f"{key}: {found.value} ± {found.stderr} for {true}"
        )


@pytest.mark.parametrize("hardening", SPRINGS)
def test_agree_with_each_other(hardening):
    made = fits(hardening)
    for key in TRUE:
        values = [fit.estimates[key].value for fit in made.values()]
        errors = [fit.estimates[key].stderr for fit in made.values()]
        assert np.ptp(values) < 0.2 * min(errors)
        # The same information, up to where the samples happen to lie.
        assert max(errors) < 1.5 * min(errors)
        assert min(errors) > 1e-4 * TRUE[key] * SIGMA


def test_samplings_are_what_they_say():
    """As many samples over the same time; the teeth come at twice the speed at times."""
    for name, time in samplings().items():
        assert len(time) == COUNT
        np.testing.assert_allclose(time[[0, -1]], [0, LAST], atol=1e-9)
        steps = np.diff(time)
        spread = steps.max() / steps.min()
        assert spread < 1.001 if name == "equal" else spread > 2
