"""Likelihoods with the initial states integrated out, against the closed form of one inertia and each other."""

from importlib import import_module

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.laplace_likelihood import LaplaceLikelihood
from casadi_engine.posterior.modal import Transients
from casadi_engine.posterior.spectral_likelihood import SpectralLikelihood
from casadi_engine.posterior.states import StatePrior
from casadi_engine.posterior.target import Target

WIDE = [StatePrior(np.zeros((1, 3)), 10 * np.eye(3)[None])]
POINTS = [(0.4, 0.5), (0.41, 0.49), (0.35, 0.6), (0.8, 0.01)]


@pytest.mark.parametrize("gap", [False, True])
def test_it_is_that_of_the_closed_form(run_up, closed_form, gap):
    record = run_up(gap=gap)
    target = Target(ce.estimate(ce.one_inertia(), record, noise=ce.Noise(omega=0.02), progress=False))
    assert isinstance(target.likelihood, LaplaceLikelihood if gap else SpectralLikelihood)
    levels = (0.02, 0.03, 0.02, 0.1)
    points = np.array([target.coordinates.of(np.array(z)) for z in POINTS])
    found = target.likelihood.full(points, np.array(levels)[:, None])
    expected = [
        closed_form(record, *z, sigma, target.likelihood) for z, sigma in zip(POINTS, levels, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_shaft_has_the_same_likelihood_in_samples_and_in_bins(two_masses):
    fit, target = two_masses
    shots = SingleShots.over(target.search)
    first = {
        record.experiment.name: np.array([one.value for one in fit.initial[record.experiment.name].values()])
        / record.scale
        for record in target.search.records
    }
    held = {name: np.zeros(len(states), dtype=bool) for name, states in first.items()}
    wide = [StatePrior(np.zeros((1, 3)), 1e3 * np.eye(3)[None])]
    samples = LaplaceLikelihood(shots, first, target.start, held, wide)
    bins = SpectralLikelihood(target.search.records, target.start, wide)
    sigma, random = np.array([0.1]), np.random.default_rng(0)
    points = [target.start, *(target.start + 0.01 * random.standard_normal(target.nv) for _ in range(3))]
    in_bins = np.array([bins.squares(v, sigma).cost for v in points])
    in_samples = np.array([samples.squares(v, sigma).cost for v in points])
    np.testing.assert_allclose(in_bins, in_samples, rtol=1e-5)
    one, two = bins.squares(points[1], sigma), samples.squares(points[1], sigma)
    assert one.cost == pytest.approx(two.cost, rel=1e-6)
    np.testing.assert_allclose(one.gradient, two.gradient, rtol=1e-3, atol=1e-3 * np.abs(two.gradient).max())


def test_few_bins_keep_the_likelihood_about_the_optimum(two_masses):
    _, target = two_masses
    sigma, random = np.array([0.1]), np.random.default_rng(1)
    likelihood = SpectralLikelihood(target.search.records, target.start, WIDE)
    spread = np.linalg.cholesky(np.linalg.inv(likelihood.squares(target.start, sigma).matrix))
    likelihood.choose([target.start], sigma, 0.02)
    used, whole = likelihood.bins
    assert used < whole / 20
    points = [target.start + spread @ random.standard_normal(target.nv) for _ in range(30)]
    points, sigmas = np.array(points), np.full((30, 1), 0.1)
    left = likelihood.full(points, sigmas) - likelihood.value(points, sigmas)
    assert np.abs(left).max() < 0.5
    assert np.std(likelihood.value(points, sigmas)) > 5 * left.std()
    # a larger noise level makes the bins that are left out more likely, as it does the others
    at, levels = np.array([target.start, target.start]), np.array([[0.1], [0.11]])
    wide = likelihood.full(at, levels) - likelihood.value(at, levels)
    assert wide[0] == pytest.approx(wide[1], abs=0.05)


def test_it_counts_the_directions_of_states_that_the_prior_tells(two_masses):
    _, target = two_masses
    sigma = np.array([0.1])
    for width, untold in ((10.0, 0), (1e-9, 3)):
        narrow = [StatePrior(np.zeros((1, 3)), width * np.eye(3)[None])]
        likelihood = SpectralLikelihood(target.search.records, target.start, narrow)
        assert likelihood.untold(target.start, sigma) == (untold, 3)


def test_poles_that_coincide_are_worked_on_plainly(two_masses, monkeypatch):
    _, target = two_masses
    record = target.search.records[0]
    core, sigma = record.propagator.core, np.array([[0.1]] * 2)
    basis = SpectralLikelihood([record], target.start, WIDE)._basis(0, target.start, whole=True)
    at, found = np.array([target.start, target.start + 0.1]), []
    for sound in (1e7, 0.0):
        monkeypatch.setattr(import_module("casadi_engine.posterior.modal"), "_SOUND", sound)
        model = Transients(core, at, sigma)
        found.append((WIDE[0].integral(*model.at(basis), model.turn)[0], model.radius))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-8)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-8)


def test_what_cannot_be_evaluated_has_no_likelihood(two_masses):
    _, target = two_masses
    assert target.likelihood.full(np.full((1, target.nv), np.nan), np.array([[0.1]])) == [-np.inf]
    assert target.likelihood.squares(np.full(target.nv, np.nan), np.array([0.1])) is None
