"""A servo drive whose dry friction differs by direction, by SciPy; made, so the truth is known. Its model has inertia
and viscous friction. Started at rest and driven both ways; speed with noise of 0.05 rad/s at 100 Hz, 12 s.
"""

import math

import numpy as np
from made_with_scipy import motion
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "inertia and viscous friction in SI",
    "gain and decay rate, the port takes an angular acceleration",
    "rpm, mN m, time constant and gain",
)
truth = (
    {"shaft.asymmetric_friction"},
    {"shaft.coulomb_friction", "shaft.asymmetric_friction"},
    # the mean of both directions, and half of their difference
    {"shaft.coulomb_friction", "shaft.constant_torque"},
)
same = "dry friction by direction"
INERTIA, VISCOUS, FORWARD, BACKWARD = 0.012, 0.02, 0.45, 0.25  # the truth
START_J, START_C = 0.02, 0.05
NOISE = 0.05
RPM = math.pi / 30


def build(writing=0):
    b = ce.Blueprint("made_servo")
    (_si, _per_inertia, _rpm)[writing](b)
    m = b.model()
    return m, m.parameters()


def _si(b):
    inertia = b.parameter("J", START_J, unit="kg m2", min=1e-3, max=1)
    viscous = b.parameter("c", START_C, unit="N m s/rad", min=0, max=2)
    speed = b.state("speed", unit="rad/s", scale=10)
    torque = b.input("T", unit="N m")
    shaft = b.port("shaft", "inertia", {"speed": speed})
    b.ode("speed", (torque - viscous * speed + shaft) / inertia)
    b.output("omega", speed, unit="rad/s", scale=10)


def _per_inertia(b):
    gain = b.parameter("gain", 1 / START_J, unit="1/kg/m2", min=1, max=1000)
    decay = b.parameter("decay", START_C / START_J, unit="1/s", min=0, max=100)
    speed = b.state("speed", unit="rad/s", scale=10)
    torque = b.input("T", unit="N m")
    shaft = b.port("shaft", "inertia", {"speed": speed}, unit="rad/s2")
    b.ode("speed", gain * torque - decay * speed + shaft)
    b.output("omega", speed, unit="rad/s", scale=10)


def _rpm(b):
    lag = b.parameter("lag", START_J / START_C, unit="s", min=1e-2, max=10)
    gain = b.parameter("gain", 1e-3 / START_C / RPM, unit="rpm/mN/m", min=1e-3, max=100)
    speed = b.state("speed", unit="rpm", scale=100)
    torque = b.input("T", unit="mN m", scale=1000)
    shaft = b.port("shaft", "inertia", {"speed": RPM * speed}, unit="mN m")
    b.ode("speed", (gain * (torque + shaft) - speed) / lag)
    b.output("omega", speed, unit="rpm", scale=100)


def initial(writing=0):
    return {"speed": 0.0}


def records():
    return [_record("two_tones", (0.9, 0.5), (0.4, 1.1), 1)], [
        _record("other_tones", (0.7, 0.8), (0.55, 0.9), 2)
    ]


def _record(name, sizes, frequencies, seed):
    time = np.arange(1200) / 100
    ramp = np.clip(time / 0.5 - 1, 0, 1)  # nothing for half a second: it starts at rest
    torque = ramp * sum(a * np.sin(2 * np.pi * f * time) for a, f in zip(sizes, frequencies, strict=True))

    def free(t, x, friction):
        return np.array([(np.interp(t, time, torque) - VISCOUS * x[0] + friction) / INERTIA])

    speed = motion(free, 0, (FORWARD, BACKWARD), time, [0.0])[0]
    noisy = speed + NOISE * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        name, time=time, units={"T": "N m", "omega": "rad/s"}, T=torque, omega=noisy
    )


def by_hand():
    estimation, fresh = (
        [Record(one["omega"].time, one["T"].values[:, None], one["omega"].values) for one in part]
        for part in records()
    )

    def made(friction, **starts):
        def rhs(x, u, p):
            # as stiff as the steps allow, so that it nearly sticks
            return (u - p["c"] * x + friction(np.tanh(x / 0.02), p)) / p["J"]

        return Structure(
            rhs,
            lambda x, u, p: x[0],
            {"J": [0.02], "c": [0.03], **starts},
            lambda one: one.output[:1],
            steps=8,
        )

    structures = {
        "nothing added": made(lambda s, p: 0.0),
        "dry friction": made(lambda s, p: -p["dry"] * s, dry=[0.3]),
        "dry friction by direction": made(
            lambda s, p: -p["forward"] * np.maximum(s, 0) - p["backward"] * np.minimum(s, 0),
            forward=[0.3], backward=[0.3],
        ),
        "dry friction and a constant torque": made(lambda s, p: -p["dry"] * s + p["torque"], dry=[0.3], torque=[0.0]),
    }  # fmt: skip
    return {name: fit(one, estimation, fresh) for name, one in structures.items()}
