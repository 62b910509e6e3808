"""Parameters: values, bounds, ties, constraints, priors and their map to the vector that is estimated."""

from casadi_engine.parameters.collection import Parameters
from casadi_engine.parameters.compiled import CompiledConstraint, CompiledPrior, ParameterMap, compile
from casadi_engine.parameters.constraint import Constraint, FrequencyConstraint
from casadi_engine.parameters.expression import parse_expression, write_expression
from casadi_engine.parameters.names import near_matches
from casadi_engine.parameters.parameter import Parameter

__all__ = [
    "CompiledConstraint",
    "CompiledPrior",
    "Constraint",
    "FrequencyConstraint",
    "Parameter",
    "ParameterMap",
    "Parameters",
    "compile",
    "near_matches",
    "parse_expression",
    "write_expression",
]
