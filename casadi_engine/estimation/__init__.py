"""Estimation: the multiple-shooting problem, its solution, and the uncertainty of the answer."""

from casadi_engine.estimation.estimate import estimate
from casadi_engine.estimation.fit import Direction, Estimate, Fit, Optimum, Trace
from casadi_engine.estimation.simulate import simulate

__all__ = ["Direction", "Estimate", "Fit", "Optimum", "Trace", "estimate", "simulate"]
