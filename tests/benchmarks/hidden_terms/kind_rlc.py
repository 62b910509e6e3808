"""A series resonant circuit: coil, capacitor and resistor at a voltage, written in H, F and ohm."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate


def model(outputs):
    b = ce.Blueprint("rlc")
    inductance = b.parameter("L", 0.1, unit="H", min=1e-3, max=10)
    resistance = b.parameter("R", 5.0, unit="ohm", min=0, max=100)
    capacity = b.parameter("C", 1e-4, unit="F", min=1e-6, max=1e-2)
    charge, current = b.state("q", unit="C", scale=2e-3), b.state("i", unit="A", scale=0.5)
    voltage = b.input("U", unit="V", scale=10)
    coil = b.port("coil", "inertia", {"speed": current}, unit="V")
    capacitor = b.port("capacitor", "coupling", {"twist": charge}, unit="V")
    b.ode("q", current)
    b.ode("i", (voltage - resistance * current - charge / capacity + coil - capacitor) / inductance)
    if "I" in outputs:
        b.output("I", current, unit="A", scale=0.5)
    if "UC" in outputs:
        b.output("UC", charge / capacity, unit="V", scale=10)
    return b.model()


def course(v, run):
    lamp, cubic = v.get("coil.quadratic_drag", 0.0), v.get("capacitor.cubic_stiffness", 0.0)
    diode, bias = v.get("coil.coulomb_friction", 0.0), v.get("coil.constant_torque", 0.0)
    saturates = v.get("coil.saturation", 0.0)

    def rate(t, x, u):
        q, i = x
        left = u["U"] - v["R"] * i - q / v["C"] - cubic * q**3 - lamp * i * abs(i) + bias
        return i, left * (1 + saturates * i**2) / v["L"]

    held = [Dry((0, 1), (0, 1 / v["L"]), lambda x: diode)] if diode else []
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"I": x[:, 1] + v.get("sensor_I.sensor_offset", 0.0), "UC": x[:, 0] / v["C"]}


def swept(rng):
    time = 1e-3 * np.arange(800)
    return Manoeuvre.of(rng, time, {"U": sines(rng, time, 12.0, (9.0, 23.0, 41.0, 57.0))}, (0.0, 0.0))


def switched(rng):
    time = 1e-3 * np.arange(800)
    return Manoeuvre.of(rng, time, {"U": levels(rng, 800, 50, -12.0, 12.0)}, (0.0, 0.0))


def discharged(rng):
    time = 1e-3 * np.arange(500)
    return Manoeuvre.of(
        rng, time, {"U": levels(rng, 500, 125, -8.0, 8.0)}, (float(rng.uniform(1.5e-3, 3e-3)), 0.0)
    )


KIND = Kind(
    name="rlc",
    sentence="a series resonant circuit",
    truth={"L": 0.1, "R": 5.0, "C": 1e-4},
    terms={
        "coil.coulomb_friction": Hidden(0.8, ce.effects.CoulombFriction(), "coil"),
        "coil.quadratic_drag": Hidden(5.0, ce.effects.QuadraticDrag(), "coil"),
        "capacitor.cubic_stiffness": Hidden(1.2e9, ce.effects.CubicStiffness(), "capacitor"),
        "coil.constant_torque": Hidden(1.5, ce.effects.ConstantTorque(), "coil"),
        "sensor_I.sensor_offset": Hidden(0.08, ce.effects.SensorOffset(), "sensor_I"),
        "coil.saturation": Hidden(1.5),
    },
    choices=(
        "coil.coulomb_friction",
        "capacitor.cubic_stiffness",
        "coil.quadratic_drag",
        "sensor_I.sensor_offset",
        "coil.coulomb_friction+capacitor.cubic_stiffness",
        "coil.saturation",
        "coil.coulomb_friction|coil.constant_torque",
    ),
    model=model,
    outputs=(("I", "UC"), ("I",)),
    course=course,
    manoeuvres={"swept": swept, "switched": switched, "discharged": discharged},
    pairs=(("swept", "switched"), ("switched", "discharged"), ("discharged", "swept")),
    units={"U": "V", "I": "A", "UC": "V"},
)
