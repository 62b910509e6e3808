"""casadi-engine: grey-box identification of engine-load systems in CasADi."""

from typing import TYPE_CHECKING

from casadi_engine import effects
from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.detection import misfires
    from casadi_engine.discrepancy import repair
    from casadi_engine.effects import Effect
    from casadi_engine.errors import CasadiEngineError
    from casadi_engine.estimation import estimate, simulate
    from casadi_engine.experiment import Experiment, orders, read_experiment
    from casadi_engine.identifiability import choose_experiments, identifiability, profile
    from casadi_engine.model import Blueprint, Model, crankshaft, one_inertia, two_mass
    from casadi_engine.parameters import Parameters
    from casadi_engine.posterior import posterior
    from casadi_engine.problem import Noise, Problem, load_problem
    from casadi_engine.report import load_result, plot, report
    from casadi_engine.validation import validate

__version__ = "0.61.0"

__all__ = [
    "Blueprint",
    "CasadiEngineError",
    "Effect",
    "Experiment",
    "Model",
    "Noise",
    "Parameters",
    "Problem",
    "choose_experiments",
    "crankshaft",
    "effects",
    "estimate",
    "identifiability",
    "load_problem",
    "load_result",
    "misfires",
    "one_inertia",
    "orders",
    "plot",
    "posterior",
    "profile",
    "read_experiment",
    "repair",
    "report",
    "simulate",
    "two_mass",
    "validate",
]

import_at_first_use(
    __name__,
    {
        "casadi_engine.detection": ("misfires",),
        "casadi_engine.discrepancy": ("repair",),
        "casadi_engine.effects": ("Effect",),
        "casadi_engine.errors": ("CasadiEngineError",),
        "casadi_engine.estimation": ("estimate", "simulate"),
        "casadi_engine.experiment": ("Experiment", "orders", "read_experiment"),
        "casadi_engine.identifiability": ("choose_experiments", "identifiability", "profile"),
        "casadi_engine.model": ("Blueprint", "Model", "crankshaft", "one_inertia", "two_mass"),
        "casadi_engine.parameters": ("Parameters",),
        "casadi_engine.posterior": ("posterior",),
        "casadi_engine.problem": ("Noise", "Problem", "load_problem"),
        "casadi_engine.report": ("load_result", "plot", "report"),
        "casadi_engine.validation": ("validate",),
    },
)
