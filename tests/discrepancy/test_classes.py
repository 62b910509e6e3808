"""Classes: the ranking formula against draws, coverage of the truth, and what would split a class."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.classes import (
    best_split,
    clusters,
    confusable,
    ranking_probability,
    separation,
    theoretical_class,
)
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.score import Scores, score


def scores(r, mu=None, *, truth=0, rng=None, names=None, sides=None):
    """Scores with correlation R; z has mean mu R[truth] plus noise from rng."""
    values, vectors = np.linalg.eigh(r)
    directions = (vectors * np.sqrt(np.maximum(values, 0))).T
    directions /= np.maximum(np.linalg.norm(directions, axis=0), 1e-300)
    y = (0 if mu is None else mu) * directions[:, truth]
    if rng is not None:
        y = y + rng.standard_normal(len(r))
    k = len(r)
    names = names or [f"effect_{i}" for i in range(k)]
    candidates = tuple(
        Candidate(name, "port", None, side=0 if sides is None else sides[i]) for i, name in enumerate(names)
    )
    z = directions.T @ y
    one = np.ones(k)
    return Scores(candidates, directions, y, z, z.copy(), one, one, one, np.zeros((0, k)), 1000)


def pair(rho):
    return np.array([[1, rho], [rho, 1.0]])


@pytest.mark.parametrize("mu", [1.0, 3.0, 6.0])
@pytest.mark.parametrize("rho", [-0.9, 0.0, 0.5, 0.99])
def test_the_ranking_probability_is_that_of_draws(mu, rho):
    y = np.random.default_rng(0).standard_normal((2, 200_000))
    zj = mu + y[0]
    zk = rho * zj + np.sqrt(1 - rho**2) * y[1]
    share = np.mean(np.abs(zj) > np.abs(zk))
    assert ranking_probability(mu, rho) == pytest.approx(share, abs=4 * np.sqrt(0.25 / 200_000))


def test_published_figures_of_the_ranking():
    """95 % at d = 3.3 and 99 % at d = 4.65, where |rho| is near 1."""
    for d, wanted in ((3.3, 0.95), (4.65, 0.99)):
        mu = 40.0
        rho = np.sqrt(1 - (d / mu) ** 2)
        assert separation(mu, rho) == pytest.approx(d)
        assert ranking_probability(mu, rho) == pytest.approx(wanted, abs=0.001)
        assert ranking_probability(mu, rho) == pytest.approx(stats.norm.cdf(d / 2), abs=1e-3)


def test_rows_that_are_the_same_are_one_with_two_names():
    r = np.array([[1, 1, 0.2], [1, 1, 0.2], [0.2, 0.2, 1]])
    made = scores(r, 6.0)
    assert clusters(made) == [[0, 1], [2]]
    found = confusable(made)
    assert [m.names for m in found] == [(0, 1)]
    assert found[0].probability == 1


def test_the_truth_is_in_the_class_and_separable_effects_stand_alone():
    rng = np.random.default_rng(4)
    inside = dict.fromkeys((1.0, 2.5, 5.0, 8.0), 0)
    alone, wrong, runs = dict(inside), dict(inside), 1000
    for d in inside:
        mu = 9.0
        rho = np.sqrt(1 - (d / mu) ** 2)
        for _ in range(runs):
            found = confusable(scores(pair(rho), mu, rng=rng))
            members = [m.candidate for m in found]
            inside[d] += 0 in members
            alone[d] += members == [0]
            wrong[d] += members == [1]
    assert all(count >= 0.98 * runs for count in inside.values())
    assert all(count <= 0.02 * runs for count in wrong.values())
    assert alone[5.0] >= 0.95 * runs
    assert alone[8.0] >= 0.999 * runs
    assert alone[1.0] < 0.5 * runs


def test_refits_take_the_place_of_predicted_drops():
    made = scores(pair(0.9), 5.0)
    assert next(m.candidate for m in confusable(made)) == 0
    found = confusable(made, gain={0: 20.0, 1: 40.0})
    assert [m.candidate for m in found] == [1]


def test_points_of_a_grid_are_one_effect_and_probabilities_sum_to_one():
    r = np.full((4, 4), 0.98) + 0.02 * np.eye(4)
    made = scores(r, 4.0, names=["step", "step", "step", "drag"])
    found = confusable(made)
    assert [made.candidates[m.candidate].effect for m in found] == ["step", "drag"]
    assert sum(m.probability for m in found) == pytest.approx(1)
    assert found[0].rho == pytest.approx(1)


def test_amplitudes_of_the_forbidden_sign_do_not_win():
    made = scores(pair(-0.99), 6.0, sides=[0, 1])
    assert [m.candidate for m in confusable(made)] == [0]


def test_the_theoretical_class_holds_what_is_not_separated():
    r = np.eye(3)
    r[0, 1] = r[1, 0] = 0.95
    made = scores(r, 0.0)
    assert theoretical_class(made, 0, 5.0) == [0, 1]
    assert theoretical_class(made, 0, 20.0) == [0]


def test_nothing_testable_has_no_class():
    made = scores(np.eye(2), 3.0)
    assert confusable(replace(made, testability=np.zeros(2))) == []


def test_the_experiment_that_splits_a_class_is_found_by_simulation(shaft):
    """A constant torque and a viscous drag at the load: a longer record with other speeds tells them apart."""
    now = shaft.data("now", seed=1, n=200)
    candidates = [shaft.candidates(shaft.model)[k] for k in (2, 3)]
    noise = NoiseModel(shaft.sigma)
    same, longer = shaft.data("same", noise=False, n=200), shaft.data("longer", noise=False, n=800)
    own = score(compress(shaft.null(now), candidates, noise))
    proposed = {
        plan.name: score(compress(shaft.null(now, plan), candidates, noise)) for plan in (same, longer)
    }
    found = best_split([0, 1], [0.1, 0.1], own, proposed)
    assert [s.experiment for s in found] == ["longer", "same"]
    assert found[0].after > found[1].after > found[1].before > 0
