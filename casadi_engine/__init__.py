"""casadi-engine: grey-box identification of engine-load systems in CasADi."""

from casadi_engine import effects
from casadi_engine.discrepancy import repair
from casadi_engine.effects import Effect
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import estimate, simulate
from casadi_engine.experiment import Experiment, orders, read_experiment
from casadi_engine.identifiability import choose_experiments, identifiability, profile
from casadi_engine.model import Blueprint, Model, crankshaft, one_inertia, two_mass
from casadi_engine.parameters import Parameters
from casadi_engine.problem import Noise, Problem, load_problem
from casadi_engine.report import load_result, plot, report
from casadi_engine.validation import validate

__version__ = "0.8.0"

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
    "one_inertia",
    "orders",
    "plot",
    "profile",
    "read_experiment",
    "repair",
    "report",
    "simulate",
    "two_mass",
    "validate",
]
