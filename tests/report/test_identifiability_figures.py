"""Figures and tables of practical identifiability: what they draw, not how it looks."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ResultError
from casadi_engine.identifiability import PlannedExperiment, choose_experiments, fisher, loss_sweep, profile
from casadi_engine.report import as_html, text
from casadi_engine.report.figures import figures


@pytest.fixture(scope="module")
def fit():
    time = 0.02 * np.arange(200)
    omega = 4 * (1 - np.exp(-time / 0.8)) + 0.05 * np.random.default_rng(1).standard_normal(200)
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "run", time=time, units=units, hold="zero", T=np.full(200, 2.0), omega=omega
    )
    return ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.05), progress=False)


@pytest.fixture(scope="module")
def found(fit):
    noise = ce.Noise(omega=0.05)
    plans = {"a": fit.data[0], "b <b>": PlannedExperiment(fit.data[0].between(0, 2))}
    return {
        "profile": profile(fit, points=2),
        "sweep": loss_sweep(fit.model, fit.data, points=7, parameters=fit.parameters),
        "information": fisher(fit.model, fit.data, parameters=fit.parameters, noise=noise),
        "choice": choose_experiments(fit.model, plans, noise=noise, criterion={"J_eng": 0.01}, size=1),
        "choice A": choose_experiments(fit.model, plans, noise=noise, size=1),
    }


@pytest.mark.parametrize("kind", ["profile", "sweep", "information", "choice", "choice A"])
def test_every_figure_is_drawn_with_labels(found, kind):
    made = figures(found[kind])
    assert next(iter(made)) == "overview"
    for name in made:
        figure = ce.plot(found[kind], what=name)
        for ax in figure.axes:
            if ax.get_visible():
                assert ax.get_xlabel()
                assert ax.lines


def test_a_profile_draws_its_points_and_threshold(found):
    profiled = found["profile"]
    ax = ce.plot(profiled, what="profile J_eng").axes[0]
    lines = {line.get_label(): line for line in ax.lines}
    np.testing.assert_allclose(lines["profile"].get_ydata(), profiled["J_eng"].rise)
    np.testing.assert_allclose(lines["95 %"].get_ydata()[0], profiled["J_eng"].threshold)
    assert "along J_eng" in figures(profiled)


def test_a_sweep_is_drawn_on_a_logarithmic_axis(found):
    ax = ce.plot(found["sweep"], what="sweep C_eng").axes[0]
    assert ax.get_yscale() == "log"
    np.testing.assert_allclose(ax.lines[0].get_ydata(), found["sweep"].loss["C_eng"])


def test_texts_and_tables(found):
    for one in found.values():
        assert text(one) == str(one)
        assert as_html(one).startswith('<div class="table"><table>')
    assert "b &lt;b&gt;" in as_html(found["choice"])
    assert "chosen" in as_html(found["choice"])
    assert "not determined" not in as_html(found["information"])


def test_an_unknown_figure_is_refused(found):
    with pytest.raises(ResultError, match="there is no such figure of this result; seen: 'waterfall'"):
        ce.plot(found["profile"], what="waterfall")
