"""Draws from known optima, and what is met in place of draws."""

from importlib import import_module

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import UntrustedPosteriorError
from casadi_engine.posterior import drawing, ensemble, importance
from casadi_engine.posterior.box import Box
from casadi_engine.posterior.drawing import Drawing, Met, dispersed
from casadi_engine.posterior.modes import Modes, find_modes
from casadi_engine.posterior.target import Target


def modes_at(target, at):
    """Modes of which one alone is known, with the information of the optimum."""
    squares = target.squares(target.start[: target.nv])
    at, none = at[None], np.zeros((0, len(at)))
    valley = none, np.zeros((0, *2 * at.shape[1:])), np.zeros(0)
    return Modes(
        at,
        target.information(squares.matrix)[None],
        target.log_density(at),
        np.ones(1),
        1,
        valley,
        np.zeros((0, target.nv)),
    )


def drawing_of(target, evaluations=20_000):
    return Drawing(target, "auto", np.random.default_rng(0), 500, evaluations, lambda words: None)


@pytest.fixture
def poor(fit):
    """The target of a fit, and a place 8 standard errors off its optimum as the only one that is known."""
    target = Target(fit)
    known = modes_at(target, target.start)
    size = np.sqrt(np.linalg.inv(known.information[0])[0, 0])
    return target, modes_at(target, target.start + np.array([8 * size, 0.0]))


def test_optima_are_looked_for_again_where_draws_lie_higher(fit, poor, monkeypatch):
    target, modes = poor
    monkeypatch.setattr(importance, "FEWEST", 1e9)
    met = drawing_of(target).draws(modes, last=False)
    assert isinstance(met, Met)
    assert 1 <= len(met.higher) <= drawing.OPTIMA
    best = target.log_density(target.start[None])[0]
    height = target.log_density(np.array(met.higher))
    assert (height > modes.height[0] + drawing.HIGHER).all()
    assert height[0] > best - 3
    again = find_modes(target, fit, np.random.default_rng(0), wide=0, met=met.higher)
    assert again.height[0] == pytest.approx(best, abs=0.01)


def test_a_posterior_is_that_of_the_highest_optimum_wherever_it_was_looked_for_first(
    fit, post, poor, monkeypatch
):
    posterior = import_module("casadi_engine.posterior.posterior")
    _, modes = poor
    looked = []

    def first_poor(*args, met, **options):
        looked.append(len(met))
        return find_modes(*args, met=met, **options) if met else modes

    monkeypatch.setattr(posterior, "find_modes", first_poor)
    monkeypatch.setattr(importance, "ROUNDS", 1)
    found = ce.posterior(fit)
    assert looked[0] == 0
    assert looked[1] > 0
    assert found.log_evidence == pytest.approx(post.log_evidence, abs=0.1)


@pytest.mark.slow
def test_walkers_that_do_not_agree_say_what_the_evidence_cannot_exceed(fit, post, monkeypatch):
    pytest.importorskip("emcee")
    monkeypatch.setattr(ensemble, "FEWEST", 1e9)
    with pytest.raises(UntrustedPosteriorError, match=r"the log evidence is [\d.]+ at most") as caught:
        ce.posterior(fit, method="ensemble", evaluations=4000)
    limit = float(str(caught.value).split("the log evidence is ")[1].split(" at most")[0])
    target = Target(fit)
    best = target.full(target.start[None]) - target.prior.log_density(target.start[None])
    assert post.log_evidence < limit == pytest.approx(best[0], abs=0.05)


@pytest.mark.slow
def test_walkers_that_do_not_agree_are_judged_by_weights(fit, post, monkeypatch):
    pytest.importorskip("emcee")
    target = Target(fit)
    modes = modes_at(target, target.start)
    own, asked = drawing_of(target, 6_000), []
    sample = importance.sample

    def untrusted_at_first(density, start, *others):
        asked.append(len(start.share))
        monkeypatch.setattr(importance, "FEWEST", 1e9 if len(asked) < 3 else 400.0)
        return sample(density, start, *others)

    monkeypatch.setattr(importance, "sample", untrusted_at_first)
    monkeypatch.setattr(ensemble, "FEWEST", 1e9)
    found = own.draws(modes, last=True)
    assert asked[2] == drawing.COMPONENTS
    assert found.why == "from where an ensemble of walkers has been"
    assert found.log_evidence == pytest.approx(post.log_evidence, abs=0.5)


def test_more_of_the_data_are_taken_where_those_left_out_say_much(fit, monkeypatch):
    pytest.importorskip("emcee")
    target = Target(fit)
    modes = modes_at(target, target.start)
    own = drawing_of(target)
    monkeypatch.setattr(importance, "FEWEST", 1e9)
    monkeypatch.setattr(Drawing, "_left_out", lambda *_: drawing.SCATTER + 1)
    assert own.draws(modes, last=False) == Met()


def test_walkers_that_have_no_room_are_named(two_masses):
    fit, target = two_masses
    random = np.random.default_rng(0)
    modes = find_modes(target, fit, random, wide=0)
    with pytest.raises(UntrustedPosteriorError, match=r"cannot be evaluated around.*seen: 0 of 1200 draws"):
        dispersed(lambda y: np.full(len(y), -np.inf), modes, Box(target.low, target.high), random)
