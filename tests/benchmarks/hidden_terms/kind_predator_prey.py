"""Prey and predators in a tank, fed from outside; rates per hour."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import simulate

HOUR = 3600.0


class Satiety(ce.Effect):
    """Predators that are busy with what they caught: attack x y / (1 + h x) instead of attack x y (Holling II)."""

    name, attaches = "satiety", ("inertia",)
    sentence = "predators at {port} that have enough"
    amplitude = ce.effects.Amplitude("handling", min=0, max=10)

    def law(self, port, p, math):
        met = port.attack * port.prey * port.predators
        return met * p.handling * port.prey / (1 + p.handling * port.prey)

    def sizes(self, port, values):
        return (0.1, 0.4, 1.2)


class Crowding(ce.Effect):
    """Deaths that grow with the square of how many there are."""

    name, attaches = "crowding", ("inertia",)
    sentence = "{port} that suffer from their number"
    amplitude = ce.effects.Amplitude("rate", min=0)

    def law(self, port, p, math):
        return -p.rate * port.count**2


def model(outputs):
    b = ce.Blueprint("predator_prey", time_unit="h")
    growth = b.parameter("r", 0.6, min=0.02, max=10)
    attack = b.parameter("a", 0.35, min=0.02, max=10)
    gain = b.parameter("e", 0.5, min=0.02, max=10)
    deaths = b.parameter("d", 0.4, min=0.02, max=10)
    x, y = b.state("x", unit="1", scale=1.5), b.state("y", unit="1", scale=1.5)
    stocked = b.input("u", unit="1", scale=0.5)
    feeding = b.port("feeding", "inertia", {"prey": x, "predators": y, "attack": attack}, unit="1")
    prey = b.port("prey", "inertia", {"count": x}, unit="1")
    predators = b.port("predators", "inertia", {"count": y}, unit="1")
    b.ode("x", stocked + growth * x - attack * x * y + feeding + prey)
    b.ode("y", gain * (attack * x * y - feeding) - deaths * y + predators)
    for name, count in (("X", x), ("Y", y)):
        if name in outputs:
            b.output(name, count, unit="1", scale=1.5)
    return b.model()


def course(v, run):
    handling, moved = v.get("feeding.satiety", 0.0), v.get("predators.constant_torque", 0.0)
    crowds, season = v.get("prey.crowding", 0.0), v.get("prey.season", 0.0)
    harvest = v.get("predators.load_step", 0.0)

    def rate(t, s, u):
        x, y = s
        eaten = v["a"] * x * y / (1 + handling * x)
        grown = v["r"] * (1 + season * np.sin(2 * np.pi * t / (9 * HOUR))) * x - crowds * x**2
        dy = v["e"] * eaten - v["d"] * y + moved - harvest * (t > run.event)
        return (u["u"] + grown - eaten) / HOUR, dy / HOUR

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if harvest else ())
    return {"X": x[:, 0] + v.get("sensor_X.sensor_offset", 0.0), "Y": x[:, 1], "states": x}


def stocked(rng):
    time = 0.12 * HOUR * np.arange(500)
    return Manoeuvre.of(rng, time, {"u": levels(rng, 500, 50, 0.0, 0.7)}, (2.0, 1.6))


def cycled(rng):
    time = 0.12 * HOUR * np.arange(500)
    fed = 0.25 + sines(rng, time, 0.2, (1 / (23 * HOUR), 1 / (9.7 * HOUR)))
    return Manoeuvre.of(rng, time, {"u": fed}, (float(rng.uniform(2.5, 3.5)), 1.2))


KIND = Kind(
    name="predator_prey",
    sentence="prey and predators in a tank",
    truth={"r": 0.6, "a": 0.35, "e": 0.5, "d": 0.4},
    terms={
        "feeding.satiety": Hidden(0.15, Satiety(), "feeding"),
        "prey.crowding": Hidden(0.06, Crowding(), "prey"),
        "predators.constant_torque": Hidden(0.12, ce.effects.ConstantTorque(), "predators"),
        "predators.load_step": Hidden(0.15, ce.effects.LoadStep(), "predators", {"time": "event"}),
        "sensor_X.sensor_offset": Hidden(0.3, ce.effects.SensorOffset(), "sensor_X"),
        "prey.season": Hidden(0.35),
    },
    choices=(
        "feeding.satiety",
        "prey.crowding",
        "predators.load_step",
        "prey.season",
        "predators.constant_torque",
        "prey.crowding+predators.constant_torque",
        "sensor_X.sensor_offset",
    ),
    model=model,
    outputs=(("X", "Y"), ("X",)),
    course=course,
    manoeuvres={"stocked": stocked, "cycled": cycled},
    pairs=(("stocked", "cycled"), ("cycled", "stocked")),
    units={"u": "1", "X": "1", "Y": "1"},
    effects=lambda: with_own(Satiety(), Crowding()),
)
