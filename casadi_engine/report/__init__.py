"""Report: tables, figures and self-contained pages of the results."""

import casadi_engine.report.identifiability_figures
import casadi_engine.report.modes_figures
import casadi_engine.report.orders_figures
import casadi_engine.report.repaired
import casadi_engine.report.repaired_figures
import casadi_engine.report.repaired_page
import casadi_engine.report.stored_view  # noqa: F401  registers what it draws
from casadi_engine.report.figures import plot
from casadi_engine.report.kinds import Simulated
from casadi_engine.report.page import report
from casadi_engine.report.result_file import to_result, write_result
from casadi_engine.report.stored import Result, load_result
from casadi_engine.report.tables import as_html, fit_html, fit_text, text, validation_html, validation_text

__all__ = [
    "Result",
    "Simulated",
    "as_html",
    "fit_html",
    "fit_text",
    "load_result",
    "plot",
    "report",
    "text",
    "to_result",
    "validation_html",
    "validation_text",
    "write_result",
]
