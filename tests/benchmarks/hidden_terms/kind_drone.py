"""One axis of a drone on a test stand: rotors with a lag turn it, its low centre of gravity brings it back."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, delayed, simulate


def model(outputs):
    b = ce.Blueprint("drone")
    inertia = b.parameter("J", 0.012, unit="kg m2", min=5e-4, max=0.3)
    restoring = b.parameter("k", 0.4, unit="N m/rad", min=0.01, max=10)
    damping = b.parameter("c", 0.015, unit="N m s/rad", min=0, max=1)
    lag = b.parameter("tau", 0.08, unit="s", min=5e-3, max=1)
    angle, rate = b.state("angle", unit="rad"), b.state("rate", unit="rad/s", scale=3)
    torque = b.state("torque", unit="N m", scale=0.2)
    command = b.input("u", unit="N m", scale=0.2)
    frame = b.port("frame", "inertia", {"speed": rate}, unit="N m")
    b.ode("angle", rate)
    b.ode("rate", (torque - restoring * ca.sin(angle) - damping * rate + frame) / inertia)
    b.ode("torque", (command - torque) / lag)
    if "gyro" in outputs:
        b.output("gyro", rate, unit="rad/s", scale=3)
    if "roll" in outputs:
        b.output("roll", angle, unit="rad")
    return b.model()


def course(v, run):
    drag, trim = v.get("frame.quadratic_drag", 0.0), v.get("frame.constant_torque", 0.0)
    dry, saturates = v.get("frame.coulomb_friction", 0.0), v.get("rotors.saturation", 0.0)
    drop, at = v.get("frame.load_step", 0.0), run.event

    def rate(t, x, u):
        angle, turn, torque = x
        acting = torque - v["k"] * np.sin(angle) - v["c"] * turn - drag * turn * abs(turn) + trim
        command = np.tanh(saturates * u["u"]) / saturates if saturates else u["u"]
        return turn, (acting - drop * (t > at)) / v["J"], (command - torque) / v["tau"]

    held = [Dry((0, 1, 0), (0, 1 / v["J"], 0), lambda x: dry)] if dry else []
    x = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[at] if drop else ())
    gyro = delayed(run.time, x[:, 1], v.get("sensor_gyro.sensor_delay", 0.0))
    return {"gyro": gyro + v.get("sensor_gyro.sensor_offset", 0.0), "roll": x[:, 0]}


def rolled(rng):
    time = 0.01 * np.arange(800)
    return Manoeuvre.of(rng, time, {"u": levels(rng, 800, 35, -0.35, 0.35)}, (0.0, 0.0, 0.0))


def waved(rng):
    time = 0.01 * np.arange(800)
    return Manoeuvre.of(rng, time, {"u": sines(rng, time, 0.4, (0.4, 0.9, 1.7, 3.1))}, (0.0, 0.0, 0.0))


def released(rng):
    time = 0.01 * np.arange(700)
    return Manoeuvre.of(
        rng, time, {"u": levels(rng, 700, 100, -0.2, 0.2)}, (float(rng.uniform(0.7, 1.1)), 0.0, 0.0)
    )


KIND = Kind(
    name="drone",
    sentence="one axis of a drone on a stand",
    truth={"J": 0.012, "k": 0.4, "c": 0.015, "tau": 0.08},
    terms={
        "frame.quadratic_drag": Hidden(8e-3, ce.effects.QuadraticDrag(), "frame"),
        "frame.constant_torque": Hidden(0.03, ce.effects.ConstantTorque(), "frame"),
        "frame.coulomb_friction": Hidden(0.02, ce.effects.CoulombFriction(), "frame"),
        "frame.load_step": Hidden(0.05, ce.effects.LoadStep(), "frame", {"time": "event"}),
        "sensor_gyro.sensor_offset": Hidden(0.25, ce.effects.SensorOffset(), "sensor_gyro"),
        "sensor_gyro.sensor_delay": Hidden(0.03, ce.effects.SensorDelay(), "sensor_gyro"),
        "rotors.saturation": Hidden(5.0),
    },
    choices=(
        "frame.quadratic_drag",
        "sensor_gyro.sensor_offset",
        "frame.load_step",
        "frame.coulomb_friction",
        "frame.quadratic_drag+frame.constant_torque",
        "rotors.saturation",
        "sensor_gyro.sensor_delay",
    ),
    model=model,
    outputs=(("gyro", "roll"), ("gyro",)),
    course=course,
    manoeuvres={"rolled": rolled, "waved": waved, "released": released},
    pairs=(("rolled", "waved"), ("waved", "released"), ("released", "rolled")),
    units={"u": "N m", "gyro": "rad/s", "roll": "rad"},
)
