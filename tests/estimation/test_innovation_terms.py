"""What innovations add to the problem: derivatives of the stability constraint and of the likelihood's size."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.innovations import SizedPriors, StableLoop, closed_loop, of_predictor
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.search import Search
from casadi_engine.experiment import Channel


@pytest.fixture
def search(shaft, shaft_model):
    """A search for the noise wanted; two outputs with gaps by default."""

    def make(noise, *, two=True, stride=1, priors=False):
        data = shaft(n=240, two=two).data
        for name in ("omega", "omega_load")[: 1 + two]:
            values = data[name].values.copy()
            values[np.random.default_rng(len(name)).random(len(values)) < 0.2] = np.nan
            values[np.arange(len(values)) % stride > 0] = np.nan
            data = data.with_channel(Channel(name, "rad/s", time=data[name].time, values=values))
        model = shaft_model(two)
        pars = model.parameters()
        if priors:
            pars["C_el"].set(prior=(0.2, 0.1))
        return Search(model, (data,), pars, noise, interval="auto", initial=None, loss=Loss(), ties="substitute",
                      method="exact", max_iterations=1, tolerance=1e-9, warm=None, progress=None)  # fmt: skip

    return make


def point(search, seed=0):
    v = search.coordinates.of(search.pmap.start)
    return v + 0.1 * np.random.default_rng(seed).normal(size=len(v))


def slopes(f, v, e=1e-6):
    return np.array([(f(v + s) - f(v - s)) / (2 * e) for s in e * np.eye(len(v))])


@pytest.mark.parametrize("stride", [1, 3])
def test_the_stability_constraint(search, stride):
    made = search(ce.Noise(omega="innovations"), two=False, stride=stride)
    (term,) = made.constraints._supplied
    assert isinstance(term, StableLoop)
    assert made.constraints.labels == ["the predictor is stable"]
    assert (made.constraints.lower[0], made.constraints.upper[0]) == (-np.inf, 0.0)
    v = point(made)
    value, gradient = term.evaluate(v)
    loop, _ = closed_loop(made.records[0], v, stride, 0)
    assert value == pytest.approx(np.log(np.abs(np.linalg.eigvals(loop[0])).max()), abs=2e-3)
    np.testing.assert_allclose(gradient, slopes(lambda x: term.evaluate(x)[0], v), rtol=1e-4, atol=1e-7)
    wanted = slopes(lambda x: term.evaluate(x)[1], v)
    np.testing.assert_allclose(term.hessian(v), wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max())
    total = made.constraints.hessian(v, np.array([2.0]))
    np.testing.assert_allclose(total, 2.0 * term.hessian(v) / made.constraints.scale[0])


@pytest.mark.parametrize("two", [True, False])
def test_the_size_of_the_innovations(search, two):
    made = search(ce.Noise(process="estimate"), two=two, priors=True)
    priors, v = made.problem.priors, point(made)
    assert isinstance(priors, SizedPriors)
    assert priors.count == 1
    cost, gradient, hessian, gauss_newton = priors.evaluate(v)
    assert priors.size(v) == pytest.approx(2 * (cost - priors._priors.evaluate(v)[0]))
    np.testing.assert_allclose(gradient, slopes(lambda x: priors.evaluate(x)[0], v), rtol=1e-5, atol=1e-4)
    wanted = slopes(lambda x: priors.evaluate(x)[1], v)
    np.testing.assert_allclose(hessian, wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max())
    assert np.linalg.eigvalsh(gauss_newton).min() > -1e-9 * np.abs(gauss_newton).max()


def test_the_information_in_the_size_is_whole(search):
    # for whitened innovations e = B y with y ~ N(0, S): slopes of B y and the rest make tr(S^-1 dS S^-1 dS)/2
    made = search(ce.Noise(process="estimate"))
    v, record = point(made), made.records[0]
    core, gain = of_predictor(record)
    z, d = v[record.active], len(record.active)
    discrete = core.at(z, 1)
    both = (True, True)
    s = gain.stationary(z, core, discrete).innovation
    white = gain.at(z, core, discrete, both).whitener / gain._level[:, None]
    inside = np.einsum("iab,bc,jac->ij", white[1 : 1 + d], s[0], white[1 : 1 + d])
    back = np.linalg.inv(s[0])
    whole = np.einsum("ab,ibc,cd,jda->ij", back, s[1 : 1 + d], back, s[1 : 1 + d]) / 2
    rest = gain.log_determinant(z, core, discrete, both)[1]
    np.testing.assert_allclose(inside + rest, whole, rtol=1e-9, atol=1e-12 * np.abs(whole).max())


def test_a_simulated_record_has_no_predictor(search):
    made = search(ce.Noise())
    with pytest.raises(TypeError, match="no predictor"):
        of_predictor(made.records[0])
