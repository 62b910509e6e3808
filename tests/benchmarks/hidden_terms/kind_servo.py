"""A servo: a motor that turns a load through a gear with an elastic shaft, which may have play."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

RATIO = 10.0


def model(outputs):
    b = ce.Blueprint("servo")
    j_motor = b.parameter("Jm", 1e-4, unit="kg m2", min=1e-6, max=1e-2)
    j_load = b.parameter("Jl", 0.02, unit="kg m2", min=1e-4, max=2)
    stiffness = b.parameter("K", 200.0, unit="N m/rad", min=5, max=5000)
    damper = b.parameter("D", 0.2, unit="N m s/rad", min=0, max=10)
    viscous = b.parameter("c", 1e-3, unit="N m s/rad", min=0, max=0.1)
    ratio = b.parameter("n", RATIO, unit="1", vary=False)
    w_motor = b.state("w_motor", unit="rad/s", scale=50)
    w_load = b.state("w_load", unit="rad/s", scale=5)
    twist = b.state("twist", unit="rad", scale=0.01)
    torque = b.input("T", unit="N m", scale=0.3)
    rate = w_motor / ratio - w_load
    motor = b.port("motor", "inertia", {"speed": w_motor})
    load = b.port("load", "inertia", {"speed": w_load})
    gear = b.port("gear", "coupling", {"twist": twist, "twist_rate": rate, "stiffness": stiffness})
    shaft = stiffness * twist + damper * rate + gear
    b.ode("w_motor", (torque - viscous * w_motor - shaft / ratio + motor) / j_motor)
    b.ode("w_load", (shaft + load) / j_load)
    b.ode("twist", rate)
    if "tacho" in outputs:
        b.output("tacho", w_motor, unit="rad/s", scale=50)
    if "load_speed" in outputs:
        b.output("load_speed", w_load, unit="rad/s", scale=5)
    return b.model()


def course(v, run):
    gap, cubic = v.get("gear.backlash", 0.0), v.get("gear.cubic_stiffness", 0.0)
    ripple, drag = v.get("motor.ripple", 0.0), v.get("load.quadratic_drag", 0.0)
    n = v["n"] * (1 + v.get("parameter_n.wrong_value", 0.0))

    def rate(t, x, u):
        w_motor, w_load, twist, angle = x
        turn = w_motor / n - w_load
        inside = twist - np.clip(twist, -gap, gap)
        shaft = v["K"] * inside + v["D"] * turn + cubic * twist**3
        motor = u["T"] - v["c"] * w_motor - shaft / n + ripple * np.sin(angle)
        load = shaft - drag * w_load * abs(w_load)
        return motor / v["Jm"], load / v["Jl"], turn, w_motor

    held = []
    for name, row in (("motor", (1, 0, 0, 0)), ("load", (0, 1, 0, 0))):
        size = v.get(f"{name}.coulomb_friction", 0.0)
        if size:
            inertia = v["Jm" if name == "motor" else "Jl"]
            held.append(Dry(row, [one / inertia for one in row], lambda x, size=size: size))
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"tacho": x[:, 0], "load_speed": x[:, 1]}


def rocked(rng):
    time = 2e-3 * np.arange(900)
    signs = np.resize((1.0, -1.0), 18)
    size = np.repeat(signs * rng.uniform(0.15, 0.45, 18), 50)
    return Manoeuvre.of(rng, time, {"T": size}, (0.0, 0.0, 0.0, 0.0))


def shaken(rng):
    time = 2e-3 * np.arange(900)
    return Manoeuvre.of(rng, time, {"T": sines(rng, time, 0.7, (1.1, 2.9, 7.7, 17.0))}, (0.0, 0.0, 0.0, 0.0))


def braked(rng):
    time = 2e-3 * np.arange(800)
    speed = float(rng.uniform(60, 100))
    return Manoeuvre.of(rng, time, {"T": levels(rng, 800, 80, -0.35, 0.3)}, (speed, speed / RATIO, 0.0, 0.0))


KIND = Kind(
    name="servo",
    sentence="a motor, a gear and a load",
    truth={"Jm": 1e-4, "Jl": 0.02, "K": 200.0, "D": 0.2, "c": 1e-3, "n": RATIO},
    terms={
        "gear.backlash": Hidden(0.008, ce.effects.Backlash(), "gear"),
        "gear.cubic_stiffness": Hidden(8e5, ce.effects.CubicStiffness(), "gear"),
        "load.coulomb_friction": Hidden(0.6, ce.effects.CoulombFriction(), "load"),
        "motor.coulomb_friction": Hidden(0.05, ce.effects.CoulombFriction(), "motor"),
        "load.quadratic_drag": Hidden(0.03, ce.effects.QuadraticDrag(), "load"),
        "motor.ripple": Hidden(0.08),
        "parameter_n.wrong_value": Hidden(0.2, wrong="n", needs=("tacho", "load_speed")),
    },
    choices=(
        "gear.backlash",
        "load.coulomb_friction",
        "gear.cubic_stiffness",
        "gear.backlash+load.coulomb_friction",
        "motor.coulomb_friction",
        "motor.ripple",
        "load.quadratic_drag",
        "parameter_n.wrong_value",
    ),
    model=model,
    outputs=(("tacho", "load_speed"), ("tacho",)),
    course=course,
    manoeuvres={"rocked": rocked, "shaken": shaken, "braked": braked},
    pairs=(("rocked", "shaken"), ("shaken", "braked"), ("braked", "rocked")),
    units={"T": "N m", "tacho": "rad/s", "load_speed": "rad/s"},
)
