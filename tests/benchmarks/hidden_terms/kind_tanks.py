"""Two tanks, the upper one emptying into the lower one, filled by a pump; outflow by the root of the level."""

from __future__ import annotations

import casadi as ca
import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import simulate

AREA, GRAVITY, HEIGHT = 0.01, 9.81, 0.30
# Outflow is linear below a level of about a millimetre: an empty tank is no place for a root.
SHALLOW = 1e-3


class Overflow(ce.Effect):
    """What stands above the edge of a tank is lost."""

    name, attaches = "overflow", ("inertia",)
    sentence = "{port} overflows above a level"
    amplitude = ce.effects.Amplitude("rate", unit="m2/s", min=0)
    nuisance = {"edge": ce.effects.Grid(0.1, 0.5, steps=9, unit="m")}  # noqa: RUF012 (read only)

    def law(self, port, p, math):
        return -p.rate * math.positive(port.level - p.edge, width=1e-3)


class Leak(ce.Effect):
    """A hole in the bottom that leads outside."""

    name, attaches = "leak", ("inertia",)
    sentence = "a hole in {port}"
    amplitude = ce.effects.Amplitude("area", unit="m2", min=0)

    def law(self, port, p, math):
        return -p.area * falls(port.level, math.sqrt)


def falls(level, root):
    """sqrt(2 g h), odd in h and smooth at 0."""
    return (2 * GRAVITY) ** 0.5 * level / root(root(level**2 + SHALLOW**2))


def model(outputs):
    b = ce.Blueprint("tanks")
    gain = b.parameter("k", 8e-6, unit="m3/s/V", min=1e-7, max=1e-3)
    first = b.parameter("a1", 2e-5, unit="m2", min=1e-6, max=1e-3)
    second = b.parameter("a2", 2.2e-5, unit="m2", min=1e-6, max=1e-3)
    area = b.parameter("A", AREA, unit="m2", vary=False)
    h1, h2 = (b.state(name, unit="m", scale=0.2) for name in ("h1", "h2"))
    pump = b.input("u", unit="V", scale=5)
    upper, lower = (
        b.port(name, "inertia", {"level": h}, unit="m3/s") for name, h in (("upper", h1), ("lower", h2))
    )
    b.ode("h1", (gain * pump - first * falls(h1, ca.sqrt) + upper) / area)
    b.ode("h2", (first * falls(h1, ca.sqrt) - second * falls(h2, ca.sqrt) + lower) / area)
    for name, h in (("y1", h1), ("y2", h2)):
        if name in outputs:
            b.output(name, h, unit="m", scale=0.2)
    return b.model()


def course(v, run):
    over, leak = v.get("upper.overflow", 0.0), v.get("upper.leak", 0.0)
    inflow, clog = v.get("lower.constant_torque", 0.0), v.get("upper.clogging", 0.0)
    valve, opened = v.get("upper.load_step", 0.0), run.event

    def rate(t, x, u):
        h1, h2 = x
        between = v["a1"] * (1 - clog * t / 2000.0) * falls(h1, np.sqrt)
        lost = over * max(h1 - HEIGHT, 0.0) + leak * falls(h1, np.sqrt) + valve * (t > opened)
        return (v["k"] * u["u"] - between - lost) / v["A"], (
            between - v["a2"] * falls(h2, np.sqrt) + inflow
        ) / v["A"]

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[opened] if valve else ())
    return {"y1": x[:, 0], "y2": x[:, 1] + v.get("sensor_y2.sensor_offset", 0.0), "states": x}


def steps(rng):
    time = 4.0 * np.arange(500)
    return Manoeuvre.of(rng, time, {"u": levels(rng, 500, 50, 2.5, 8.5)}, (0.05, 0.04))


def waves(rng):
    time = 4.0 * np.arange(500)
    u = 5.3 + sines(rng, time, 3.0, (1 / 1100, 1 / 430, 1 / 190))
    return Manoeuvre.of(rng, time, {"u": u}, (0.18, 0.15))


KIND = Kind(
    name="tanks",
    sentence="two tanks in a row",
    truth={"k": 8e-6, "a1": 2e-5, "a2": 2.2e-5, "A": AREA},
    terms={
        "upper.overflow": Hidden(8e-4, Overflow(), "upper", {"edge": HEIGHT}),
        "upper.leak": Hidden(5e-6, Leak(), "upper"),
        "lower.constant_torque": Hidden(8e-6, ce.effects.ConstantTorque(), "lower"),
        "sensor_y2.sensor_offset": Hidden(0.03, ce.effects.SensorOffset(), "sensor_y2"),
        "upper.load_step": Hidden(1.2e-5, ce.effects.LoadStep(), "upper", {"time": "event"}),
        "upper.clogging": Hidden(0.4),
    },
    choices=(
        "upper.overflow",
        "upper.leak",
        "lower.constant_torque",
        "sensor_y2.sensor_offset",
        "upper.overflow+lower.constant_torque",
        "upper.clogging",
        "upper.overflow|upper.leak",
        "upper.load_step",
    ),
    model=model,
    outputs=(("y1", "y2"),),
    course=course,
    manoeuvres={"steps": steps, "waves": waves},
    pairs=(("steps", "waves"), ("waves", "steps")),
    units={"u": "V", "y1": "m", "y2": "m"},
    effects=lambda: with_own(Overflow(), Leak()),
)
