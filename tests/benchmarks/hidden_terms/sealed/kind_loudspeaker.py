"""A woofer on an amplifier: voice coil, cone and suspension, with a laser on the cone; millimetres and grams."""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

import casadi_engine as ce


def model(outputs):
    b = ce.Blueprint("loudspeaker")
    resistance = b.parameter("R", 5.5, unit="Ohm", vary=False)
    inductance = b.parameter("L", 1.5, unit="mH", vary=False)
    force = b.parameter("Bl", 12.0, unit="N/A", min=1, max=100)
    mass = b.parameter("m", 60.0, unit="g", min=2, max=1000)
    stiffness = b.parameter("K", 2.5, unit="N/mm", min=0.1, max=100)
    losses = b.parameter("Rm", 2.0, unit="N s/m", min=0, max=50)
    i = b.state("i", unit="A", scale=2)
    x, v = b.state("x", unit="mm", scale=4), b.state("v", unit="mm/s", scale=500)
    voltage = b.input("U", unit="V", scale=10)
    cone = b.port("cone", "inertia", {"speed": v}, unit="N")
    suspension = b.port(
        "suspension", "coupling", {"twist": x, "twist_rate": v, "stiffness": stiffness}, unit="N"
    )
    b.ode("i", 1e3 * (voltage - resistance * i - 1e-3 * force * v) / inductance)
    b.ode("x", v)
    b.ode("v", 1e6 * (force * i - stiffness * x - 1e-3 * losses * v - suspension + cone) / mass)
    if "current" in outputs:
        b.output("current", i, unit="A", scale=2)
    if "laser" in outputs:
        b.output("laser", x, unit="mm", scale=4)
    return b.model()


def course(v, run):
    resistance = v["R"] * (1 + v.get("parameter_R.wrong_value", 0.0))
    cubic, choked = v.get("suspension.cubic_stiffness", 0.0), v.get("cone.quadratic_drag", 0.0)
    rub, weak = v.get("cone.coulomb_friction", 0.0), v.get("coil.leaves_the_gap", 0.0)

    def rate(t, s, u):
        i, x, speed = s
        force = v["Bl"] / (1 + weak * x**2)
        pulled = v["K"] * x + cubic * x**3 + 1e-3 * v["Rm"] * speed + choked * speed * abs(speed)
        di = 1e3 * (u["U"] - resistance * i - 1e-3 * force * speed) / v["L"]
        return di, speed, 1e6 * (force * i - pulled) / v["m"]

    held = [Dry((0, 0, 1), (0, 0, 1e6 / v["m"]), lambda s: rub)] if rub else []
    s = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"current": s[:, 0], "laser": s[:, 1] + v.get("sensor_laser.sensor_offset", 0.0), "states": s}


def tones(rng):
    time = 5e-4 * np.arange(1000)
    volts = sines(rng, time, 24.0, (11.0, 23.0, 37.0, 71.0))
    return Manoeuvre.of(rng, time, {"U": volts}, (0.5, 1.0, 200.0))


def noise(rng):
    time = 5e-4 * np.arange(1000)
    return Manoeuvre.of(rng, time, {"U": levels(rng, 1000, 16, -20.0, 20.0)}, (0.0, 0.0, 0.0))


def bursts(rng):
    time = 5e-4 * np.arange(1200)
    volts = np.zeros(1200)
    for first in range(0, 1200, 300):
        hertz, size = rng.uniform(20, 50), rng.uniform(10, 22)
        volts[first : first + 180] = size * np.sin(2 * np.pi * hertz * 5e-4 * np.arange(180))
    return Manoeuvre.of(rng, time, {"U": volts}, (0.0, 0.0, 0.0))


KIND = Kind(
    name="loudspeaker",
    sentence="a woofer and its amplifier",
    truth={"R": 5.5, "L": 1.5, "Bl": 12.0, "m": 60.0, "K": 2.5, "Rm": 2.0},
    terms={
        "suspension.cubic_stiffness": Hidden(0.06, ce.effects.CubicStiffness(), "suspension"),
        "cone.coulomb_friction": Hidden(2.5, ce.effects.CoulombFriction(), "cone"),
        "cone.quadratic_drag": Hidden(1.2e-5, ce.effects.QuadraticDrag(), "cone"),
        # a cone that rests elsewhere is the same
        "sensor_laser.sensor_offset": Hidden(
            1.2, ce.effects.SensorOffset(), "sensor_laser", right=("cone.constant_torque",)
        ),
        "parameter_R.wrong_value": Hidden(0.25, wrong="R", needs=("current", "laser")),
        "coil.leaves_the_gap": Hidden(0.015),
    },
    choices=(
        "suspension.cubic_stiffness",
        "cone.coulomb_friction",
        "coil.leaves_the_gap",
        "sensor_laser.sensor_offset",
        "suspension.cubic_stiffness+cone.coulomb_friction",
        "parameter_R.wrong_value",
        "cone.quadratic_drag",
    ),
    model=model,
    outputs=(("current", "laser"), ("laser",)),
    course=course,
    manoeuvres={"tones": tones, "noise": noise, "bursts": bursts},
    pairs=(("noise", "tones"), ("tones", "bursts"), ("bursts", "noise")),
    units={"U": "V", "current": "A", "laser": "mm"},
)
