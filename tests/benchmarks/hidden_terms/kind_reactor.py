"""A stirred tank reactor: a reaction that gives off heat, cooled by a jacket."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import delayed, simulate

# Activation temperature [K] and the temperature at which the rate constant is stated.
ACTIVATION, STATED = 6000.0, 330.0


class SecondOrder(ce.Effect):
    """A second reaction whose rate goes with the square of concentration; it gives off as much heat."""

    name, attaches = "second_order", ("inertia",)
    sentence = "a reaction of second order in {port}"
    amplitude = ce.effects.Amplitude("rate", min=0)

    def law(self, port, p, math):
        return p.rate * port.concentration**2


def model(outputs):
    b = ce.Blueprint("reactor")
    turnover = b.parameter("D", 4e-3, unit="1/s", vary=False)
    rate = b.parameter("k", 3e-3, unit="1/s", min=1e-4, max=0.1)
    heat = b.parameter("beta", 20.0, unit="1", min=1, max=400, description="warming per concentration [K]")
    cooled = b.parameter("h", 6e-3, unit="1/s", min=1e-4, max=0.1)
    c, t = b.state("c", unit="1"), b.state("T", unit="K", scale=20)
    feed, jacket = b.input("cf", unit="1"), b.input("Tj", unit="K", scale=20)
    reaction = b.port("reaction", "inertia", {"concentration": c}, unit="1/s")
    tank = b.port("tank", "inertia", {"temperature": t}, unit="K/s")
    used = rate * ca.exp(ACTIVATION * (1 / STATED - 1 / t)) * c + reaction
    b.ode("c", turnover * (feed - c) - used)
    b.ode("T", turnover * (310.0 - t) + heat * used - cooled * (t - jacket) + tank)
    if "temperature" in outputs:
        b.output("temperature", t, unit="K", scale=20)
    if "analyser" in outputs:
        b.output("analyser", c, unit="1")
    return b.model()


def course(v, run):
    second, stirred = v.get("reaction.second_order", 0.0), v.get("tank.constant_torque", 0.0)
    tired, fouled = v.get("reaction.decay", 0.0), v.get("tank.load_step", 0.0)
    turnover = v["D"] * (1 + v.get("parameter_D.wrong_value", 0.0))

    def rate(t, x, u):
        c, temperature = x
        constant = v["k"] * np.exp(ACTIVATION * (1 / STATED - 1 / temperature)) * np.exp(-tired * t / 3600)
        used = constant * c + second * c**2
        warmed = turnover * (310.0 - temperature) + v["beta"] * used - v["h"] * (temperature - u["Tj"])
        return turnover * (u["cf"] - c) - used, warmed + stirred - fouled * (t > run.event)

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if fouled else ())
    late = delayed(run.time, x[:, 0], v.get("sensor_analyser.sensor_delay", 0.0))
    offset = v.get("sensor_temperature.sensor_offset", 0.0)
    return {"temperature": x[:, 1] + offset, "analyser": late, "states": x}


def stepped(rng):
    time = 6.0 * np.arange(600)
    inputs = {"cf": levels(rng, 600, 75, 0.4, 1.6), "Tj": levels(rng, 600, 50, 300.0, 345.0)}
    return Manoeuvre.of(rng, time, inputs, (0.6, 318.0))


def waved(rng):
    time = 6.0 * np.arange(600)
    feed = 1 + sines(rng, time, 0.5, (1 / 1700, 1 / 530))
    jacket = 322 + sines(rng, time, 22.0, (1 / 1300, 1 / 410))
    return Manoeuvre.of(rng, time, {"cf": feed, "Tj": jacket}, (0.5, float(rng.uniform(315, 330))))


KIND = Kind(
    name="reactor",
    sentence="a cooled stirred tank reactor",
    truth={"D": 4e-3, "k": 3e-3, "beta": 20.0, "h": 6e-3},
    terms={
        "reaction.second_order": Hidden(3e-3, SecondOrder(), "reaction"),
        "tank.constant_torque": Hidden(0.03, ce.effects.ConstantTorque(), "tank"),
        "tank.load_step": Hidden(0.035, ce.effects.LoadStep(), "tank", {"time": "event"}),
        "sensor_temperature.sensor_offset": Hidden(4.0, ce.effects.SensorOffset(), "sensor_temperature"),
        "sensor_analyser.sensor_delay": Hidden(25.0, ce.effects.SensorDelay(), "sensor_analyser"),
        "parameter_D.wrong_value": Hidden(0.4, wrong="D", needs=("temperature", "analyser")),
        "reaction.decay": Hidden(1.0),
    },
    choices=(
        "reaction.second_order",
        "tank.load_step",
        "sensor_temperature.sensor_offset",
        "reaction.decay",
        "reaction.second_order+tank.load_step",
        "sensor_analyser.sensor_delay",
        "tank.constant_torque",
        "parameter_D.wrong_value",
    ),
    model=model,
    outputs=(("temperature", "analyser"), ("temperature",)),
    course=course,
    manoeuvres={"stepped": stepped, "waved": waved},
    pairs=(("stepped", "waved"), ("waved", "stepped")),
    units={"cf": "1", "Tj": "K", "temperature": "K", "analyser": "1"},
    effects=lambda: with_own(SecondOrder()),
)
