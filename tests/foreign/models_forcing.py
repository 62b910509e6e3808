"""Small models that are forced in time, and records with units and samplings that a user may have."""

from __future__ import annotations

import casadi as ca
import numpy as np
from small_case import Case, case, equal, jittered

import casadi_engine as ce


def rotor(name, torque):
    """J dw/dt = torque(b, p) - c w, the speed in rpm."""

    def build(p):
        b = ce.Blueprint(name)
        symbols = {key: b.parameter(key, value) for key, value in p.items()}
        w = b.state("w", unit="rad/s", scale=10.0)
        b.ode("w", torque(b.time, symbols) - symbols["c"] * w)
        b.output("speed", w, unit="rad/s", scale=10.0)
        return b.model()

    return build


SPEED = {"speed": lambda t, x, p, u: x[0]}


@case
def load_step():
    """A load that sets in between two samples; its instant is sought."""
    return Case(
        "load_step", rotor("load_step", lambda t, s: 20 - ca.if_else(t > s["ts"], s["load"], 0)),
        lambda t, x, p, u: [20 - p["load"] * (t > p["ts"]) - p["c"] * x[0]], SPEED,
        {"c": 2.0, "load": 12.0, "ts": 1.537}, {"w": 10.0}, {"speed": "rpm"}, equal(3.0, 31), "ts", 1.3,
        breaks=lambda p: (p["ts"],), cause=("instant", "time"),
    )  # fmt: skip


@case
def load_step_size():
    """The same step, its size sought."""
    return Case(
        "load_step_size", rotor("load_step_size", lambda t, s: 20 - ca.if_else(t > 1.537, s["load"], 0)),
        lambda t, x, p, u: [20 - p["load"] * (t > 1.537) - p["c"] * x[0]], SPEED, {"c": 2.0, "load": 12.0}, {"w": 10.0},
        {"speed": "rpm"}, equal(3.0, 31), "load", 6.0, breaks=lambda p: (1.537,), cause=("instant", "time"),
    )  # fmt: skip


@case
def fast_sine():
    """Forced at 3 Hz, sampled at 10 Hz; the amplitude is sought."""
    return Case(
        "fast_sine", rotor("fast_sine", lambda t, s: s["A"] * ca.sin(6 * np.pi * t)),
        lambda t, x, p, u: [p["A"] * np.sin(6 * np.pi * t) - p["c"] * x[0]], SPEED, {"c": 2.0, "A": 50.0}, {"w": 5.0},
        {"speed": "rpm"}, equal(4.0, 41), "A", 30.0,
    )  # fmt: skip


@case
def sine_by_drive():
    """The same written as a drive, to an equation that is nonlinear; the frequency is sought."""

    def build(p):
        b = ce.Blueprint("sine_by_drive")
        f = b.parameter("f", p["f"], unit="Hz", min=0.1, max=10)
        w = b.state("w", unit="rad/s")
        push = b.drive("push", 50 * ca.sin(2 * np.pi * f * b.time), unit="N m")
        b.ode("w", push - 0.2 * w * ca.fabs(w))
        b.output("speed", w, unit="rad/s")
        return b.model()

    return Case(
        "sine_by_drive", build, lambda t, x, p, u: [50 * np.sin(2 * np.pi * p["f"] * t) - 0.2 * x[0] * np.abs(x[0])],
        SPEED, {"f": 2.7}, {"w": 5.0}, {"speed": "rpm"}, equal(4.0, 41), "f", 2.68, known_start=True,
    )  # fmt: skip


@case
def square_wave():
    """A square wave written with sign(sin(t)), whose jumps fall between the samples."""
    return Case(
        "square_wave", rotor("square_wave", lambda t, s: s["A"] * ca.sign(ca.sin(2 * np.pi * t))),
        lambda t, x, p, u: [p["A"] * np.sign(np.sin(2 * np.pi * t)) - p["c"] * x[0]], SPEED, {"c": 3.0, "A": 20.0},
        {"w": 0.0}, {"speed": "rpm"}, jittered(4.0, 60), "A", 10.0, breaks=lambda p: np.arange(1, 8) / 2,
        cause=("jump", "time", "instant"),
    )  # fmt: skip


@case
def ramp():
    """A ramp that ends at a time which is sought."""
    return Case(
        "ramp", rotor("ramp", lambda t, s: 30 * ca.fmin(t / s["T"], 1)),
        lambda t, x, p, u: [30 * np.minimum(t / p["T"], 1) - p["c"] * x[0]], SPEED, {"c": 2.0, "T": 1.234}, {"w": 0.0},
        {"speed": "rpm"}, equal(3.0, 31), "T", 1.0, breaks=lambda p: (p["T"],),
    )  # fmt: skip


@case
def short_pulse():
    """A pulse of a millisecond at 20 Hz sampling: nearly an impulse."""
    return Case(
        "short_pulse",
        rotor("short_pulse", lambda t, s: s["A"] * ca.if_else(ca.logic_and(t > 0.512, t < 0.513), 1, 0)),
        lambda t, x, p, u: [p["A"] * ((t > 0.512) & (t < 0.513)) - p["c"] * x[0]], SPEED, {"c": 3.0, "A": 2e4},
        {"w": 1.0}, {"speed": "rpm"}, equal(2.0, 41), "A", 1e4, breaks=lambda p: (0.512, 0.513), known_start=True,
        cause=("jump", "time", "instant"),
    )  # fmt: skip


@case
def staircase():
    """A load that grows by a step each second, written with floor."""
    return Case(
        "staircase", rotor("staircase", lambda t, s: s["A"] * ca.floor(t - 0.25)),
        lambda t, x, p, u: [p["A"] * np.floor(t - 0.25) - p["c"] * x[0]], SPEED, {"c": 3.0, "A": 4.0}, {"w": 1.0},
        {"speed": "rpm"}, equal(4.0, 41), "A", 3.0, breaks=lambda p: 0.25 + np.arange(4), cause=("jump", "time"),
    )  # fmt: skip


@case
def shaft_in_rpm():
    """The output is declared in rpm, as the tachometer shows it; the inertia is sought."""

    def build(p):
        b = ce.Blueprint("shaft_in_rpm")
        inertia, c = b.parameter("J", p["J"], unit="kg m2", min=1e-3), b.parameter("c", p["c"], min=0)
        torque = b.input("T", unit="N m")
        w = b.state("w", unit="rad/s", scale=10.0)
        b.ode("w", (torque - c * w) / inertia)
        b.output("n", w * 30 / np.pi, unit="rpm", scale=100.0)
        return b.model()

    t = np.arange(41) * 0.1
    return Case(
        "shaft_in_rpm", build, lambda t, x, p, u: [(u["T"] - p["c"] * x[0]) / p["J"]],
        {"n": lambda t, x, p, u: x[0]}, {"J": 0.2, "c": 0.3}, {"w": 0.0}, {"T": "N m", "n": "rpm"}, equal(4.0, 81), "J",
        0.5, inputs={"T": (t, 5 + 4 * np.sign(np.sin(3 * t + 0.1)))}, hold="zero",
    )  # fmt: skip


@case
def valve_in_bar():
    """The input is declared in bar and recorded in Pa; the gain is sought."""

    def build(p):
        b = ce.Blueprint("valve_in_bar")
        gain = b.parameter("gain", p["gain"], min=0)
        pressure = b.input("p", unit="bar")
        z = b.state("z", unit="mm")
        b.ode("z", gain * pressure - 2 * z)
        b.output("travel", z, unit="mm")
        return b.model()

    t = np.arange(31) * 0.1
    return Case(
        "valve_in_bar", build, lambda t, x, p, u: [p["gain"] * u["p"] / 1e5 - 2 * x[0]],
        {"travel": lambda t, x, p, u: 1e-3 * x[0]}, {"gain": 3.0}, {"z": 0.0}, {"p": "Pa", "travel": "m"},
        equal(3.0, 61), "gain", 1.0, inputs={"p": (t, 1e5 * (2 + np.sin(4 * t)))},
    )  # fmt: skip


def spring_rotor(name, time, free, guess):
    """A 20 Hz rotor on a spring with a damper, driven by a torque that is recorded at 1 kHz."""

    def build(p):
        b = ce.Blueprint(name)
        c, k = (
            b.parameter("c", p["c"], unit="N m s/rad", min=0),
            b.parameter("k", p["k"], unit="N m/rad", min=0),
        )
        torque = b.input("T", unit="N m")
        a, w = b.state("a", unit="rad", scale=0.1), b.state("w", unit="rad/s")
        b.ode("a", w)
        b.ode("w", (torque - k * a - c * w) / 0.01)
        b.output("speed", w, unit="rad/s")
        return b.model()

    t = np.arange(101) * 5e-3
    return Case(
        name, build, lambda t, x, p, u: [x[1], (u["T"] - p["k"] * x[0] - p["c"] * x[1]) / 0.01],
        {"speed": lambda t, x, p, u: x[1]}, {"c": 0.1, "k": 0.01 * (40 * np.pi) ** 2}, {"a": 0.0, "w": 0.0},
        {"T": "N m", "speed": "rad/s"}, time, free, guess,
        inputs={"T": (t, 3 * np.sin(110 * t) + 2 * np.sin(150 * t))},
    )  # fmt: skip


@case
def late_by_half():
    """Outputs that lie halfway between the samples of the input."""
    return spring_rotor("late_by_half", 2.5e-3 + np.arange(99) * 5e-3, "c", 0.2)


@case
def faster_output():
    """Outputs ten times as often as the input."""
    return spring_rotor("faster_output", np.arange(1001) * 5e-4, "k", 170.0)


@case
def odd_output():
    """Outputs at jittered times that never meet those of the input."""
    return spring_rotor("odd_output", jittered(0.499, 150, seed=3), "c", 0.05)


@case
def slow_then_fast():
    """A decay that was sampled coarsely, then finely, then not at all for a minute."""

    def build(p):
        b = ce.Blueprint("slow_then_fast")
        fast, slow = b.parameter("fast", p["fast"], min=0), b.parameter("slow", p["slow"], min=0)
        x, y = b.state("x"), b.state("y")
        b.ode("x", -fast * x)
        b.ode("y", -slow * y + 0.02 * x * y)
        b.output("total", x + y)
        return b.model()

    time = np.concatenate([np.linspace(0, 3, 7), np.linspace(3.1, 4, 37), np.linspace(64, 66, 9)])
    return Case(
        "slow_then_fast", build, lambda t, x, p, u: [-p["fast"] * x[0], -p["slow"] * x[1] + 0.02 * x[0] * x[1]],
        {"total": lambda t, x, p, u: x[0] + x[1]}, {"fast": 0.8, "slow": 0.02}, {"x": 3.0, "y": 1.0}, {"total": "1"},
        time, "fast", 1.5,
    )  # fmt: skip
