"""The last state of a record, by simulation and by a quadratic about the fit."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.posterior.last_state import LastStates, last_state
from casadi_engine.posterior.spectral_likelihood import SpectralLikelihood
from casadi_engine.posterior.states import StatePrior
from casadi_engine.posterior.target import Target


def test_a_record_leads_to_its_last_state(run_up):
    """One inertia under a constant torque that changes its sign behind the last sample, held until there."""
    fit = ce.estimate(ce.one_inertia(), run_up(), noise=ce.Noise(omega=0.02), progress=False)
    target = Target(fit)
    ahead, forced = last_state(target.search.records[0], target.start)
    inertia, damper = fit.values["J_eng"], fit.values["C_eng"]
    gone = np.exp(-damper / inertia * 2.0)
    np.testing.assert_allclose(ahead, [[gone]])
    np.testing.assert_allclose(forced * target.search.records[0].scale, [2.0 / damper * (1 - gone)])


def test_the_last_state_is_that_of_a_simulation(two_masses):
    """A shaft whose drives are joined by lines: sample by sample, the drives coming back."""
    fit, target = two_masses
    record = target.search.records[0]
    first = np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
    ahead, forced = last_state(record, target.start)
    discrete = record.propagator.discretisation(target.start[record.active], 0)
    drives = record.propagator.merged_drives(target.start[record.active]).value
    expected = first
    for here, there in zip(drives.T, [*drives.T[1:], -drives[:, 0]], strict=True):
        expected = discrete.f[0] @ expected + discrete.g0[0] @ here + discrete.g1[0] @ there
    np.testing.assert_allclose(ahead @ first + forced, expected, rtol=1e-9)


def test_it_follows_the_parameters(two_masses):
    """A quadratic through what simulations say, its slopes those of differences."""
    _, target = two_masses
    record, v = target.search.records[0], target.start
    first, sigma = np.array([1.2, 1.2, 0.1]), np.array([0.1])
    information = target.likelihood.squares(v, sigma).matrix
    found = LastStates.about(record, StatePrior(first[None], np.eye(3)[None]), v, information)
    spread = np.linalg.cholesky(np.linalg.inv(information))
    random = np.random.default_rng(3)

    def there(at):
        ahead, forced = last_state(record, at)
        return ahead @ first + forced

    points = v + (spread @ random.standard_normal((target.nv, 20))).T
    moved = np.array([there(at) - there(v) for at in points])
    error = found.moved(points) - moved
    assert np.abs(error).max() < 0.1 * np.abs(moved).max()
    straight = (points - v) @ found.slopes.T - moved
    assert np.abs(error).mean() < 0.5 * np.abs(straight).mean()
    side = 1e-5 * np.eye(target.nv)
    at = points[0]
    slopes = [(found.moved((at + e)[None])[0] - found.moved((at - e)[None])[0]) / 2e-5 for e in side]
    np.testing.assert_allclose(
        found.slopes_at(at).T, slopes, rtol=1e-6, atol=1e-9 * np.abs(found.slopes).max()
    )


def test_a_first_state_that_follows_is_in_the_sum(two_masses):
    _, target = two_masses
    record, v = target.search.records[0], target.start
    first, way = np.array([1.2, 1.2, 0.1]), np.arange(1.0, target.nv + 1)
    moved = StatePrior(first[None], np.eye(3)[None], follows=lambda at: first * float(way @ (at - v)))
    still = replace(moved, follows=None)
    information = 1e4 * np.eye(target.nv)
    at = v + 0.01
    more = [LastStates.about(record, one, v, information).moved(at[None])[0] for one in (moved, still)]
    ahead, _ = last_state(record, at)
    by = first * float(way @ (at - v))
    np.testing.assert_allclose(more[0] - more[1], by + ahead @ by, rtol=0.02, atol=1e-3)


def test_directions_that_the_data_do_not_tell_are_followed_as_far_as_makes_sense(two_masses):
    _, target = two_masses
    record, v = target.search.records[0], target.start
    first = StatePrior(np.array([[1.2, 1.2, 0.1]]), np.eye(3)[None])
    found = LastStates.about(record, first, v, np.zeros((target.nv, target.nv)))
    assert np.isfinite(found.bends).all()
    assert found.slopes.any()


@pytest.mark.parametrize("width", [1e-6, 1.0])
def test_a_first_state_that_is_known_leaves_the_likelihood_of_the_samples(two_masses, width):
    """The last state follows the parameters: with the first one known chi-squared is that of simulations. With the last
    one where the fit has it, it is not, in the weakest direction."""
    fit, target = two_masses
    record, sigma = target.search.records[0], np.array([0.1])
    first = np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
    known = StatePrior(first[None], width * 1e-3 * np.eye(3)[None])
    likelihood = SpectralLikelihood(target.search.records, target.start, [known])
    plain = likelihood.value(points := _points(target, sigma), np.full((len(points), 1), 0.1))
    likelihood.choose([target.start], sigma, 0.0)
    levels = np.full((len(points), 1), 0.1)
    full, value = likelihood.full(points, levels), likelihood.value(points, levels)
    np.testing.assert_allclose(value - value[0], full - full[0], atol=0.02)
    if width < 1:
        measured = fit.traces[record.experiment.name]["omega"].measured
        halves = [-0.5 * np.square((_simulated(fit, target, v) - measured) / 0.1).sum() for v in points]
        np.testing.assert_allclose(full - full[0], np.array(halves) - halves[0], atol=2e-3)
        assert np.abs((plain - plain[0]) - (full - full[0])).max() > 0.05


def _points(target, sigma):
    """The optimum, and two standard errors to either side in the direction that the data tell least of."""
    sizes, axes = np.linalg.eigh(target.likelihood.squares(target.start, sigma).matrix)
    sides = [scale * axes[:, 0] / np.sqrt(sizes[0]) for scale in (0, 1, -1, 2, -2)]
    return target.start + np.array(sides)


def _simulated(fit, target, v):
    """The speed from the fit's first states at v."""
    record = target.search.records[0]
    parameters = fit.parameters.copy()
    for name, value in zip(target.free, target.coordinates.values(v), strict=True):
        parameters[name].set(value=float(value))
    initial = {name: one.value for name, one in fit.initial[record.experiment.name].items()}
    made = ce.simulate(fit.model, record.experiment, parameters=parameters, initial=initial)
    return np.asarray(made["omega"].values)
