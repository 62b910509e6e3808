"""A hydraulic cylinder behind a servo valve: a piston between two chambers, written with the load pressure."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

SUPPLY, MASS, AREA = 1e7, 100.0, 1e-3
# The spool's edges are a hundredth of its stroke wide.
EDGE = 0.01


def flow(gain, command, pressure, math):
    """Through the valve [m3/s]."""
    return gain * command * math.sqrt(1 - pressure * math.tanh(command / EDGE) / SUPPLY)


def model(outputs):
    b = ce.Blueprint("hydraulic")
    mass = b.parameter("m", MASS, unit="kg", vary=False)
    area = b.parameter("A", AREA, unit="m2", vary=False)
    gain = b.parameter("kq", 3e-4, unit="m3/s", min=1e-6, max=1e-2)
    soft = b.parameter("kappa", 2.0, unit="1", min=0.05, max=50)
    leak = b.parameter("Cl", 8.0, unit="1", min=0, max=500)
    viscous = b.parameter("c", 500.0, unit="N s/m", min=0, max=20_000)
    v = b.state("v", unit="m/s", scale=0.2)
    pressure = b.state("p", unit="Pa", scale=1e6)
    spool = b.input("u", unit="1")
    piston = b.port("piston", "inertia", {"speed": v}, unit="N")
    b.ode("v", (area * pressure - viscous * v + piston) / mass)
    # kappa in 1e-13 m3/Pa, Cl in 1e-12 m3/s/Pa: compressibility and leakage of a cylinder of this size
    b.ode("p", (flow(gain, spool, pressure, ca) - area * v - 1e-12 * leak * pressure) / (1e-13 * soft))
    if "speed" in outputs:
        b.output("speed", v, unit="m/s", scale=0.2)
    if "pressure" in outputs:
        b.output("pressure", pressure, unit="Pa", scale=1e6)
    return b.model()


def course(v, run):
    mass, area = v["m"] * (1 + v.get("parameter_m.wrong_value", 0.0)), v["A"]
    weight, fades = v.get("piston.constant_torque", 0.0), v.get("piston.stribeck_friction", 0.0)
    dry, drag = v.get("piston.coulomb_friction", 0.0), v.get("piston.quadratic_drag", 0.0)
    lap = v.get("valve.overlap", 0.0)

    def rate(t, x, u):
        speed, p = x
        command = u["u"] - np.clip(u["u"], -lap, lap)
        through = flow(v["kq"], command, p, np)
        force = area * p - v["c"] * speed - drag * speed * abs(speed) + weight
        return force / mass, (through - area * speed - 1e-12 * v["Cl"] * p) / (1e-13 * v["kappa"])

    held = []
    if dry or fades:
        held = [Dry((1, 0), (1 / mass, 0), lambda x: dry + fades * np.exp(-((x[0] / 0.03) ** 2)))]
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"speed": x[:, 0], "pressure": x[:, 1] + v.get("sensor_pressure.sensor_offset", 0.0), "states": x}


def stepped(rng):
    time = 4e-3 * np.arange(700)
    return Manoeuvre.of(rng, time, {"u": levels(rng, 700, 35, -1.0, 1.0)}, (0.0, 0.0))


def waved(rng):
    time = 4e-3 * np.arange(700)
    return Manoeuvre.of(rng, time, {"u": sines(rng, time, 0.9, (0.7, 1.9, 4.3, 9.1))}, (0.0, 0.0))


def slowed(rng):
    time = 4e-3 * np.arange(600)
    return Manoeuvre.of(
        rng, time, {"u": levels(rng, 600, 60, -0.4, 0.5)}, (float(rng.uniform(0.1, 0.3)), 3e5)
    )


KIND = Kind(
    name="hydraulic",
    sentence="a hydraulic cylinder behind a valve",
    truth={"m": MASS, "A": AREA, "kq": 3e-4, "kappa": 2.0, "Cl": 8.0, "c": 500.0},
    terms={
        "piston.coulomb_friction": Hidden(150.0, ce.effects.CoulombFriction(), "piston"),
        "piston.constant_torque": Hidden(-250.0, ce.effects.ConstantTorque(), "piston"),
        "piston.quadratic_drag": Hidden(5000.0, ce.effects.QuadraticDrag(), "piston"),
        "sensor_pressure.sensor_offset": Hidden(1.2e5, ce.effects.SensorOffset(), "sensor_pressure"),
        "parameter_m.wrong_value": Hidden(0.5, wrong="m", needs=("speed", "pressure")),
        "valve.overlap": Hidden(0.12),
    },
    choices=(
        "piston.coulomb_friction",
        "piston.constant_torque",
        "piston.quadratic_drag",
        "valve.overlap",
        "piston.coulomb_friction+piston.constant_torque",
        "sensor_pressure.sensor_offset",
        "parameter_m.wrong_value",
    ),
    model=model,
    outputs=(("speed", "pressure"), ("pressure",)),
    course=course,
    manoeuvres={"stepped": stepped, "waved": waved, "slowed": slowed},
    pairs=(("stepped", "waved"), ("waved", "slowed"), ("slowed", "stepped")),
    units={"u": "1", "speed": "m/s", "pressure": "Pa"},
)
