"""Small models of circuits and of heat."""

from __future__ import annotations

import casadi as ca
import numpy as np
from small_case import Case, bursts, case, equal, jittered

import casadi_engine as ce


@case
def low_pass():
    """A square wave through a resistor into a capacitor, times in milliseconds."""

    def build(p):
        b = ce.Blueprint("low_pass")
        r, c = b.parameter("R", p["R"], min=1), b.parameter("C", p["C"], min=1e-9)
        source = b.input("u", unit="V")
        v = b.state("v", unit="V")
        b.ode("v", (source - v) / (r * c))
        b.output("y", v, unit="V")
        return b.model()

    return Case(
        "low_pass", build, lambda t, x, p, u: [(u["u"] - x[0]) / (p["R"] * p["C"])], {"y": lambda t, x, p, u: x[0]},
        {"R": 1000.0, "C": 2e-6}, {"v": 0.0}, {"u": "V", "y": "mV", "time": "ms"}, jittered(0.02, 60), "R", 2000.0,
        inputs={"u": (np.linspace(0, 0.02, 5), [5.0, 0.0, 5.0, 0.0, 0.0])}, hold="zero",
    )  # fmt: skip


@case
def resonant_circuit():
    """A ramped voltage at 1 kHz, the current at 10 kHz."""

    def build(p):
        b = ce.Blueprint("resonant_circuit")
        r, ell, c = (
            b.parameter("R", p["R"], min=0),
            b.parameter("L", p["L"], min=1e-6),
            b.parameter("C", p["C"], min=1e-9),
        )
        source = b.input("u", unit="V")
        i, v = b.state("i", unit="A", scale=1e-2), b.state("v", unit="V")
        b.ode("i", (source - r * i - v) / ell)
        b.ode("v", i / c)
        b.output("current", i, unit="A")
        return b.model()

    t = np.arange(21) * 1e-3
    return Case(
        "resonant_circuit", build,
        lambda t, x, p, u: [(u["u"] - p["R"] * x[0] - x[1]) / p["L"], x[0] / p["C"]],
        {"current": lambda t, x, p, u: x[0]}, {"R": 20.0, "L": 0.05, "C": 1e-6}, {"i": 0.0, "v": 0.0},
        {"u": "V", "current": "mA"}, equal(0.02, 201), "C", 1.1e-6,
        inputs={"u": (t, np.sign(np.sin(400 * t + 0.1)))},
    )  # fmt: skip


@case
def diode_clipper():
    def build(p):
        b = ce.Blueprint("diode_clipper")
        rc, sat = b.parameter("RC", p["RC"], unit="s", min=1e-6), b.parameter("sat", p["sat"], min=1e-12)
        v = b.state("v", unit="V")
        source = 2 * ca.sin(2 * np.pi * 50 * b.time)
        b.ode("v", (source - v) / rc - sat * ca.sinh(v / 0.05))
        b.output("y", v, unit="V")
        return b.model()

    return Case(
        "diode_clipper", build,
        lambda t, x, p, u: [(2 * np.sin(100 * np.pi * t) - x[0]) / p["RC"] - p["sat"] * np.sinh(x[0] / 0.05)],
        {"y": lambda t, x, p, u: x[0]}, {"RC": 1e-3, "sat": 1e-2}, {"v": 0.0}, {"y": "V", "time": "ms"},
        equal(0.06, 121), "sat", 3e-2, known_start=True, cause=("stiff", "steps"),
    )  # fmt: skip


@case
def piecewise_resistor():
    """Chua's circuit in its settled form: a resistor whose slope changes at a voltage."""

    def build(p):
        b = ce.Blueprint("piecewise_resistor")
        alpha = b.parameter("alpha", p["alpha"], min=0)
        x, y, z = b.state("x"), b.state("y"), b.state("z")
        law = -0.7 * x - 0.2 * (ca.fabs(x + 1) - ca.fabs(x - 1))
        b.ode("x", alpha * (y - x - law))
        b.ode("y", x - y + z)
        b.ode("z", -14 * y)
        b.output("vx", x)
        return b.model()

    def rates(t, x, p, u):
        law = -0.7 * x[0] - 0.4 * np.clip(x[0], -1, 1)
        return [p["alpha"] * (x[1] - x[0] - law), x[0] - x[1] + x[2], -14 * x[1]]

    return Case(
        "piecewise_resistor", build, rates, {"vx": lambda t, x, p, u: x[0]}, {"alpha": 5.0},
        {"x": 0.3, "y": 0.1, "z": -0.2}, {"vx": "1"}, equal(12.0, 121), "alpha", 4.5, known_start=True,
    )  # fmt: skip


@case
def amplifier():
    """An amplifier that saturates at 5 V, fed by a triangle of 1 V."""

    def build(p):
        b = ce.Blueprint("amplifier")
        gain, tau = b.parameter("gain", p["gain"], min=0), b.parameter("tau", p["tau"], unit="s", min=1e-6)
        u = b.input("u", unit="V")
        v = b.state("v", unit="V")
        b.ode("v", (ca.fmin(ca.fmax(gain * u, -5), 5) - v) / tau)
        b.output("y", v, unit="V")
        return b.model()

    t, swing = np.linspace(0, 0.4, 9), np.array([0, 1.0, 0, -1.0, 0, 1.0, 0, -1.0, 0])

    def corners(p):
        """Where the triangle passes the limits: SciPy's steps across a corner are too rough for a derivative."""
        if p["gain"] <= 5:
            return ()
        share = 5 / p["gain"]  # of a leg, from its end at 0 V
        return tuple(
            a + (b - a) * (share if u == 0 else 1 - share) for a, b, u in zip(t, t[1:], swing, strict=False)
        )

    return Case(
        "amplifier", build, lambda t, x, p, u: [(np.clip(p["gain"] * u["u"], -5, 5) - x[0]) / p["tau"]],
        {"y": lambda t, x, p, u: x[0]}, {"gain": 8.0, "tau": 0.01}, {"v": 0.0}, {"u": "V", "y": "V"},
        jittered(0.4, 100), "gain", 6.0, inputs={"u": (t, swing)}, breaks=corners,
    )  # fmt: skip


@case
def fast_coil():
    """A motor whose coil has a time constant of 1e-5 s, sampled at 10 ms."""

    def build(p):
        b = ce.Blueprint("fast_coil")
        inertia, drag = b.parameter("J", p["J"], unit="kg m2", min=1e-6), b.parameter("d", p["d"], min=0)
        i, w = b.state("i", unit="A"), b.state("w", unit="rad/s")
        b.ode("i", (12 - 1.0 * i - 0.05 * w) / 1e-5)
        b.ode("w", (0.05 * i - drag * w * ca.fabs(w)) / inertia)
        b.output("speed", w, unit="rad/s")
        return b.model()

    return Case(
        "fast_coil", build,
        lambda t, x, p, u: [(12 - x[0] - 0.05 * x[1]) * 1e5, (0.05 * x[0] - p["d"] * x[1] * abs(x[1])) / p["J"]],
        {"speed": lambda t, x, p, u: x[1]}, {"J": 1e-3, "d": 1e-5}, {"i": 0.0, "w": 0.0}, {"speed": "rpm"},
        equal(1.0, 101), "J", 1.5e-3, known_start=True, method="Radau", cause=("stiff", "time constant"),
    )  # fmt: skip


@case
def fast_coil_linear():
    """The same with a drag that is linear, and a voltage that was recorded."""

    def build(p):
        b = ce.Blueprint("fast_coil_linear")
        inertia = b.parameter("J", p["J"], unit="kg m2", min=1e-6)
        volt = b.input("volt", unit="V")
        i, w = b.state("i", unit="A"), b.state("w", unit="rad/s")
        b.ode("i", (volt - 1.0 * i - 0.05 * w) / 1e-5)
        b.ode("w", (0.05 * i - 1e-3 * w) / inertia)
        b.output("speed", w, unit="rad/s")
        return b.model()

    return Case(
        "fast_coil_linear", build,
        lambda t, x, p, u: [(u["volt"] - x[0] - 0.05 * x[1]) * 1e5, (0.05 * x[0] - 1e-3 * x[1]) / p["J"]],
        {"speed": lambda t, x, p, u: x[1]}, {"J": 1e-3}, {"i": 0.0, "w": 0.0}, {"speed": "rpm", "volt": "V"},
        equal(1.0, 101), "J", 1.5e-3, known_start=True, method="Radau", cause=("stiff", "time constant"),
        inputs={"volt": ([0.0, 0.4, 0.5, 1.0], [0.0, 12.0, 12.0, 6.0])},
    )  # fmt: skip


@case
def rectifier():
    """A coil behind an ideal half-wave rectifier."""

    def build(p):
        b = ce.Blueprint("rectifier")
        ell = b.parameter("L", p["L"], min=1e-6)
        i = b.state("i", unit="A")
        b.ode("i", (ca.fmax(10 * ca.sin(2 * np.pi * 50 * b.time), 0) - 2 * i) / ell)
        b.output("current", i, unit="A")
        return b.model()

    return Case(
        "rectifier", build,
        lambda t, x, p, u: [(np.maximum(10 * np.sin(100 * np.pi * t), 0) - 2 * x[0]) / p["L"]],
        {"current": lambda t, x, p, u: x[0]}, {"L": 0.02}, {"i": 0.0}, {"current": "mA", "time": "ms"},
        jittered(0.1, 50), "L", 0.03, breaks=lambda p: np.arange(1, 10) * 0.01,
    )  # fmt: skip


@case
def warm_room():
    def build(p):
        b = ce.Blueprint("warm_room")
        cap, loss = b.parameter("C", p["C"], unit="J/K", min=1), b.parameter("G", p["G"], unit="W/K", min=0)
        heat, outside = b.input("P", unit="W"), b.input("T_out", unit="K")
        temp = b.state("T", unit="K", scale=300.0)
        b.ode("T", (heat - loss * (temp - outside)) / cap)
        b.output("T_in", temp, unit="K", scale=300.0)
        return b.model()

    hours = np.arange(0, 25) * 3600.0
    return Case(
        "warm_room", build, lambda t, x, p, u: [(u["P"] - p["G"] * (x[0] - u["T_out"])) / p["C"]],
        {"T_in": lambda t, x, p, u: x[0]}, {"C": 2e6, "G": 150.0}, {"T": 292.0},
        {"P": "W", "T_out": "degC", "T_in": "degC", "time": "h"}, equal(24 * 3600, 97), "G", 100.0,
        inputs={"P": (hours, np.where((np.arange(25) // 6) % 2, 3000.0, 1000.0)),
                "T_out": (hours, 5 - 4 * np.cos(np.arange(25) * np.pi / 12))},
    )  # fmt: skip


@case
def three_walls():
    """Three masses in a row, the last alone measured, in bursts an hour apart."""

    def build(p):
        b = ce.Blueprint("three_walls")
        g = b.parameter("G", p["G"], unit="W/K", min=0)
        heat = b.input("P", unit="W")
        t = [b.state(f"T{k}", unit="K", scale=10.0) for k in range(3)]
        b.ode("T0", (heat - g * (t[0] - t[1])) / 2e4)
        b.ode("T1", (g * (t[0] - t[1]) - g * (t[1] - t[2])) / 5e4)
        b.ode("T2", (g * (t[1] - t[2]) - 5 * t[2]) / 1e5)
        b.output("over", t[2], unit="K", scale=10.0)
        return b.model()

    def rates(t, x, p, u):
        a, c = p["G"] * (x[0] - x[1]), p["G"] * (x[1] - x[2])
        return [(u["P"] - a) / 2e4, (a - c) / 5e4, (c - 5 * x[2]) / 1e5]

    return Case(
        "three_walls", build, rates, {"over": lambda t, x, p, u: x[2]}, {"G": 20.0}, {"T0": 0.0, "T1": 0.0, "T2": 0.0},
        {"P": "W", "over": "K"}, bursts(36000.0, 10, 8), "G", 30.0, known_start=True,
        inputs={"P": ([0.0, 7200.0, 14400.0, 36000.0], [500.0, 0.0, 800.0, 0.0])}, hold="zero",
    )  # fmt: skip


@case
def radiator():
    """A hot body that radiates, T to the fourth."""

    def build(p):
        b = ce.Blueprint("radiator")
        eps, cap = b.parameter("eps", p["eps"], min=0, max=1), b.parameter("C", p["C"], unit="J/K", min=1)
        temp = b.state("T", unit="K", scale=1000.0)
        b.ode("T", -eps * 5.670374419e-8 * 0.2 * (temp**4 - 293.15**4) / cap)
        b.output("surface", temp, unit="K", scale=1000.0)
        return b.model()

    return Case(
        "radiator", build,
        lambda t, x, p, u: [-p["eps"] * 5.670374419e-8 * 0.2 * (x[0] ** 4 - 293.15**4) / p["C"]],
        {"surface": lambda t, x, p, u: x[0]}, {"eps": 0.8, "C": 500.0}, {"T": 1300.0}, {"surface": "degC"},
        equal(600.0, 21), "eps", 0.5,
    )  # fmt: skip


@case
def thermostat():
    """A heater that a clock switches; when it switches on late is the parameter."""

    def build(p):
        b = ce.Blueprint("thermostat")
        delay, power = (
            b.parameter("delay", p["delay"], unit="s", min=0, max=200),
            b.parameter("P", p["P"], unit="W"),
        )
        temp = b.state("T", unit="K", scale=20.0)
        b.ode("T", (ca.if_else(b.time > delay, power, 0) - 8 * temp) / 4000)
        b.output("over", temp, unit="K", scale=20.0)
        return b.model()

    return Case(
        "thermostat", build, lambda t, x, p, u: [(p["P"] * (t > p["delay"]) - 8 * x[0]) / 4000],
        {"over": lambda t, x, p, u: x[0]}, {"delay": 103.7, "P": 300.0}, {"T": 0.0}, {"over": "K"},
        equal(1000.0, 51), "delay", 80.0, known_start=True, breaks=lambda p: (p["delay"],),
        cause=("instant", "time"),
    )  # fmt: skip
