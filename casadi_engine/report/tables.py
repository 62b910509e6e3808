"""Results as text for a terminal and as HTML for a notebook or a page."""

from __future__ import annotations

import html
from collections.abc import Collection, Sequence
from functools import singledispatch
from typing import Any

from casadi_engine.estimation import summary as fits
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.gain_table import gain_rows, predictor_words
from casadi_engine.report.kinds import Simulated, shown_by_others
from casadi_engine.validation import summary as validations
from casadi_engine.validation.validate import Validation

# The two texts live beside Fit and Validation, which print themselves with them.
fit_text = fits.summary
validation_text = validations.summary


@singledispatch
def text(result: Any) -> str:
    """Return a result as one screen of text. Raises ResultError for another kind of object."""
    return str(shown_by_others(text, result, "text")(result))


@singledispatch
def as_html(result: Any) -> str:
    """Return a result as HTML tables without a page around them. Raises ResultError for another kind."""
    return str(shown_by_others(as_html, result, "html")(result))


@text.register
def _(result: Fit) -> str:
    return fit_text(result)


@text.register
def _(result: Validation) -> str:
    return validation_text(result)


@text.register
def _(result: Simulated) -> str:
    many = len(result.simulated)
    lines = [f"Simulation of {result.model.name}: {many} record{'s' * (many != 1)}"]
    for index, one in enumerate(result.simulated):
        where = f" -> {result.files[index]}" if index < len(result.files) else ""
        lines.append(f"  {one.name}: {fits.count(one.samples)} samples, {one.duration:.6g} s{where}")
    return "\n".join(lines)


@as_html.register
def _(result: Fit) -> str:
    return fit_html(result)


@as_html.register
def _(result: Validation) -> str:
    return validation_html(result)


@as_html.register
def _(result: Simulated) -> str:
    return table(("record", "samples", "duration [s]", "file"), simulated_rows(result), right=(1, 2))


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], *, right: Collection[int] = (), caption: str = ""
) -> str:
    """An HTML table of text cells, all escaped; the columns in ``right`` are flush right."""

    def line(tag: str, cells: Sequence[str]) -> str:
        written = "".join(
            f'<{tag} class="r">{html.escape(cell)}</{tag}>'
            if k in right
            else f"<{tag}>{html.escape(cell)}</{tag}>"
            for k, cell in enumerate(cells)
        )
        return f"<tr>{written}</tr>"

    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    body = "".join(line("td", row) for row in rows)
    inside = f"{title}<thead>{line('th', header)}</thead><tbody>{body}</tbody>"
    return f'<div class="table"><table>{inside}</table></div>'


def fit_html(fit: Fit) -> str:
    """A fit as HTML: status, cost, parameters, initial states, fit percentages."""
    head = f"<p><b>Fit of {html.escape(fit.model.name)}: {html.escape(fit.status)}</b></p>"
    parts = (cost_table, parameter_table, gain_table, initial_table, percent_table)
    return head + "".join(part(fit) for part in parts)


def validation_html(validation: Any) -> str:
    """A validation as HTML: verdict, measures, tests."""
    head = f"<p><b>{html.escape(validations.verdict(validation))}</b></p>"
    words = "".join(f"<p>{html.escape(line)}</p>" for line in validations.parameter_words(validation))
    return head + measure_table(validation) + residual_table(validation) + words


def gain_table(fit: Fit) -> str:
    """The predictor's gain K, (2.10); nothing for output error."""
    rows = gain_rows(fit, fits.with_error)
    return table(("gain K of state", "by output", "value"), rows) if rows else ""


def cost_table(fit: Fit) -> str:
    """Cost, samples and noise."""
    rows = [
        ("cost", fits.cost_words(fit)),
        ("noise", "; ".join(fits.noise_words(fit))),
        ("predictor", predictor_words(fit)),
        ("samples that count", fits.count(fit.n)),
        ("solved", f"{fit.iterations} iterations, {fits.count(fit.nodes)} shooting intervals"),
    ]
    if len(fit.optima) > 1:
        rows.append(("optima", fits.optima_words(fit)))
    return table(("what", "found"), rows)


def parameter_table(fit: Fit) -> str:
    """Every parameter with its error, bounds and notes."""
    rows = []
    for name, value, unit, share, notes in fits.parameter_rows(fit):
        parameter = fits.parameter_of(fit, name)
        bounds = "" if parameter is None else f"{parameter.min:.4g} … {parameter.max:.4g}"
        description = "" if parameter is None else parameter.description
        rows.append((name, value, unit, share, bounds, notes, description))
    header = ("parameter", "value ± standard error", "unit", "", "bounds", "note", "meaning")
    return table(header, rows, caption="Parameters")


def initial_table(fit: Fit) -> str:
    """Initial states of every record."""
    rows = [(record, fits.initial_words(fit, record)) for record in fit.initial]
    return table(("record", "initial states"), rows, caption="Initial states") if rows else ""


def percent_table(fit: Fit) -> str:
    """Fit percentages by record and output."""
    header = ("record", "output", "fit %, simulation", "fit %, one-step prediction")
    caption = "Fit, 100 % is perfect and 0 % no better than the mean (2.32)"
    return table(header, fits.fit_rows(fit), right=(2, 3), caption=caption)


def correlation_table(fit: Fit, *, most: int = 10) -> str:
    """The strongest correlations of the estimates."""
    pairs = fits.correlations(fit)[:most]
    rows = [(first, second, f"{value:+.3f}") for first, second, value in pairs]
    caption = "Strongest correlations of the estimates"
    return table(("parameter", "parameter", "correlation"), rows, right=(2,), caption=caption) if rows else ""


def measure_table(validation: Any) -> str:
    """Fit %, errors and whiteness of every output."""
    caption = "Fit and errors; S1 is the largest error, S2 the rms error, both in the output's unit"
    rows = validations.output_rows(validation)
    return table(validations.MEASURES, rows, right=range(3, 9), caption=caption)


def residual_table(validation: Any) -> str:
    """The residual tests, one row each, and whether fresh data agree with the parameters."""
    failed = set(validation.failed)
    rows = [
        (
            name,
            validations.p_text(test),
            "-" if test.dof is None else str(test.dof),
            str(test.samples) if hasattr(test, "samples") else "-",
            "FAILED" if name in failed else f"not made: {test.why}" if test.p_value is None else "passed",
        )
        for name, test in validations.all_tests(validation).items()
    ]
    caption = f"Residual tests, failed by Holm's rule at alpha = {validation.alpha:g}"
    return table(("test", "p", "dof", "samples", "verdict"), rows, right=(1, 2, 3), caption=caption)


def simulated_rows(result: Simulated) -> list[tuple[str, str, str, str]]:
    """Record, samples, duration and file of every simulated record."""
    files = [*result.files, *[""] * len(result.simulated)]
    return [
        (one.name, fits.count(one.samples), f"{one.duration:.6g}", files[index])
        for index, one in enumerate(result.simulated)
    ]
