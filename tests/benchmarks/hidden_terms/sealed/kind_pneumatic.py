"""A pneumatic cylinder that lifts a mass against a spring; one valve fills it, another vents it, both choked.

Millimetres, bar (absolute) and N; conductances are those of the valves per area of the piston, so that they are speeds.
"""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, delayed, simulate

import casadi_engine as ce

GRAVITY, SUPPLY, ROOM = 9.81, 12.0, 1.0
# 50 mm of bore [mm2]; speed at which friction fades [mm/s].
AREA, FADING = 1963.0, 80.0


def lifted(pressure):
    """Force of the air on the piston [N]."""
    return 0.1 * AREA * (pressure - ROOM)


def model(outputs):
    b = ce.Blueprint("pneumatic")
    mass = b.parameter("m", 15.0, unit="kg", vary=False)
    stiffness = b.parameter("Ks", 3.0, unit="N/mm", min=0.1, max=60)
    viscous = b.parameter("c", 0.3, unit="N s/mm", min=0.01, max=6)
    fill = b.parameter("kf", 208.0, unit="mm/s", min=10, max=5000)
    vent = b.parameter("kv", 600.0, unit="mm/s", min=20, max=10_000)
    dead = b.parameter("x0", 40.0, unit="mm", vary=False, description="length of the dead volume")
    polytropic = b.parameter("gamma", 1.3, unit="1", vary=False)
    x, v = b.state("x", unit="mm", scale=100), b.state("v", unit="mm/s", scale=200)
    p = b.state("p", unit="bar", scale=3)
    opened, bled = b.input("fill", unit="1"), b.input("vent", unit="1")
    piston = b.port("piston", "inertia", {"speed": v}, unit="N")
    chamber = b.port("chamber", "inertia", {"pressure": p}, unit="bar mm/s")
    signals = {"twist": x, "twist_rate": v, "stiffness": stiffness}
    spring = stiffness * x + b.port("spring", "coupling", signals, unit="N")
    b.ode("x", v)
    b.ode("v", 1e3 * (lifted(p) - mass * GRAVITY - spring - viscous * v + piston) / mass)
    b.ode("p", polytropic * (fill * SUPPLY * opened - vent * p * bled - p * v + chamber) / (x + dead))
    if "position" in outputs:
        b.output("position", x, unit="mm", scale=100)
    if "pressure" in outputs:
        b.output("pressure", p, unit="bar", scale=3)
    return b.model()


def course(v, run):
    mass = v["m"] * (1 + v.get("parameter_m.wrong_value", 0.0))
    dry, fades = v.get("piston.coulomb_friction", 0.0), v.get("piston.stribeck_friction", 0.0)
    cubic, load = v.get("spring.cubic_stiffness", 0.0), v.get("piston.load_step", 0.0)
    leak, lap = v.get("chamber.leak", 0.0), v.get("chamber.overlap", 0.0)

    def rate(t, s, u):
        x, speed, p = s
        force = lifted(p) - mass * GRAVITY - v["Ks"] * x - cubic * x**3 - v["c"] * speed
        force -= load * (t > run.event)
        flow = v["kf"] * SUPPLY * max(u["fill"] - lap, 0.0) - v["kv"] * p * u["vent"] - leak * (p - ROOM) ** 2
        return speed, 1e3 * force / mass, v["gamma"] * (flow - p * speed) / (x + v["x0"])

    held = []
    if dry or fades:
        weight = (0, 1e3 / mass, 0)
        held = [Dry((0, 1, 0), weight, lambda s: dry + fades * np.exp(-((s[1] / FADING) ** 2)))]
    s = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[run.event] if load else ())
    late = delayed(run.time, s[:, 0], v.get("sensor_position.sensor_delay", 0.0))
    pressure = s[:, 2] + v.get("sensor_pressure.sensor_offset", 0.0)
    return {"position": late, "pressure": pressure, "states": s}


def rest(pressure):
    """Where the spring holds the piston at that pressure, and still."""
    return (lifted(pressure) - 15.0 * GRAVITY) / 3.0, 0.0, pressure


def stepped(rng):
    time = 0.01 * np.arange(900)
    inputs = {"fill": levels(rng, 900, 60, 0.3, 0.75), "vent": levels(rng, 900, 90, 0.45, 0.65)}
    return Manoeuvre.of(rng, time, inputs, rest(3.6))


def waved(rng):
    time = 0.01 * np.arange(900)
    inputs = {
        "fill": 0.5 + sines(rng, time, 0.28, (0.23, 0.61, 1.7, 3.9)),
        "vent": 0.55 + sines(rng, time, 0.12, (0.31, 0.83)),
    }
    return Manoeuvre.of(rng, time, inputs, rest(3.6))


def dropped(rng):
    """From high above, the fill valve nearly closed at first."""
    time = 0.01 * np.arange(800)
    fill = levels(rng, 800, 100, 0.3, 0.7)
    fill[:100] = 0.25
    inputs = {"fill": fill, "vent": levels(rng, 800, 80, 0.45, 0.65)}
    return Manoeuvre.of(rng, time, inputs, rest(float(rng.uniform(4.2, 4.8))))


KIND = Kind(
    name="pneumatic",
    sentence="a pneumatic cylinder that lifts a mass",
    truth={"m": 15.0, "Ks": 3.0, "c": 0.3, "kf": 208.0, "kv": 600.0, "x0": 40.0, "gamma": 1.3},
    terms={
        "piston.coulomb_friction": Hidden(35.0, ce.effects.CoulombFriction(), "piston"),
        "piston.stribeck_friction": Hidden(30.0, ce.effects.StribeckFriction(), "piston", {"fading": FADING}),
        "spring.cubic_stiffness": Hidden(6e-5, ce.effects.CubicStiffness(), "spring"),
        "piston.load_step": Hidden(80.0, ce.effects.LoadStep(), "piston", {"time": "event"}),
        "sensor_pressure.sensor_offset": Hidden(0.3, ce.effects.SensorOffset(), "sensor_pressure"),
        "sensor_position.sensor_delay": Hidden(0.045, ce.effects.SensorDelay(), "sensor_position"),
        "parameter_m.wrong_value": Hidden(0.5, wrong="m", needs=("position", "pressure")),
        "chamber.leak": Hidden(20.0),
        "chamber.overlap": Hidden(0.06),
    },
    choices=(
        "piston.coulomb_friction",
        "chamber.leak",
        "piston.load_step",
        "spring.cubic_stiffness",
        "piston.coulomb_friction+spring.cubic_stiffness",
        "sensor_pressure.sensor_offset",
        "piston.stribeck_friction|piston.coulomb_friction",
        "parameter_m.wrong_value",
        "chamber.overlap",
        "sensor_position.sensor_delay",
    ),
    model=model,
    outputs=(("position", "pressure"), ("position",)),
    course=course,
    manoeuvres={"stepped": stepped, "waved": waved, "dropped": dropped},
    pairs=(("stepped", "waved"), ("waved", "dropped"), ("dropped", "stepped")),
    units={"fill": "1", "vent": "1", "position": "mm", "pressure": "bar"},
)
