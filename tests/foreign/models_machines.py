"""Small models of vehicles, pendulums, fluid and servo systems."""

from __future__ import annotations

import casadi as ca
import numpy as np
from small_case import Case, case, equal, jittered

import casadi_engine as ce

G = 9.81


@case
def quarter_car():
    """A wheel over a bump in millimetres; the body's travel is recorded half a sample late."""

    def build(p):
        b = ce.Blueprint("quarter_car")
        c, k = b.parameter("c", p["c"], unit="N s/m", min=0), b.parameter("k", p["k"], unit="N/m", min=0)
        road = b.input("road", unit="m", scale=0.01)
        zb, vb = b.state("zb", unit="m", scale=0.01), b.state("vb", unit="m/s", scale=0.1)
        zw, vw = b.state("zw", unit="m", scale=0.01), b.state("vw", unit="m/s", scale=0.1)
        strut = k * (zw - zb) + c * (vw - vb)
        b.ode("zb", vb)
        b.ode("vb", strut / 300)
        b.ode("zw", vw)
        b.ode("vw", (160000 * (road - zw) - strut) / 40)
        b.output("body", zb, unit="m", scale=0.01)
        return b.model()

    def rates(t, x, p, u):
        strut = p["k"] * (x[2] - x[0]) + p["c"] * (x[3] - x[1])
        return [x[1], strut / 300, x[3], (160000 * (u["road"] - x[2]) - strut) / 40]

    t = np.arange(41) * 0.05
    return Case(
        "quarter_car", build, rates, {"body": lambda t, x, p, u: x[0]}, {"c": 1200.0, "k": 16000.0},
        {"zb": 0.0, "vb": 0.0, "zw": 0.0, "vw": 0.0}, {"road": "mm", "body": "mm"}, equal(1.96, 98, 0.01), "c", 2000.0,
        inputs={"road": (t, np.where((t > 0.2) & (t < 0.4), 30.0, 0.0) + 5 * np.sin(9 * t))},
    )  # fmt: skip


@case
def coast_down():
    """A car rolls out; speed in km/h at odd times."""

    def build(p):
        b = ce.Blueprint("coast_down")
        roll, drag = (
            b.parameter("roll", p["roll"], min=0, max=0.1),
            b.parameter("cda", p["cda"], unit="m2", min=0),
        )
        v = b.state("v", unit="m/s", scale=10.0)
        b.ode("v", -roll * 9.81 - 0.5 * 1.2 * cda_over_mass(drag) * v * ca.fabs(v))
        b.output("speed", v, unit="m/s", scale=10.0)
        return b.model()

    def cda_over_mass(drag):
        return drag / 1400

    return Case(
        "coast_down", build, lambda t, x, p, u: [-p["roll"] * G - 0.6 * p["cda"] / 1400 * x[0] * np.abs(x[0])],
        {"speed": lambda t, x, p, u: x[0]}, {"roll": 0.011, "cda": 0.65}, {"v": 33.0}, {"speed": "km/h"},
        jittered(120.0, 40), "cda", 0.3,
    )  # fmt: skip


@case
def geared_car():
    """Torque at the engine, engine speed in rpm; the gear ratio is sought."""

    def build(p):
        b = ce.Blueprint("geared_car")
        ratio, mass = (
            b.parameter("ratio", p["ratio"], min=1, max=30),
            b.parameter("m", p["m"], unit="kg", min=1),
        )
        torque = b.input("T", unit="N m", scale=100.0)
        v = b.state("v", unit="m/s", scale=10.0)
        b.ode("v", (torque * ratio / 0.3 - 150 - 0.4 * v**2) / mass)
        b.output("omega", v * ratio / 0.3, unit="rad/s", scale=100.0)
        return b.model()

    t = np.arange(31) * 1.0
    return Case(
        "geared_car", build, lambda t, x, p, u: [(u["T"] * p["ratio"] / 0.3 - 150 - 0.4 * x[0] ** 2) / p["m"]],
        {"omega": lambda t, x, p, u: x[0] * p["ratio"] / 0.3}, {"ratio": 7.5, "m": 1500.0}, {"v": 8.0},
        {"T": "N m", "omega": "rpm"}, jittered(30.0, 90), "ratio", 6.0,
        inputs={"T": (t, 80 + 60 * np.sign(np.sin(0.7 * t + 0.2)))}, hold="zero", known_start=True,
    )  # fmt: skip


@case
def single_track():
    """Lateral motion of a car; steering angle in degrees, yaw rate in deg/s."""

    def build(p):
        b = ce.Blueprint("single_track")
        cf, cr = b.parameter("cf", p["cf"], min=1), b.parameter("cr", p["cr"], min=1)
        steer = b.input("delta", unit="rad", scale=0.05)
        slip, yaw = b.state("slip", unit="rad", scale=0.05), b.state("yaw", unit="rad/s", scale=0.1)
        front, rear = cf * (steer - slip - 1.2 * yaw / 25), cr * (1.4 * yaw / 25 - slip)
        b.ode("slip", (front + rear) / (1500 * 25) - yaw)
        b.ode("yaw", (1.2 * front - 1.4 * rear) / 2500)
        b.output("rate", yaw, unit="rad/s", scale=0.1)
        return b.model()

    def rates(t, x, p, u):
        front = p["cf"] * (u["delta"] - x[0] - 0.048 * x[1])
        rear = p["cr"] * (0.056 * x[1] - x[0])
        return [(front + rear) / 37500 - x[1], (1.2 * front - 1.4 * rear) / 2500]

    t = np.arange(61) * 0.1
    return Case(
        "single_track", build, rates, {"rate": lambda t, x, p, u: x[1]}, {"cf": 8e4, "cr": 1e5},
        {"slip": 0.0, "yaw": 0.0}, {"delta": "deg", "rate": "deg/s"}, jittered(6.0, 121), "cr", 7e4,
        inputs={"delta": (t, 2 * np.sin(t**1.6))},
    )  # fmt: skip


@case
def small_pendulum():
    def build(p):
        b = ce.Blueprint("small_pendulum")
        w2, d = b.parameter("w2", p["w2"], min=0), b.parameter("d", p["d"], unit="1/s", min=0)
        a, w = b.state("a", unit="rad", scale=0.1), b.state("w", unit="rad/s")
        b.ode("a", w)
        b.ode("w", -w2 * a - d * w)
        b.output("angle", a, unit="rad", scale=0.1)
        return b.model()

    return Case(
        "small_pendulum", build, lambda t, x, p, u: [x[1], -p["w2"] * x[0] - p["d"] * x[1]],
        {"angle": lambda t, x, p, u: x[0]}, {"w2": 20.0, "d": 0.2}, {"a": 0.1, "w": 0.0}, {"angle": "deg"},
        jittered(6.0, 70), "d", 0.4,
    )  # fmt: skip


@case
def large_pendulum():
    """Starts nearly upright; its length is sought."""

    def build(p):
        b = ce.Blueprint("large_pendulum")
        length = b.parameter("l", p["l"], unit="m", min=0.01, max=10)
        a, w = b.state("a", unit="rad"), b.state("w", unit="rad/s")
        b.ode("a", w)
        b.ode("w", -9.81 / length * ca.sin(a) - 0.05 * w)
        b.output("angle", a, unit="rad")
        return b.model()

    return Case(
        "large_pendulum", build, lambda t, x, p, u: [x[1], -G / p["l"] * np.sin(x[0]) - 0.05 * x[1]],
        {"angle": lambda t, x, p, u: x[0]}, {"l": 0.8}, {"a": 2.8, "w": 0.0}, {"angle": "deg"}, equal(6.0, 61), "l",
        0.83,
    )  # fmt: skip


@case
def driven_pendulum():
    """Driven by a torque that is a function of time; sampled at 10 Hz."""

    def build(p):
        b = ce.Blueprint("driven_pendulum")
        w2, drive = b.parameter("w2", p["w2"], min=0), b.parameter("drive", p["drive"])
        a, w = b.state("a", unit="rad"), b.state("w", unit="rad/s")
        b.ode("a", w)
        b.ode("w", -w2 * ca.sin(a) - 0.3 * w + drive * ca.sin(2 * np.pi * 1.3 * b.time))
        b.output("angle", a, unit="rad")
        return b.model()

    return Case(
        "driven_pendulum", build,
        lambda t, x, p, u: [x[1], -p["w2"] * np.sin(x[0]) - 0.3 * x[1] + p["drive"] * np.sin(2.6 * np.pi * t)],
        {"angle": lambda t, x, p, u: x[0]}, {"w2": 12.0, "drive": 4.0}, {"a": 0.5, "w": 0.0}, {"angle": "rad"},
        equal(8.0, 81), "w2", 11.0,
    )  # fmt: skip


@case
def double_pendulum():
    def build(p):
        b = ce.Blueprint("double_pendulum")
        l2 = b.parameter("l2", p["l2"], unit="m", min=0.1, max=2)
        a, c = b.state("a", unit="rad"), b.state("c", unit="rad")
        v, w = b.state("v", unit="rad/s"), b.state("w", unit="rad/s")
        d = a - c
        bottom = 3 - ca.cos(2 * d)
        b.ode("a", v)
        b.ode("c", w)
        b.ode(
            "v",
            (
                -3 * 9.81 * ca.sin(a)
                - 9.81 * ca.sin(a - 2 * c)
                - 2 * ca.sin(d) * (w**2 * l2 + v**2 * ca.cos(d))
            )
            / bottom,
        )
        b.ode("w", 2 * ca.sin(d) * (2 * v**2 + 2 * 9.81 * ca.cos(a) + w**2 * l2 * ca.cos(d)) / (l2 * bottom))
        b.output("upper", a, unit="rad")
        b.output("lower", c, unit="rad")
        return b.model()  # fmt: skip

    def rates(t, x, p, u):
        """Lagrange's equations as a mass matrix (unit masses, upper length 1 m)."""
        a, c, v, w = x
        l2, s, k = p["l2"], np.sin(a - c), np.cos(a - c)
        mass = np.array([[2.0, l2 * k], [l2 * k, l2**2]])
        force = [-l2 * w**2 * s - 2 * G * np.sin(a), l2 * v**2 * s - G * l2 * np.sin(c)]
        return [v, w, *np.linalg.solve(mass, force)]

    return Case(
        "double_pendulum", build, rates, {"upper": lambda t, x, p, u: x[0], "lower": lambda t, x, p, u: x[1]},
        {"l2": 0.7}, {"a": 1.2, "c": -0.4, "v": 0.0, "w": 0.0}, {"upper": "deg", "lower": "deg"}, equal(2.0, 61), "l2",
        0.75, known_start=True,
    )  # fmt: skip


@case
def dc_motor():
    """Voltage held between slow samples, speed in rpm five times as often."""

    def build(p):
        b = ce.Blueprint("dc_motor")
        k, inertia = b.parameter("k", p["k"], min=1e-4), b.parameter("J", p["J"], unit="kg m2", min=1e-7)
        volt = b.input("u", unit="V")
        i, w = b.state("i", unit="A"), b.state("w", unit="rad/s", scale=100.0)
        b.ode("i", (volt - 1.2 * i - k * w) / 5e-3)
        b.ode("w", (k * i - 2e-5 * w) / inertia)
        b.output("speed", w, unit="rad/s", scale=100.0)
        return b.model()

    t = np.arange(21) * 0.05
    return Case(
        "dc_motor", build,
        lambda t, x, p, u: [(u["u"] - 1.2 * x[0] - p["k"] * x[1]) / 5e-3, (p["k"] * x[0] - 2e-5 * x[1]) / p["J"]],
        {"speed": lambda t, x, p, u: x[1]}, {"k": 0.05, "J": 2e-4}, {"i": 0.0, "w": 0.0}, {"u": "V", "speed": "rpm"},
        equal(1.0, 101), "J", 4e-4, inputs={"u": (t, np.where(np.arange(21) % 7 < 4, 12.0, 4.0))}, hold="zero",
    )  # fmt: skip


@case
def two_tanks():
    """Two tanks in a row that drain through holes; flow in L/min, level in cm."""

    def build(p):
        b = ce.Blueprint("two_tanks")
        a1, a2 = b.parameter("a1", p["a1"], min=0), b.parameter("a2", p["a2"], min=0)
        flow = b.input("q", unit="m3/s", scale=1e-4)
        h1, h2 = b.state("h1", unit="m", scale=0.1), b.state("h2", unit="m", scale=0.1)
        out = a1 * ca.sqrt(2 * 9.81 * h1)
        b.ode("h1", (flow - out) / 0.02)
        b.ode("h2", (out - a2 * ca.sqrt(2 * 9.81 * h2)) / 0.02)
        b.output("level", h2, unit="m", scale=0.1)
        return b.model()

    def rates(t, x, p, u):
        out = p["a1"] * np.sqrt(2 * G * x[0])
        return [(u["q"] - out) / 0.02, (out - p["a2"] * np.sqrt(2 * G * x[1])) / 0.02]

    return Case(
        "two_tanks", build, rates, {"level": lambda t, x, p, u: x[1]}, {"a1": 6e-5, "a2": 5e-5}, {"h1": 0.3, "h2": 0.2},
        {"q": "L/min", "level": "cm", "time": "min"}, equal(1200.0, 41), "a2", 4e-5,
        inputs={"q": ([0.0, 300.0, 600.0, 1200.0], [6.0, 9.0, 7.0, 7.0])},
    )  # fmt: skip


@case
def hydraulic_cylinder():
    """Pressure in bar drives a piston against a spring; travel in millimetres."""

    def build(p):
        b = ce.Blueprint("hydraulic_cylinder")
        area, d = b.parameter("A", p["A"], unit="m2", min=1e-6), b.parameter("d", p["d"], unit="N s/m", min=0)
        pressure = b.input("p", unit="bar", scale=10.0)
        z, v = b.state("z", unit="m", scale=0.01), b.state("v", unit="m/s", scale=0.1)
        b.ode("z", v)
        b.ode("v", (area * 1e5 * pressure - 4e4 * z - d * v) / 5)
        b.output("travel", z, unit="m", scale=0.01)
        return b.model()

    t = np.arange(31) * 0.02
    return Case(
        "hydraulic_cylinder", build,
        lambda t, x, p, u: [x[1], (p["A"] * u["p"] - 4e4 * x[0] - p["d"] * x[1]) / 5],
        {"travel": lambda t, x, p, u: x[0]}, {"A": 1e-3, "d": 300.0}, {"z": 0.0, "v": 0.0},
        {"p": "bar", "travel": "mm"}, equal(0.6, 121), "A", 2e-3,
        inputs={"p": (t, 10 + 8 * np.sin(15 * t))},
    )  # fmt: skip


@case
def magnetic_levitation():
    """A ball under a magnet with its controller."""

    def build(p):
        b = ce.Blueprint("magnetic_levitation")
        strength = b.parameter("k", p["k"], min=1e-7)
        target = b.input("r", unit="m", scale=1e-3)
        gap, v = b.state("gap", unit="m", scale=0.01), b.state("v", unit="m/s", scale=0.1)
        current = 1.0 + 300 * (gap - target) + 8 * v
        b.ode("gap", v)
        b.ode("v", 9.81 - strength / 0.05 * (current / gap) ** 2)
        b.output("y", gap, unit="m", scale=0.01)
        return b.model()

    def rates(t, x, p, u):
        current = 1 + 300 * (x[0] - u["r"]) + 8 * x[1]
        return [x[1], G - 20 * p["k"] * current**2 / x[0] ** 2]

    t = np.arange(11) * 0.1
    return Case(
        "magnetic_levitation", build, rates, {"y": lambda t, x, p, u: x[0]}, {"k": 5e-5}, {"gap": 0.011, "v": 0.0},
        {"r": "mm", "y": "mm"}, jittered(1.0, 101), "k", 4e-5,
        inputs={"r": (t, 10 + np.where(np.arange(11) % 4 < 2, 0.5, -0.5))}, hold="zero",
    )  # fmt: skip


@case
def drone():
    """Height of a drone; thrust by the square of the rotors' speed in rpm."""

    def build(p):
        b = ce.Blueprint("drone")
        thrust, drag = b.parameter("kt", p["kt"], min=0), b.parameter("cd", p["cd"], min=0)
        rotor = b.input("n", unit="rpm", scale=5000.0)
        z, v = b.state("z", unit="m"), b.state("v", unit="m/s")
        b.ode("z", v)
        b.ode("v", thrust * (rotor / 1000) ** 2 - 9.81 - drag * v * ca.fabs(v))
        b.output("height", z, unit="m")
        return b.model()

    t = np.arange(41) * 0.25
    return Case(
        "drone", build,
        lambda t, x, p, u: [x[1], p["kt"] * (u["n"] * 30 / np.pi / 1000) ** 2 - G - p["cd"] * x[1] * np.abs(x[1])],
        {"height": lambda t, x, p, u: x[0]}, {"kt": 0.4, "cd": 0.15}, {"z": 0.0, "v": 0.0}, {"n": "rpm", "height": "m"},
        equal(10.0, 101), "cd", 0.3, inputs={"n": (t, 4950 + 250 * np.sin(1.3 * t))},
    )  # fmt: skip
