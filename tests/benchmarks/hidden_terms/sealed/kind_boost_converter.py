"""A boost converter with two switches, averaged over its switching; its duty and its supply are inputs."""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import simulate

import casadi_engine as ce

CAPACITY = 220.0


class ConstantPower(ce.Effect):
    """A regulated load: the lower the voltage, the more current it draws."""

    name, attaches = "constant_power", ("inertia",)
    sentence = "a load of constant power at {port}"
    amplitude = ce.effects.Amplitude("power", unit="W", min=0)

    def law(self, port, p, math):
        del math
        return -p.power / port.voltage


def model(outputs):
    b = ce.Blueprint("boost_converter")
    inductance = b.parameter("L", 150.0, unit="uH", min=10, max=3000)
    copper = b.parameter("RL", 0.2, unit="Ohm", min=0.01, max=5)
    load = b.parameter("R", 10.0, unit="Ohm", min=0.5, max=200)
    capacity = b.parameter("C", CAPACITY, unit="uF", vary=False)
    i, v = b.state("i", unit="A", scale=5), b.state("v", unit="V", scale=20)
    duty, supply = b.input("d", unit="1"), b.input("Vin", unit="V", scale=12)
    coil = b.port("coil", "inertia", {"current": i}, unit="V")
    bus = b.port("bus", "inertia", {"voltage": v}, unit="A")
    b.ode("i", 1e6 * (supply - copper * i - (1 - duty) * v + coil) / inductance)
    b.ode("v", 1e6 * ((1 - duty) * i - v / load + bus) / capacity)
    if "voltage" in outputs:
        b.output("voltage", v, unit="V", scale=20)
    if "current" in outputs:
        b.output("current", i, unit="A", scale=5)
    return b.model()


def course(v, run):
    capacity, gain = v["C"] * (1 + v.get("parameter_C.wrong_value", 0.0)), v.get("input_d.input_gain", 0.0)
    power, load = v.get("bus.constant_power", 0.0), v.get("bus.load_step", 0.0)
    series = v.get("capacitor.series_resistance", 0.0)

    def terminals(i, stored, duty):
        """Voltage of the bus, where the capacitor's own resistance carries what the load leaves."""
        return (stored + series * (1 - (1 + gain) * duty) * i) / (1 + series / v["R"])

    def rate(t, x, u):
        i, stored = x
        fed = (1 - (1 + gain) * u["d"]) * i
        bus = terminals(i, stored, u["d"])
        drawn = bus / v["R"] + power / bus + load * (t > run.event)
        rises = u["Vin"] - v["RL"] * i - (1 - (1 + gain) * u["d"]) * bus
        return 1e6 * rises / v["L"], 1e6 * (fed - drawn) / capacity

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if load else ())
    voltage = terminals(x[:, 0], x[:, 1], run.inputs["d"]) + v.get("sensor_voltage.sensor_offset", 0.0)
    current = x[:, 0] + v.get("sensor_current.sensor_offset", 0.0)
    return {"voltage": voltage, "current": current, "states": x}


def _supply(rng, time):
    """A battery that others use as well."""
    return 12 + sines(rng, time, 1.2, (35.0, 110.0))


def switched(rng):
    time = 5e-5 * np.arange(900)
    inputs = {"d": levels(rng, 900, 60, 0.25, 0.6), "Vin": _supply(rng, time)}
    return Manoeuvre.of(rng, time, inputs, (3.0, 18.0))


def waved(rng):
    time = 5e-5 * np.arange(900)
    duty = 0.43 + sines(rng, time, 0.18, (40.0, 130.0, 310.0, 620.0))
    return Manoeuvre.of(rng, time, {"d": duty, "Vin": _supply(rng, time)}, (3.5, 20.0))


def begun(rng):
    """From a bus that is charged to the supply, and the supply in steps."""
    time = 5e-5 * np.arange(800)
    inputs = {"d": levels(rng, 800, 100, 0.3, 0.6), "Vin": levels(rng, 800, 70, 9.5, 14.0)}
    return Manoeuvre.of(rng, time, inputs, (float(rng.uniform(0.8, 1.5)), 12.0))


KIND = Kind(
    name="boost_converter",
    sentence="a boost converter, averaged",
    truth={"L": 150.0, "RL": 0.2, "R": 10.0, "C": CAPACITY},
    terms={
        "bus.constant_power": Hidden(22.0, ConstantPower(), "bus"),
        "bus.load_step": Hidden(1.2, ce.effects.LoadStep(), "bus", {"time": "event"}),
        "input_d.input_gain": Hidden(0.1, ce.effects.InputGain(), "input_d"),
        "sensor_current.sensor_offset": Hidden(0.8, ce.effects.SensorOffset(), "sensor_current"),
        "sensor_voltage.sensor_offset": Hidden(1.8, ce.effects.SensorOffset(), "sensor_voltage"),
        # a current that is shown too small: L, RL and R take the same factor
        "parameter_C.wrong_value": Hidden(
            -0.3, wrong="C", right=("sensor_current.sensor_gain",), needs=("voltage", "current")
        ),
        "capacitor.series_resistance": Hidden(0.4),
    },
    choices=(
        "bus.load_step",
        "input_d.input_gain",
        "capacitor.series_resistance",
        "bus.constant_power",
        "sensor_current.sensor_offset",
        "parameter_C.wrong_value",
        "bus.load_step+sensor_voltage.sensor_offset",
        "sensor_voltage.sensor_offset|bus.constant_power",
    ),
    model=model,
    outputs=(("voltage", "current"), ("voltage",)),
    course=course,
    manoeuvres={"switched": switched, "waved": waved, "begun": begun},
    pairs=(("switched", "waved"), ("waved", "begun"), ("begun", "switched")),
    units={"d": "1", "Vin": "V", "voltage": "V", "current": "A"},
    effects=lambda: with_own(ConstantPower()),
)
