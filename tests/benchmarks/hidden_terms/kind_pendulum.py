"""A pendulum on a motor's shaft: point mass on a light arm, written in its length and N m s/rad."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

MASS, GRAVITY = 0.5, 9.81


def model(outputs):
    b = ce.Blueprint("pendulum")
    m = b.parameter("m", MASS, unit="kg", vary=False)
    length = b.parameter("L", 0.4, unit="m", min=0.05, max=4)
    damping = b.parameter("c", 0.02, unit="N m s/rad", min=0, max=1)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s", scale=3)
    torque = b.input("T", unit="N m")
    pivot = b.port("pivot", "inertia", {"speed": speed})
    b.ode("angle", speed)
    gravity = m * GRAVITY * length * ca.sin(angle)
    b.ode("speed", (torque - gravity - damping * speed + pivot) / (m * length**2))
    if "phi" in outputs:
        b.output("phi", angle, unit="rad")
    if "gyro" in outputs:
        b.output("gyro", speed, unit="rad/s")
    return b.model()


def course(v, run):
    m, length = v["m"] * (1 + v.get("parameter_m.wrong_value", 0.0)), v["L"]
    inertia = m * length**2
    drag, cogging = v.get("pivot.quadratic_drag", 0.0), v.get("pivot.cogging", 0.0)
    constant, dry = v.get("pivot.constant_torque", 0.0), v.get("pivot.coulomb_friction", 0.0)

    def rate(t, x, u):
        angle, speed = x
        acting = u["T"] - m * GRAVITY * length * np.sin(angle) - v["c"] * speed + constant
        acting -= drag * speed * abs(speed) + cogging * np.sin(7 * angle)
        return speed, acting / inertia

    held = [Dry((0, 1), (0, 1 / inertia), lambda x: dry)] if dry else []
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    offset = v.get("sensor_phi.sensor_offset", 0.0)
    return {"phi": x[:, 0] + offset, "gyro": x[:, 1]}


def decay(rng):
    time = 0.03 * np.arange(600)
    return Manoeuvre.of(rng, time, {"T": 0 * time}, (float(rng.uniform(1.0, 1.8)), float(rng.uniform(-1, 1))))


def driven(rng):
    time = 0.03 * np.arange(700)
    return Manoeuvre.of(rng, time, {"T": sines(rng, time, 1.2, (0.11, 0.37, 0.83, 1.31))}, (0.0, 0.0))


def pushed(rng):
    time = 0.03 * np.arange(600)
    return Manoeuvre.of(rng, time, {"T": levels(rng, 600, 40, -1.0, 1.0)}, (0.0, 0.0))


KIND = Kind(
    name="pendulum",
    sentence="a pendulum on a motor's shaft",
    truth={"m": MASS, "L": 0.4, "c": 0.02},
    terms={
        "pivot.coulomb_friction": Hidden(0.05, ce.effects.CoulombFriction(), "pivot"),
        "pivot.quadratic_drag": Hidden(0.012, ce.effects.QuadraticDrag(), "pivot"),
        "pivot.constant_torque": Hidden(0.15, ce.effects.ConstantTorque(), "pivot"),
        "sensor_phi.sensor_offset": Hidden(0.12, ce.effects.SensorOffset(), "sensor_phi"),
        "pivot.cogging": Hidden(0.10),
        "parameter_m.wrong_value": Hidden(0.3, wrong="m", unseen=("decay",)),
    },
    choices=(
        "pivot.coulomb_friction",
        "pivot.quadratic_drag",
        "pivot.coulomb_friction+pivot.quadratic_drag",
        "sensor_phi.sensor_offset",
        "pivot.cogging",
        "pivot.coulomb_friction|pivot.constant_torque",
        "pivot.constant_torque",
        "parameter_m.wrong_value",
    ),
    model=model,
    outputs=(("phi", "gyro"), ("phi",)),
    course=course,
    manoeuvres={"decay": decay, "driven": driven, "pushed": pushed},
    pairs=(("driven", "decay"), ("decay", "driven"), ("pushed", "driven")),
    units={"T": "N m", "phi": "rad", "gyro": "rad/s"},
    absent=("c",),
)
