"""Torsional chains: inertias on a line, or a tree, joined by spring-damper couplings, any number of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from casadi_engine.errors import ModelError
from casadi_engine.model.blueprint import Blueprint

SPEED_SCALE = 100.0
TWIST_SCALE = 0.1


@dataclass(frozen=True, eq=False)
class Inertia:
    """One inertia of a chain.

    port, state : names of its port and of its speed state
    inertia : J [kg m2]        damping : absolute damper [N m s/rad], None for none (numbers or SX)
    angle : its angle [rad] as an SX expression if it is known, for the port's signals
    description : one clause for tables
    """

    port: str
    state: str
    inertia: Any
    damping: Any = None
    angle: Any = None
    description: str = ""


@dataclass(frozen=True, eq=False)
class Coupling:
    """The coupling between an inertia and the next: K [N m/rad], C [N m s/rad] and its names.

    behind : index of an earlier inertia that the next one is coupled to instead, which makes a branch
    """

    port: str
    state: str
    stiffness: Any
    damping: Any
    description: str = ""
    behind: int | None = None


@dataclass(frozen=True, eq=False)
class Chain:
    """A chain whose states and ports are declared: speeds [rad/s], twists [rad], inner torques [N m].

    `torques[i]` acts on inertia i: of its absolute damper, its couplings and the slots of these ports.
    `rates` are the twists' rates [rad/s]; `angles` the inertias' angles [rad], None where not known.
    `slots` are those of the inertias' ports, then of the couplings'.
    """

    inertias: tuple[Inertia, ...]
    couplings: tuple[Coupling, ...]
    speeds: tuple[Any, ...]
    twists: tuple[Any, ...]
    torques: tuple[Any, ...]
    rates: tuple[Any, ...]
    angles: tuple[Any, ...]
    slots: tuple[Any, ...]


def declare_chain(
    b: Blueprint, inertias: Sequence[Inertia], couplings: Sequence[Coupling], *, angle: Any = None
) -> Chain:
    """Declare the states and ports of a chain and work out the torques inside it.

    The states are in the order of the thesis's appendix A, [ω1, ω2, twist21, ω3, twist32, …], with
    twist_{i+1,i} = θ_{i+1} − θ_i: a positive twist pulls inertia i forwards.
    angle : SX angle of the first inertia [rad]; all others then follow by the twists. None: an inertia's own
    ModelError if there is not one coupling fewer than inertias, or one is behind an inertia that follows it.
    """
    near = _near_sides(inertias, couplings)
    speeds: list[Any] = []
    twists: list[Any] = []
    for index, body in enumerate(inertias):
        speeds.append(b.state(body.state, unit="rad/s", scale=SPEED_SCALE, description=body.description))
        if index:
            joint = couplings[index - 1]
            twists.append(b.state(joint.state, unit="rad", scale=TWIST_SCALE, description=joint.description))
    angles = [body.angle for body in inertias] if angle is None else [angle]
    if angle is not None:
        for side, twist in zip(near, twists, strict=True):
            angles.append(angles[side] + twist)
    torques: list[Any] = []
    slots: list[Any] = []
    for body, speed, turned in zip(inertias, speeds, angles, strict=True):
        signals = {"speed": speed} | ({} if turned is None else {"angle": turned})
        slot = b.port(body.port, "inertia", signals, description=body.description)
        slots.append(slot)
        torques.append(slot if body.damping is None else -body.damping * speed + slot)
    rates = [speeds[index + 1] - speeds[side] for index, side in enumerate(near)]
    for index, (joint, side) in enumerate(zip(couplings, near, strict=True)):
        signals = {"twist": twists[index], "twist_rate": rates[index], "stiffness": joint.stiffness}
        slot = b.port(joint.port, "coupling", signals, description=joint.description)
        slots.append(slot)
        torque = joint.stiffness * twists[index] + joint.damping * rates[index] + slot
        torques[side] = torques[side] + torque
        torques[index + 1] = torques[index + 1] - torque
    return Chain(*map(tuple, (inertias, couplings, speeds, twists, torques, rates, angles, slots)))


def write_chain(b: Blueprint, chain: Chain, outer: Sequence[Any]) -> None:
    """Write the odes of a chain with the torques `outer` [N m] that act on its inertias from outside."""
    for body, inner, torque in zip(chain.inertias, chain.torques, outer, strict=True):
        b.ode(body.state, (inner + torque) / body.inertia)
    for joint, rate in zip(chain.couplings, chain.rates, strict=True):
        b.ode(joint.state, rate)


def _near_sides(inertias: Sequence[Inertia], couplings: Sequence[Coupling]) -> list[int]:
    """For each coupling the index of the inertia on its first side."""
    if len(couplings) != len(inertias) - 1:
        raise ModelError(
            "the chain's couplings do not fit its inertias",
            seen=f"{len(inertias)} inertias, {len(couplings)} couplings",
            allowed="one coupling fewer than inertias",
            cure="give the coupling between each inertia and the next",
        )
    near = [index if joint.behind is None else joint.behind for index, joint in enumerate(couplings)]
    for index, side in enumerate(near):
        if not 0 <= side <= index:
            raise ModelError(
                f"the coupling {couplings[index].port} is behind an inertia that does not come before it",
                seen=f"behind={side}",
                allowed=f"0 to {index}, counted from 0",
                cure="list the inertias from the first one outwards",
            )
    return near
