"""Models by their evidence."""

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import PosteriorError
from casadi_engine.posterior import compare


def test_a_damper_that_is_there_is_asked_for(post, run_up):
    pars = ce.one_inertia().parameters()
    pars.fix("C_eng", 0.48)  # 20 standard errors off
    fit = ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=0.02), progress=False)
    found = compare({"wrong damper": ce.posterior(fit), "free damper": post})
    assert list(found.log_evidence) == ["free damper", "wrong damper"]
    assert found.probability["free damper"] > 0.99
    pars.fix("C_eng", 0.5)  # the truth, which a free damper has to pay for finding
    fit = ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=0.02), progress=False)
    right = ce.posterior(fit)
    found = compare({"right damper": right, "free damper": post})
    # a flat prior of 0 to 1e5 and an error of 0.0009 beside the best damper: Occam's factor
    occam = np.log(1e5 / (np.sqrt(2 * np.pi) * 0.00089))
    assert right.log_evidence - post.log_evidence == pytest.approx(occam, abs=2.0)
    assert sum(found.probability.values()) == pytest.approx(1.0)
    assert "right damper" in str(found).splitlines()[1]
    assert found.to_dict()["error"]["right damper"] == right.log_evidence_error
    assert "white noise" not in str(found)


def test_coloured_noise_counts_alike_for_all_models(post):
    """The rival of a true model had 100 %, by the likelihood of white noise along a residual of 13 samples' worth."""
    coloured = ce.posterior(replace(post.fit, own_noise={"J_eng": 3.0}))
    found = compare(
        {"one": coloured, "again": post}
    )  # as its residual was taken for white where the draws were made
    root = max((coloured, post), key=lambda one: one.log_likelihood.max()).root
    assert found.root == found.to_dict()["likelihood_root"] == root
    gap = abs(found.log_evidence["one"] - found.log_evidence["again"])
    assert gap < 0.15 * 9 / root
    both = compare({"one": coloured, "again": replace(coloured)})
    assert "divided by 9, for all models" in str(both)
    assert both.probability["one"] == pytest.approx(0.5)


def test_only_posteriors_of_the_same_records_are_compared(post, run_up):
    with pytest.raises(PosteriorError, match="nothing to compare; seen: 1 posteriors"):
        compare({"one": post})
    with pytest.raises(PosteriorError, match="nothing to compare; seen: list"):
        compare([post, post])
    traces = {"other": post.fit.traces["run_up"]}
    with pytest.raises(PosteriorError, match=r"different records.*two: other \(omega, 200 samples\)"):
        compare({"one": post, "two": replace(post, fit=replace(post.fit, traces=traces))})
    noisy = replace(post.fit.traces["run_up"]["omega"], measured=np.zeros(200))
    changed = replace(post.fit, traces={"run_up": {"omega": noisy}})
    with pytest.raises(PosteriorError, match="different records"):
        compare({"one": post, "two": replace(post, fit=changed)})


def test_a_fit_in_the_place_of_a_posterior_is_named(post):
    with pytest.raises(PosteriorError, match=r"no posterior; seen: other: a Fit; .* ce.posterior\(fit\)"):
        compare({"one": post, "other": post.fit})


def test_it_is_reached_through_the_function_of_the_same_name():
    assert ce.posterior.compare is compare
