"""A pendulum with dry friction at its pivot that swings out and stays where it stops, by SciPy; made, so the truth is
known. A free decay from 2.4 rad of 16 s, fresh from 1.3 rad; an encoder of 1000 steps a turn at 60 Hz.
"""

import math

import casadi as ca
import numpy as np
from made_with_scipy import motion
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "squared frequency and decay rate, the port takes an angular acceleration",
    "length and a damping in N m s/rad beside a known mass",
    "degrees, period and damping ratio, a known inertia",
)
truth = ({"pivot.coulomb_friction"},)
same = "dry friction"
MASS, LENGTH, GRAVITY = 0.5, 0.4, 9.81
INERTIA = MASS * LENGTH**2
DRY, VISCOUS = 0.02, 0.004  # the truth: N m, N m s/rad
W2, DECAY = 26.0, 0.1  # start values: rad/s2, 1/s
STEP = 2 * math.pi / 1000


def build(writing=0):
    b = ce.Blueprint("made_pendulum")
    (_per_inertia, _length, _degrees)[writing](b)
    m = b.model()
    return m, m.parameters()


def _per_inertia(b):
    w2 = b.parameter("w2", W2, unit="rad/s2", min=1, max=200)
    decay = b.parameter("decay", DECAY, unit="1/s", min=0, max=5)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    pivot = b.port("pivot", "inertia", {"speed": speed}, unit="rad/s2")
    b.ode("angle", speed)
    b.ode("speed", -w2 * ca.sin(angle) - decay * speed + pivot)
    b.output("angle", angle, unit="rad")


def _length(b):
    mass = b.parameter("m", MASS, unit="kg", vary=False)
    length = b.parameter("L", GRAVITY / W2, unit="m", min=0.05, max=5)
    damping = b.parameter("c", DECAY * MASS * (GRAVITY / W2) ** 2, unit="N m s/rad", min=0, max=1)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    pivot = b.port("pivot", "inertia", {"speed": speed})
    b.ode("angle", speed)
    b.ode("speed", (-mass * GRAVITY * length * ca.sin(angle) - damping * speed + pivot) / (mass * length**2))
    b.output("angle", angle, unit="rad")


def _degrees(b):
    frequency, degree = math.sqrt(W2), math.pi / 180
    period = b.parameter("period", 2 * math.pi / frequency, unit="s", min=0.4, max=6)
    ratio = b.parameter("damping_ratio", DECAY / 2 / frequency, unit="1", min=0, max=0.5)
    inertia = b.parameter("J", INERTIA, unit="kg m2", vary=False)
    angle, speed = b.state("angle", unit="deg", scale=60), b.state("speed", unit="deg/s", scale=300)
    pivot = b.port("pivot", "inertia", {"speed": speed}, unit="N m")
    natural = 2 * math.pi / period
    b.ode("angle", speed)
    gravity = -(natural**2) * ca.sin(degree * angle) / degree
    b.ode("speed", gravity - 2 * ratio * natural * speed + pivot / inertia / degree)
    b.output("angle", angle, unit="deg")


def initial(writing=0):
    return {"angle": 90.0 if writing == 2 else math.pi / 2, "speed": 0.0}


def records():
    return [_record("from_2_4_rad", 2.4)], [_record("from_1_3_rad", 1.3)]


def _record(name, start):
    time = np.arange(960) / 60

    def free(t, x, friction):
        return np.array([x[1], (friction - VISCOUS * x[1]) / INERTIA - GRAVITY / LENGTH * np.sin(x[0])])

    angle = motion(free, 1, (DRY, DRY), time, [start, 0.0])[0]
    return ce.Experiment.from_arrays(
        name, time=time, units={"angle": "rad"}, angle=STEP * np.round(angle / STEP)
    )


def by_hand():
    estimation, fresh = (
        [Record(one["angle"].time, None, one["angle"].values) for one in part] for part in records()
    )

    def made(friction, **starts):
        def rhs(x, u, p):
            return np.array([x[1], -p["w2"] * np.sin(x[0]) - p["decay"] * x[1] - friction(x[1], p)])

        whole = {"w2": [24.5, 25.0, 24.0], "decay": [0.1, 0.05, 0.2], **starts}
        return Structure(
            rhs, lambda x, u, p: x[0], whole, lambda one: np.array([one.output[0], 0.0]), steps=4
        )

    structures = {
        "nothing added": made(lambda v, p: 0.0),
        "dry friction": made(lambda v, p: p["dry"] * np.tanh(v / 0.01), dry=[0.1, 0.3, 0.2]),
    }
    return {name: fit(one, estimation, fresh) for name, one in structures.items()}
