"""A pendulum that swings out, its cart held; the viscous model lacks dry friction at the pivot (../shared/data/
pendulum_cart, from a master's thesis of Aalborg). The angle counts from upright and comes in steps of 0.0031 rad.

Found on 8 to 30 s, fresh 30 to 60 s, every second sample (75 Hz). By the thesis: 0.0040 N m
dry, 0.00046 N m s viscous.
"""

import math

import casadi as ca
import numpy as np
from rigs_common import shared
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "squared frequency and decay rate, the port takes an angular acceleration",
    "length, and a damping in N m s/rad beside a known mass",
    "degrees from hanging, period and damping ratio, a known inertia",
)
truth = ({"pivot.coulomb_friction"},)
same = "dry friction"
MASS, LENGTH, GRAVITY = 0.2186, 0.318, 9.81  # of the thesis: kg, m, m/s2
INERTIA = MASS * LENGTH**2
DECAY = 0.05  # start value, 1/s
EVERY = 2
SPANS = (8.0, 30.0), (30.0, 60.0)


def build(writing=0):
    b = ce.Blueprint("pendulum", description="a pendulum whose cart is held")
    (_per_inertia, _length, _degrees)[writing](b)
    m = b.model()
    return m, m.parameters()


def _per_inertia(b):
    w2 = b.parameter("w2", GRAVITY / LENGTH, unit="rad/s2", min=5, max=200)
    decay = b.parameter("decay", DECAY, unit="1/s", min=0, max=5)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    pivot = b.port("pivot", "inertia", {"speed": speed}, unit="rad/s2")
    b.ode("angle", speed)
    b.ode("speed", w2 * ca.sin(angle) - decay * speed + pivot)
    b.output("angle", angle, unit="rad")


def _length(b):
    mass = b.parameter("m", MASS, unit="kg", vary=False)
    length = b.parameter("L", LENGTH, unit="m", min=0.05, max=2)
    damping = b.parameter("c", DECAY * INERTIA, unit="N m s/rad", min=0, max=0.1)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    pivot = b.port("pivot", "inertia", {"speed": speed})
    b.ode("angle", speed)
    b.ode("speed", (mass * GRAVITY * length * ca.sin(angle) - damping * speed + pivot) / (mass * length**2))
    b.output("angle", angle, unit="rad")


def _degrees(b):
    frequency = math.sqrt(GRAVITY / LENGTH)
    period = b.parameter("period", 2 * math.pi / frequency, unit="s", min=0.4, max=3)
    ratio = b.parameter("damping_ratio", DECAY / 2 / frequency, unit="1", min=0, max=0.5)
    inertia = b.parameter("J", INERTIA, unit="kg m2", vary=False)
    angle, speed = b.state("angle", unit="deg", scale=60), b.state("speed", unit="deg/s", scale=300)
    pivot = b.port("pivot", "inertia", {"speed": speed}, unit="N m")
    natural = 2 * math.pi / period
    degree = math.pi / 180
    b.ode("angle", speed)
    gravity = -(natural**2) * ca.sin(degree * angle) / degree
    b.ode("speed", gravity - 2 * ratio * natural * speed + pivot / inertia / degree)
    b.output("angle", angle + 180, unit="deg")


def initial(writing=0):
    if writing == 2:
        return {"angle": -90.0, "speed": 0.0}
    return {"angle": math.pi / 2, "speed": 0.0}


def records(spans=SPANS, every=EVERY):
    return tuple([_record(f"from_{span[0]:.0f}s", span, every)] for span in spans)


def _record(name, span, every):
    time, angle, _ = np.loadtxt(shared("pendulum_cart", "test1pend1.csv"), delimiter=",").T
    inside = (time >= span[0]) & (time < span[1])
    time, angle = time[inside][::every], angle[inside][::every]
    # the rig's clock is even; its times are rounded to 10 µs
    even = np.linspace(time[0], time[-1], len(time))
    return ce.Experiment.from_arrays(name, time=even, units={"angle": "rad"}, angle=angle)


def by_hand(spans=SPANS, every=EVERY):
    estimation, fresh = (
        [Record(one["angle"].time, None, one["angle"].values) for one in part]
        for part in records(spans, every)
    )
    return {name: fit(one, estimation, fresh) for name, one in structures().items()}


def structures():
    """For all rigs of this pendulum."""

    def made(friction, **starts):
        def rhs(x, u, p):
            return np.array([x[1], p["w2"] * np.sin(x[0]) - p["decay"] * x[1] + friction(x[1], p)])

        def guess(record):
            slope = np.polyfit(record.time[:7] - record.time[0], record.output[:7], 2)
            return np.array([slope[2], slope[1]])

        whole = {"w2": [30.85, 31.5, 30.2], "decay": [0.05, 0.03, 0.1], **starts}
        return Structure(rhs, lambda x, u, p: x[0], whole, guess, steps=2)

    def dry(v, p):
        return -p["dry"] * np.tanh(v / 0.02)

    def drag(v, p):
        return dry(v, p) - p["drag"] * v * np.abs(v)

    def fading(v, p):
        return dry(v, p) - p["fading"] * np.tanh(v / 0.02) * np.exp(-((v / p["at"]) ** 2))

    some = [0.1, 0.2, 0.05]
    return {
        "nothing added": made(lambda v, p: 0.0),
        "dry friction": made(dry, dry=some),
        "dry friction and drag": made(drag, dry=some, drag=[0.001] * 3),
        "dry and fading friction": made(fading, dry=some, fading=[0.01] * 3, at=[1.0] * 3),
    }
