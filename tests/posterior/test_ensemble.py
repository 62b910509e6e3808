"""Ensembles of walkers, and the evidence from their draws."""

import sys

import numpy as np
import pytest

from casadi_engine.errors import MissingDependencyError
from casadi_engine.posterior import ensemble
from casadi_engine.posterior.bridge import bridge, meng_wong
from casadi_engine.posterior.mixture import around

pytest.importorskip("emcee")


def valley(x):
    """Curved: the second coordinate follows the square of the first. Its integral is e^2."""
    first, second = x[:, 0], x[:, 1] - x[:, 0] ** 2
    return -0.5 * (first**2 + (second / 0.3) ** 2) - np.log(2 * np.pi * 0.3) + 2.0


@pytest.fixture(scope="module")
def chains():
    random = np.random.default_rng(0)
    starts = [4 * random.standard_normal((10, 2)) for _ in range(2)]
    explored = ensemble.explore(valley, starts, random)
    return ensemble.walk(valley, explored, random, most=40_000)


def test_walkers_that_start_far_off_agree_on_a_curved_valley(chains):
    assert chains.trusted
    assert chains.rhat.max() <= ensemble.LARGEST
    x = chains.x.reshape(-1, 2)
    error = 5 / np.sqrt(chains.size)
    assert x[:, 0].mean() == pytest.approx(0.0, abs=error)
    assert x[:, 0].std() == pytest.approx(1.0, abs=error)
    assert x[:, 1].mean() == pytest.approx(1.0, abs=2 * error)
    assert chains.evaluations == chains.steps * 20


def test_the_evidence_of_the_valley(chains):
    found, error = bridge(valley, chains.x, chains.density, chains.size, np.random.default_rng(1))
    assert error < 0.1
    assert found == pytest.approx(2.0, abs=4 * error)


def test_the_bridge_of_two_normal_densities():
    random = np.random.default_rng(2)
    mine, other = 1.0 + random.standard_normal(4000), 1.5 * random.standard_normal(4000)

    def ratio(x):  # a normal density about 1 times e^5, over one of the width 1.5
        return 5.0 - 0.5 * (x - 1) ** 2 + 0.5 * (x / 1.5) ** 2 + np.log(1.5)

    found, error = meng_wong(ratio(mine), ratio(other), 4000.0)
    assert found == pytest.approx(5.0, abs=4 * error)
    assert error < 0.02


def test_walkers_in_two_places_do_not_agree():
    def apart(x):
        return np.logaddexp(-0.5 * np.square(x).sum(axis=1), -0.5 * np.square(x - 60).sum(axis=1))

    random = np.random.default_rng(0)
    explored = ensemble.Explored(
        [random.standard_normal((8, 2)), 60 + random.standard_normal((8, 2))],
        around(random.standard_normal((200, 2)), 1, random),
        0,
    )
    chains = ensemble.walk(apart, explored, random, most=4000)
    assert not chains.trusted
    assert chains.rhat.max() > 1.5


def test_lost_walkers_are_set_beside_the_others():
    random = np.random.default_rng(0)
    start = random.standard_normal((12, 2))
    start[0] = 1e3

    def holed(x):  # flat far out, where nothing leads back
        return np.maximum(-0.5 * np.square(x).sum(axis=1), -200.0)

    explored = ensemble.explore(holed, [start], random)
    assert np.abs(explored.states[0]).max() < 10


def test_a_missing_package_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "emcee", None)
    with pytest.raises(MissingDependencyError, match=r"casadi-engine\[bayes\]"):
        ensemble.emcee()
