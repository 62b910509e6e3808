"""Report: tables, figures and self-contained pages of the results."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.report.figures import plot
    from casadi_engine.report.kinds import Simulated
    from casadi_engine.report.page import report
    from casadi_engine.report.result_file import to_result, write_result
    from casadi_engine.report.stored import Result, load_result
    from casadi_engine.report.tables import (
        as_html,
        fit_html,
        fit_text,
        text,
        validation_html,
        validation_text,
    )

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

import_at_first_use(
    __name__,
    {
        "casadi_engine.report.figures": ("plot",),
        "casadi_engine.report.kinds": ("Simulated",),
        "casadi_engine.report.page": ("report",),
        "casadi_engine.report.result_file": ("to_result", "write_result"),
        "casadi_engine.report.stored": ("Result", "load_result"),
        "casadi_engine.report.tables": (
            "as_html",
            "fit_html",
            "fit_text",
            "text",
            "validation_html",
            "validation_text",
        ),
    },
)
