"""report.html: complete, self-contained, safe, atomic."""

import builtins
import os
import re
import sys
from html.parser import HTMLParser

import pytest

from casadi_engine.errors import MissingDependencyError, OutputError, ResultError
from casadi_engine.estimation.fit import Optimum
from casadi_engine.report import Simulated, report
from casadi_engine.report import page as page_module

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Reader(HTMLParser):
    """Checks that tags close in order, and collects links, sources and headings."""

    def __init__(self):
        super().__init__()
        self.open, self.resources, self.headings, self.figures = [], [], [], 0

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.resources += [given[key] for key in ("src", "href", "data", "action") if key in given]
        self.figures += tag == "figure"
        assert given.get("aria-label", "a picture has words")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def read(path):
    text = path.read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    return text, reader


def check_alone(path):
    text, reader = read(path)
    assert all(link.startswith("#") for link in reader.resources)
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|import\(|fetch\(|XMLHttpRequest|<link|<img", text)
    assert os.path.getsize(path) < 3_000_000
    assert 'name="viewport"' in text
    assert "@media print" in text
    return text, reader


def test_a_fit_alone(tmp_path, factory):
    optima = (Optimum(1168.25, {}, 3, "converged"), Optimum(1300.0, {}, 1, "converged"))
    path = report(factory.fit(optima=optima), tmp_path / "new" / "report.html", arguments={"problem": "a.py"})
    assert path == tmp_path / "new" / "report.html"
    text, reader = check_alone(path)
    assert reader.headings == [
        "Verdict", "Model", "Parameters", "Fit", "Residual tests", "Data", "How it was made",
    ]  # fmt: skip
    assert reader.figures == 6
    for words in (
        "The fit: converged.",
        "d(omega_eng)/dt = (K_el*twist",
        "\\frac{\\mathrm{d}}{\\mathrm{d}t}",
        "0.39108 ± 0.00042",
        "at its lower bound: no symmetric error",
        "assumed, not measured: p3, p4",
        "The residual tests were not made",
        "from_arrays(channels=",
        "a.py",
        "CasADi",
    ):
        assert words in text, words


def test_a_fit_with_its_validation(tmp_path, factory):
    fit = factory.fit()
    fresh = factory.validation(factory.fit(records=("fresh",)), white=False)
    text, reader = check_alone(report(fit, tmp_path / "r.html", validation=fresh))
    assert "Residual tests FAILED" in text
    assert 'class="verdict poor"' in text
    assert "fresh/omega/whiteness" in text
    assert reader.figures == 7  # trace and residual of both, correlations, parameters, matrix
    again, reader = check_alone(report(fit, tmp_path / "r.html", validation=factory.validation(fit)))
    assert reader.figures == 5  # the same records are not drawn twice
    assert "Residual tests PASSED" in again


def test_a_validation_and_a_simulation(tmp_path, factory, validation):
    text, reader = check_alone(report(validation, tmp_path / "v.html"))
    assert reader.headings[0] == "Verdict"
    assert "PASSED" in text
    assert 'class="verdict good"' in text
    fit = factory.fit()
    made = Simulated(fit.model, fit.parameters, fit.data, fit.data, ("out/a.csv",))
    text, reader = check_alone(report(made, tmp_path / "s.html"))
    assert reader.headings == ["Simulation", "Model", "Parameters", "Data", "How it was made"]
    assert "out/a.csv" in text


def test_names_cannot_break_the_page(tmp_path, factory):
    fit = factory.fit(
        records=('<img src="http://x">',),
        messages=("<script>alert(1)</script>",),
        options={"<b>": "</table>"},
    )
    text, _ = read(report(fit, tmp_path / "r.html", arguments={"<i>": "&amp;"}))
    assert "<script>alert" not in text
    assert 'src="http' not in text
    assert "&lt;script&gt;" in text


def test_figures_beyond_the_budget_are_named(tmp_path, factory, monkeypatch):
    monkeypatch.setattr(page_module, "FIGURE_BYTES", 40_000)
    text, reader = check_alone(report(factory.fit(), tmp_path / "r.html"))
    assert 0 < reader.figures < 5
    assert "figures are left out to keep this file small" in text


def test_many_records_are_not_all_drawn(tmp_path, factory):
    fit = factory.fit(records=tuple(f"record_{k}" for k in range(6)), samples=3000)
    text, _ = check_alone(report(fit, tmp_path / "r.html"))
    assert "2 more outputs are in the tables, but not drawn here." in text


def test_errors_of_report(tmp_path, fit):
    with pytest.raises(
        ResultError, match="report does not know this kind of result; seen: str; allowed: a Fit"
    ):
        report("fit", tmp_path / "r.html")
    with pytest.raises(ResultError, match="the validation of a report is not one; seen: Fit") as error:
        report(fit, tmp_path / "r.html", validation=fit)
    assert error.value.cure == "give what validate(fit) returned"
    with pytest.raises(OutputError, match="seen: a folder of that name"):
        report(fit, tmp_path)
    assert os.listdir(tmp_path) == []


def test_no_other_file_is_replaced(tmp_path, fit):
    """A script of that name was lost, without a word."""
    script, page = tmp_path / "study.py", tmp_path / "notes.html"
    script.write_text("print(1)")
    page.write_text("<p>mine</p>")
    with pytest.raises(OutputError, match=r"ends in \.html; do: write ce\.report\(result, .*study\.html"):
        report(fit, script)
    with pytest.raises(OutputError, match=r"a file of this name would be lost: .*notes\.html"):
        report(fit, page)
    assert (script.read_text(), page.read_text()) == ("print(1)", "<p>mine</p>")
    first = report(fit, tmp_path / "r.html")
    assert report(fit, first) == first


def test_a_page_needs_neither_matplotlib_nor_scipys_signals(tmp_path, factory, validation, monkeypatch):
    for name in list(sys.modules):
        if name.partition(".")[0] == "matplotlib" or name.startswith("scipy.signal"):
            monkeypatch.setitem(sys.modules, name, None)  # importing it is an error now
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    _, reader = check_alone(report(factory.fit(), tmp_path / "r.html", validation=validation))
    assert reader.figures == 5


def test_without_jinja2(tmp_path, fit, monkeypatch):
    real = builtins.__import__

    def refuse(name, *others, **more):
        if name == "jinja2":
            raise ImportError(name)
        return real(name, *others, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingDependencyError, match=r"report\.html needs the package jinja2") as error:
        report(fit, tmp_path / "r.html")
    assert error.value.cure == 'pip install "casadi-engine[app]"'
    assert os.listdir(tmp_path) == []


def test_a_failing_write_leaves_the_old_page(tmp_path, fit, monkeypatch):
    path = tmp_path / "report.html"
    old = "<p>Written by casadi-engine 0.1</p>"
    path.write_text(old)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OutputError, match=r"report\.html: cannot be written; seen: .*No space left"):
        report(fit, path)
    assert path.read_text() == old
    assert os.listdir(tmp_path) == ["report.html"]
