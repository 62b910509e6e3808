"""Physical effects that a model may lack: the protocol for your own, and the library.

An effect can act at a port of its kind that has the signals which its law reads. ``print(ce.effects.table())``, or
``python -m casadi_engine.effects``, lists formulas, ports and signals of the library, ``print(model.ports)`` what the
ports of a model have, ``ports_for(model, effect)`` where it fits.
"""

from typing import TYPE_CHECKING

from casadi_engine.lazy import import_at_first_use

if TYPE_CHECKING:
    from casadi_engine.effects.ambient_loss import AmbientLoss
    from casadi_engine.effects.candidate import Candidate, candidate, candidates, cycles_of
    from casadi_engine.effects.combustion import CylinderImbalance, Misfire
    from casadi_engine.effects.cross_sensitivity import CrossSensitivity
    from casadi_engine.effects.edge import EndStop, LowerEndStop, Relief
    from casadi_engine.effects.events import by_record
    from casadi_engine.effects.friction import (
        AsymmetricFriction,
        CoulombFriction,
        QuadraticDrag,
        StribeckFriction,
        ViscousFriction,
    )
    from casadi_engine.effects.functions import Sharp, Smooth
    from casadi_engine.effects.inputs import InputDelay, InputGain, InputLag, InputOffset, InputPath
    from casadi_engine.effects.library import library
    from casadi_engine.effects.orifice import OrificeLeak
    from casadi_engine.effects.parameter import WrongValue
    from casadi_engine.effects.protocol import Amplitude, Effect, Grid, Law
    from casadi_engine.effects.radiation import Radiation
    from casadi_engine.effects.sensor import (
        SensorDelay,
        SensorDrift,
        SensorGain,
        SensorLag,
        SensorOffset,
    )
    from casadi_engine.effects.stiffness import Backlash, CubicStiffness, GroundSpring
    from casadi_engine.effects.storage import HiddenStorage, Relaxation
    from casadi_engine.effects.table import table
    from casadi_engine.effects.torque import ConstantTorque, Impulse, LoadStep
    from casadi_engine.effects.transfer import Overflow, Transfer
    from casadi_engine.model.combustion import Motored, fit_motored
    from casadi_engine.model.port_view import port_view
    from casadi_engine.model.term import ports_for

__all__ = [
    "AmbientLoss",
    "Amplitude",
    "AsymmetricFriction",
    "Backlash",
    "Candidate",
    "ConstantTorque",
    "CoulombFriction",
    "CrossSensitivity",
    "CubicStiffness",
    "CylinderImbalance",
    "Effect",
    "EndStop",
    "Grid",
    "GroundSpring",
    "HiddenStorage",
    "Impulse",
    "InputDelay",
    "InputGain",
    "InputLag",
    "InputOffset",
    "InputPath",
    "Law",
    "LoadStep",
    "LowerEndStop",
    "Misfire",
    "Motored",
    "OrificeLeak",
    "Overflow",
    "QuadraticDrag",
    "Radiation",
    "Relaxation",
    "Relief",
    "SensorDelay",
    "SensorDrift",
    "SensorGain",
    "SensorLag",
    "SensorOffset",
    "Sharp",
    "Smooth",
    "StribeckFriction",
    "Transfer",
    "ViscousFriction",
    "WrongValue",
    "by_record",
    "candidate",
    "candidates",
    "cycles_of",
    "fit_motored",
    "library",
    "port_view",
    "ports_for",
    "table",
]

import_at_first_use(
    __name__,
    {
        "casadi_engine.effects.ambient_loss": ("AmbientLoss",),
        "casadi_engine.effects.candidate": ("Candidate", "candidate", "candidates", "cycles_of"),
        "casadi_engine.effects.combustion": ("CylinderImbalance", "Misfire"),
        "casadi_engine.effects.cross_sensitivity": ("CrossSensitivity",),
        "casadi_engine.effects.edge": ("EndStop", "LowerEndStop", "Relief"),
        "casadi_engine.effects.events": ("by_record",),
        "casadi_engine.effects.friction": (
            "AsymmetricFriction",
            "CoulombFriction",
            "QuadraticDrag",
            "StribeckFriction",
            "ViscousFriction",
        ),
        "casadi_engine.effects.library": ("library",),
        "casadi_engine.effects.orifice": ("OrificeLeak",),
        "casadi_engine.effects.parameter": ("WrongValue",),
        "casadi_engine.effects.radiation": ("Radiation",),
        "casadi_engine.effects.inputs": ("InputDelay", "InputGain", "InputLag", "InputOffset", "InputPath"),
        "casadi_engine.effects.sensor": (
            "SensorDelay",
            "SensorDrift",
            "SensorGain",
            "SensorLag",
            "SensorOffset",
        ),
        "casadi_engine.effects.stiffness": ("Backlash", "CubicStiffness", "GroundSpring"),
        "casadi_engine.effects.table": ("table",),
        "casadi_engine.effects.storage": ("HiddenStorage", "Relaxation"),
        "casadi_engine.effects.torque": ("ConstantTorque", "Impulse", "LoadStep"),
        "casadi_engine.effects.transfer": ("Overflow", "Transfer"),
        "casadi_engine.model.combustion": ("Motored", "fit_motored"),
        "casadi_engine.effects.protocol": ("Amplitude", "Effect", "Grid", "Law"),
        "casadi_engine.effects.functions": ("Sharp", "Smooth"),
        "casadi_engine.model.port_view": ("port_view",),
        "casadi_engine.model.term": ("ports_for",),
    },
)
