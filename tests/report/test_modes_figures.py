"""Figures of modes and reductions: what is drawn is what the result holds."""

import re

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ResultError
from casadi_engine.model import reduce
from casadi_engine.report.figures import drawn, figures


@pytest.fixture(scope="module")
def crank():
    return ce.crankshaft(reciprocating_speed="measured", outputs=("omega", "omega_load"))


@pytest.fixture(scope="module")
def reduction(crank):
    return reduce(crank, dof=2)


def check_labels(figure):
    for ax in figure.axes:
        for label in (ax.get_xlabel(), ax.get_ylabel()):
            assert label in ("", "speed", "displacement") or re.search(r"\[.+\]$", label), label
    assert any(ax.get_xlabel() for ax in figure.axes)


def test_mode_shapes_are_the_modes(crank):
    modes = crank.modes()
    assert list(figures(modes)) == ["overview", "damping"]
    figure = ce.plot(modes)
    check_labels(figure)
    left, right = figure.axes[::2], figure.axes[1::2]
    assert left[1].get_title(loc="left") == "mode 2: 335.2 Hz, damping ratio 0.0191"
    shapes = modes.deformations[:, np.array(modes.numbers) > 0]
    for k, (swing, bars) in enumerate(zip(left, right, strict=True)):
        np.testing.assert_allclose([bar.get_height() for bar in bars.patches], shapes[:, k])
        drawn_line = swing.lines[-1].get_ydata()
        assert np.max(drawn_line) == pytest.approx(1)
        assert len(drawn_line) == 7
    assert [text.get_text() for text in right[-1].get_xticklabels()] == [
        f"twist_{i + 1}{i}" for i in range(1, 7)
    ]
    # the first mode: the engine as one against the dynamometer, in the ratio of their inertias
    first = left[0].lines[-1].get_ydata()
    assert first[0] / first[6] == pytest.approx(-(1 / 5.646) * 2.6534, rel=0.02)


def test_damping_is_drawn_over_frequency(crank):
    figure = ce.plot(crank.modes(), what="damping")
    check_labels(figure)
    x, y = figure.axes[0].lines[-1].get_data()
    assert x[0] == pytest.approx(20.45, abs=0.01)
    assert y[0] == pytest.approx(0.0811, abs=1e-4)


def test_many_modes_take_several_figures():
    modes = ce.crankshaft(cylinders=8, reciprocating_speed="measured").modes()
    assert list(figures(modes)) == ["overview", "modes 8 to 10", "damping"]
    assert len(ce.plot(modes).axes) == 14
    assert len(ce.plot(modes, what="modes 8 to 10").axes) == 6


def test_models_without_twists_or_oscillations():
    modes = ce.one_inertia().modes()
    for what in figures(modes):
        assert drawn(ce.plot(modes, what=what), "png")
    assert "aperiodic mode" in ce.plot(modes).axes[0].get_title(loc="left")
    assert "no oscillatory mode" in ce.plot(modes, what="damping").axes[0].texts[0].get_text()
    same = reduce(ce.one_inertia(), dof=1)
    for what in figures(same):
        assert drawn(ce.plot(same, what=what), "png")


def test_receptances_of_both_models_are_drawn(reduction):
    assert list(figures(reduction)) == ["overview", "degrees of freedom", "frequencies"]
    figure = ce.plot(reduction)
    check_labels(figure)
    omega, load, error = figure.axes
    assert omega.get_ylabel() == "|omega| [(rad/s)/(N m)]"
    curves = {line.get_label(): line for line in omega.lines}
    assert list(curves) == ["T_1, full", "T_1, lumped", "T_load, full", "T_load, lumped"]
    np.testing.assert_array_equal(
        curves["T_load, lumped"].get_ydata(), np.abs(reduction.lumped.values[:, 0, -1])
    )
    np.testing.assert_array_equal(load.lines[0].get_ydata(), np.abs(reduction.exact.values[:, 1, 0]))
    hz, percent = error.lines[0].get_data()
    assert (
        percent[np.searchsorted(hz, reduction.limit_hz)]
        <= 10.0
        < percent[np.searchsorted(hz, 1.1 * reduction.limit_hz)]
    )
    assert error.get_title(loc="left").startswith(f"within 10 % up to {reduction.limit_hz:.3g} Hz")


def test_steps_and_frequencies_are_drawn(reduction):
    figure = ce.plot(reduction, what="degrees of freedom")
    check_labels(figure)
    (ax,) = figure.axes
    assert [bar.get_width() for bar in ax.patches][1:] == [step.limit_hz for step in reduction.steps[1:]]
    assert ax.get_yticklabels()[-1].get_text() == "1 inertia"
    (ax,) = ce.plot(reduction, what="frequencies").axes
    full, lumped = (line.get_ydata() for line in ax.lines)
    assert full[0] == pytest.approx(20.45, abs=0.01)
    assert np.isfinite(lumped).tolist() == [True] + [False] * 5


def test_what_cannot_be_drawn_names_what_can():
    with pytest.raises(ResultError, match="plot does not know this kind of result") as caught:
        ce.plot(3)
    assert "Modes, a Reduction, an Experiment" in str(caught.value)
