"""Coupled electric drives, by SciPy after Wigren and Schoukens 2017: a motor drives a pulley through an elastic belt,
and a pulse counter tells the pulley's speed without its sign. Made, so the truth is known: dry friction at the pulley.

500 samples at 50 Hz, steps of random size both ways, so that the output is folded at zero; pulses of 0.2 rad/s.
"""

import math

import casadi as ca
import numpy as np
from made_with_scipy import motion
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "inertias, belt stiffness and dampers in SI",
    "natural frequency, damping ratio and gain, the port takes an angular acceleration",
    "rpm and milliseconds",
)
truth = ({"pulley.coulomb_friction"},)
same = "dry friction"
# the truth: lag and gain of the motor, belt, pulley
LAG, GAIN, STIFFNESS, DAMPING, INERTIA, DRY = 0.15, 12.0, 4.0, 0.05, 0.03, 0.15
PULSE = 0.2
START = {"lag": 0.2, "gain": 10.0, "omega": 10.0, "zeta": 0.1}
RPM = math.pi / 30


def build(writing=0):
    b = ce.Blueprint("made_drives", time_unit="ms" if writing == 2 else None)
    (_si, _frequency, _rpm)[writing](b)
    m = b.model()
    return m, m.parameters()


def _si(b):
    lag = b.parameter("lag", START["lag"], unit="s", min=0.01, max=5)
    gain = b.parameter("gain", START["gain"], unit="rad/s/V", min=0.5, max=200)
    stiffness = b.parameter("k", START["omega"] ** 2 * INERTIA, unit="N m/rad", min=0.1, max=100)
    damping = b.parameter("c", 2 * START["zeta"] * START["omega"] * INERTIA, unit="N m s/rad", min=0, max=5)
    inertia = b.parameter("J", INERTIA, unit="kg m2", vary=False)
    motor, twist = b.state("motor", unit="rad/s", scale=10), b.state("twist", unit="rad")
    speed = b.state("speed", unit="rad/s", scale=10)
    volts = b.input("u", unit="V")
    pulley = b.port("pulley", "inertia", {"speed": speed})
    belt = b.port("belt", "coupling", {"twist": twist, "twist_rate": motor - speed, "stiffness": stiffness})
    b.ode("motor", (gain * volts - motor) / lag)
    b.ode("twist", motor - speed)
    b.ode("speed", (stiffness * twist + damping * (motor - speed) + pulley + belt) / inertia)
    b.output("y", ca.fabs(speed), unit="rad/s", scale=10)


def _frequency(b):
    lag = b.parameter("lag", START["lag"], unit="s", min=0.01, max=5)
    gain = b.parameter("gain", START["gain"], unit="rad/s/V", min=0.5, max=200)
    omega = b.parameter("w0", START["omega"], unit="rad/s", min=1, max=100)
    zeta = b.parameter("zeta", START["zeta"], unit="1", min=0, max=3)
    motor, twist = b.state("motor", unit="rad/s", scale=10), b.state("twist", unit="rad")
    speed = b.state("speed", unit="rad/s", scale=10)
    volts = b.input("u", unit="V")
    pulley = b.port("pulley", "inertia", {"speed": speed}, unit="rad/s2")
    signals = {"twist": twist, "twist_rate": motor - speed, "stiffness": omega**2}
    belt = b.port("belt", "coupling", signals, unit="rad/s2")
    b.ode("motor", (gain * volts - motor) / lag)
    b.ode("twist", motor - speed)
    b.ode("speed", omega**2 * twist + 2 * zeta * omega * (motor - speed) + pulley + belt)
    b.output("y", ca.fabs(speed), unit="rad/s", scale=10)


def _rpm(b):
    lag = b.parameter("lag", 1e3 * START["lag"], unit="ms", min=10, max=5e3)
    gain = b.parameter("gain", START["gain"] / RPM, unit="rpm/V", min=5, max=2e3)
    belt_lag = b.parameter("belt_time", 1e3 / START["omega"], unit="ms", min=10, max=1e3)
    zeta = b.parameter("zeta", START["zeta"], unit="1", min=0, max=3)
    inertia = b.parameter("J", INERTIA, unit="kg m2", vary=False)
    motor, twist = b.state("motor", unit="rpm", scale=100), b.state("twist", unit="rad")
    speed = b.state("speed", unit="rpm", scale=100)
    volts = b.input("u", unit="V")
    omega = 1 / belt_lag
    rate = motor - speed
    pulley = b.port("pulley", "inertia", {"speed": RPM * speed}, unit="N m")
    signals = {"twist": twist, "twist_rate": RPM * rate, "stiffness": inertia * (1e3 * omega) ** 2}
    belt = b.port("belt", "coupling", signals, unit="N m")
    b.ode("motor", (gain * volts - motor) / lag)
    b.ode("twist", RPM * rate / 1e3)
    acting = 1e3 * omega**2 * twist / RPM + 2 * zeta * omega * rate
    b.ode("speed", acting + (pulley + belt) / inertia / RPM / 1e3)
    b.output("y", ca.fabs(speed), unit="rpm", scale=100)


def initial(writing=0):
    return {"motor": 0.0, "twist": 0.0, "speed": 10.0 if writing == 2 else 10.0 * RPM}


def records():
    return [_record("estimation", 1)], [_record("fresh", 2)]


def _record(name, seed):
    random = np.random.default_rng(seed)
    time = np.arange(500) / 50
    levels = np.repeat(random.uniform(-1.5, 1.5, 20), 25)
    volts = np.convolve(levels, np.full(5, 0.2), mode="same")

    def free(t, x, friction):
        motor, twist, speed = x
        belt = STIFFNESS * twist + DAMPING * (motor - speed)
        return np.array(
            [(GAIN * np.interp(t, time, volts) - motor) / LAG, motor - speed, (belt + friction) / INERTIA]
        )

    speed = motion(free, 2, (DRY, DRY), time, [0.0, 0.0, 0.0])[2]
    noisy = np.abs(speed) + 0.05 * random.standard_normal(len(time))
    y = PULSE * np.round(np.abs(noisy) / PULSE)
    return ce.Experiment.from_arrays(name, time=time, units={"u": "V", "y": "rad/s"}, u=volts, y=y)


def by_hand():
    estimation, fresh = (
        [Record(one["y"].time, one["u"].values[:, None], one["y"].values) for one in part]
        for part in records()
    )

    def made(friction, **starts):
        def rhs(x, u, p):
            rate = x[0] - x[2]
            belt = p["w0"] ** 2 * x[1] + 2 * p["zeta"] * p["w0"] * rate
            return np.array([(p["gain"] * u[0] - x[0]) / p["lag"], rate, belt - friction(x[2], p)])

        whole = {"lag": [0.2, 0.1], "gain": [10.0, 14.0], "w0": [10.0, 13.0], "zeta": [0.1, 0.05], **starts}
        return Structure(
            rhs, lambda x, u, p: np.abs(x[2]), whole, lambda one: np.array([0.1, 0.0, 0.1]), steps=6
        )

    structures = {
        "nothing added": made(lambda v, p: 0.0),
        "dry friction": made(lambda v, p: p["dry"] * np.tanh(v / 0.05), dry=[2.0, 6.0]),
        "viscous friction": made(lambda v, p: p["viscous"] * v, viscous=[0.1, 0.5]),
    }
    return {name: fit(one, estimation, fresh) for name, one in structures.items()}
