"""Figures and tables of a posterior: what they draw, not how it looks."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.posterior import Mode, compare
from casadi_engine.report import as_html, text
from casadi_engine.report.figures import figures


@pytest.fixture(scope="module")
def post():
    time = 0.02 * np.arange(100)
    omega = 4 * (1 - np.exp(-time / 0.8)) + 0.05 * np.random.default_rng(1).standard_normal(100)
    data = ce.Experiment.from_arrays(
        "run", time=time, units={"T": "N m", "omega": "rad/s"}, hold="zero", T=np.full(100, 2.0), omega=omega
    )
    return ce.posterior(ce.estimate(ce.one_inertia(), data, progress=False), draws=300)


@pytest.fixture(scope="module")
def ahead(post):
    """What a few draws predict."""
    return post.predictive(draws=5)


def test_every_figure_is_drawn_with_labels(post):
    made = figures(post)
    assert list(made) == ["overview", "pairs", "modes", "prediction run"]
    for name in made:
        figure = ce.plot(post, what=name)
        assert any(axes.get_xlabel() for axes in figure.axes)
        assert any(axes.get_ylabel() for axes in figure.axes)


def test_marginals_show_the_posterior_beside_the_prior_and_the_fits_error(post):
    axes = ce.plot(post).axes
    assert [one.get_title(loc="left") or one.get_title() for one in axes] == list(post.names)
    labels = [line.get_label() for line in axes[0].lines]
    assert {"posterior, its 95 % shaded", "the fit's error (cut)", "prior"} <= set(labels)
    drawn = next(line for line in axes[0].lines if line.get_label().startswith("posterior"))
    assert np.trapezoid(drawn.get_ydata(), drawn.get_xdata()) == pytest.approx(1.0, abs=0.02)
    prior = next(line for line in axes[0].lines if line.get_label() == "prior")
    inertia = np.asarray(prior.get_xdata())
    np.testing.assert_allclose(prior.get_ydata(), 1 / (inertia * np.log(1e9)), rtol=1e-6)


def test_pairs_mark_the_modes_that_have_mass(post):
    from dataclasses import replace

    small = Mode(dict.fromkeys(post.names, 1.0), 0.001, 6.0, 1)
    several = replace(post, modes=(*post.modes, small))
    for one in (post, several):
        panel = ce.plot(one, what="pairs").axes[0]
        assert sum(line.get_marker() == "x" for line in panel.lines) == 1
    left, right = ce.plot(several, what="modes").axes
    np.testing.assert_allclose(left.lines[0].get_ydata(), [0.0, 6.0])
    assert [bar.get_height() for bar in right.patches] == pytest.approx([100.0, 0.1])


def test_the_prediction_is_drawn_with_its_band(post, ahead):
    figure = ce.plot(post, what="prediction run")
    assert len(figure.axes) == 2
    assert figure.axes[0].collections
    assert ce.plot(ahead).axes[0].collections


def test_it_has_words_and_a_table(post):
    assert text(post) == str(post)
    page = as_html(post)
    assert all(name in page for name in post.names)
    assert "Posterior by importance, 300 draws" in page


def test_a_comparison_shows_how_far_each_model_lies_below_the_best(post):
    found = compare({"one": post, "other": replace(post, log_evidence=post.log_evidence - 20.0)})
    axes = ce.plot(found).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["one", "other"]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([0.0, 20.0])
    assert any("20.00" in words.get_text() and "< 0.001 %" in words.get_text() for words in axes.texts)


def test_a_short_record_is_drawn_whole_and_a_long_one_at_its_end(ahead, monkeypatch):
    from casadi_engine.report import posterior_figures

    (top, _) = ce.plot(ahead).axes
    assert (top.get_title(loc="left") or top.get_title()) == "run: omega"
    assert len(top.lines[0].get_xdata()) == 100
    monkeypatch.setattr(posterior_figures, "SEEN", 30)
    (top, _) = ce.plot(ahead).axes
    assert len(top.lines[0].get_xdata()) == 30
    assert (top.get_title(loc="left") or top.get_title()).endswith(", the last part")
    assert top.get_ylabel() == "omega [rad/s]"


def test_modes_are_named_in_the_key_and_room_is_left_for_the_fits_error_alone(post):
    labels = [line.get_label() for line in ce.plot(post).axes[0].lines]
    assert "modes" in labels
    without = {
        name: replace(one, stderr=None, why="not known (see note)")
        for name, one in post.fit.estimates.items()
    }
    bare = replace(post, fit=replace(post.fit, estimates=without))
    tops = [ce.plot(one).axes[0].get_ylim()[1] for one in (post, bare)]
    assert tops[0] == pytest.approx(1.7 / 1.15 * tops[1])


def test_a_page_of_its_own(post, tmp_path):
    page = ce.report(post, tmp_path / "posterior.html").read_text(encoding="utf-8")
    assert "<title>Posterior of" in page
    assert page.count("<figure") >= 4
    for word in ("Parameters", "What the draws foretell", "J_eng", *post.names):
        assert word in page


def test_a_page_of_a_comparison(post, tmp_path):
    page = ce.report(compare({"one": post, "another": post}), tmp_path / "two.html").read_text(
        encoding="utf-8"
    )
    assert "<title>Comparison of models" in page
    assert page.count("<figure") == 1
