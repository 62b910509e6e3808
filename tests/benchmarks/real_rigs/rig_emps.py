"""Servo drive EMPS: a carriage on a ball screw. The viscous model lacks dry friction, and a little that its direction
changes it (Janot, Gautier and Brunot 2019; ../shared/data/emps).

Speed in blocks of 10 ms, force joined between their middles; the pulses are fresh. Published: M = 95.11 kg,
Fv = 203.5 N s/m, Fc = 20.39 N, offset −3.16 N.
"""

import numpy as np
from rigs_common import page, shared
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "mass, viscous friction and offset in SI",
    "everything per mass: gain, decay rate and drift, the port takes an acceleration",
    "time constant and gain, mm/s and kN",
)
truth = (
    {"carriage.coulomb_friction"},
    {"carriage.asymmetric_friction"},
    {"carriage.coulomb_friction", "carriage.asymmetric_friction"},
)
same = "dry friction"
MASS, VISCOUS, OFFSET = 90.0, 250.0, 0.0  # start values
EVERY = 10  # samples of 1 ms in a block


def build(writing=0):
    b = ce.Blueprint("emps", description="a carriage on a ball screw, driven by a force")
    (_per_force, _per_mass, _time_constant)[writing](b)
    m = b.model()
    return m, m.parameters()


def _per_force(b):
    mass = b.parameter("M", MASS, unit="kg", min=1, max=1000)
    viscous = b.parameter("Fv", VISCOUS, unit="N s/m", min=0, max=5000)
    offset = b.parameter("offset", OFFSET, unit="N", min=-100, max=100)
    speed = b.state("speed", unit="m/s", scale=0.1)
    force = b.input("F", unit="N", scale=100)
    carriage = b.port("carriage", "inertia", {"speed": speed})
    b.ode("speed", (force - viscous * speed - offset + carriage) / mass)
    b.output("v", speed, unit="m/s", scale=0.1)


def _per_mass(b):
    gain = b.parameter("gain", 1 / MASS, unit="1/kg", min=1e-3, max=1)
    decay = b.parameter("decay", VISCOUS / MASS, unit="1/s", min=0, max=50)
    drift = b.parameter("drift", OFFSET / MASS, unit="m/s2", min=-1, max=1)
    speed = b.state("speed", unit="m/s", scale=0.1)
    force = b.input("F", unit="N", scale=100)
    carriage = b.port("carriage", "inertia", {"speed": speed}, unit="m/s2")
    b.ode("speed", gain * force - decay * speed - drift + carriage)
    b.output("v", speed, unit="m/s", scale=0.1)


def _time_constant(b):
    lag = b.parameter("lag", MASS / VISCOUS, unit="s", min=0.01, max=100)
    gain = b.parameter("gain", 1e6 / VISCOUS, unit="mm/s/kN", min=200, max=1e6)
    offset = b.parameter("offset", OFFSET / 1e3, unit="kN", min=-0.1, max=0.1)
    speed = b.state("speed", unit="mm/s", scale=100)
    force = b.input("F", unit="kN", scale=0.1)
    carriage = b.port("carriage", "inertia", {"speed": speed}, unit="kN")
    b.ode("speed", (gain * (force - offset + carriage) - speed) / lag)
    b.output("v", speed, unit="mm/s", scale=100)


def initial(writing=0):
    return {"speed": 10.0 if writing == 2 else 0.01}


def records():
    emps = page("emps")
    before, emps.EVERY = emps.EVERY, EVERY
    try:
        names = "DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"
        return tuple([emps.read(shared("emps", name))] for name in names)
    finally:
        emps.EVERY = before


def by_hand():
    estimation, fresh = ([_plain(one) for one in part] for part in records())
    return {name: fit(one, estimation, fresh) for name, one in _structures().items()}


def _plain(exp):
    return Record(exp["v"].time, exp["F"].values[:, None], exp["v"].values)


def _structures():
    def made(friction, **starts):
        def rhs(x, u, p):
            return (u - p["Fv"] * x - p["offset"] + friction(x, p)) / p["M"]

        whole = {"M": [95.0], "Fv": [200.0], "offset": [-3.0], **starts}
        return Structure(
            rhs, lambda x, u, p: x[0], whole, lambda one: one.output[:1], steps=4, state_scale=0.01
        )

    def dry(x, p):
        return -p["Fc"] * np.tanh(x / 1e-3)

    def directed(x, p):
        return dry(x, p) - p["Fv_difference"] * np.abs(x)

    def fading(x, p):
        return dry(x, p) - p["Fs"] * np.tanh(x / 1e-3) * np.exp(-((x / p["vs"]) ** 2))

    return {
        "nothing added": made(lambda x, p: 0.0),
        "dry friction": made(dry, Fc=[20.0]),
        # never at rest: a dry friction that differs by direction is the offset
        "dry friction, viscous by direction": made(directed, Fc=[20.0], Fv_difference=[0.0]),
        "dry and fading friction": made(fading, Fc=[20.0], Fs=[1.0], vs=[0.05]),
    }
