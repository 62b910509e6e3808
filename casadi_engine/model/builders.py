"""Builders of the engine-load models with one and two inertias, equations (2.37) and (4.1) to (4.5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from casadi_engine.errors import ModelError
from casadi_engine.model.blueprint import Blueprint
from casadi_engine.model.chain import SPEED_SCALE, Chain, Coupling, Inertia, declare_chain, write_chain
from casadi_engine.model.crank_slider import Geometry
from casadi_engine.model.cylinders import (
    TORQUE_SCALE,
    CylinderOptions,
    ReciprocatingInertia,
    ReciprocatingSpeed,
    check_option,
    declare_cylinders,
    vary_inertia,
)
from casadi_engine.model.model import Model

LoadKind = Literal["none", "measured", "constant"]

# Table 4.1 of the thesis, which prints the reciprocals 2.557 and 5.646 of the inertias.
J_ENG, J_LOAD, K_EL, C_EL, C_ENG = 1 / 2.557, 1 / 5.646, 1992.0, 2.5, 0.1541


def one_inertia(
    *,
    name: str = "one_inertia",
    cylinders: int = 0,
    firing_order: Sequence[int] | None = None,
    firing_offsets: Sequence[float] | None = None,
    geometry: Geometry | Mapping[str, float] | None = None,
    reciprocating_speed: ReciprocatingSpeed = "model",
    reciprocating_inertia: ReciprocatingInertia = "mean",
    load: LoadKind = "none",
    friction_torque: float | None = None,
) -> Model:
    """Build the engine as one rigid inertia, J_eng dω/dt = T − C_eng ω (2.37), output omega [rad/s].

    cylinders : 0 takes the engine torque from a channel T [N m]; N takes it from the crank angle theta [rad]
        (0 at the combustion TDC of cylinder 1) and the pressures p1…pN [Pa] by (3.1) to (3.6)
    firing_order, firing_offsets [rad], geometry, reciprocating_speed, reciprocating_inertia : as in
        `two_mass`; they are only for cylinders > 0
    load : "none"; "measured", a braking channel T_load [N m]; "constant", a braking parameter T_load [N m]
    friction_torque : default [N m] of a constant braking parameter T_f (the engine turns forwards), or None

    For a run-down recorded with cylinder pressure: one cylinder, its own geometry and a friction torque; free
    J_eng, T_f and, if the pressure is relative, p_crank, which then holds the sensor's offset. One record
    does not tell a constant T_load from T_f, nor a scale error of the pressure from J_eng and T_f.
    ModelError if the options do not fit together.

    >>> print(one_inertia().equations())
    d(omega_eng)/dt = (T - C_eng*omega_eng)/J_eng
    omega = omega_eng
    >>> one_inertia(cylinders=1, geometry=Geometry.from_bore(0.0677, stroke=0.055, rod=0.0842, mass=0.25),
    ...             friction_torque=0.8).parameter_names
    ('J_eng', 'C_eng', 'T_f', 'r', 'L', 'A_p', 'm_eq', 'p_crank')
    """
    check_option("load", load, ("none", "measured", "constant"))
    options = _cylinder_options(
        cylinders, firing_order, firing_offsets, geometry, reciprocating_speed, reciprocating_inertia
    )
    b = Blueprint(name, description="engine as one rigid inertia")
    inertia = inertia_parameter(b, "J_eng", J_ENG, "inertia of the engine")
    damping = damper_parameter(b, "C_eng", C_ENG, "absolute damping of the engine")
    braking: Any = 0
    if friction_torque is not None:
        braking += b.parameter(
            "T_f", friction_torque, unit="N m", min=0, description="constant friction torque"
        )
    if load == "constant":
        braking += b.parameter("T_load", 0.0, unit="N m", description="constant load torque, braking")
    theta = crank_angle(b) if options else None
    body = Inertia("engine", "omega_eng", inertia, damping, theta, "speed of the engine")
    chain = declare_chain(b, [body], [])
    torque, change = _cylinder_torque(b, options, theta, chain) if options else (_torque_drive(b), None)
    if load == "measured":
        braking += load_drive(b)
    torque -= braking
    if change is not None:
        torque += vary_inertia(b, change=change, inertia=inertia, torque=chain.torques[0] + torque)
    write_chain(b, chain, [torque])
    declare_outputs(b, ("omega",), {"omega": (chain.speeds[0], "crank speed")})
    return b.model()


def two_mass(
    *,
    name: str = "two_mass",
    cylinders: int = 4,
    firing_order: Sequence[int] | None = None,
    firing_offsets: Sequence[float] | None = None,
    geometry: Geometry | Mapping[str, float] | None = None,
    reciprocating_speed: ReciprocatingSpeed = "model",
    reciprocating_inertia: ReciprocatingInertia = "mean",
    outputs: Sequence[str] = ("omega",),
) -> Model:
    """Build the engine and its load as two inertias with an elastic coupling, (4.1) or its linear form (4.3).

    States omega_eng, omega_load [rad/s], twist = theta_load − theta_eng [rad]; channels theta [rad]
    (unwrapped, 0 at the combustion TDC of cylinder 1), p1…pN [Pa], T_load [N m] that brakes the load; drives
    T_1…T_N and T_load [N m]; parameters J_eng, J_load [kg m2], K_el [N m/rad], C_el, C_eng [N m s/rad] with
    the defaults of Table 4.1, and the geometry r, L, A_p, m_eq, p_crank, fixed by default.

    firing_order : cylinders in the order in which they fire; default the usual one, 1-3-4-2 for four
    firing_offsets : (cylinders,) rad, the combustion TDC of each cylinder within 4π, for uneven firing
    geometry : Geometry, a mapping of some of its fields, or None for Table 4.2
    reciprocating_speed : "model" is (4.1): the torque (3.5) of the reciprocating masses uses the model's own
        speed and acts as a law of each port cylinder_k; "measured" is (4.3): it uses the channel omega
        [rad/s] and is part of the drives, so that the model is linear
    reciprocating_inertia : "mean" neglects the θ̈ term of (3.3), whose mean J_eng holds; "variable" adds it
        less its mean m_eq r² ⟨f²⟩ per cylinder, so that J_eng is the total mean inertia either way
    outputs : "omega" (speed of the engine), "omega_load", or both
    ModelError if the options do not fit together.

    >>> model = two_mass(reciprocating_speed="measured")
    >>> model.linear.A.shape, model.linear.B.shape, model.has_slot_laws
    ((3, 3), (3, 5), False)
    """
    options = CylinderOptions(
        cylinders, firing_order, firing_offsets, geometry, reciprocating_speed, reciprocating_inertia
    )
    b = Blueprint(name, description="engine and load as two inertias with an elastic coupling")
    j_eng = inertia_parameter(b, "J_eng", J_ENG, "inertia of the engine")
    j_load = inertia_parameter(b, "J_load", J_LOAD, "inertia of the load")
    k_el = stiffness_parameter(b, "K_el", K_EL, "stiffness of the coupling")
    c_el = damper_parameter(b, "C_el", C_EL, "damping of the coupling")
    c_eng = damper_parameter(b, "C_eng", C_ENG, "absolute damping of the engine")
    theta = crank_angle(b)
    chain = declare_chain(
        b,
        [
            Inertia("engine", "omega_eng", j_eng, c_eng, theta, "speed of the engine"),
            Inertia("load", "omega_load", j_load, None, None, "speed of the load"),
        ],
        [Coupling("coupling", "twist", k_el, c_el, "theta_load - theta_eng")],
    )
    torque, change = _cylinder_torque(b, options, theta, chain)
    if change is not None:
        torque += vary_inertia(b, change=change, inertia=j_eng, torque=chain.torques[0] + torque)
    write_chain(b, chain, [torque, -load_drive(b)])
    speeds = dict(zip(("omega", "omega_load"), chain.speeds, strict=True))
    words = {"omega": "speed of the engine", "omega_load": "speed of the load"}
    declare_outputs(b, outputs, {key: (speed, words[key]) for key, speed in speeds.items()})
    return b.model()


def inertia_parameter(b: Blueprint, name: str, value: float, description: str) -> Any:
    """Declare an inertia [kg m2]."""
    return b.parameter(name, value, unit="kg m2", min=1e-6, max=1e3, description=description)


def stiffness_parameter(b: Blueprint, name: str, value: float, description: str) -> Any:
    """Declare a stiffness [N m/rad]."""
    return b.parameter(name, value, unit="N m/rad", min=1e-3, max=1e9, description=description)


def damper_parameter(b: Blueprint, name: str, value: float, description: str) -> Any:
    """Declare a damper [N m s/rad]."""
    return b.parameter(name, value, unit="N m s/rad", min=0, max=1e5, description=description)


def crank_angle(b: Blueprint) -> Any:
    """Declare the channel theta [rad]."""
    return b.input("theta", unit="rad", description="crank angle, 0 at the combustion TDC of cylinder 1")


def _torque_drive(b: Blueprint) -> Any:
    channel = b.input("T", unit="N m", scale=TORQUE_SCALE, description="torque on the engine")
    return b.drive("T", channel, scale=TORQUE_SCALE, description="torque on the engine")


def _cylinder_torque(b: Blueprint, options: CylinderOptions, theta: Any, chain: Chain) -> tuple[Any, Any]:
    """The torque of all cylinders on the chain's first inertia [N m], and its change [kg m2] or None."""
    made = declare_cylinders(b, options, theta=theta, speeds=chain.speeds[:1] * options.cylinders)
    varies = options.reciprocating_inertia == "variable"
    return made.torque, sum(made.inertia_change) if varies else None


def load_drive(b: Blueprint, name: str = "T_load") -> Any:
    """Declare the channel and drive of a braking torque [N m]; return the drive."""
    channel = b.input(name, unit="N m", scale=TORQUE_SCALE, description="load torque, braking")
    return b.drive(name, channel, scale=TORQUE_SCALE, description="load torque, braking")


def declare_outputs(b: Blueprint, names: Sequence[str], known: Mapping[str, tuple[Any, str]]) -> None:
    """Declare those of the `known` speeds [rad/s] and theta [rad] that `names` asks for.

    ModelError for any other.
    """
    listed = isinstance(names, (tuple, list)) and all(isinstance(name, str) for name in names)
    if not listed or not names or not set(names) <= set(known):
        raise ModelError(
            "the outputs are not ones of this model",
            seen=repr(names),
            allowed=f"a sequence of one or more of {', '.join(known)}",
            cure=f"give outputs={tuple(known)!r}, for instance",
        )
    for name in names:
        expression, description = known[name]
        unit, scale = ("rad", 1.0) if name == "theta" else ("rad/s", SPEED_SCALE)
        b.output(name, expression, unit=unit, scale=scale, description=description)


def _cylinder_options(
    cylinders: int, order: Any, offsets: Any, geometry: Any, speed: Any, inertia: Any
) -> CylinderOptions | None:
    """The options of one or more cylinders; None for none, when these options must be left out."""
    options = CylinderOptions(cylinders, order, offsets, geometry, speed, inertia)
    if cylinders != 0:
        return options
    usual = CylinderOptions(0)
    given = [key for key, value in vars(options).items() if not _same(value, getattr(usual, key))]
    if given:
        raise ModelError(
            "options of cylinders are given, but the torque is a channel",
            seen=f"cylinders=0 with {', '.join(given)}",
            allowed="these options with cylinders >= 1",
            cure="give the number of cylinders, or leave these options out",
        )
    return None


def _same(value: Any, usual: Any) -> bool:
    """Whether an option is as it was left out; an array never is."""
    return value is usual or (isinstance(value, (str, int)) and value == usual)
