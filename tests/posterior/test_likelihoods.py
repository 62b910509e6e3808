"""Likelihoods with the initial states integrated out, against the closed form of one inertia and each other."""

from importlib import import_module

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.posterior.laplace_likelihood import LaplaceLikelihood
from casadi_engine.posterior.modal import Transients, least_squares
from casadi_engine.posterior.spectral_likelihood import SpectralLikelihood
from casadi_engine.posterior.target import Target

POINTS = [(0.4, 0.5), (0.41, 0.49), (0.35, 0.6), (0.8, 0.01)]


def closed_form(record, inertia, damper, sigma):
    """Chi-squared of the run-up, its initial speed at its best."""
    time, speed = record["omega"].time, record["omega"].values
    seen = np.isfinite(speed)
    decay = np.exp(-damper / inertia * time)
    rest = (speed - 2.0 / damper * (1 - decay))[seen]
    free = decay[seen] / np.linalg.norm(decay[seen])
    return float(rest @ rest - (free @ rest) ** 2) / sigma**2


@pytest.mark.parametrize("gap", [False, True])
def test_chi_squared_is_that_of_the_closed_form(run_up, gap):
    record = run_up(gap=gap)
    target = Target(ce.estimate(ce.one_inertia(), record, noise=ce.Noise(omega=0.02), progress=False))
    assert isinstance(target.likelihood, LaplaceLikelihood if gap else SpectralLikelihood)
    found = [target.likelihood.full(target.coordinates.of(np.array(z)), np.array([0.02])) for z in POINTS]
    expected = [-0.5 * closed_form(record, *z, 0.02) for z in POINTS]
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-6)


def test_a_shaft_has_the_same_likelihood_in_samples_and_in_bins(two_masses):
    fit, target = two_masses
    shots = SingleShots.over(target.search)
    first = {
        record.experiment.name: np.array([one.value for one in fit.initial[record.experiment.name].values()])
        / record.scale
        for record in target.search.records
    }
    held = {name: np.zeros(len(states), dtype=bool) for name, states in first.items()}
    samples = LaplaceLikelihood(shots, first, target.start, held)
    sigma, random = np.array([0.1]), np.random.default_rng(0)
    points = [target.start, *(target.start + 0.01 * random.standard_normal(target.nv) for _ in range(3))]
    in_bins = np.array([target.likelihood.full(v, sigma) for v in points])
    in_samples = np.array([samples.value(v, sigma) for v in points])
    np.testing.assert_allclose(np.diff(in_bins), np.diff(in_samples), rtol=1e-5, atol=1e-4)
    one, two = target.likelihood.squares(points[1], sigma), samples.squares(points[1], sigma)
    assert one.cost == pytest.approx(two.cost, rel=1e-6)
    np.testing.assert_allclose(one.gradient, two.gradient, rtol=1e-3, atol=1e-3 * np.abs(two.gradient).max())


def test_few_bins_keep_the_likelihood_about_the_optimum(two_masses):
    _, target = two_masses
    sigma, random = np.array([0.1]), np.random.default_rng(1)
    likelihood = SpectralLikelihood(target.search.records, target.nv)
    spread = np.linalg.cholesky(np.linalg.inv(likelihood.squares(target.start, sigma).matrix))
    likelihood.choose([target.start], sigma, 0.02)
    used, whole = likelihood.bins
    assert used < whole / 20
    points = [target.start + spread @ random.standard_normal(target.nv) for _ in range(30)]
    left = np.array([likelihood.full(v, sigma) - likelihood.value(v, sigma) for v in points])
    assert np.abs(left).max() < 0.5
    assert np.std([likelihood.value(v, sigma) for v in points]) > 5 * left.std()
    # a larger noise level makes the bins that are left out more likely, as it does the others
    wide = [
        likelihood.full(target.start, s * sigma) - likelihood.value(target.start, s * sigma) for s in (1, 1.1)
    ]
    assert wide[0] == pytest.approx(wide[1], abs=0.05)


def test_poles_that_coincide_are_worked_on_plainly(two_masses, monkeypatch):
    _, target = two_masses
    record = target.search.records[0]
    discrete = record.propagator.discretisation(target.start, 0)
    likelihood = SpectralLikelihood([record], target.nv)
    bins = likelihood._bins(0, target.start, whole=True)
    sigma = np.array([0.1])
    one = Transients(discrete, bins, sigma)
    monkeypatch.setattr(import_module("casadi_engine.posterior.modal"), "_SOUND", 0.0)
    two = Transients(discrete, bins, sigma)
    values = [least_squares(own.rows.reshape(3, -1), own.rest.ravel()) for own in (one, two)]
    assert values[0] == pytest.approx(values[1], rel=1e-8)
    np.testing.assert_allclose(np.sort_complex(one.poles), np.sort_complex(two.poles), rtol=1e-8)


def test_what_cannot_be_evaluated_has_no_likelihood(two_masses):
    _, target = two_masses
    assert target.likelihood.full(np.full(target.nv, np.nan), np.array([0.1])) == -np.inf
    assert target.likelihood.squares(np.full(target.nv, np.nan), np.array([0.1])) is None


def test_least_squares_without_rows_and_with_twins():
    rest = np.array([3.0, 4.0, 0.0])
    assert least_squares(np.zeros((0, 3)), rest) == 25.0
    assert least_squares(np.array([[1.0, 0, 0], [1.0, 0, 0], [0, 0, 0]]), rest) == pytest.approx(16.0)
    with pytest.raises(FloatingPointError):
        least_squares(np.array([[np.nan, 0, 0]]), rest)
