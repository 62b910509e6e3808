"""Small models of pharmacology, chemistry and biology."""

from __future__ import annotations

import casadi as ca
import numpy as np
from small_case import Case, bursts, case, equal, jittered, twelve

import casadi_engine as ce


@case
def oral_dose():
    def build(p):
        b = ce.Blueprint("oral_dose")
        ka = b.parameter("ka", p["ka"], unit="1/s", min=0)
        ke = b.parameter("ke", p["ke"], unit="1/s", min=0)
        volume = b.parameter("V", p["V"], unit="m3", min=1e-6)
        gut, blood = b.state("gut", unit="kg"), b.state("blood", unit="kg")
        b.ode("gut", -ka * gut)
        b.ode("blood", ka * gut - ke * blood)
        b.output("c", blood / volume, unit="kg/m3")
        return b.model()

    return Case(
        "oral_dose", build, lambda t, x, p, u: [-p["ka"] * x[0], p["ka"] * x[0] - p["ke"] * x[1]],
        {"c": lambda t, x, p, u: x[1] / p["V"]}, {"ka": 3e-4, "ke": 5e-5, "V": 0.03}, {"gut": 3e-4, "blood": 0.0},
        {"c": "mg/L", "time": "h"}, twelve(12 * 3600), "ke", 1e-4, known_start=True,
    )  # fmt: skip


@case
def two_compartments():
    def build(p):
        b = ce.Blueprint("two_compartments")
        k10, k12, k21 = (b.parameter(name, p[name], unit="1/s", min=0) for name in ("k10", "k12", "k21"))
        blood, tissue = b.state("blood", unit="mg"), b.state("tissue", unit="mg")
        b.ode("blood", -(k10 + k12) * blood + k21 * tissue)
        b.ode("tissue", k12 * blood - k21 * tissue)
        b.output("amount", blood, unit="mg")
        return b.model()

    return Case(
        "two_compartments", build,
        lambda t, x, p, u: [-(p["k10"] + p["k12"]) * x[0] + p["k21"] * x[1], p["k12"] * x[0] - p["k21"] * x[1]],
        {"amount": lambda t, x, p, u: 1e-6 * x[0]}, {"k10": 0.5, "k12": 4.0, "k21": 1.0},
        {"blood": 100.0, "tissue": 0.0}, {"amount": "kg"}, twelve(8.0), "k12", 2.0, known_start=True,
    )  # fmt: skip


@case
def michaelis_menten():
    def build(p):
        b = ce.Blueprint("michaelis_menten")
        top, half = (
            b.parameter("vmax", p["vmax"], unit="kg/m3/s", min=0),
            b.parameter("km", p["km"], unit="kg/m3"),
        )
        c = b.state("c", unit="kg/m3")
        b.ode("c", -top * c / (half + c))
        b.output("conc", c, unit="kg/m3")
        return b.model()

    return Case(
        "michaelis_menten", build, lambda t, x, p, u: [-p["vmax"] * x[0] / (p["km"] + x[0])],
        {"conc": lambda t, x, p, u: x[0]}, {"vmax": 2e-6, "km": 4e-3}, {"c": 0.03}, {"conc": "kg/m3", "time": "min"},
        jittered(8 * 3600, 40), "km", 1e-2,
    )  # fmt: skip


@case
def infusion():
    """A pump that is switched on and off; blood is drawn in bursts."""

    def build(p):
        b = ce.Blueprint("infusion")
        ke, volume = (
            b.parameter("ke", p["ke"], unit="1/s", min=0),
            b.parameter("V", p["V"], unit="m3", min=1e-4),
        )
        pump = b.input("pump", unit="kg/s")
        blood = b.state("blood", unit="kg", scale=1e-4)
        b.ode("blood", pump - ke * blood)
        b.output("c", blood / volume, unit="kg/m3", scale=1e-2)
        return b.model()

    return Case(
        "infusion", build, lambda t, x, p, u: [u["pump"] - p["ke"] * x[0]],
        {"c": lambda t, x, p, u: x[0] / p["V"]}, {"ke": 2e-4, "V": 0.02}, {"blood": 0.0},
        {"pump": "mg/s", "c": "mg/L"}, bursts(20000.0, 8, 5), "ke", 4e-4,
        inputs={"pump": ([0.0, 3000.0, 8000.0, 10000.0, 20000.0], [0.02, 0.0, 0.05, 0.0, 0.0])}, hold="zero",
    )  # fmt: skip


@case
def reaction_chain():
    def build(p):
        b = ce.Blueprint("reaction_chain")
        k1, k2 = b.parameter("k1", p["k1"], unit="1/s", min=0), b.parameter("k2", p["k2"], unit="1/s", min=0)
        a, m, c = b.state("A"), b.state("B"), b.state("C")
        b.ode("A", -k1 * a)
        b.ode("B", k1 * a - k2 * m)
        b.ode("C", k2 * m)
        b.output("b", m)
        b.output("c", c)
        return b.model()

    return Case(
        "reaction_chain", build,
        lambda t, x, p, u: [-p["k1"] * x[0], p["k1"] * x[0] - p["k2"] * x[1], p["k2"] * x[1]],
        {"b": lambda t, x, p, u: x[1], "c": lambda t, x, p, u: x[2]}, {"k1": 0.7, "k2": 0.2},
        {"A": 1.0, "B": 0.0, "C": 0.0}, {"b": "1", "c": "1"}, jittered(20.0, 30), "k1", 0.3,
    )  # fmt: skip


@case
def reversible():
    """Second order forwards, first order backwards, with a long pause between two series of samples."""

    def build(p):
        b = ce.Blueprint("reversible")
        kf, kb = b.parameter("kf", p["kf"], min=0), b.parameter("kb", p["kb"], unit="1/s", min=0)
        a, c = b.state("a"), b.state("c")
        b.ode("a", -2 * kf * a**2 + 2 * kb * c)
        b.ode("c", kf * a**2 - kb * c)
        b.output("ca", a)
        return b.model()

    time = np.concatenate([np.linspace(0, 2, 25), np.linspace(100, 101, 15)])
    return Case(
        "reversible", build,
        lambda t, x, p, u: [-2 * (p["kf"] * x[0] ** 2 - p["kb"] * x[1]), p["kf"] * x[0] ** 2 - p["kb"] * x[1]],
        {"ca": lambda t, x, p, u: x[0]}, {"kf": 1.5, "kb": 0.4}, {"a": 1.0, "c": 0.0}, {"ca": "1"}, time, "kb", 0.8,
        known_start=True,
    )  # fmt: skip


@case
def autocatalysis():
    def build(p):
        b = ce.Blueprint("autocatalysis")
        k = b.parameter("k", p["k"], min=0)
        a, c = b.state("a"), b.state("c")
        b.ode("a", -k * a * c)
        b.ode("c", k * a * c)
        b.output("product", c)
        return b.model()

    return Case(
        "autocatalysis", build, lambda t, x, p, u: [-p["k"] * x[0] * x[1], p["k"] * x[0] * x[1]],
        {"product": lambda t, x, p, u: x[1]}, {"k": 3.0}, {"a": 1.0, "c": 1e-3}, {"product": "1"}, equal(5.0, 26), "k",
        2.5, known_start=True,
    )  # fmt: skip


@case
def brusselator():
    def build(p):
        b = ce.Blueprint("brusselator")
        feed, rate = b.parameter("A", p["A"], min=0), b.parameter("B", p["B"], min=0)
        x, y = b.state("x"), b.state("y")
        b.ode("x", feed + x**2 * y - (rate + 1) * x)
        b.ode("y", rate * x - x**2 * y)
        b.output("cx", x)
        b.output("cy", y)
        return b.model()

    def rates(t, x, p, u):
        made = x[0] ** 2 * x[1]
        return [p["A"] + made - (p["B"] + 1) * x[0], p["B"] * x[0] - made]

    return Case(
        "brusselator", build, rates, {"cx": lambda t, x, p, u: x[0], "cy": lambda t, x, p, u: x[1]},
        {"A": 1.0, "B": 3.0}, {"x": 1.5, "y": 3.0}, {"cx": "1", "cy": "1"}, equal(20.0, 81), "B", 2.8,
    )  # fmt: skip


@case
def stirred_reactor():
    """Exothermic reaction in a cooled vessel; the cooling water and the vessel are read in degrees Celsius."""

    def build(p):
        b = ce.Blueprint("stirred_reactor")
        k0, ua = b.parameter("k0", p["k0"], unit="1/s", min=0), b.parameter("UA", p["UA"], unit="1/s", min=0)
        water = b.input("water", unit="K")
        c, temp = b.state("c"), b.state("temp", unit="K", scale=300.0)
        reaction = k0 * ca.exp(-8750 * (1 / temp - 1 / 350)) * c
        b.ode("c", (1 - c) / 60 - reaction)
        b.ode("temp", (350 - temp) / 60 + 209 * reaction + ua * (water - temp))
        b.output("vessel", temp, unit="K")
        return b.model()

    def rates(t, x, p, u):
        reaction = p["k0"] * np.exp(8750 * (1 / 350 - 1 / x[1])) * x[0]
        return [
            (1 - x[0]) / 60 - reaction,
            (350 - x[1]) / 60 + 209 * reaction + p["UA"] * (u["water"] - x[1]),
        ]

    return Case(
        "stirred_reactor", build, rates, {"vessel": lambda t, x, p, u: x[1]}, {"k0": 0.0166, "UA": 0.035},
        {"c": 0.5, "temp": 350.0}, {"water": "degC", "vessel": "degC"}, jittered(400.0, 80), "UA", 0.05,
        inputs={"water": ([0.0, 100.0, 110.0, 250.0, 300.0, 400.0], [27.0, 27.0, 25.0, 25.0, 29.0, 27.0])},
    )  # fmt: skip


@case
def epidemic():
    def build(p):
        b = ce.Blueprint("epidemic")
        beta, gamma = b.parameter("beta", p["beta"], min=0), b.parameter("gamma", p["gamma"], min=0)
        s, i = b.state("S", scale=1e4), b.state("I", scale=1e3)
        b.ode("S", -beta * s * i / 1e4)
        b.ode("I", beta * s * i / 1e4 - gamma * i)
        b.output("ill", i)
        return b.model()

    return Case(
        "epidemic", build,
        lambda t, x, p, u: [-p["beta"] * x[0] * x[1] / 1e4, p["beta"] * x[0] * x[1] / 1e4 - p["gamma"] * x[1]],
        {"ill": lambda t, x, p, u: x[1]}, {"beta": 0.5, "gamma": 0.2}, {"S": 9990.0, "I": 10.0}, {"ill": "1"},
        equal(60.0, 61), "beta", 0.45, known_start=True,
    )  # fmt: skip


@case
def predator_prey():
    """Yearly counts of both."""

    def build(p):
        b = ce.Blueprint("predator_prey")
        a, c = b.parameter("a", p["a"], min=0), b.parameter("c", p["c"], min=0)
        hare, lynx = b.state("hare"), b.state("lynx")
        b.ode("hare", a * hare - 0.4 * hare * lynx)
        b.ode("lynx", 0.1 * hare * lynx - c * lynx)
        b.output("hares", hare)
        b.output("lynxes", lynx)
        return b.model()

    return Case(
        "predator_prey", build,
        lambda t, x, p, u: [x[0] * (p["a"] - 0.4 * x[1]), x[1] * (0.1 * x[0] - p["c"])],
        {"hares": lambda t, x, p, u: x[0], "lynxes": lambda t, x, p, u: x[1]}, {"a": 1.1, "c": 0.4},
        {"hare": 10.0, "lynx": 5.0}, {"hares": "1", "lynxes": "1"}, equal(30.0, 31), "c", 0.42,
    )  # fmt: skip


@case
def logistic():
    """Yeast that is counted at 12 unequal times."""

    def build(p):
        b = ce.Blueprint("logistic")
        r, most = b.parameter("r", p["r"], unit="1/s", min=0), b.parameter("K", p["K"], min=1)
        n = b.state("n")
        b.ode("n", r * n * (1 - n / most))
        b.output("count", n)
        return b.model()

    return Case(
        "logistic", build, lambda t, x, p, u: [p["r"] * x[0] * (1 - x[0] / p["K"])],
        {"count": lambda t, x, p, u: x[0]}, {"r": 1.0, "K": 600.0}, {"n": 10.0}, {"count": "1"}, twelve(18.0), "K",
        400.0, known_start=True,
    )  # fmt: skip


@case
def nerve():
    """FitzHugh and Nagumo's oscillator with a pulse of current."""

    def build(p):
        b = ce.Blueprint("nerve")
        eps, shift = b.parameter("eps", p["eps"], unit="1/s", min=0), b.parameter("shift", p["shift"])
        current = b.input("I")
        v, w = b.state("v"), b.state("w")
        b.ode("v", v - v**3 / 3 - w + current)
        b.ode("w", eps * (v + shift - 0.8 * w))
        b.output("voltage", v)
        return b.model()

    return Case(
        "nerve", build,
        lambda t, x, p, u: [x[0] - x[0] ** 3 / 3 - x[1] + u["I"], p["eps"] * (x[0] + p["shift"] - 0.8 * x[1])],
        {"voltage": lambda t, x, p, u: x[0]}, {"eps": 0.08, "shift": 0.7}, {"v": -1.2, "w": -0.62},
        {"I": "1", "voltage": "1"}, jittered(80.0, 120), "eps", 0.07,
        inputs={"I": (np.linspace(0, 80, 9), [0.0, 0.5, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5])}, hold="zero",
    )  # fmt: skip


@case
def lorenz():
    def build(p):
        b = ce.Blueprint("lorenz")
        rho = b.parameter("rho", p["rho"], min=0)
        x, y, z = b.state("x"), b.state("y"), b.state("z")
        b.ode("x", 10 * (y - x))
        b.ode("y", x * (rho - z) - y)
        b.ode("z", x * y - 8 / 3 * z)
        b.output("sx", x)
        b.output("sz", z)
        return b.model()

    return Case(
        "lorenz", build,
        lambda t, x, p, u: [10 * (x[1] - x[0]), x[0] * (p["rho"] - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]],
        {"sx": lambda t, x, p, u: x[0], "sz": lambda t, x, p, u: x[2]}, {"rho": 28.0}, {"x": 1.0, "y": 1.0, "z": 20.0},
        {"sx": "1", "sz": "1"}, equal(3.0, 61), "rho", 27.0, known_start=True,
    )  # fmt: skip
