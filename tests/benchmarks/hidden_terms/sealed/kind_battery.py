"""A cell under load: charge, polarisation and temperature; per cent, millivolts and degrees Celsius."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import simulate

import casadi_engine as ce

HOUR = 3600.0
# Twice the thermal voltage [mV], the scale of Butler and Volmer.
THERMAL = 51.4


class ChargeTransfer(ce.Effect):
    """A current that grows faster than its overpotential (Butler and Volmer); the proportional part is in R1."""

    name, attaches = "charge_transfer", ("inertia",)
    sentence = "a charge transfer at {port} that eases with overpotential"
    amplitude = ce.effects.Amplitude("exchange", unit="A", min=0)

    def law(self, port, p, math):
        share = port.overpotential / THERMAL
        return -p.exchange * (0.5 * (math.exp(share) - math.exp(-share)) - share)


def open_circuit(charge, math):
    """Open-circuit voltage [mV] at a charge [%]."""
    share = charge / 100
    return 3350 + 830 * share - 300 * math.exp(-18 * share) + 30 * math.sin(7 * share)


def model(outputs):
    b = ce.Blueprint("battery")
    capacity = b.parameter("Q", 4.8, unit="Ah", min=0.3, max=50)
    r0 = b.parameter("R0", 22.0, unit="mOhm", min=0.5, max=500)
    r1 = b.parameter("R1", 30.0, unit="mOhm", min=0.5, max=500)
    c1 = b.parameter("C1", 1500.0, unit="A s/V", min=50, max=50_000)
    heat = b.parameter("Cth", 65.0, unit="J/K", vary=False)
    cooled = b.parameter("h", 0.12, unit="W/K", min=5e-3, max=3)
    charge = b.state("charge", unit="%", scale=50)
    u1 = b.state("u1", unit="mV", scale=100)
    t = b.state("T", unit="degC", scale=10)
    current, room = b.input("I", unit="A", scale=5), b.input("Ta", unit="degC", scale=10)
    cell = b.port("cell", "inertia", {"temperature": t}, unit="W")
    store = b.port("store", "inertia", {"level": charge}, unit="A")
    film = b.port("film", "inertia", {"overpotential": u1}, unit="A")
    b.ode("charge", 100 * (store - current) / (HOUR * capacity))
    b.ode("u1", 1e3 * (current - u1 / r1 + film) / c1)
    b.ode("T", (1e-3 * current * (r0 * current + u1) - cooled * (t - room) + cell) / heat)
    for name in outputs:
        if name == "voltage":
            b.output(name, open_circuit(charge, ca) - r0 * current - u1, unit="mV", scale=100)
        else:
            b.output(name, t, unit="degC", scale=10)
    return b.model()


def course(v, run):
    heat = v["Cth"] * (1 + v.get("parameter_Cth.wrong_value", 0.0))
    eases, reversible = v.get("film.charge_transfer", 0.0), v.get("cell.reversible_heat", 0.0)
    fed, short = v.get("store.constant_torque", 0.0), v.get("store.load_step", 0.0)

    def rate(t, x, u):
        _, u1, temperature = x
        current, share = u["I"], u1 / THERMAL
        drained = current - fed + short * (t > run.event)
        film = u1 / v["R1"] + eases * (np.sinh(share) - share)
        made = 1e-3 * current * (v["R0"] * current + u1 - reversible * (temperature + 273.15))
        cooling = v["h"] * (temperature - u["Ta"])
        return -100 * drained / (HOUR * v["Q"]), 1e3 * (current - film) / v["C1"], (made - cooling) / heat

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if short else ())
    voltage = open_circuit(x[:, 0], np) - v["R0"] * run.inputs["I"] - x[:, 1]
    offset = v.get("sensor_thermometer.sensor_offset", 0.0)
    return {"voltage": voltage, "thermometer": x[:, 2] + offset, "states": x}


def _room(rng, time):
    return 22 + sines(rng, time, 1.5, (1 / 2900, 1 / 1100))


def _levels(rng, count, hold, size, mean):
    """Levels of which so much is left in the mean that no cell runs empty."""
    current = levels(rng, count, hold, -size, size)
    return current + mean - current.mean()


def pulsed(rng):
    time = 6.0 * np.arange(600)
    current = _levels(rng, 600, 30, 8.0, 0.7)
    return Manoeuvre.of(rng, time, {"I": current, "Ta": _room(rng, time)}, (65.0, 0.0, 22.0))


def driven(rng):
    time = 6.0 * np.arange(600)
    current = 0.6 + sines(rng, time, 10.0, (1 / 370, 1 / 110)) * (0.55 + sines(rng, time, 0.45, (1 / 1500,)))
    start = (float(rng.uniform(45, 65)), 20.0, 26.0)
    return Manoeuvre.of(rng, time, {"I": current, "Ta": _room(rng, time)}, start)


def emptied(rng):
    time = 6.0 * np.arange(500)
    current = _levels(rng, 500, 50, 3.5, 2.7)
    return Manoeuvre.of(rng, time, {"I": current, "Ta": _room(rng, time)}, (92.0, 0.0, 30.0))


KIND = Kind(
    name="battery",
    sentence="a cell under load",
    truth={"Q": 4.8, "R0": 22.0, "R1": 30.0, "C1": 1500.0, "Cth": 65.0, "h": 0.12},
    terms={
        "film.charge_transfer": Hidden(3.0, ChargeTransfer(), "film"),
        "store.constant_torque": Hidden(-0.45, ce.effects.ConstantTorque(), "store"),
        "store.load_step": Hidden(1.0, ce.effects.LoadStep(), "store", {"time": "event"}),
        # a constant source of heat is the same
        "sensor_thermometer.sensor_offset": Hidden(
            2.5, ce.effects.SensorOffset(), "sensor_thermometer", right=("cell.constant_torque",)
        ),
        "parameter_Cth.wrong_value": Hidden(0.4, wrong="Cth"),
        "cell.reversible_heat": Hidden(0.35),
    },
    choices=(
        "film.charge_transfer",
        "store.load_step",
        "cell.reversible_heat",
        "sensor_thermometer.sensor_offset",
        "film.charge_transfer+store.load_step",
        "parameter_Cth.wrong_value",
        "store.constant_torque",
    ),
    model=model,
    outputs=(("voltage", "thermometer"),),
    course=course,
    manoeuvres={"pulsed": pulsed, "driven": driven, "emptied": emptied},
    pairs=(("pulsed", "emptied"), ("driven", "pulsed"), ("emptied", "driven")),
    units={"I": "A", "Ta": "degC", "voltage": "mV", "thermometer": "degC"},
    effects=lambda: with_own(ChargeTransfer()),
)
