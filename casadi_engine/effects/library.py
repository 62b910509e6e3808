"""The effects that come with the package."""

from __future__ import annotations

from casadi_engine.effects.ambient_loss import AmbientLoss
from casadi_engine.effects.combustion import CylinderImbalance, Misfire
from casadi_engine.effects.cross_sensitivity import CrossSensitivity
from casadi_engine.effects.edge import EndStop, LowerEndStop, Relief
from casadi_engine.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousFriction,
)
from casadi_engine.effects.inputs import InputDelay, InputGain, InputLag, InputOffset, InputPath
from casadi_engine.effects.orifice import OrificeLeak
from casadi_engine.effects.parameter import WrongValue
from casadi_engine.effects.protocol import Effect
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
from casadi_engine.effects.torque import ConstantTorque, Impulse, LoadStep
from casadi_engine.effects.transfer import Overflow, Transfer
from casadi_engine.errors import EffectError
from casadi_engine.parameters import near_matches


def library(*names: str) -> tuple[Effect, ...]:
    """Return the effects that a search tries unless told otherwise, or those called `names`, which may be others too.

    By name alone: impulse, whose grid of times is long. EffectError for a name that there is not.

    >>> [effect.name for effect in library()][:3]
    ['coulomb_friction', 'viscous_friction', 'quadratic_drag']
    >>> library("backlash")[0].attaches
    ('coupling',)
    """
    everything: tuple[Effect, ...] = (
        CoulombFriction(),
        ViscousFriction(),
        QuadraticDrag(),
        StribeckFriction(),
        AsymmetricFriction(),
        ConstantTorque(),
        GroundSpring(),
        CubicStiffness(),
        Backlash(),
        EndStop(),
        LowerEndStop(),
        Relief(),
        AmbientLoss(),
        Radiation(),
        HiddenStorage(),
        Relaxation(),
        Misfire(),
        CylinderImbalance(),
        LoadStep(),
        SensorOffset(),
        SensorDrift(),
        SensorDelay(),
        SensorLag(),
        SensorGain(),
        CrossSensitivity(),
        InputGain(),
        InputOffset(),
        InputLag(),
        InputDelay(),
        InputPath(),
        Transfer(),
        Overflow(),
        OrificeLeak(),
        WrongValue(),
    )
    if not names:
        return everything
    known = {effect.name: effect for effect in (*everything, Impulse())}
    for name in names:
        if name not in known:
            raise EffectError(
                "the library has no such effect",
                seen=repr(name),
                allowed=near_matches(name, known),
                cure="choose one, or write your own by deriving from ce.Effect",
            )
    return tuple(known[name] for name in names)
