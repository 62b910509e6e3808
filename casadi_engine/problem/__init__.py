"""Problem: a model, its parameters, a reader, records and noise."""

from casadi_engine.problem.load import load_problem
from casadi_engine.problem.noise import Noise
from casadi_engine.problem.problem import NAME, Problem

__all__ = ["NAME", "Noise", "Problem", "load_problem"]
