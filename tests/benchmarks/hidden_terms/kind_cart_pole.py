"""A cart on a rail with a hanging pole: a small gantry crane, pushed by a force."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

POLE, GRAVITY = 0.2, 9.81


def accelerations(mass, pole, length, angle, force, torque, math):
    """Of cart and pole, from what acts along the rail and about the joint."""
    cosine, both = math.cos(angle), mass + pole
    whole = mass + pole * math.sin(angle) ** 2
    cart = (force - cosine * torque / length) / whole
    turn = (both * torque / (pole * length) - cosine * force) / (length * whole)
    return cart, turn


def model(outputs):
    b = ce.Blueprint("cart_pole")
    mass = b.parameter("M", 1.0, unit="kg", min=0.1, max=20)
    pole = b.parameter("m", POLE, unit="kg", vary=False)
    length = b.parameter("L", 0.5, unit="m", min=0.05, max=5)
    rail = b.parameter("c", 0.5, unit="N s/m", min=0, max=20)
    joint = b.parameter("d", 2e-3, unit="N m s/rad", min=0, max=0.5)
    v = b.state("v", unit="m/s")
    angle, turn = b.state("angle", unit="rad"), b.state("turn", unit="rad/s", scale=2)
    force = b.input("F", unit="N", scale=3)
    cart = b.port("cart", "inertia", {"speed": v}, unit="N")
    hinge = b.port("hinge", "inertia", {"speed": turn}, unit="N m")
    along = force - rail * v + cart + pole * length * turn**2 * ca.sin(angle)
    about = hinge - joint * turn - pole * GRAVITY * length * ca.sin(angle)
    dv, dturn = accelerations(mass, pole, length, angle, along, about, ca)
    b.ode("v", dv)
    b.ode("angle", turn)
    b.ode("turn", dturn)
    if "speed" in outputs:
        b.output("speed", v, unit="m/s")
    if "theta" in outputs:
        b.output("theta", angle, unit="rad")
    return b.model()


def course(v, run):
    mass, pole, length = v["M"], v["m"] * (1 + v.get("parameter_m.wrong_value", 0.0)), v["L"]
    drag, slope = v.get("hinge.quadratic_drag", 0.0), v.get("cart.constant_torque", 0.0)
    cable = v.get("cart.cable", 0.0)

    def rate(t, x, u):
        speed, angle, turn, place = x
        along = u["F"] - v["c"] * speed + pole * length * turn**2 * np.sin(angle) + slope - cable * place
        about = -v["d"] * turn - pole * GRAVITY * length * np.sin(angle) - drag * turn * abs(turn)
        dv, dturn = accelerations(mass, pole, length, angle, along, about, np)
        return dv, turn, dturn, speed

    def weight(force, torque):
        def of(x):
            dv, dturn = accelerations(mass, pole, length, x[1], force, torque, np)
            return dv, 0.0, dturn, 0.0

        return of

    held = []
    for name, row, push in (("cart", (1, 0, 0, 0), (1.0, 0.0)), ("hinge", (0, 0, 1, 0), (0.0, 1.0))):
        size = v.get(f"{name}.coulomb_friction", 0.0)
        if size:
            held.append(Dry(row, weight(*push), lambda x, size=size: size))
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"speed": x[:, 0], "theta": x[:, 1] + v.get("sensor_theta.sensor_offset", 0.0)}


def pushed(rng):
    time = 0.02 * np.arange(700)
    return Manoeuvre.of(rng, time, {"F": levels(rng, 700, 45, -4.0, 4.0)}, (0.0, 0.0, 0.0, 0.0))


def waved(rng):
    time = 0.02 * np.arange(700)
    return Manoeuvre.of(
        rng, time, {"F": sines(rng, time, 5.0, (0.21, 0.47, 0.79, 1.3))}, (0.0, 0.0, 0.0, 0.0)
    )


def swinging(rng):
    time = 0.02 * np.arange(600)
    start = (0.0, float(rng.uniform(0.6, 1.2)), 0.0, 0.0)
    return Manoeuvre.of(rng, time, {"F": sines(rng, time, 2.0, (0.33, 0.61))}, start)


KIND = Kind(
    name="cart_pole",
    sentence="a cart with a hanging pole",
    truth={"M": 1.0, "m": POLE, "L": 0.5, "c": 0.5, "d": 2e-3},
    terms={
        "cart.coulomb_friction": Hidden(0.6, ce.effects.CoulombFriction(), "cart"),
        "hinge.coulomb_friction": Hidden(0.02, ce.effects.CoulombFriction(), "hinge"),
        "hinge.quadratic_drag": Hidden(4e-3, ce.effects.QuadraticDrag(), "hinge"),
        "cart.constant_torque": Hidden(0.4, ce.effects.ConstantTorque(), "cart", needs=("speed",)),
        "sensor_theta.sensor_offset": Hidden(0.06, ce.effects.SensorOffset(), "sensor_theta"),
        "cart.cable": Hidden(1.0, needs=("speed",)),
        "parameter_m.wrong_value": Hidden(0.6, wrong="m", needs=("speed",)),
    },
    choices=(
        "cart.coulomb_friction",
        "hinge.coulomb_friction",
        "cart.constant_torque",
        "cart.coulomb_friction+hinge.quadratic_drag",
        "sensor_theta.sensor_offset",
        "cart.cable",
        "cart.coulomb_friction|cart.constant_torque",
        "parameter_m.wrong_value",
    ),
    model=model,
    outputs=(("speed", "theta"), ("speed",), ("theta",)),
    course=course,
    manoeuvres={"pushed": pushed, "waved": waved, "swinging": swinging},
    pairs=(("pushed", "waved"), ("waved", "swinging"), ("swinging", "pushed")),
    units={"F": "N", "speed": "m/s", "theta": "rad"},
    absent=("d",),
)
