"""A car on a road: mass, drag of the air, and a drive whose force follows its command with a lag."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, delayed, simulate


def model(outputs):
    b = ce.Blueprint("vehicle")
    mass = b.parameter("m", 1200.0, unit="kg", min=100, max=10_000)
    air = b.parameter("cA", 0.42, unit="N s2/m2", min=0, max=10)
    lag = b.parameter("tau", 0.8, unit="s", min=0.05, max=10)
    v = b.state("v", unit="m/s", scale=20)
    force = b.state("force", unit="N", scale=1000)
    command = b.input("F", unit="N", scale=1000)
    body = b.port("body", "inertia", {"speed": v}, unit="N")
    b.ode("v", (force - air * v * ca.fabs(v) + body) / mass)
    b.ode("force", (command - force) / lag)
    for name in outputs:
        b.output(name, v, unit="m/s", scale=20)
    return b.model()


def course(v, run):
    grade, viscous = v.get("body.constant_torque", 0.0), v.get("body.viscous_friction", 0.0)
    rolling, gust = v.get("body.coulomb_friction", 0.0), v.get("body.gusts", 0.0)
    climb, begins = v.get("body.load_step", 0.0), run.event

    def rate(t, x, u):
        speed, force = x
        acting = force - v["cA"] * speed * abs(speed) + grade - viscous * speed - climb * (t > begins)
        return (acting + gust * np.sin(0.7 * t)) / v["m"], (u["F"] - force) / v["tau"]

    held = [Dry((1, 0), (1 / v["m"], 0), lambda x: rolling)] if rolling else []
    x = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[begins] if climb else ())
    return {"speed": delayed(run.time, x[:, 0], v.get("sensor_speed.sensor_delay", 0.0))}


def driven(rng):
    time = 0.2 * np.arange(600)
    return Manoeuvre.of(rng, time, {"F": levels(rng, 600, 40, -1200.0, 2600.0)}, (15.0, 0.0))


def overtaking(rng):
    time = 0.2 * np.arange(600)
    return Manoeuvre.of(rng, time, {"F": 500 + sines(rng, time, 2200.0, (0.013, 0.041, 0.11))}, (22.0, 500.0))


def coasting(rng):
    time = 0.2 * np.arange(500)
    return Manoeuvre.of(
        rng, time, {"F": levels(rng, 500, 50, -500.0, 500.0)}, (float(rng.uniform(28, 38)), 0.0)
    )


KIND = Kind(
    name="vehicle",
    sentence="a car on a road",
    truth={"m": 1200.0, "cA": 0.42, "tau": 0.8},
    terms={
        "body.coulomb_friction": Hidden(180.0, ce.effects.CoulombFriction(), "body"),
        "body.constant_torque": Hidden(-250.0, ce.effects.ConstantTorque(), "body"),
        "body.viscous_friction": Hidden(12.0, ce.effects.ViscousFriction(), "body"),
        "body.load_step": Hidden(400.0, ce.effects.LoadStep(), "body", {"time": "event"}),
        "sensor_speed.sensor_delay": Hidden(0.5, ce.effects.SensorDelay(), "sensor_speed"),
        "body.gusts": Hidden(250.0),
    },
    choices=(
        "body.load_step",
        "body.coulomb_friction",
        "body.constant_torque",
        "body.viscous_friction",
        "body.gusts",
        "body.coulomb_friction+body.load_step",
        "sensor_speed.sensor_delay",
    ),
    model=model,
    outputs=(("speed",),),
    course=course,
    manoeuvres={"driven": driven, "overtaking": overtaking, "coasting": coasting},
    pairs=(("driven", "coasting"), ("overtaking", "driven"), ("coasting", "overtaking")),
    units={"F": "N", "speed": "m/s"},
    absent=("cA",),
)
