"""Loaded results drawn and shown on a page: what result.json holds, and words for what it does not."""

import re

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ResultError
from casadi_engine.estimation.fit import Optimum
from casadi_engine.report import Simulated, load_result, to_result, write_result
from casadi_engine.report.figures import drawn, figures


def stored(folder, result, command, **more):
    document = to_result(result, command=command, arguments={"problem": "p.py"}, seconds=1.0, seed=0) | more
    return load_result(write_result(folder / "result.json", document))


@pytest.fixture
def starts():
    values = {"J_eng": 0.39}
    return (
        Optimum(10.0, values, 3, "converged"),
        Optimum(15.0, values, 2, "converged"),
        Optimum(np.nan, {}, 1, "failed"),
    )


def test_a_fit_is_drawn(tmp_path, factory, starts):
    fit = factory.fit(optima=starts)
    result = stored(tmp_path, fit, "fit")
    assert list(figures(result)) == ["overview", "fit", "parameters", "correlation matrix", "waterfall"]
    for what in figures(result):
        assert drawn(ce.plot(result, what=what), "png")
    # the panels hold what those of the fit itself hold
    for what in ("parameters", "correlation matrix", "waterfall"):
        for one, other in zip(ce.plot(result, what=what).axes, ce.plot(fit, what=what).axes, strict=True):
            for line, same in zip(one.lines, other.lines, strict=True):
                np.testing.assert_allclose(
                    np.asarray(line.get_xdata(), float), np.asarray(same.get_xdata(), float)
                )
            for image, same in zip(one.images, other.images, strict=True):
                np.testing.assert_allclose(
                    image.get_array().filled(9), same.get_array().filled(9), atol=1e-12
                )
    (ax,) = ce.plot(result).axes
    percent = result["fit_percent"]["misfire_1200rpm"]["omega"]["simulation"]
    assert [bar.get_width() for bar in ax.patches] == [percent]
    assert ax.get_title(loc="left") == "fit: converged"


def test_intervals_are_shown_in_place_of_errors(tmp_path, factory):
    result = stored(tmp_path, factory.doubted(factory.fit()), "fit")
    page = ce.report(result, tmp_path / "again.html").read_text()
    assert "95 %: 0.120 to 0.270" in page
    assert result.stderr["J_load"] is None
    assert load_result(tmp_path)["parameters"]["J_load"]["interval"] == (0.12, 0.27)
    drawn_fit = ce.plot(factory.doubted(factory.fit()), what="parameters").axes[0]
    for one, same in zip(ce.plot(result, what="parameters").axes[0].lines, drawn_fit.lines, strict=True):
        np.testing.assert_allclose(np.asarray(one.get_xdata(), float), np.asarray(same.get_xdata(), float))


def test_a_validation_is_drawn(tmp_path, validation):
    result = stored(tmp_path, validation, "validate")
    assert "residual tests" in figures(result)
    (ax,) = ce.plot(result, what="residual tests").axes
    checks = result["records"]["misfire_1200rpm"]["omega"]
    found = dict(zip((t.get_text() for t in ax.get_yticklabels()), ax.lines[0].get_xdata(), strict=True))
    assert found["misfire_1200rpm/omega/whiteness"] == max(checks["whiteness_p"], 1e-16)
    assert len(found) == 1 + sum(p is not None for p in checks["cross_p"].values())
    assert "alpha = 0.01" in ax.get_title(loc="left")


def test_simulated_files_are_read_back_from_beside_the_result(tmp_path, fit):
    data = fit.data[0]
    data.to_csv(tmp_path / "run.csv")
    answer = Simulated(fit.model, fit.parameters, fit.data, fit.data, ("run.csv",))
    result = stored(tmp_path, answer, "simulate")
    assert list(figures(result)) == ["overview", "file run.csv"]
    figure = ce.plot(result)
    assert [re.search(r": (\w+)", ax.get_title(loc="left"))[1] for ax in figure.axes] == ["omega"]
    (tmp_path / "run.csv").unlink()
    with pytest.raises(ResultError, match=r"run\.csv: a file of this result is not there") as caught:
        ce.plot(result)
    assert "do: keep result.json beside its data files" in str(caught.value)


@pytest.mark.parametrize("kind", ["fit", "validate"])
def test_a_page_of_a_loaded_result(tmp_path, factory, validation, starts, kind):
    result = stored(tmp_path, factory.fit(optima=starts) if kind == "fit" else validation, kind)
    page = ce.report(result, tmp_path / "again.html").read_text()
    assert f"<h1>{kind} of " in page
    assert "read back from" in page
    assert "Traces are not stored in result.json" in page
    for name, value in result.values.items():
        assert name in page
        assert f"{value:.6g}" in page
    assert "misfire_1200rpm" in page
    assert page.count("<figure>") == len(figures(result)) - 1
    if kind == "validate":
        assert "Residual tests " + ("passed" if result["passed"] else "failed") in page


def test_a_result_with_nothing_to_draw_says_so(tmp_path, fit):
    answer = Simulated(fit.model, fit.parameters, fit.data, (), ())
    result = stored(tmp_path, answer, "simulate")
    with pytest.raises(ResultError, match="there is nothing in this result that can be drawn") as caught:
        ce.plot(result)
    assert "seen: a result of simulate, answered" in str(caught.value)
    assert "do: run the command again" in str(caught.value)
    assert "J_eng" in ce.report(result, tmp_path / "page.html").read_text()
