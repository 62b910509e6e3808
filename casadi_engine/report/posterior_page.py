"""The pages of a posterior and of a comparison: marginals, pairs, modes, and what the draws foretell of the records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from casadi_engine.posterior.comparison import Comparison
from casadi_engine.posterior.result import Posterior
from casadi_engine.report import posterior_figures  # noqa: F401  registers the figures
from casadi_engine.report.figures import figures
from casadi_engine.report.page import Section
from casadi_engine.report.sections import DRAWN, Page, _data, _how, _model, page_of
from casadi_engine.report.tables import as_html

_PAIRS = "Draws of every two parameters; crosses are modes"
_FORETOLD = "Measured outputs, and the 95 % of the simulations with drawn parameters; below less their median"


@page_of.register
def _(result: Posterior, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    fit, made = result.fit, figures(result)
    wanted = [
        (
            result,
            "overview",
            "Each parameter: its draws, its prior, and the normal density of the fit's error",
        )
    ]
    if "pairs" in made:
        wanted.append((result, "pairs", _PAIRS))
    wanted.append(
        (result, "modes", "How far the modes lie below the highest, and the share of the draws in each")
    )
    foretold = [(result, name, _FORETOLD) for name in made if name.startswith("prediction ")]
    sections = [
        Section("posterior", "Posterior", preformatted=[str(result)]),
        Section("parameters", "Parameters", tables=[as_html(result)], wanted=wanted),
        Section("predictions", "What the draws foretell", wanted=foretold[:DRAWN]),
        _model(fit.model),
        _data(fit.data),
        _how(arguments, fit.options, {"posterior": result.seconds}),
    ]
    return f"Posterior of {fit.model.name}", fit.model.description, sections


@page_of.register
def _(result: Comparison, _validation: Any, arguments: Mapping[str, Any]) -> Page:
    wanted = [(result, "overview", "Log evidence of each model below that of the best")]
    section = Section("comparison", "Comparison", preformatted=[str(result)], wanted=wanted)
    return "Comparison of models", "", [section, _how(arguments, {}, {})]
