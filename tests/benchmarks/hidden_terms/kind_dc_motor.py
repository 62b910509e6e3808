"""A DC motor that turns a load by a flexible shaft, driven by its voltage."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

CONSTANT = 0.05


def model(outputs):
    b = ce.Blueprint("dc_motor")
    coil = b.parameter("L", 2e-3, unit="H", min=1e-4, max=0.1)
    resistance = b.parameter("R", 1.0, unit="ohm", min=0.05, max=20)
    constant = b.parameter("kt", CONSTANT, unit="N m/A", vary=False)
    j_rotor = b.parameter("J1", 1e-4, unit="kg m2", min=5e-6, max=2e-3)
    j_load = b.parameter("J2", 3e-4, unit="kg m2", min=1e-5, max=6e-3)
    stiffness = b.parameter("K", 1.2, unit="N m/rad", min=0.05, max=30)
    damper = b.parameter("D", 1e-3, unit="N m s/rad", min=0, max=0.05)
    current = b.state("i", unit="A", scale=3)
    w1, w2 = (b.state(name, unit="rad/s", scale=100) for name in ("w1", "w2"))
    twist = b.state("twist", unit="rad", scale=0.1)
    voltage = b.input("U", unit="V", scale=12)
    winding = b.port("winding", "inertia", {"speed": current}, unit="V")
    rotor = b.port("rotor", "inertia", {"speed": w1}, unit="N m")
    load = b.port("load", "inertia", {"speed": w2}, unit="N m")
    shaft = b.port(
        "shaft", "coupling", {"twist": twist, "twist_rate": w1 - w2, "stiffness": stiffness}, unit="N m"
    )
    passed = stiffness * twist + damper * (w1 - w2) + shaft
    b.ode("i", (voltage - resistance * current - constant * w1 + winding) / coil)
    b.ode("w1", (constant * current - passed + rotor) / j_rotor)
    b.ode("w2", (passed + load) / j_load)
    b.ode("twist", w1 - w2)
    if "speed" in outputs:
        b.output("speed", w1, unit="rad/s", scale=100)
    if "current" in outputs:
        b.output("current", current, unit="A", scale=3)
    return b.model()


def course(v, run):
    constant = v["kt"] * (1 + v.get("parameter_kt.wrong_value", 0.0))
    cubic, gap = v.get("shaft.cubic_stiffness", 0.0), v.get("shaft.backlash", 0.0)
    fan, cogging = v.get("load.quadratic_drag", 0.0), v.get("rotor.cogging", 0.0)

    def rate(t, x, u):
        i, w1, w2, twist, angle = x
        inside = twist - np.clip(twist, -gap, gap)
        passed = v["K"] * inside + v["D"] * (w1 - w2) + cubic * twist**3
        electric = u["U"] - v["R"] * i - constant * w1
        first = constant * i - passed + cogging * np.sin(2 * angle)
        return electric / v["L"], first / v["J1"], (passed - fan * w2 * abs(w2)) / v["J2"], w1 - w2, w1

    held = []
    rows = {"winding": (0, "L"), "rotor": (1, "J1"), "load": (2, "J2")}
    for name, (k, inertia) in rows.items():
        size = v.get(f"{name}.coulomb_friction", 0.0)
        if size:
            row = np.eye(5)[k]
            held.append(Dry(row, row / v[inertia], lambda x, size=size: size))
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"current": x[:, 0] + v.get("sensor_current.sensor_offset", 0.0), "speed": x[:, 1], "states": x}


def reversed_(rng):
    time = 1.5e-3 * np.arange(800)
    size = np.repeat(np.resize((1.0, -1.0), 10) * rng.uniform(3.0, 12.0, 10), 80)
    return Manoeuvre.of(rng, time, {"U": size}, (0.0,) * 5)


def shaken(rng):
    time = 1.5e-3 * np.arange(800)
    return Manoeuvre.of(rng, time, {"U": sines(rng, time, 14.0, (1.3, 4.7, 11.0, 19.0))}, (0.0,) * 5)


def slowed(rng):
    time = 1.5e-3 * np.arange(700)
    w = float(rng.uniform(100, 180))
    return Manoeuvre.of(rng, time, {"U": levels(rng, 700, 100, -3.0, 8.0)}, (0.0, w, w, 0.0, 0.0))


KIND = Kind(
    name="dc_motor",
    sentence="a DC motor and a load on a flexible shaft",
    truth={"L": 2e-3, "R": 1.0, "kt": CONSTANT, "J1": 1e-4, "J2": 3e-4, "K": 1.2, "D": 1e-3},
    terms={
        "rotor.coulomb_friction": Hidden(0.02, ce.effects.CoulombFriction(), "rotor"),
        "load.coulomb_friction": Hidden(0.02, ce.effects.CoulombFriction(), "load"),
        "load.quadratic_drag": Hidden(1.5e-6, ce.effects.QuadraticDrag(), "load"),
        "winding.coulomb_friction": Hidden(1.2, ce.effects.CoulombFriction(), "winding"),
        "shaft.backlash": Hidden(0.06, ce.effects.Backlash(), "shaft"),
        "shaft.cubic_stiffness": Hidden(80.0, ce.effects.CubicStiffness(), "shaft"),
        "sensor_current.sensor_offset": Hidden(0.5, ce.effects.SensorOffset(), "sensor_current"),
        "parameter_kt.wrong_value": Hidden(0.2, wrong="kt", needs=("current", "speed")),
        "rotor.cogging": Hidden(0.05),
    },
    choices=(
        "load.quadratic_drag",
        "rotor.coulomb_friction",
        "shaft.backlash",
        "rotor.cogging",
        "winding.coulomb_friction",
        "load.quadratic_drag+winding.coulomb_friction",
        "sensor_current.sensor_offset",
        "parameter_kt.wrong_value",
        "shaft.cubic_stiffness",
        "load.coulomb_friction",
    ),
    model=model,
    outputs=(("speed", "current"), ("speed",)),
    course=course,
    manoeuvres={"reversed": reversed_, "shaken": shaken, "slowed": slowed},
    pairs=(("reversed", "shaken"), ("shaken", "slowed"), ("slowed", "reversed")),
    units={"U": "V", "speed": "rad/s", "current": "A"},
)
