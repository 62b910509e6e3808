"""The prior: a density that integrates to one, and no density where there are no bounds."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import PosteriorError
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.parameters import compile
from casadi_engine.posterior.prior import Prior


def made(**changes):
    pars = ce.one_inertia().parameters()
    for name, change in changes.items():
        pars[name].set(**change)
    pmap = compile(pars, ("J_eng", "C_eng"))
    coordinates = Coordinates(pmap)
    return Prior(pmap, coordinates), coordinates


def integral(prior, low, high, count=100):
    grid = [np.linspace(a, b, count + 1) for a, b in zip(low, high, strict=True)]
    middle = [0.5 * (one[1:] + one[:-1]) for one in grid]
    cell = np.prod([one[1] - one[0] for one in grid])
    return cell * np.exp(prior.log_density(np.array([(a, b) for a in middle[0] for b in middle[1]]))).sum()


def test_flat_between_bounds():
    prior, coordinates = made(J_eng={"min": 0.1, "max": 1.0}, C_eng={"min": 0.0, "max": 2.0})
    one, two = prior.log_density(np.array([coordinates.of(np.array(z)) for z in ((0.2, 0.0), (0.9, 1.9))]))
    assert one == two
    assert prior.log_density(coordinates.of(np.array([0.05, 1.0]))[None])[0] == -np.inf
    assert integral(prior, prior.low, prior.high, 40) == pytest.approx(1.0)
    assert prior.words["J_eng"] == "flat in the logarithm, 0.1 to 1"
    assert prior.words["C_eng"] == "flat in the value, 0 to 2"


@pytest.mark.parametrize("bounds", [{"min": 1e-6, "max": np.inf}, {"min": 0.41, "max": 0.6}])
def test_a_normal_prior_is_normal_in_the_value_and_cut_at_the_bounds(bounds):
    prior, coordinates = made(
        J_eng={"value": 0.42, "prior": (0.4, 0.05), **bounds}, C_eng={"min": 0.0, "max": 2.0}
    )
    low = np.maximum(prior.low, coordinates.of(np.array([0.1, 0.0])))
    high = np.minimum(prior.high, coordinates.of(np.array([0.8, 2.0])))
    assert integral(prior, low, high) == pytest.approx(1.0, rel=5e-3)
    at = coordinates.of(np.array([0.5, 1.0]))
    other = coordinates.of(np.array([0.45, 1.0]))
    expected = -0.5 * (2.0**2 - 1.0**2) + np.log(0.5 / 0.45)
    assert np.diff(prior.log_density(np.array([other, at])))[0] == pytest.approx(expected)
    assert prior.words["J_eng"] == "normal, 0.4 ± 0.05"


def test_shares_of_the_prior_between_values():
    prior, _ = made(J_eng={"min": 0.1, "max": 1.0}, C_eng={"min": 0.0, "max": 2.0})
    assert prior.share(0, 0.1, 1.0) == pytest.approx(1.0)
    assert prior.share(0, 0.1, np.sqrt(0.1)) == pytest.approx(0.5)
    assert prior.share(1, 0.5, 1.0) == pytest.approx(0.25)
    prior, _ = made(J_eng={"value": 0.42, "prior": (0.4, 0.05)}, C_eng={"min": 0.0, "max": 2.0})
    assert prior.share(0, 0.35, 0.45) == pytest.approx(0.6827, abs=1e-4)


def test_the_prior_of_a_tied_parameter_holds_what_it_is_tied_to():
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(min=0.1, max=1.0)
    pars.tie("C_eng", "2*J_eng")
    pars["C_eng"].set(prior=(1.0, 0.1))
    pmap = compile(pars, ("J_eng", "C_eng"))
    coordinates = Coordinates(pmap)
    prior = Prior(pmap, coordinates)
    best, off = prior.log_density(np.array([coordinates.of(np.array([z])) for z in (0.5, 0.55)]))
    assert best - off == pytest.approx(0.5)


def test_marginals_integrate_to_one():
    prior, coordinates = made(J_eng={"prior": (0.4, 0.05)}, C_eng={"min": 0.0, "max": 2.0})
    inertia = np.geomspace(0.1, 1.0, 2001)
    density = prior.marginal(0, inertia)
    assert np.trapezoid(density, np.log(inertia)) == pytest.approx(1.0, rel=1e-3)
    damper = np.linspace(0, 2.0, 5)
    assert np.trapezoid(prior.marginal(1, damper), damper / coordinates.scale[1]) == pytest.approx(1.0)


def test_no_bounds_no_posterior():
    with pytest.raises(
        PosteriorError, match="without bounds have no posterior; seen: J_eng from 1e-06 to inf"
    ):
        made(J_eng={"max": np.inf})
    with pytest.raises(PosteriorError, match="C_eng from -inf to 2"):
        made(C_eng={"min": -np.inf, "max": 2.0})
