"""Validation: how well a model explains data, and whether its residuals are white."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.estimation.fit_percent import FitMeasures, fit_measures
    from casadi_engine.validation.correlation import Correlation, autocorrelation, cross_correlation
    from casadi_engine.validation.residual_tests import (
        ResidualChecks,
        ResidualTest,
        check_residual,
        independence,
        rejected,
        whiteness,
    )
    from casadi_engine.validation.validate import OutputCheck, Validation, validate

__all__ = [
    "Correlation",
    "FitMeasures",
    "OutputCheck",
    "ResidualChecks",
    "ResidualTest",
    "Validation",
    "autocorrelation",
    "check_residual",
    "cross_correlation",
    "fit_measures",
    "independence",
    "rejected",
    "validate",
    "whiteness",
]

import_at_first_use(
    __name__,
    {
        "casadi_engine.estimation.fit_percent": ("FitMeasures", "fit_measures"),
        "casadi_engine.validation.correlation": ("Correlation", "autocorrelation", "cross_correlation"),
        "casadi_engine.validation.residual_tests": (
            "ResidualChecks",
            "ResidualTest",
            "check_residual",
            "independence",
            "rejected",
            "whiteness",
        ),
        "casadi_engine.validation.validate": ("OutputCheck", "Validation", "validate"),
    },
)
