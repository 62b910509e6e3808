"""A fit that came of several searches has the start that was given, and the time of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.estimate import _as_asked


@pytest.fixture(scope="module")
def fit() -> ce.Fit:
    time = np.arange(120) * 0.01
    speed = 4 * (1 - np.exp(-time / 0.8)) + 0.01 * np.random.default_rng(3).standard_normal(120)
    run = ce.Experiment.from_arrays(
        "run", time=time, units={"T": "N m", "omega": "rad/s"}, hold="zero", T=np.full(120, 2.0), omega=speed
    )
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.9)
    return ce.estimate(ce.one_inertia(), run, parameters=pars, progress=False)


def test_the_start_is_the_one_that_was_given(fit: ce.Fit) -> None:
    """A table said "G 141.214 (start 139.8)" of a search that had begun at 12."""
    assert fit.start["J_eng"] == 0.9
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.7)
    again = replace(fit, start={"J_eng": 0.41, "process.omega": 2.0})
    assert _as_asked(again, pars, 1.0).start == {"J_eng": 0.7, "process.omega": 2.0}
    assert _as_asked(again, None, 1.0).start == again.start


def test_the_time_of_other_searches_is_said(fit: ce.Fit) -> None:
    one = replace(fit, timing={"setup": 0.5, "solve": 1.0, "total": 1.6})
    found = _as_asked(one, None, 10.0)  # a later search may have led nowhere
    assert found.timing["total"] == 10.0
    assert found.timing["other searches"] == pytest.approx(8.5)
    assert "(other searches 8.5, setup 0.5, solve 1)" in str(found)
    assert "other searches" not in _as_asked(one, None, 1.6).timing
