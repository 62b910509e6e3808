"""A heated block and the body it warms, both losing heat to the room."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import delayed, simulate

ROOM = 293.0


class Radiation(ce.Effect):
    """Heat radiated to the room, of the fourth power of temperature."""

    name, attaches = "radiation", ("inertia",)
    sentence = "{port} radiates"
    amplitude = ce.effects.Amplitude("coefficient", unit="W/K4", min=0)

    def law(self, port, p, math):
        return -p.coefficient * (port.temperature**4 - port.ambient**4)


def model(outputs):
    b = ce.Blueprint("thermal")
    c1 = b.parameter("C1", 200.0, unit="J/K", min=10, max=5000)
    c2 = b.parameter("C2", 400.0, unit="J/K", min=10, max=5000)
    between = b.parameter("G12", 4.0, unit="W/K", min=0.1, max=100)
    g1 = b.parameter("G1", 0.6, unit="W/K", min=0, max=20)
    g2 = b.parameter("G2", 0.5, unit="W/K", min=0, max=20)
    t1, t2 = (b.state(name, unit="K", scale=30) for name in ("T1", "T2"))
    heat, room = b.input("P", unit="W", scale=50), b.input("Ta", unit="K", scale=30)
    block = b.port("block", "inertia", {"temperature": t1, "ambient": room}, unit="W")
    body = b.port("body", "inertia", {"temperature": t2, "ambient": room}, unit="W")
    b.ode("T1", (heat - between * (t1 - t2) - g1 * (t1 - room) + block) / c1)
    b.ode("T2", (between * (t1 - t2) - g2 * (t2 - room) + body) / c2)
    for name, t in (("Tb", t1), ("Ts", t2)):
        if name in outputs:
            b.output(name, t, unit="K", scale=30)
    return b.model()


def course(v, run):
    radiated, source = v.get("block.radiation", 0.0), v.get("body.constant_torque", 0.0)
    wall = v.get("body.wall", 0.0)
    door, opened = v.get("body.load_step", 0.0), run.event

    def rate(t, x, u):
        t1, t2, t3 = x
        room = u["Ta"]
        first = u["P"] - v["G12"] * (t1 - t2) - v["G1"] * (t1 - room) - radiated * (t1**4 - room**4)
        second = (
            v["G12"] * (t1 - t2) - v["G2"] * (t2 - room) + source - door * (t > opened) - wall * (t2 - t3)
        )
        return first / v["C1"], second / v["C2"], wall * (t2 - t3) / 600.0

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[opened] if door else ())
    late = delayed(run.time, x[:, 1], v.get("sensor_Ts.sensor_delay", 0.0))
    return {"Tb": x[:, 0], "Ts": late + v.get("sensor_Ts.sensor_offset", 0.0), "states": x}


def _room(rng, time):
    return ROOM + sines(rng, time, 2.0, (1 / 2700, 1 / 900))


def stepped(rng):
    time = 6.0 * np.arange(600)
    inputs = {"P": levels(rng, 600, 60, 0.0, 160.0), "Ta": _room(rng, time)}
    return Manoeuvre.of(rng, time, inputs, (ROOM, ROOM, ROOM))


def waved(rng):
    time = 6.0 * np.arange(600)
    heat = 80 + sines(rng, time, 75.0, (1 / 2100, 1 / 800, 1 / 310))
    return Manoeuvre.of(rng, time, {"P": heat, "Ta": _room(rng, time)}, (ROOM + 25, ROOM + 20, ROOM + 20))


def cooling(rng):
    time = 6.0 * np.arange(500)
    heat = levels(rng, 500, 125, 0.0, 60.0)
    hot = ROOM + float(rng.uniform(60, 90))
    return Manoeuvre.of(rng, time, {"P": heat, "Ta": _room(rng, time)}, (hot, hot - 5, hot - 5))


KIND = Kind(
    name="thermal",
    sentence="a heated block and the body it warms",
    truth={"C1": 200.0, "C2": 400.0, "G12": 4.0, "G1": 0.6, "G2": 0.5},
    terms={
        "block.radiation": Hidden(6e-9, Radiation(), "block"),
        "body.constant_torque": Hidden(14.0, ce.effects.ConstantTorque(), "body"),
        "body.load_step": Hidden(12.0, ce.effects.LoadStep(), "body", {"time": "event"}),
        "sensor_Ts.sensor_offset": Hidden(4.0, ce.effects.SensorOffset(), "sensor_Ts"),
        "sensor_Ts.sensor_delay": Hidden(25.0, ce.effects.SensorDelay(), "sensor_Ts"),
        "body.wall": Hidden(1.5),
    },
    choices=(
        "block.radiation",
        "body.load_step",
        "sensor_Ts.sensor_offset",
        "body.constant_torque",
        "body.wall",
        "block.radiation+body.load_step",
        "sensor_Ts.sensor_delay",
    ),
    model=model,
    outputs=(("Tb", "Ts"), ("Ts",)),
    course=course,
    manoeuvres={"stepped": stepped, "waved": waved, "cooling": cooling},
    pairs=(("stepped", "cooling"), ("waved", "stepped"), ("cooling", "waved")),
    units={"P": "W", "Ta": "K", "Tb": "K", "Ts": "K"},
    effects=lambda: with_own(Radiation()),
)
