"""Builder of crankshafts: damping wheel, 1 to 12 cylinders, flywheel and what they drive (appendix A)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any, Literal

from casadi_engine.errors import ModelError
from casadi_engine.model.blueprint import Blueprint
from casadi_engine.model.builders import (
    crank_angle,
    damper_parameter,
    declare_outputs,
    inertia_parameter,
    load_drive,
    stiffness_parameter,
)
from casadi_engine.model.chain import Chain, Coupling, Inertia, declare_chain, write_chain
from casadi_engine.model.crank_slider import Geometry
from casadi_engine.model.cylinders import (
    CylinderOptions,
    ReciprocatingInertia,
    ReciprocatingSpeed,
    check_option,
    declare_cylinders,
    vary_inertia,
)
from casadi_engine.model.model import Model
from casadi_engine.parameters import Parameters, near_matches

Angle = Literal["measured", "state"]

MOST_CYLINDERS = 12
# Table 4.12 of the thesis, which prints the reciprocals of inertias, and the values fixed in its listing.
J_WHEEL, J_CYLINDER, J_FLYWHEEL = 1 / 33.39, 1 / 22.3, 1 / 5.968
K_WHEEL, K_CYLINDER, K_FLYWHEEL = 241.8e3, 1270e3, 1427e3
C_WHEEL, C_COUPLING, C_ABSOLUTE = 15.0, 2.5, 0.1541 / 4


@dataclass(frozen=True)
class Driven:
    """An inertia that the crankshaft drives through a coupling; the defaults are the thesis's dynamometer.

    inertia : J [kg m2]        stiffness : K [N m/rad]        damping : C [N m s/rad], of the coupling
    absolute_damping : damper to the ground [N m s/rad] of its bearings, C7 for inertia 7; None for none
    behind : number of the inertia it is coupled to (1 is the wheel), which makes a branch; None: the one before
    load : name of a channel of a braking torque on it [N m], or None
    description : one clause for tables
    """

    inertia: float = 1 / 5.646
    stiffness: float = 1992.0
    damping: float = 2.5
    absolute_damping: float | None = None
    behind: int | None = None
    load: str | None = None
    description: str = "dynamometer"


def crankshaft(
    *,
    name: str = "crankshaft",
    cylinders: int = 4,
    firing_order: Sequence[int] | None = None,
    firing_offsets: Sequence[float] | None = None,
    geometry: Geometry | Mapping[str, float] | None = None,
    reciprocating_speed: ReciprocatingSpeed = "model",
    reciprocating_inertia: ReciprocatingInertia = "mean",
    angle: Angle = "measured",
    driven: Sequence[Driven | Mapping[str, Any]] = (Driven(),),
    outputs: Sequence[str] = ("omega",),
) -> Model:
    """Build a crankshaft as a chain of inertias: J1 damping wheel, one for each cylinder, flywheel, driven ones.

    With four cylinders and one driven inertia these are the thesis's 7 degrees of freedom (Figure 3.6).
    States omega_1, omega_2, twist_21, omega_3, twist_32, … [rad/s, rad] in the order of appendix A; parameters
    J1… [kg m2], K21… [N m/rad], C21… and absolute dampers C2… of the cylinders [N m s/rad] with the defaults of
    Table 4.12 and its listing, repeated for other numbers of cylinders, and the fixed r, L, A_p, m_eq, p_crank;
    channels theta [rad] (of the wheel, 0 at the combustion TDC of cylinder 1), p1… [Pa], T_load [N m].

    cylinders : 1 to 12. firing_order, firing_offsets [rad], geometry, reciprocating_inertia : as in `two_mass`
    reciprocating_speed : "model", the nonlinear form: each cylinder sees its own inertia's angle and speed;
        "measured", the linear form: all see the channels theta and omega [rad/s], so that drives need no states
    angle : for the nonlinear form. "measured": the channel theta and the twists up to the cylinder; "state": one
        more state, theta_1 [rad], the first, with the gas forces F_1… [N] as drives and no channel theta
    driven : inertias behind the flywheel or elsewhere, Driven or mappings of its fields; () for none. If none
        names a load, the channel T_load brakes the last inertia
    outputs : of "omega" (wheel), "omega_load" (the first inertia with a load), and "theta" with angle="state"
    ModelError, ParameterError if the options do not fit together. Source: thesis chapter 3 and appendix A.

    >>> model = crankshaft(reciprocating_speed="measured")
    >>> model.linear.A.shape, [drive.name for drive in model.drives]
    ((13, 13), ['T_1', 'T_2', 'T_3', 'T_4', 'T_load'])
    """
    count = _checked_cylinders(cylinders)
    options = CylinderOptions(
        count, firing_order, firing_offsets, geometry, reciprocating_speed, reciprocating_inertia
    )
    _check_angle(angle, reciprocating_speed)
    line = _with_load(_read_driven(driven, count + 2))
    b = Blueprint(name, description=f"crankshaft with {count} cylinder{'s' * (count > 1)}")
    bodies, joints = _parts(b, count, line)
    theta = crank_angle(b) if angle == "measured" else None
    start = b.state("theta_1", unit="rad", description="angle of the wheel") if theta is None else theta
    chain = declare_chain(b, bodies, joints, angle=start)
    write_chain(b, chain, _outer_torques(b, options, chain, line, theta))
    if theta is None:
        b.ode("theta_1", chain.speeds[0])
    loaded = next(k for k, one in enumerate(line) if one.load is not None)
    known = {
        "omega": (chain.speeds[0], "speed of the wheel"),
        "omega_load": (chain.speeds[count + 1 + loaded], f"speed of the {line[loaded].description}"),
    }
    declare_outputs(b, outputs, known | ({"theta": (start, "angle of the wheel")} if theta is None else {}))
    return b.model()


def thesis_ties(parameters: Parameters) -> Parameters:
    """Return a copy of a crankshaft's parameters with the ties (4.15) and (4.16) and what the thesis holds fixed.

    The cylinders' inertias are tied to J2, the stiffnesses between them to K32, the dampers to C32, and the
    absolute dampers to C_eng/cylinders of an added parameter C_eng [N m s/rad], their sum. C_eng, all dampers
    and everything behind the flywheel are fixed at their values; the rest keeps its settings, but bounds of tied
    parameters that say no more than those of J2 or K32 are dropped. For four cylinders that leaves six free:
    J1, J2, J6, K21, K32, K65. ModelError for the parameters of another model, TieError for fixed ones.

    >>> pars = thesis_ties(crankshaft().parameters())
    >>> [name for name in pars if pars[name].vary and not pars[name].tie]
    ['J1', 'J2', 'J6', 'K21', 'K32', 'K65']
    """
    if not isinstance(parameters, Parameters):
        raise _not_tied(type(parameters).__name__)
    made = parameters.copy()
    count = 0
    while f"C{count + 2}" in made and f"J{count + 2}" in made:
        count += 1
    needed = ["J1", "K21", "C21", f"J{count + 2}", f"K{count + 2}{count + 1}", "m_eq"]
    missing = [each for each in needed if each not in made]
    if missing or not count or "C_eng" in made:
        raise _not_tied(", ".join(made.names[:8]) + (", C_eng" if "C_eng" in made else ""))
    total = sum(made[f"C{i}"].value for i in range(2, count + 2))
    made.add("C_eng", total, unit="N m s/rad", min=0, max=1e6, vary=False, description="all absolute damping")
    for i in range(2, count + 2):
        made.tie(f"C{i}", f"C_eng/{count}")
    for i in range(3, count + 2):
        _tie_equal(made, f"J{i}", "J2")
    for i in range(4, count + 2):
        _tie_equal(made, f"K{i}{i - 1}", "K32")
        _tie_equal(made, f"C{i}{i - 1}", "C32")
    made.fix("C21")
    made.fix(f"C{count + 2}{count + 1}")
    if count > 1:
        made.fix("C32")
    number = count + 3
    while f"J{number}" in made:
        links = [f"{letter}{number}{i}" for letter in "KC" for i in range(1, number)] + [f"C{number}"]
        for each in (f"J{number}", *(link for link in links if link in made)):
            made.fix(each)
        number += 1
    return made


def _outer_torques(
    b: Blueprint, options: CylinderOptions, chain: Chain, line: Sequence[Driven], theta: Any
) -> list[Any]:
    """Declare cylinders and loads; for each inertia the torque from outside the chain [N m]."""
    count = options.cylinders
    throws = range(1, count + 1)  # the inertias of the cylinders, counted from 0
    linear = options.reciprocating_speed == "measured"
    made = declare_cylinders(
        b,
        options,
        theta=theta,
        speeds=[chain.speeds[i] for i in throws],
        angles=None if linear else [chain.angles[i] for i in throws],
    )
    outer: list[Any] = [0] * len(chain.inertias)
    for i, drive, slot in zip(throws, made.drives, made.slots, strict=True):
        outer[i] = drive + slot + made.common / count
    for index, one in enumerate(line, start=count + 1):
        if one.load is not None:
            outer[index] -= load_drive(b, one.load)
    if options.reciprocating_inertia == "variable":
        _vary_inertias(b, chain, made.inertia_change, outer)
    return outer


def _tie_equal(parameters: Parameters, name: str, leader: str) -> None:
    """Tie two parameters; bounds that the leader's imply go, or each would be a constraint of the fit."""
    one, other = parameters[name], parameters[leader]
    if one.min <= other.min and one.max >= other.max:
        one.set(min=-math.inf, max=math.inf)
    parameters.tie(name, leader)


def _parts(b: Blueprint, count: int, line: Sequence[Driven]) -> tuple[list[Inertia], list[Coupling]]:
    """Declare the parameters; the inertias and couplings of a chain, first those of the wheel to the flywheel."""
    flywheel = count + 2
    words = ["damping wheel", *(f"cylinder {k}" for k in range(1, count + 1)), "flywheel"]
    words += [one.description for one in line[1:]]
    j_values = [J_WHEEL, *[J_CYLINDER] * count, J_FLYWHEEL, *(one.inertia for one in line[1:])]
    k_values = [K_WHEEL, *[K_CYLINDER] * (count - 1), K_FLYWHEEL, *(one.stiffness for one in line[1:])]
    c_values = [C_WHEEL, *[C_COUPLING] * count, *(one.damping for one in line[1:])]
    behind = [*range(1, flywheel), *(one.behind or flywheel + i for i, one in enumerate(line[1:]))]
    labels = [f"{far}{near}" for far, near in enumerate(behind, start=2)]
    inertias = [
        inertia_parameter(b, f"J{i}", value, f"inertia of the {word}")
        for i, (value, word) in enumerate(zip(j_values, words, strict=True), start=1)
    ]
    between = [f"{words[near - 1]} and {words[far - 1]}" for far, near in enumerate(behind, start=2)]
    links = list(zip(labels, between, strict=True))
    stiffness = [
        stiffness_parameter(b, f"K{label}", value, f"stiffness between {word}")
        for (label, word), value in zip(links, k_values, strict=True)
    ]
    damping = [
        damper_parameter(b, f"C{label}", value, f"damping between {word}")
        for (label, word), value in zip(links, c_values, strict=True)
    ]
    absolute: list[Any] = [None] * len(inertias)
    for i in range(2, count + 2):
        absolute[i - 1] = damper_parameter(b, f"C{i}", C_ABSOLUTE, f"absolute damping of {words[i - 1]}")
    for i, one in enumerate(line[1:], start=flywheel + 1):
        if one.absolute_damping is not None:
            text = f"absolute damping of {one.description}"
            absolute[i - 1] = damper_parameter(b, f"C{i}", one.absolute_damping, text)
    bodies = [
        Inertia(f"inertia_{i}", f"omega_{i}", inertia, damper, None, f"speed of the {word}")
        for i, (inertia, damper, word) in enumerate(zip(inertias, absolute, words, strict=True), start=1)
    ]
    joints = [
        Coupling(f"coupling_{label}", f"twist_{label}", k, c, f"theta_{far} - theta_{near}", near - 1)
        for far, (label, near, k, c) in enumerate(
            zip(labels, behind, stiffness, damping, strict=True), start=2
        )
    ]
    return bodies, joints


def _vary_inertias(b: Blueprint, chain: Chain, changes: Sequence[Any], outer: list[Any]) -> None:
    """Add to the torques on the cylinders' inertias what their changing inertia takes."""
    for k, change in enumerate(changes, start=1):
        torque = chain.torques[k] + outer[k]
        inertia = chain.inertias[k].inertia
        outer[k] += vary_inertia(
            b, change=change, inertia=inertia, torque=torque, port=f"variable_inertia_{k}"
        )


def _check_angle(angle: str, reciprocating_speed: str) -> None:
    check_option("angle", angle, ("measured", "state"))
    if reciprocating_speed == "measured" and angle == "state":
        raise ModelError(
            "the linear form takes the crank angle from its channel",
            seen='reciprocating_speed="measured", angle="state"',
            allowed='angle="state" with reciprocating_speed="model"',
            cure='set reciprocating_speed="model", or angle="measured"',
        )


def _checked_cylinders(cylinders: int) -> int:
    whole = isinstance(cylinders, Integral) and not isinstance(cylinders, bool)
    if not whole or not 1 <= cylinders <= MOST_CYLINDERS:
        raise ModelError(
            "the number of cylinders of a crankshaft is not acceptable",
            seen=repr(cylinders),
            allowed=f"a whole number from 1 to {MOST_CYLINDERS}",
            cure="give cylinders=4, for instance",
        )
    return int(cylinders)


def _read_driven(driven: Sequence[Driven | Mapping[str, Any]], flywheel: int) -> list[Driven]:
    """The driven inertias, checked; `flywheel` is the number of the inertia before them."""
    if isinstance(driven, Driven | Mapping | str) or not isinstance(driven, Sequence):
        raise _not_driven(driven)
    known = tuple(field.name for field in fields(Driven))
    made = []
    for number, one in enumerate(driven, start=flywheel + 1):
        if not isinstance(one, Driven | Mapping):
            raise _not_driven(one)
        for key in one if isinstance(one, Mapping) else ():
            if key not in known:
                raise ModelError(
                    "a driven inertia has no such quantity",
                    seen=repr(key),
                    allowed=near_matches(key, known),
                    cure=f"give {', '.join(known)}",
                )
        body = one if isinstance(one, Driven) else Driven(**one)
        whole = isinstance(body.behind, Integral) and not isinstance(body.behind, bool)
        if body.behind is not None and not (whole and 1 <= body.behind < number):
            raise ModelError(
                f"inertia {number} is behind an inertia that does not come before it",
                seen=f"behind={body.behind!r}",
                allowed=f"1 (the wheel) to {number - 1}, where {flywheel} is the flywheel; or None",
                cure="list driven inertias from the crankshaft outwards",
            )
        made.append(body)
    return made


def _with_load(others: list[Driven]) -> list[Driven]:
    """Put the flywheel before the driven inertias, and a load on the last of them if there is none yet."""
    line = [Driven(description="flywheel"), *others]
    if all(one.load is None for one in line):
        line[-1] = Driven(**(vars(line[-1]) | {"load": "T_load"}))
    return line


def _not_driven(seen: object) -> ModelError:
    return ModelError(
        "the driven inertias are not acceptable",
        seen=repr(seen),
        allowed="a sequence of Driven or of mappings of its fields",
        cure="give driven=(Driven(inertia=0.18, stiffness=1992, damping=2.5),), or () for none",
    )


def _not_tied(seen: str) -> ModelError:
    return ModelError(
        "these are not the parameters of a crankshaft, or they have its ties already",
        seen=seen,
        allowed="J1, J2, K21, C21, C2 and so on, without C_eng",
        cure="give crankshaft(...).parameters()",
    )
