"""The short-period motion of a small aircraft about its trim: incidence and pitch rate, by its elevator.

Angles in degrees; the derivatives are stated at one airspeed, which is measured and varies.
"""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import delayed, simulate

import casadi_engine as ce

# Airspeed at which the derivatives are stated [m/s]; time constant of the elevator's servo [s].
STATED, SERVO = 25.0, 0.05


def model(outputs):
    b = ce.Blueprint("aircraft")
    lift = b.parameter("za", 4.5, unit="1/s", min=0.3, max=60)
    stiffness = b.parameter("ma", 40.0, unit="1/s2", min=2, max=800)
    damping = b.parameter("mq", 6.0, unit="1/s", min=0.3, max=100)
    power = b.parameter("md", 60.0, unit="1/s2", min=3, max=1000)
    servo = b.parameter("tau", SERVO, unit="s", vary=False)
    incidence = b.state("alpha", unit="deg", scale=4)
    turn = b.state("q", unit="deg/s", scale=20)
    surface = b.state("delta", unit="deg", scale=4)
    command, airspeed = b.input("elevator", unit="deg", scale=4), b.input("airspeed", unit="m/s", scale=25)
    share = airspeed / STATED
    rate = turn - lift * share * incidence
    heave = b.port("heave", "inertia", {"incidence": incidence}, unit="deg/s")
    pitch = b.port("pitch", "inertia", {"speed": turn}, unit="deg/s2")
    signals = {"twist": incidence, "twist_rate": rate, "stiffness": stiffness}
    tail = b.port("tail", "coupling", signals, unit="deg/s2")
    linkage = b.port("linkage", "coupling", {"twist": surface, "stiffness": power}, unit="deg/s2")
    moment = stiffness * incidence + tail + power * surface + linkage
    b.ode("alpha", rate + heave)
    b.ode("q", -(share**2) * moment - damping * share * turn + pitch)
    b.ode("delta", (command - surface) / servo)
    if "gyro" in outputs:
        b.output("gyro", turn, unit="deg/s", scale=20)
    if "vane" in outputs:
        b.output("vane", incidence, unit="deg", scale=4)
    return b.model()


def course(v, run):
    cubic, gap = v.get("tail.cubic_stiffness", 0.0), v.get("linkage.backlash", 0.0)
    ballast, gear = v.get("pitch.constant_torque", 0.0), v.get("pitch.load_step", 0.0)
    servo, most = v["tau"] * (1 + v.get("parameter_tau.wrong_value", 0.0)), v.get("servo.rate_limit", np.inf)

    def rate(t, x, u):
        incidence, turn, surface = x
        share = u["airspeed"] / STATED
        acts = surface - np.clip(surface, -gap, gap)
        moment = v["ma"] * incidence + cubic * incidence**3 + v["md"] * acts
        pitch = -(share**2) * moment - v["mq"] * share * turn + ballast - gear * (t > run.event)
        moves = np.clip((u["elevator"] - surface) / servo, -most, most)
        return turn - v["za"] * share * incidence, pitch, moves

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if gear else ())
    vane = delayed(run.time, x[:, 0], v.get("sensor_vane.sensor_delay", 0.0))
    vane = vane * (1 + v.get("sensor_vane.sensor_gain", 0.0))
    return {"gyro": x[:, 1] + v.get("sensor_gyro.sensor_offset", 0.0), "vane": vane, "states": x}


def _airspeed(rng, time):
    return STATED + sines(rng, time, 3.5, (0.05, 0.13))


def stepped(rng):
    time = 0.02 * np.arange(800)
    inputs = {"elevator": levels(rng, 800, 32, -6.0, 6.0), "airspeed": _airspeed(rng, time)}
    return Manoeuvre.of(rng, time, inputs, (0.0, 0.0, 0.0))


def swept(rng):
    time = 0.02 * np.arange(800)
    elevator = sines(rng, time, 6.5, (0.17, 0.53, 1.1, 1.9))
    return Manoeuvre.of(rng, time, {"elevator": elevator, "airspeed": _airspeed(rng, time)}, (0.0, 0.0, 0.0))


def pulled_up(rng):
    """From a pull-up: three, two, one and one units of time to either side, and again."""
    time = 0.02 * np.arange(700)
    signs = np.repeat((1.0, -1.0, 1.0, -1.0), np.multiply((3, 2, 1, 1), 20))
    elevator = np.concatenate([size * signs for size in rng.uniform(3.0, 7.0, 5)])
    start = (float(rng.uniform(3, 5)), float(rng.uniform(10, 20)), -3.0)
    return Manoeuvre.of(rng, time, {"elevator": elevator, "airspeed": _airspeed(rng, time)}, start)


BOTH = ("gyro", "vane")

KIND = Kind(
    name="aircraft",
    sentence="the short-period motion of an aircraft",
    truth={"za": 4.5, "ma": 40.0, "mq": 6.0, "md": 60.0, "tau": SERVO},
    terms={
        "linkage.backlash": Hidden(0.7, ce.effects.Backlash(), "linkage"),
        "tail.cubic_stiffness": Hidden(1.5, ce.effects.CubicStiffness(), "tail"),
        # of the pitch rate alone a constant moment, a steady updraught and an offset are one thing
        "pitch.constant_torque": Hidden(50.0, ce.effects.ConstantTorque(), "pitch", needs=BOTH),
        "sensor_gyro.sensor_offset": Hidden(4.0, ce.effects.SensorOffset(), "sensor_gyro", needs=BOTH),
        "pitch.load_step": Hidden(60.0, ce.effects.LoadStep(), "pitch", {"time": "event"}),
        "sensor_vane.sensor_gain": Hidden(0.2, ce.effects.SensorGain(), "sensor_vane", needs=BOTH),
        "sensor_vane.sensor_delay": Hidden(0.04, ce.effects.SensorDelay(), "sensor_vane", needs=BOTH),
        "parameter_tau.wrong_value": Hidden(1.0, wrong="tau"),
        "servo.rate_limit": Hidden(28.0, unseen=("swept",)),
    },
    choices=(
        "sensor_vane.sensor_gain",
        "linkage.backlash",
        "pitch.load_step",
        "servo.rate_limit",
        "tail.cubic_stiffness",
        "pitch.constant_torque",
        "linkage.backlash+sensor_gyro.sensor_offset",
        "parameter_tau.wrong_value",
        "sensor_vane.sensor_delay",
    ),
    model=model,
    outputs=(BOTH, ("gyro",)),
    course=course,
    manoeuvres={"stepped": stepped, "swept": swept, "pulled_up": pulled_up},
    pairs=(("stepped", "swept"), ("swept", "pulled_up"), ("pulled_up", "stepped")),
    units={"elevator": "deg", "airspeed": "m/s", "gyro": "deg/s", "vane": "deg"},
)
