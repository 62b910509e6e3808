"""A carriage that hangs below an electromagnet, held by its controller; the gap is counted downwards, in millimetres.

The controller has a sensor of its own and asks an amplifier for a current. Millihenry, N s/m; force k i²/(z + a)².
"""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, delayed, simulate

import casadi_engine as ce

GRAVITY, MASS = 9.81, 0.5
# The controller [A, mm, A/mm, A s/mm] and its amplifier [Ohm, V/A].
HELD, CENTRE, GAIN, DAMPING = 2.0, 8.0, 0.8, 0.018
NOMINAL, LOOP = 5.0, 20.0


def amplified(wanted, z, v, i):
    """Voltage on the coil [V] for a wanted gap."""
    asked = HELD + GAIN * (z - wanted) + DAMPING * v
    return NOMINAL * asked + LOOP * (asked - i)


def model(outputs):
    b = ce.Blueprint("maglev")
    mass = b.parameter("m", MASS, unit="kg", vary=False)
    magnet = b.parameter("k", 110.0, unit="N mm2/A2", min=5, max=2000)
    core = b.parameter("a", 1.5, unit="mm", vary=False)
    leakage = b.parameter("L0", 60.0, unit="mH", min=2, max=1000)
    resistance = b.parameter("R", NOMINAL, unit="Ohm", vary=False)
    viscous = b.parameter("c", 6.0, unit="N s/m", min=0, max=200)
    z, v = b.state("z", unit="mm", scale=8), b.state("v", unit="mm/s", scale=100)
    i = b.state("i", unit="A", scale=2)
    wanted = b.input("wanted", unit="mm", scale=8)
    carriage = b.port("carriage", "inertia", {"speed": v}, unit="N")
    coil = b.port("coil", "inertia", {"current": i}, unit="V")
    far = z + core
    force = magnet * i**2 / far**2
    b.ode("z", v)
    b.ode("v", 1e3 * (mass * GRAVITY - force - 1e-3 * viscous * v + carriage) / mass)
    voltage = amplified(wanted, z, v, i) - resistance * i + 2e-3 * magnet * i * v / far**2
    b.ode("i", 1e3 * (voltage + coil) / (leakage + 2 * magnet / far))
    if "gap" in outputs:
        b.output("gap", z, unit="mm", scale=8)
    if "current" in outputs:
        b.output("current", i, unit="A", scale=2)
    return b.model()


def course(v, run):
    resistance = v["R"] * (1 + v.get("parameter_R.wrong_value", 0.0))
    dry, load = v.get("carriage.coulomb_friction", 0.0), v.get("carriage.load_step", 0.0)
    full, late = v.get("coil.saturation", 0.0), v.get("coil.eddy_currents", 0.0)

    def rate(t, x, u):
        z, speed, i, flux = x
        far = z + v["a"]
        acts = flux if late else i
        force = v["k"] * acts**2 / (1 + full * acts**2) / far**2
        down = v["m"] * GRAVITY - force - 1e-3 * v["c"] * speed - load * (t > run.event)
        voltage = amplified(u["wanted"], z, speed, i) - resistance * i + 2e-3 * v["k"] * i * speed / far**2
        rises = 1e3 * voltage / (v["L0"] + 2 * v["k"] / far)
        return speed, 1e3 * down / v["m"], rises, 1e3 * (i - flux) / late if late else 0.0

    held = [Dry((0, 1, 0, 0), (0, 1e3 / v["m"], 0, 0), lambda x: dry)] if dry else []
    x = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[run.event] if load else ())
    gap = delayed(run.time, x[:, 0], v.get("sensor_gap.sensor_delay", 0.0))
    return {"gap": gap + v.get("sensor_gap.sensor_offset", 0.0), "current": x[:, 2], "states": x}


def stepped(rng):
    time = 2e-3 * np.arange(900)
    return Manoeuvre.of(rng, time, {"wanted": levels(rng, 900, 75, 6.7, 9.3)}, (8.0, 0.0, 2.0, 2.0))


def waved(rng):
    time = 2e-3 * np.arange(900)
    wanted = CENTRE + sines(rng, time, 1.6, (0.9, 2.3, 4.3, 7.1))
    return Manoeuvre.of(rng, time, {"wanted": wanted}, (8.0, 0.0, 2.0, 2.0))


def caught(rng):
    """Let go away from where the controller wants it."""
    time = 2e-3 * np.arange(800)
    start = (float(rng.uniform(9.5, 11.0)), 0.0, 2.2, 2.2)
    return Manoeuvre.of(rng, time, {"wanted": levels(rng, 800, 100, 7.2, 8.8)}, start)


KIND = Kind(
    name="maglev",
    sentence="a carriage below an electromagnet",
    truth={"m": MASS, "k": 110.0, "a": 1.5, "L0": 60.0, "R": NOMINAL, "c": 6.0},
    terms={
        "carriage.coulomb_friction": Hidden(0.3, ce.effects.CoulombFriction(), "carriage"),
        # a weight that is hung on
        "carriage.load_step": Hidden(-0.7, ce.effects.LoadStep(), "carriage", {"time": "event"}),
        "sensor_gap.sensor_offset": Hidden(0.6, ce.effects.SensorOffset(), "sensor_gap"),
        "sensor_gap.sensor_delay": Hidden(9e-3, ce.effects.SensorDelay(), "sensor_gap"),
        "parameter_R.wrong_value": Hidden(0.4, wrong="R"),
        "coil.saturation": Hidden(0.02),
        "coil.eddy_currents": Hidden(6.0),
    },
    choices=(
        "carriage.coulomb_friction",
        "coil.saturation",
        "carriage.load_step",
        "sensor_gap.sensor_offset",
        "carriage.coulomb_friction+carriage.load_step",
        "parameter_R.wrong_value",
        "coil.eddy_currents",
        "sensor_gap.sensor_delay",
    ),
    model=model,
    outputs=(("gap", "current"),),
    course=course,
    manoeuvres={"stepped": stepped, "waved": waved, "caught": caught},
    pairs=(("stepped", "waved"), ("waved", "caught"), ("caught", "stepped")),
    units={"wanted": "mm", "gap": "mm", "current": "A"},
)
