"""A drug in two compartments, infused and measured in the blood; rates per hour."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels
from hidden_terms.simulator import delayed, simulate

HOUR = 3600.0


class Saturable(ce.Effect):
    """Elimination by an enzyme of limited capacity (Michaelis and Menten)."""

    name, attaches = "saturable_elimination", ("inertia",)
    sentence = "elimination from {port} that saturates"
    amplitude = ce.effects.Amplitude("capacity", min=0)
    nuisance = {"half": ce.effects.Grid(0.3, 10.0, steps=6, log=True)}  # noqa: RUF012 (read only)

    def law(self, port, p, math):
        return -p.capacity * port.amount / (p.half + port.amount)


def model(outputs):
    b = ce.Blueprint("drug", time_unit="h")
    volume = b.parameter("V", 10.0, min=0.5, max=200, description="litres")
    clear = b.parameter("CL", 3.0, min=0, max=100, description="litres per hour")
    across = b.parameter("Q", 4.0, min=0.1, max=100, description="litres per hour")
    other = b.parameter("V2", 20.0, min=1, max=400, description="litres")
    c1, c2 = (b.state(name, unit="mg/L", scale=3) for name in ("c1", "c2"))
    dose = b.input("dose", unit="mg/h", scale=20)
    blood = b.port("blood", "inertia", {"amount": c1})
    tissue = b.port("tissue", "inertia", {"amount": c2})
    b.ode("c1", (dose - clear * c1 - across * (c1 - c2) + blood) / volume)
    b.ode("c2", (across * (c1 - c2) + tissue) / other)
    for name in outputs:
        b.output(name, c1, unit="mg/L", scale=3)
    return b.model()


def course(v, run):
    capacity, made = v.get("blood.saturable_elimination", 0.0), v.get("blood.constant_torque", 0.0)
    induced, bleed = v.get("blood.induction", 0.0), v.get("blood.load_step", 0.0)

    def rate(t, x, u):
        c1, c2 = x
        cleared = v["CL"] * (1 + induced * t / (60 * HOUR)) * c1 + capacity * c1 / (2.0 + c1)
        first = u["dose"] - cleared - v["Q"] * (c1 - c2) + made - bleed * (t > run.event)
        return first / v["V"] / HOUR, v["Q"] * (c1 - c2) / v["V2"] / HOUR

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if bleed else ())
    shown = delayed(run.time, x[:, 0], v.get("sensor_blood.sensor_delay", 0.0))
    return {"blood": shown + v.get("sensor_blood.sensor_offset", 0.0), "states": x}


def infused(rng):
    time = 0.15 * HOUR * np.arange(400)
    return Manoeuvre.of(rng, time, {"dose": levels(rng, 400, 40, 0.0, 45.0)}, (0.0, 0.0))


def pulsed(rng):
    time = 0.15 * HOUR * np.arange(400)
    dose = np.zeros(400)
    for first in range(0, 400, 80):
        dose[first : first + 12] = rng.uniform(50, 110)
    return Manoeuvre.of(rng, time, {"dose": dose}, (0.0, 0.0))


def washed(rng):
    time = 0.15 * HOUR * np.arange(400)
    high = float(rng.uniform(8, 14))
    return Manoeuvre.of(rng, time, {"dose": levels(rng, 400, 100, 0.0, 25.0)}, (high, 0.8 * high))


KIND = Kind(
    name="drug",
    sentence="a drug in two compartments",
    truth={"V": 10.0, "CL": 3.0, "Q": 4.0, "V2": 20.0},
    terms={
        "blood.saturable_elimination": Hidden(20.0, Saturable(), "blood", {"half": 2.0}),
        "blood.constant_torque": Hidden(8.0, ce.effects.ConstantTorque(), "blood"),
        "blood.load_step": Hidden(8.0, ce.effects.LoadStep(), "blood", {"time": "event"}),
        "sensor_blood.sensor_offset": Hidden(1.2, ce.effects.SensorOffset(), "sensor_blood"),
        "sensor_blood.sensor_delay": Hidden(0.25 * HOUR, ce.effects.SensorDelay(), "sensor_blood"),
        "blood.induction": Hidden(1.2),
    },
    choices=(
        "blood.saturable_elimination",
        "blood.load_step",
        "sensor_blood.sensor_offset",
        "blood.induction",
        "blood.constant_torque",
        "blood.saturable_elimination+blood.load_step",
        "sensor_blood.sensor_delay",
    ),
    model=model,
    outputs=(("blood",),),
    course=course,
    manoeuvres={"infused": infused, "pulsed": pulsed, "washed": washed},
    pairs=(("infused", "pulsed"), ("washed", "infused"), ("pulsed", "washed")),
    units={"dose": "mg/h", "blood": "mg/L"},
    effects=lambda: with_own(Saturable()),
)
