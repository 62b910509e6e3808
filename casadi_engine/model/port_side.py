"""Whether the slot of a port acts the right way round: friction there has to brake."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import EffectError
from casadi_engine.model.declarations import Port

if TYPE_CHECKING:
    from casadi_engine.model.model import Model

Array = NDArray[np.float64]

# What is said of a slot that does not act the right way round.
TURNED = "acts the other way round"
# States at which the side of a slot is tried, in their scales.
_TRIED = (0.3, 0.7, -0.7, 7.0, 70.0, 700.0)


def acts_right(model: Model, port: Port) -> bool:
    """True unless the slot of a port acts the other way round."""
    return _wrong_signal(model, port) is None


def check_side(model: Model, port: Port) -> None:
    """Raise EffectError where the slot of a port acts the other way round: friction would drive.

    What acts in an inertia's slot must raise its speed; in a coupling's, pull the twist back. Tried at the start values
    of the parameters, without the effects that are attached: a mass that a search has made negative is no fault of the
    slot; and over decades of the states: where it hangs on them, as a compliance on a pressure, nothing is known.
    Nothing is known either of a speed that is what drives less what the states take back, as the current of a motor
    whose coil has no inductance: it follows what stands in the slot at once, and falls as the motor speeds up.
    """
    signal = _wrong_signal(model, port)
    if signal is not None:
        raise EffectError(
            f"the slot of the port {port.name} {TURNED}: friction there would drive",
            seen=f"a positive torque or force in it {'slows' if port.kind == 'inertia' else 'widens'} {signal}",
            allowed="one that raises the speed of an inertia, and pulls back the twist of a coupling",
            cure=f"exchange the sign of the slot of {port.name} in the ode (and of its law, if it has one), or of "
            f"the signal {signal}",
        )


def _wrong_signal(model: Model, port: Port) -> str | None:
    """The signal of a port that its slot moves the other way round."""
    if port.slot is None or port.kind not in ("inertia", "coupling"):
        return None
    signals = ("speed",) if port.kind == "inertia" else ("twist", "twist_rate")
    signal = next((name for name in signals if name in port.signals), None)
    if signal is None:
        return None
    moved, sign = port.signals[signal], 1 if port.kind == "inertia" else -1
    # what each state does to the signal, and the slot to each state
    ways = [ca.jacobian(moved, model.x), ca.jacobian(_at_rest(model), port.slot)]
    slope = ca.Function(
        "slope",
        [model.x, model.u, model.d, model.w, model.t, model.p],
        [_first_slope(model, port, moved), *ways],
        {"allow_free": True},
    )
    if slope.get_free():
        return None
    of_effects = tuple(f"{one.at}.{one.effect.name}." for one in model.effects)
    values = np.array(
        [0.0 if of_effects and one.name.startswith(of_effects) else one.value for one in model.declarations]
    )
    scale = np.array([variable.scale for variable in model.states])
    found = [[np.array(part) for part in slope(share * scale, 0, 0, 0, 0.0, values)] for share in _TRIED]
    known = [slope for slope in (float(one[0].item()) for one in found) if math.isfinite(slope)]
    if not known or not all(sign * one < 0 for one in known):
        return None
    driven = port.kind == "inertia" and ca.depends_on(moved, ca.vertcat(model.u, model.d))
    if driven and all(_is_taken_back(by[0], push[:, 0]) for _, by, push in found):
        return None
    return signal


def _is_taken_back(by: Array, push: Array) -> bool:
    """True if the slot raises states (n,) and these lower the signal; or where that is not known."""
    at = push != 0
    known = np.isfinite(by).all() and np.isfinite(push).all()
    return not known or bool((by[at] <= 0).all() and (push[at] >= 0).all())


def _at_rest(model: Model) -> ca.SX:
    return ca.substitute(model.ode, model.d, ca.SX.zeros(model.d.shape))


def _first_slope(model: Model, port: Port, moved: ca.SX) -> ca.SX:
    """By how much the slot of a port moves the lowest derivative of a signal that it moves at all: the second one of
    the twist between two masses, the first where a damper stands between its ends alone."""
    ode = _at_rest(model)
    for _ in range(2):
        moved = ca.jtimes(moved, model.x, ode)
        if ca.depends_on(moved, port.slot):
            break
    return ca.jacobian(moved, port.slot)
