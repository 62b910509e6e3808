"""Models: symbolic equations of motion, their ports, builders, modes and printed form."""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
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

import_at_first_use(
    __name__,
    {
        "casadi_engine.model.blueprint": ("Blueprint",),
        "casadi_engine.model.builders": ("one_inertia", "two_mass"),
        "casadi_engine.model.chain": ("Chain", "Coupling", "Inertia", "declare_chain", "write_chain"),
        "casadi_engine.model.crank_slider": ("Geometry",),
        "casadi_engine.model.crankshaft": ("Driven", "crankshaft", "thesis_ties"),
        "casadi_engine.model.declarations": ("ParameterDeclaration", "Port", "Ports", "Variable"),
        "casadi_engine.model.firing": ("firing_offsets",),
        "casadi_engine.model.linear": ("LinearCore",),
        "casadi_engine.model.model": ("Model",),
        "casadi_engine.model.modes": ("Modes", "matrix_derivatives", "natural_frequency_derivatives"),
        "casadi_engine.model.receptance": ("Receptance", "receptance"),
        "casadi_engine.model.reduction": ("Reduction", "reduce"),
    },
)
