"""Models: symbolic equations of motion, their ports, builders, modes and printed form."""

from casadi_engine.model.blueprint import Blueprint
from casadi_engine.model.builders import one_inertia, two_mass
from casadi_engine.model.chain import Chain, Coupling, Inertia, declare_chain, write_chain
from casadi_engine.model.crank_slider import Geometry
from casadi_engine.model.crankshaft import Driven, crankshaft, thesis_ties
from casadi_engine.model.declarations import ParameterDeclaration, Port, Ports, Variable
from casadi_engine.model.firing import firing_offsets
from casadi_engine.model.linear import LinearCore
from casadi_engine.model.model import Model
from casadi_engine.model.modes import Modes, matrix_derivatives, natural_frequency_derivatives
from casadi_engine.model.receptance import Receptance, receptance
from casadi_engine.model.reduction import Reduction, reduce

__all__ = [
    "Blueprint",
    "Chain",
    "Coupling",
    "Driven",
    "Geometry",
    "Inertia",
    "LinearCore",
    "Model",
    "Modes",
    "ParameterDeclaration",
    "Port",
    "Ports",
    "Receptance",
    "Reduction",
    "Variable",
    "crankshaft",
    "declare_chain",
    "firing_offsets",
    "matrix_derivatives",
    "natural_frequency_derivatives",
    "one_inertia",
    "receptance",
    "reduce",
    "thesis_ties",
    "two_mass",
    "write_chain",
]
