"""The tails are those of scipy.stats, at the ends of their range too."""

import numpy as np
import pytest
from scipy import stats

from casadi_engine import distributions as ours

Z = np.array([-40.0, -3.0, -0.1, 0.0, 1.0, 6.0, 38.0, np.inf, np.nan])
P = np.array([0.0, 1e-300, 1e-12, 0.05, 0.5, 0.95, 1.0])
VALUES = np.array([-1e-12, 0.0, 1e-9, 0.3, 1.0, 5.0, 80.0, np.inf, np.nan])


@pytest.mark.parametrize("dof", [1, 2, 7, 1000])
@pytest.mark.parametrize("below", [1.0, 12.5, 1e5])
def test_tails_and_their_inverses(dof, below):
    pairs = {
        "normal sf": (ours.normal_sf(Z), stats.norm.sf(Z)),
        "normal isf": (ours.normal_isf(P), stats.norm.isf(P)),
        "chi2 sf": (ours.chi2_sf(VALUES, dof), stats.chi2.sf(VALUES, dof)),
        "chi2 isf": (ours.chi2_isf(P, dof), stats.chi2.isf(P, dof)),
        "f sf": (ours.f_sf(VALUES, dof, below), stats.f.sf(VALUES, dof, below)),
        "f isf": (ours.f_isf(P[3:], dof, below), stats.f.isf(P[3:], dof, below)),
        "t sf": (ours.t_sf(Z, dof), stats.t.sf(Z, dof)),
        "beta sf": (
            ours.beta_sf(VALUES, dof / 2, below / 2),
            stats.beta.sf(VALUES, dof / 2, below / 2),
        ),
    }
    for name, (mine, theirs) in pairs.items():
        np.testing.assert_allclose(mine, theirs, rtol=1e-11, err_msg=name)


def test_nothing_is_said_without_degrees_of_freedom():
    assert np.isnan(ours.chi2_sf(3.0, 0))
    assert np.isnan(ours.beta_sf(0.3, 0.5, 0.0))
