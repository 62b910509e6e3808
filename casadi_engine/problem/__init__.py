"""Problem: a model, its parameters, a reader, records and noise."""

from casadi_engine.problem.noise import Noise

__all__ = ["Noise"]
