"""Every figure: drawn without a warning, labelled with units, written atomically."""

import os
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.figure import Figure

from casadi_engine.errors import OutputError, ResultError
from casadi_engine.estimation.fit import Estimate, Optimum, Trace
from casadi_engine.report import Simulated, panels, plot
from casadi_engine.report.envelope import envelope
from casadi_engine.report.figures import drawn, figures, last_cycle
from tests.quick import few

STARTS = (Optimum(1168.25, {}, 3, "converged"), Optimum(1500.0, {}, 2, "failed"), Optimum(np.nan, {}, 1, "x"))
RECORD = "misfire_1200rpm omega"
OF_FIT = [
    "overview", f"trace {RECORD}", f"residual {RECORD}", f"autocorrelation {RECORD}",
    "parameters", "correlation matrix", "waterfall",
]  # fmt: skip
OF_VALIDATION = ["overview", f"trace {RECORD}", f"residual {RECORD}", f"correlation {RECORD}"]
# Axes that hold names or counts have no unit.
WITHOUT_UNIT = {"parameter", "start, sorted by cost", ""}


def labels(figure):
    """Axis labels of every panel that is a plot (a panel without a y label shares its neighbour's)."""
    for ax in figure.axes:
        yield ax.get_xlabel()
        yield ax.get_ylabel()


def check_labels(figure):
    found = list(labels(figure))
    assert any(found)
    for label in found:
        assert label in WITHOUT_UNIT or re.search(r"\[.+\]$", label), label
    for ax in figure.axes:
        assert ax.get_xlabel() or ax.get_ylabel()


def simulated(fit):
    return Simulated(fit.model, fit.parameters, fit.data, fit.data, ("a.csv",))


@pytest.mark.parametrize("what", few(OF_FIT, *OF_FIT[::2]))
def test_figures_of_a_fit(factory, what):
    fit = factory.fit(samples=9000, predicted=True, optima=STARTS)
    assert list(figures(fit)) == OF_FIT
    figure = plot(fit, what=what)
    assert isinstance(figure, Figure)
    check_labels(figure)
    assert b"</svg>" in drawn(figure, "svg")


def test_the_same_result_gives_the_same_bytes(factory):
    first, second = (plot(factory.fit(optima=STARTS), what="waterfall") for _ in range(2))
    assert drawn(first, "svg") == drawn(second, "svg")


@pytest.mark.parametrize("what", few(OF_VALIDATION, *OF_VALIDATION[::2]))
@pytest.mark.parametrize("white", [True, False])
def test_figures_of_a_validation(factory, what, white):
    validation = factory.validation(white=white)
    assert list(figures(validation)) == OF_VALIDATION
    figure = plot(validation, what=what)
    check_labels(figure)
    if not white:
        drawn(figure, "png")


def test_figures_of_a_simulation_and_a_record(fit):
    assert list(figures(simulated(fit))) == ["overview", "record misfire_1200rpm"]
    for figure in (
        plot(simulated(fit)),
        plot(simulated(fit), what="record misfire_1200rpm"),
        plot(fit.data[0]),
    ):
        check_labels(figure)
        drawn(figure, "png")


def test_the_residual_says_what_it_is(factory):
    axes = plot(factory.fit(), what=f"residual {RECORD}").axes
    assert axes[0].get_title(loc="left").startswith("residual, measured less simulated (")
    assert "95.4 % expected" in axes[0].get_title(loc="left")
    assert "2.5 % missing, as zero" in axes[1].get_title(loc="left")
    axes = plot(factory.fit(predicted=True), what=f"residual {RECORD}").axes
    assert axes[0].get_title(loc="left").startswith("residual, measured less predicted (")


def test_an_interval_is_drawn_from_end_to_end(factory):
    fit = factory.doubted(factory.fit())
    left, right = plot(fit, what="parameters").axes
    start = fit.start["J_load"]
    ends = [100 * (end - start) / start for end in (0.12, 0.27)]
    assert any(np.allclose(line.get_xdata(), ends) for line in left.lines if len(line.get_xdata()) == 2)
    words = [text.get_text() for text in right.texts]
    assert f"{100 * 0.075 / fit.values['J_load']:.2g} %" in words
    assert "none" in words


def test_parameters_without_an_error_say_so(factory):
    fit = factory.fit()
    estimates = {**fit.estimates, "K_el": Estimate(1992.0, None, "N m/rad", why="not determined")}
    left, right = plot(factory.fit(estimates=estimates), what="parameters").axes
    words = {text.get_text() for text in left.texts}
    assert words == {"at its lower bound", "no error"}
    assert {"at its bound", "none", "0.21 %"} <= {text.get_text() for text in right.texts}


def test_the_waterfall_hides_nothing(factory):
    ax = plot(factory.fit(optima=STARTS), what="waterfall").axes[0]
    assert ax.get_title(loc="left") == "where the starts ended (1 without a finite cost are not shown)"
    assert ax.get_ylabel() == "cost above the lowest [1]"


def test_the_waterfall_colours_the_optima_and_says_how_they_differ(factory):
    optima = (
        Optimum(1168.25, {}, 3, "converged"),
        Optimum(1169.5, {}, 2, "converged", "K_el +30 %, J_load -12 %"),
        Optimum(1200.0, {}, 1, "not converged: x"),
        Optimum(1300.0, {}, 1, "not converged: x"),
        *(Optimum(2000.0 + k, {}, 1, "converged", "C_el +5 %") for k in range(6)),
    )
    ax = plot(factory.fit(optima=optima), what="waterfall").axes[0]
    points = ax.lines[1:]  # the first joins them
    assert [line.get_xdata().tolist() for line in points] == [[1, 2, 3], [4, 5], *([k] for k in range(6, 14))]
    assert [float(line.get_ydata()[0]) for line in points[:3]] == [0.0, 1.25, 31.75]
    colours = [line.get_color() for line in points]
    assert colours[0] == panels.SIMULATED
    assert colours[1] == panels.PREDICTED
    assert colours[2] == colours[3] == panels.MEASURED
    assert len({*colours[:2], *colours[4:]}) == len(panels.OPTIMA)
    assert [line.get_marker() for line in points[:4]] == ["o", "o", "x", "x"]
    words = [text.get_text() for text in ax.get_legend().get_texts()]
    assert words[0] == "3 starts, the lowest"
    assert words[1].replace("\n", " ") == "2 starts, +1.25: K_el +30 %, J_load -12 %"
    assert words.count("not converged") == 1
    assert ax.get_yscale() == "symlog"


def test_hard_traces_are_drawn_too(factory):
    fit = factory.fit(noise={})
    time = np.cumsum(np.linspace(1e-3, 2e-3, 30))
    nothing = np.zeros(30)
    for trace in (
        Trace(time, nothing, np.zeros(30, bool), nothing),  # nothing counts
        Trace(time, nothing, np.ones(30, bool), nothing),  # nothing is left
        Trace(np.arange(30.0), nothing, np.ones(30, bool), nothing),  # constant, even
        Trace(np.arange(10.0), nothing[:10], np.ones(10, bool), nothing[:10]),  # short
    ):
        hard = factory.fit(**vars(fit) | {"traces": {"a": {"omega": trace}}})
        for what in ("trace a omega", "residual a omega") if len(trace.time) == 10 else ("residual a omega",):
            figure = plot(hard, what=what)
            check_labels(figure)
            drawn(figure, "png")


def test_more_records_than_an_overview_holds(factory):
    figure = plot(factory.fit(records=tuple("abcdef"), samples=100))
    assert len(figure.axes) == 12
    assert figure._supxlabel.get_text() == "2 more outputs are not drawn here"


def test_the_last_cycle_is_found_by_the_crank_angle(factory):
    experiment, _ = factory.experiment()
    trace = factory.fit().traces["misfire_1200rpm"]["omega"]
    start, stop = last_cycle(trace, experiment)
    assert stop - start == pytest.approx(0.1, abs=1e-3)  # two turns at 1200 rpm
    start, stop = last_cycle(trace, None)
    assert stop - start == pytest.approx(trace.time[-1] / 20)


def test_a_figure_is_written(tmp_path, fit):
    path = tmp_path / "figures" / "fit.png"
    plot(fit, path=path, what="parameters")
    assert path.read_bytes().startswith(b"\x89PNG")
    for ending, start in ((".svg", b"<?xml"), (".pdf", b"%PDF")):
        plot(fit, path=path.with_suffix(ending), what="parameters")
        assert path.with_suffix(ending).read_bytes().startswith(start)


def test_errors_of_plot(tmp_path, fit, monkeypatch):
    with pytest.raises(
        ResultError, match="plot does not know this kind of result; seen: dict; allowed: a Fit"
    ):
        plot({})
    with pytest.raises(ResultError, match="there is no such figure of this result; seen: 'bode'") as error:
        plot(fit, what="bode")
    assert "'parameters', 'correlation matrix'" in error.value.allowed
    with pytest.raises(
        OutputError, match="not a kind of figure file that can be written; seen: 'bmp'"
    ) as error:
        plot(fit, what="parameters", path=tmp_path / "a.bmp")
    assert error.value.allowed == ".png, .svg, .pdf"
    with pytest.raises(OutputError, match="not the path of a file to write; seen: int"):
        plot(fit, what="parameters", path=3)


def test_a_users_style_is_neither_used_nor_changed(fit):
    import matplotlib

    with matplotlib.rc_context({"axes.facecolor": "black", "font.size": 30}):
        figure = plot(fit, what="parameters")
        assert matplotlib.rcParams["font.size"] == 30
    assert figure.axes[0].get_facecolor() == (1.0, 1.0, 1.0, 1.0)


values = arrays(float, st.integers(1, 400), elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan)))


@given(values, st.integers(1, 50))
def test_an_envelope_keeps_the_extremes(signal, bins):
    time = np.arange(signal.size, dtype=float)
    shown_time, shown = envelope(time, signal, bins=bins)
    assert shown.size <= max(2 * bins, 2)
    assert np.all(np.diff(shown_time) >= 0)
    if np.isfinite(signal).any():
        assert np.nanmax(shown) == np.nanmax(signal)
        assert np.nanmin(shown) == np.nanmin(signal)
    else:
        assert np.isnan(shown).all()
    places = shown_time.astype(int)
    np.testing.assert_array_equal(signal[places], shown)


def test_files_left_alone_when_writing_fails(tmp_path, fit, monkeypatch):
    path = tmp_path / "fit.png"
    path.write_bytes(b"\x89PNG old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OutputError, match="No space left"):
        plot(fit, what="parameters", path=path)
    assert path.read_bytes() == b"\x89PNG old"
    assert os.listdir(tmp_path) == ["fit.png"]


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_a_file_that_is_no_figure_is_not_replaced(fit, tmp_path, ending):
    own, made = tmp_path / f"mine.{ending}", tmp_path / f"fit.{ending}"
    own.write_text("my own notes")
    with pytest.raises(OutputError, match=rf"a file of this name would be lost: .*mine\.{ending}"):
        plot(fit, path=own)
    assert own.read_text() == "my own notes"
    for _ in range(2):  # an earlier figure is replaced
        plot(fit, path=made)
    assert made.stat().st_size > 1000
