"""Cells in a stirred vessel that live on sugar which is fed and washed out; rates per hour."""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import simulate

import casadi_engine as ce

HOUR, VOLUME = 3600.0, 5.0


class Maintenance(ce.Effect):
    """Sugar that cells take to live on and not to grow (Pirt)."""

    name, attaches = "maintenance", ("inertia",)
    sentence = "maintenance of the cells out of {port}"
    amplitude = ce.effects.Amplitude("rate", unit="1/h", min=0)

    def law(self, port, p, math):
        del math
        return -p.rate * port.cells


def model(outputs):
    b = ce.Blueprint("chemostat", time_unit="h")
    fastest = b.parameter("mu", 0.6, unit="1/h", min=0.03, max=5)
    half = b.parameter("Ks", 1.0, unit="g/L", min=0.02, max=10)
    share = b.parameter("Y", 0.5, unit="1", min=0.03, max=5, description="cells per sugar [g/g]")
    volume = b.parameter("V", VOLUME, unit="L", vary=False)
    x, s = b.state("x", unit="g/L", scale=5), b.state("s", unit="g/L", scale=2)
    flow, feed = b.input("F", unit="L/h"), b.input("Sf", unit="g/L", scale=10)
    cells = b.port("cells", "inertia", {"level": x}, unit="g/L/h")
    medium = b.port("medium", "inertia", {"level": s, "cells": x}, unit="g/L/h")
    grown = fastest * s / (half + s) * x
    b.ode("x", grown - flow / volume * x + cells)
    b.ode("s", flow / volume * (feed - s) - grown / share + medium)
    if "biomass" in outputs:
        b.output("biomass", x, unit="g/L", scale=5)
    if "sugar" in outputs:
        b.output("sugar", s, unit="g/L", scale=2)
    return b.model()


def course(v, run):
    upkeep, film = v.get("medium.maintenance", 0.0), v.get("cells.constant_torque", 0.0)
    pump, rich = 1 + v.get("input_F.input_gain", 0.0), 1 + v.get("input_Sf.input_gain", 0.0)
    line, poison = v.get("medium.load_step", 0.0), v.get("growth.inhibition", 0.0)

    def rate(t, x, u):
        cells, sugar = x
        washed = pump * u["F"] / v["V"]
        grown = v["mu"] * sugar / (v["Ks"] + sugar + poison * sugar**2) * cells
        fed = washed * (rich * u["Sf"] - sugar) - line * (t > run.event)
        used = grown / v["Y"] + upkeep * cells
        return (grown - washed * cells + film) / HOUR, (fed - used) / HOUR

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if line else ())
    return {"biomass": x[:, 0], "sugar": x[:, 1] + v.get("sensor_sugar.sensor_offset", 0.0), "states": x}


def stepped(rng):
    """Pump and feed in steps, now and then nearly as fast as cells grow."""
    time = 0.15 * HOUR * np.arange(600)
    inputs = {"F": levels(rng, 600, 40, 0.4, 2.2), "Sf": levels(rng, 600, 100, 6.0, 14.0)}
    return Manoeuvre.of(rng, time, inputs, (4.0, 0.7))


def waved(rng):
    time = 0.15 * HOUR * np.arange(600)
    inputs = {
        "F": 1.3 + sines(rng, time, 0.9, (1 / 26 / HOUR, 1 / 11 / HOUR)),
        "Sf": 10 + sines(rng, time, 4.0, (1 / 37 / HOUR, 1 / 15 / HOUR)),
    }
    return Manoeuvre.of(rng, time, inputs, (5.0, 0.8))


def inoculated(rng):
    """A few cells in much sugar, fed from the beginning."""
    time = 0.1 * HOUR * np.arange(600)
    inputs = {"F": levels(rng, 600, 60, 0.3, 1.8), "Sf": levels(rng, 600, 120, 6.0, 14.0)}
    return Manoeuvre.of(rng, time, inputs, (float(rng.uniform(1.0, 1.5)), float(rng.uniform(5, 7))))


KIND = Kind(
    name="chemostat",
    sentence="cells in a chemostat",
    truth={"mu": 0.6, "Ks": 1.0, "Y": 0.5, "V": VOLUME},
    terms={
        "medium.maintenance": Hidden(0.08, Maintenance(), "medium"),
        # cells that a film on the wall sets free
        "cells.constant_torque": Hidden(0.2, ce.effects.ConstantTorque(), "cells"),
        # a line of sugar that is opened
        "medium.load_step": Hidden(-0.7, ce.effects.LoadStep(), "medium", {"time": "event"}),
        # of flow and volume the ratio alone acts
        "input_F.input_gain": Hidden(
            0.2, ce.effects.InputGain(), "input_F", right=("parameter_V.wrong_value",)
        ),
        # sugar that is shown too small: Ks and Y take the same factor
        "input_Sf.input_gain": Hidden(
            0.2, ce.effects.InputGain(), "input_Sf", right=("sensor_sugar.sensor_gain",)
        ),
        "sensor_sugar.sensor_offset": Hidden(0.4, ce.effects.SensorOffset(), "sensor_sugar"),
        # it is felt where there is much sugar
        "growth.inhibition": Hidden(0.12, unseen=("stepped",)),
    },
    choices=(
        "cells.constant_torque",
        "sensor_sugar.sensor_offset",
        "medium.maintenance",
        "growth.inhibition",
        "input_F.input_gain",
        "medium.load_step",
        "cells.constant_torque+sensor_sugar.sensor_offset",
        "input_Sf.input_gain",
    ),
    model=model,
    outputs=(("biomass", "sugar"),),
    course=course,
    manoeuvres={"stepped": stepped, "waved": waved, "inoculated": inoculated},
    pairs=(("stepped", "waved"), ("waved", "inoculated"), ("inoculated", "stepped")),
    units={"F": "L/h", "Sf": "g/L", "biomass": "g/L", "sugar": "g/L"},
    effects=lambda: with_own(Maintenance()),
)
