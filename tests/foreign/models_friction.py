"""Small models with corners and jumps: dry friction, contact, play, limits."""

from __future__ import annotations

import casadi as ca
import numpy as np
from small_case import Case, case, equal, jittered

import casadi_engine as ce

G = 9.81
SHARP = ("sign", "jump", "switch", "event", "stick")


@case
def run_down():
    """A shaft that dry friction brings to rest at 2.4 s, and keeps at rest."""

    def build(p):
        b = ce.Blueprint("run_down")
        inertia = b.parameter("J", p["J"], unit="kg m2", min=1e-4)
        friction = b.parameter("Tf", p["Tf"], unit="N m", min=0)
        w = b.state("w", unit="rad/s", scale=10.0)
        b.ode("w", -friction * ca.sign(w) / inertia - 0.1 * w / inertia)
        b.output("speed", w, unit="rad/s", scale=10.0)
        return b.model()

    return Case(
        "run_down", build, lambda t, x, p, u, s: [(-p["Tf"] * s - 0.1 * x[0]) / p["J"]],
        {"speed": lambda t, x, p, u: x[0]}, {"J": 0.2, "Tf": 1.0}, {"w": 20.0}, {"speed": "rpm"}, equal(4.0, 81), "Tf",
        0.5, switch=lambda x, p: x[0], known_start=True, cause=SHARP,
    )  # fmt: skip


@case
def pushed_shaft():
    """Dry friction written with if_else; a torque breaks the shaft loose and lets it stop again."""

    def build(p):
        b = ce.Blueprint("pushed_shaft")
        friction = b.parameter("Tf", p["Tf"], unit="N m", min=0)
        torque = b.input("T", unit="N m")
        w = b.state("w", unit="rad/s", scale=10.0)
        b.ode("w", (torque - ca.if_else(w > 0, friction, ca.if_else(w < 0, -friction, 0)) - 0.05 * w) / 0.1)
        b.output("speed", w, unit="rad/s", scale=10.0)
        return b.model()

    t = np.arange(13) * 0.5
    return Case(
        "pushed_shaft", build, lambda t, x, p, u, s: [(u["T"] - p["Tf"] * s - 0.05 * x[0]) / 0.1],
        {"speed": lambda t, x, p, u: x[0]}, {"Tf": 0.8}, {"w": 3.0}, {"T": "N m", "speed": "rpm"}, jittered(6.0, 150),
        "Tf", 0.5, inputs={"T": (t, [0, 0, 0, 0.4, 1.5, 1.5, 0, 0, 0, -1.2, -1.2, 0.3, 0.3])}, hold="zero",
        switch=lambda x, p: x[0], known_start=True, cause=SHARP,
    )  # fmt: skip


@case
def rubbing_oscillator():
    """A mass on a spring with dry friction, until it sticks."""

    def build(p):
        b = ce.Blueprint("rubbing_oscillator")
        friction, k = b.parameter("f", p["f"], unit="m/s2", min=0), b.parameter("w2", p["w2"], min=0)
        z, v = b.state("z", unit="m"), b.state("v", unit="m/s")
        b.ode("z", v)
        b.ode("v", -k * z - friction * ca.sign(v))
        b.output("y", z, unit="m")
        return b.model()

    return Case(
        "rubbing_oscillator", build, lambda t, x, p, u, s: [x[1], -p["w2"] * x[0] - p["f"] * s],
        {"y": lambda t, x, p, u: x[0]}, {"f": 1.3, "w2": 10.0}, {"z": 1.0, "v": 0.0}, {"y": "mm"}, equal(5.0, 101), "f",
        1.0, switch=lambda x, p: x[1], known_start=True, cause=SHARP,
    )  # fmt: skip


@case
def block_on_belt():
    """A block on a moving belt, held by a spring: carried along, then sliding."""

    def build(p):
        b = ce.Blueprint("block_on_belt")
        friction = b.parameter("f", p["f"], unit="m/s2", min=0)
        z, v = b.state("z", unit="m", scale=0.1), b.state("v", unit="m/s", scale=0.1)
        b.ode("z", v)
        b.ode("v", -25 * z - 0.4 * v + friction * ca.sign(0.2 - v))
        b.output("y", z, unit="m", scale=0.1)
        return b.model()

    return Case(
        "block_on_belt", build, lambda t, x, p, u, s: [x[1], -25 * x[0] - 0.4 * x[1] + p["f"] * s],
        {"y": lambda t, x, p, u: x[0]}, {"f": 2.0}, {"z": 0.0, "v": 0.0}, {"y": "mm"}, jittered(5.0, 120), "f", 1.5,
        switch=lambda x, p: 0.2 - x[1], known_start=True, cause=SHARP,
    )  # fmt: skip


@case
def bouncing_ball():
    """A ball on hard ground: a stiff spring with a damper, in touch only."""

    def build(p):
        b = ce.Blueprint("bouncing_ball")
        k, d = b.parameter("k", p["k"], min=1), b.parameter("d", p["d"], min=0)
        h, v = b.state("h", unit="m"), b.state("v", unit="m/s")
        b.ode("h", v)
        b.ode("v", -9.81 + ca.if_else(h < 0, -k * h * (1 - d * v), 0))
        b.output("height", h, unit="m")
        return b.model()

    return Case(
        "bouncing_ball", build,
        lambda t, x, p, u: [x[1], -G + np.where(x[0] < 0, -p["k"] * x[0] * (1 - p["d"] * x[1]), 0)],
        {"height": lambda t, x, p, u: x[0]}, {"k": 2e4, "d": 0.05}, {"h": 1.0, "v": 0.0}, {"height": "mm"},
        equal(2.0, 101), "d", 0.06, known_start=True, cause=("event", "steps"),
    )  # fmt: skip


@case
def play():
    """Two masses with play between them (a dead zone)."""

    def build(p):
        b = ce.Blueprint("play")
        gap = b.parameter("gap", p["gap"], unit="rad", min=0)
        torque = b.input("T", unit="N m")
        twist, w1, w2 = (
            b.state("twist", unit="rad", scale=0.1),
            b.state("w1", unit="rad/s"),
            b.state("w2", unit="rad/s"),
        )
        wound = ca.fmax(twist - gap, 0) + ca.fmin(twist + gap, 0)
        coupling = 60 * wound
        b.ode("twist", w1 - w2)
        b.ode("w1", (torque - coupling - 0.05 * w1) / 0.05)
        b.ode("w2", (coupling - 0.2 * w2) / 0.1)
        b.output("motor", w1, unit="rad/s")
        return b.model()

    def rates(t, x, p, u):
        coupling = 60 * np.sign(x[0]) * np.maximum(np.abs(x[0]) - p["gap"], 0)
        return [x[1] - x[2], (u["T"] - coupling - 0.05 * x[1]) * 20, (coupling - 0.2 * x[2]) * 10]

    t = np.arange(11) * 0.1
    return Case(
        "play", build, rates, {"motor": lambda t, x, p, u: x[1]}, {"gap": 0.05}, {"twist": 0.0, "w1": 0.0, "w2": 0.0},
        {"T": "N m", "motor": "rpm"}, equal(1.0, 201), "gap", 0.04, inputs={"T": (t, 2 * np.sin(5 * t))},
        known_start=True,
    )  # fmt: skip


@case
def limited_actuator():
    """A valve that cannot move faster than a limit."""

    def build(p):
        b = ce.Blueprint("limited_actuator")
        rate, k = (
            b.parameter("rate", p["rate"], unit="1/s", min=0),
            b.parameter("k", p["k"], unit="1/s", min=0),
        )
        target = b.input("r")
        z = b.state("z")
        b.ode("z", ca.fmin(ca.fmax(k * (target - z), -rate), rate))
        b.output("y", z)
        return b.model()

    t = np.arange(9) * 0.5
    return Case(
        "limited_actuator", build, lambda t, x, p, u: [np.clip(p["k"] * (u["r"] - x[0]), -p["rate"], p["rate"])],
        {"y": lambda t, x, p, u: x[0]}, {"rate": 2.0, "k": 20.0}, {"z": 0.0}, {"r": "1", "y": "1"}, equal(4.0, 81),
        "rate", 3.0, inputs={"r": (t, [0, 1.0, 0, 1.0, 0.2, 0.9, 0.1, 0, 0])}, hold="zero",
    )  # fmt: skip


@case
def wound_up_controller():
    """A controller with a limited output whose integrator winds up."""

    def build(p):
        b = ce.Blueprint("wound_up_controller")
        ki = b.parameter("ki", p["ki"], min=0)
        target = b.input("r")
        y, integral = b.state("y"), b.state("integral")
        control = ca.fmin(ca.fmax(2 * (target - y) + ki * integral, -1), 1)
        b.ode("y", control - 0.5 * y)
        b.ode("integral", target - y)
        b.output("level", y)
        return b.model()

    def rates(t, x, p, u):
        return [np.clip(2 * (u["r"] - x[0]) + p["ki"] * x[1], -1, 1) - 0.5 * x[0], u["r"] - x[0]]

    return Case(
        "wound_up_controller", build, rates, {"level": lambda t, x, p, u: x[0]}, {"ki": 1.0},
        {"y": 0.0, "integral": 0.0}, {"r": "1", "level": "1"}, jittered(20.0, 100), "ki", 0.7,
        inputs={"r": ([0.0, 8.0, 14.0, 20.0], [1.5, 0.5, 1.0, 1.0])}, hold="zero", known_start=True,
    )  # fmt: skip


@case
def end_stop():
    """A flap on a spring that meets a stiff stop; driven faster than it is sampled in."""

    def build(p):
        b = ce.Blueprint("end_stop")
        stop = b.parameter("stop", p["stop"], unit="rad", min=0.05, max=1)
        a, w = b.state("a", unit="rad", scale=0.1), b.state("w", unit="rad/s")
        b.ode("a", w)
        b.ode("w", 30 * ca.sin(12 * b.time) - 100 * a - 2 * w - 2e4 * ca.fmax(a - stop, 0))
        b.output("angle", a, unit="rad", scale=0.1)
        return b.model()

    def rates(t, x, p, u):
        return [x[1], 30 * np.sin(12 * t) - 100 * x[0] - 2 * x[1] - 2e4 * np.maximum(x[0] - p["stop"], 0)]

    return Case(
        "end_stop", build, rates, {"angle": lambda t, x, p, u: x[0]}, {"stop": 0.3}, {"a": 0.0, "w": 0.0},
        {"angle": "deg"}, equal(3.0, 61), "stop", 0.31, known_start=True,
    )  # fmt: skip


@case
def relay():
    """A two-point controller without hysteresis: it slides along its set point."""

    def build(p):
        b = ce.Blueprint("relay")
        power = b.parameter("P", p["P"], min=0)
        x, y = b.state("x"), b.state("y")
        b.ode("x", -power * ca.sign(x + 0.5 * y) - 0.2 * x)
        b.ode("y", x - 0.3 * y)
        b.output("signal", y)
        return b.model()

    return Case(
        "relay", build, lambda t, x, p, u, s: [-p["P"] * s - 0.2 * x[0], x[0] - 0.3 * x[1]],
        {"signal": lambda t, x, p, u: x[1]}, {"P": 1.5}, {"x": 2.0, "y": 1.0}, {"signal": "1"}, equal(6.0, 61), "P",
        1.0, switch=lambda x, p: x[0] + 0.5 * x[1], known_start=True, cause=SHARP,
    )  # fmt: skip
