"""Estimation: the multiple-shooting problem, its solution, and the uncertainty of the answer."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.estimation.batch import Task, fits
    from casadi_engine.estimation.estimate import estimate
    from casadi_engine.estimation.fit import Direction, Estimate, Fit, Optimum, Trace
    from casadi_engine.estimation.monte_carlo import MonteCarlo, monte_carlo
    from casadi_engine.estimation.prediction import Band, Prediction
    from casadi_engine.estimation.simulate import simulate
    from casadi_engine.estimation.study import study

__all__ = [
    "Band",
    "Direction",
    "Estimate",
    "Fit",
    "MonteCarlo",
    "Optimum",
    "Prediction",
    "Task",
    "Trace",
    "estimate",
    "fits",
    "monte_carlo",
    "simulate",
    "study",
]

import_at_first_use(
    __name__,
    {
        "casadi_engine.estimation.batch": ("Task", "fits"),
        "casadi_engine.estimation.estimate": ("estimate",),
        "casadi_engine.estimation.fit": ("Direction", "Estimate", "Fit", "Optimum", "Trace"),
        "casadi_engine.estimation.monte_carlo": ("MonteCarlo", "monte_carlo"),
        "casadi_engine.estimation.prediction": ("Band", "Prediction"),
        "casadi_engine.estimation.simulate": ("simulate",),
        "casadi_engine.estimation.study": ("study",),
    },
)
