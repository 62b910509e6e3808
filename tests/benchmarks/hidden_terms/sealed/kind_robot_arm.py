"""An arm of two links that hangs and swings in a vertical plane, driven by currents; angles in degrees."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

import casadi_engine as ce

GRAVITY, DEGREE = 9.81, np.pi / 180


def inertia(v, q2, math):
    """The three entries of the symmetric inertia matrix [kg m2]."""
    turned = v["p3"] * math.cos(q2)
    return v["p1"] + v["p2"] + 2 * turned, v["p2"] + turned, v["p2"]


def torques(v, angles, speeds, math):
    """Torques on the two joints by motion and weight [N m]; angles [rad], speeds [rad/s]."""
    q1, q2 = angles
    w1, w2 = speeds
    swing, outer = v["p3"] * math.sin(q2), v["p3"] * GRAVITY / v["l1"] * math.sin(q1 + q2)
    first = swing * (2 * w1 * w2 + w2**2) - v["g1"] * math.sin(q1) - outer - v["c1"] * w1
    return first, -swing * w1**2 - outer - v["c2"] * w2


def solved(m11, m12, m22, first, second):
    """Accelerations of both joints."""
    det = m11 * m22 - m12**2
    return (m22 * first - m12 * second) / det, (m11 * second - m12 * first) / det


def model(outputs):
    b = ce.Blueprint("robot_arm")
    p = {
        "p1": b.parameter("p1", 0.48, unit="kg m2", min=0.02, max=10),
        "p2": b.parameter("p2", 0.06, unit="kg m2", min=3e-3, max=2),
        "p3": b.parameter("p3", 0.12, unit="kg m2", min=0, max=3),
        "g1": b.parameter("g1", 13.7, unit="N m", min=0, max=200),
        "c1": b.parameter("c1", 1.2, unit="N m s/rad", min=0, max=30),
        "c2": b.parameter("c2", 0.25, unit="N m s/rad", min=0, max=10),
        "l1": b.parameter("l1", 0.4, unit="m", vary=False),
    }
    k1, k2 = (
        b.parameter(name, value, unit="N m/A", vary=False) for name, value in (("k1", 2.0), ("k2", 0.5))
    )
    q1, q2 = (b.state(name, unit="deg", scale=30) for name in ("q1", "q2"))
    w1, w2 = (b.state(name, unit="deg/s", scale=100) for name in ("w1", "w2"))
    i1, i2 = (b.input(name, unit="A", scale=3) for name in ("i1", "i2"))
    shoulder = b.port("shoulder", "inertia", {"speed": w1, "angle": q1}, unit="N m")
    elbow = b.port("elbow", "inertia", {"speed": w2, "angle": q2}, unit="N m")
    first, second = torques(p, (DEGREE * q1, DEGREE * q2), (DEGREE * w1, DEGREE * w2), ca)
    a1, a2 = solved(*inertia(p, DEGREE * q2, ca), first + k1 * i1 + shoulder, second + k2 * i2 + elbow)
    for name, rate in (("q1", w1), ("q2", w2), ("w1", a1 / DEGREE), ("w2", a2 / DEGREE)):
        b.ode(name, rate)
    for name, angle in (("phi1", q1), ("phi2", q2)):
        if name in outputs:
            b.output(name, angle, unit="deg", scale=30)
    return b.model()


def course(v, run):
    k1, most = v["k1"] * (1 + v.get("parameter_k1.wrong_value", 0.0)), v.get("drive.limit", np.inf)
    pulled, load = v.get("elbow.constant_torque", 0.0), v.get("elbow.load_step", 0.0)

    def rate(t, x, u):
        q1, q2, w1, w2 = DEGREE * x
        first, second = torques(v, (q1, q2), (w1, w2), np)
        second += v["k2"] * u["i2"] + pulled - load * (t > run.event)
        a1, a2 = solved(*inertia(v, q2, np), first + k1 * np.clip(u["i1"], -most, most), second)
        return x[2], x[3], a1 / DEGREE, a2 / DEGREE

    def weight(x, first, second):
        return (0.0, 0.0, *(a / DEGREE for a in solved(*inertia(v, DEGREE * x[1], np), first, second)))

    held = []
    for name, row, pair in (("shoulder", (0, 0, 1, 0), (1.0, 0.0)), ("elbow", (0, 0, 0, 1), (0.0, 1.0))):
        size = v.get(f"{name}.coulomb_friction", 0.0)
        if size:
            held.append(Dry(row, lambda x, pair=pair: weight(x, *pair), lambda x, size=size: size))
    x = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[run.event] if load else ())
    return {"phi1": x[:, 0], "phi2": x[:, 1] + v.get("sensor_phi2.sensor_offset", 0.0), "states": x}


def moved(rng):
    time = 1e-2 * np.arange(700)
    inputs = {"i1": levels(rng, 700, 70, -4.0, 4.0), "i2": levels(rng, 700, 50, -3.0, 3.0)}
    return Manoeuvre.of(rng, time, inputs, (0.0, 0.0, 0.0, 0.0))


def swung(rng):
    time = 1e-2 * np.arange(700)
    inputs = {
        "i1": sines(rng, time, 5.0, (0.23, 0.61, 1.3)),
        "i2": sines(rng, time, 3.5, (0.37, 0.83, 1.7)),
    }
    return Manoeuvre.of(rng, time, inputs, (0.0, 0.0, 0.0, 0.0))


def dropped(rng):
    time = 1e-2 * np.arange(600)
    inputs = {"i1": levels(rng, 600, 75, -4.0, 4.0), "i2": levels(rng, 600, 75, -2.0, 2.0)}
    start = (float(rng.uniform(40, 60)), float(rng.uniform(-40, -20)), 0.0, 0.0)
    return Manoeuvre.of(rng, time, inputs, start)


KIND = Kind(
    name="robot_arm",
    sentence="an arm of two links",
    truth={
        "p1": 0.48,
        "p2": 0.06,
        "p3": 0.12,
        "g1": 13.7,
        "c1": 1.2,
        "c2": 0.25,
        "l1": 0.4,
        "k1": 2.0,
        "k2": 0.5,
    },
    terms={
        "shoulder.coulomb_friction": Hidden(1.2, ce.effects.CoulombFriction(), "shoulder"),
        "elbow.coulomb_friction": Hidden(0.3, ce.effects.CoulombFriction(), "elbow"),
        "elbow.constant_torque": Hidden(0.5, ce.effects.ConstantTorque(), "elbow"),
        "elbow.load_step": Hidden(0.6, ce.effects.LoadStep(), "elbow", {"time": "event"}),
        "sensor_phi2.sensor_offset": Hidden(6.0, ce.effects.SensorOffset(), "sensor_phi2"),
        "parameter_k1.wrong_value": Hidden(-0.25, wrong="k1"),
        "drive.limit": Hidden(2.4),
    },
    choices=(
        "shoulder.coulomb_friction",
        "elbow.constant_torque",
        "drive.limit",
        "elbow.coulomb_friction",
        "shoulder.coulomb_friction+elbow.constant_torque",
        "parameter_k1.wrong_value",
        "elbow.load_step",
        "sensor_phi2.sensor_offset",
    ),
    model=model,
    outputs=(("phi1", "phi2"),),
    course=course,
    manoeuvres={"moved": moved, "swung": swung, "dropped": dropped},
    pairs=(("moved", "swung"), ("swung", "dropped"), ("dropped", "moved")),
    units={"i1": "A", "i2": "A", "phi1": "deg", "phi2": "deg"},
)
