"""A carriage drawn by a belt: a driven pulley [rad], an elastic belt and a moved mass [m]."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

RADIUS = 0.05


def model(outputs):
    b = ce.Blueprint("conveyor")
    inertia = b.parameter("J", 0.02, unit="kg m2", min=1e-3, max=1)
    mass = b.parameter("m", 15.0, unit="kg", min=0.5, max=300)
    stiffness = b.parameter("K", 2e4, unit="N/m", min=500, max=5e5)
    damper = b.parameter("D", 60.0, unit="N s/m", min=0, max=3000)
    viscous = b.parameter("c", 20.0, unit="N s/m", min=0, max=1000)
    radius = b.parameter("r", RADIUS, unit="m", vary=False)
    turn = b.state("turn", unit="rad/s", scale=10)
    v, stretch = b.state("v", unit="m/s", scale=0.5), b.state("stretch", unit="m", scale=5e-3)
    torque = b.input("T", unit="N m", scale=5)
    rate = radius * turn - v
    pulley = b.port("pulley", "inertia", {"speed": turn}, unit="N m")
    carriage = b.port("carriage", "inertia", {"speed": v}, unit="N")
    belt = b.port(
        "belt", "coupling", {"twist": stretch, "twist_rate": rate, "stiffness": stiffness}, unit="N"
    )
    pull = stiffness * stretch + damper * rate + belt
    b.ode("turn", (torque - radius * pull + pulley) / inertia)
    b.ode("v", (pull - viscous * v + carriage) / mass)
    b.ode("stretch", rate)
    if "encoder" in outputs:
        b.output("encoder", turn, unit="rad/s", scale=10)
    if "laser" in outputs:
        b.output("laser", v, unit="m/s", scale=0.5)
    return b.model()


def course(v, run):
    radius = v["r"] * (1 + v.get("parameter_r.wrong_value", 0.0))
    cubic, gap = v.get("belt.cubic_stiffness", 0.0), v.get("belt.backlash", 0.0)
    drag, load = v.get("pulley.quadratic_drag", 0.0), v.get("carriage.load_step", 0.0)
    uneven = v.get("pulley.eccentric", 0.0)

    def rate(t, x, u):
        turn, speed, stretch, angle = x
        own = radius * (1 + uneven * np.sin(angle))
        slips = own * turn - speed
        inside = stretch - np.clip(stretch, -gap, gap)
        pull = v["K"] * inside + v["D"] * slips + cubic * stretch**3
        first = u["T"] - own * pull - drag * turn * abs(turn)
        second = pull - v["c"] * speed - load * (t > run.event)
        return first / v["J"], second / v["m"], slips, turn

    held = []
    for name, row, inertia in (("pulley", (1, 0, 0, 0), v["J"]), ("carriage", (0, 1, 0, 0), v["m"])):
        size = v.get(f"{name}.coulomb_friction", 0.0)
        if size:
            held.append(Dry(row, [one / inertia for one in row], lambda x, size=size: size))
    x = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[run.event] if load else ())
    return {"encoder": x[:, 0], "laser": x[:, 1], "states": x}


def shuttled(rng):
    time = 5e-3 * np.arange(800)
    size = np.repeat(np.resize((1.0, -1.0), 16) * rng.uniform(2.0, 8.0, 16), 50)
    return Manoeuvre.of(rng, time, {"T": size}, (0.0, 0.0, 0.0, 0.0))


def shaken(rng):
    time = 5e-3 * np.arange(800)
    return Manoeuvre.of(rng, time, {"T": sines(rng, time, 9.0, (0.6, 1.7, 4.1, 7.3))}, (0.0, 0.0, 0.0, 0.0))


def running(rng):
    time = 5e-3 * np.arange(700)
    turn = float(rng.uniform(15, 25))
    return Manoeuvre.of(rng, time, {"T": levels(rng, 700, 70, -4.0, 5.0)}, (turn, RADIUS * turn, 0.0, 0.0))


KIND = Kind(
    name="conveyor",
    sentence="a carriage drawn by a belt",
    truth={"J": 0.02, "m": 15.0, "K": 2e4, "D": 60.0, "c": 20.0, "r": RADIUS},
    terms={
        "carriage.coulomb_friction": Hidden(15.0, ce.effects.CoulombFriction(), "carriage"),
        "pulley.coulomb_friction": Hidden(0.7, ce.effects.CoulombFriction(), "pulley"),
        "pulley.quadratic_drag": Hidden(3e-3, ce.effects.QuadraticDrag(), "pulley"),
        "belt.cubic_stiffness": Hidden(1.2e9, ce.effects.CubicStiffness(), "belt"),
        "belt.backlash": Hidden(3e-3, ce.effects.Backlash(), "belt"),
        "carriage.load_step": Hidden(30.0, ce.effects.LoadStep(), "carriage", {"time": "event"}),
        "parameter_r.wrong_value": Hidden(0.15, wrong="r", needs=("encoder", "laser")),
        "pulley.eccentric": Hidden(0.25),
    },
    choices=(
        "carriage.coulomb_friction",
        "belt.cubic_stiffness",
        "carriage.load_step",
        "belt.backlash",
        "pulley.eccentric",
        "carriage.coulomb_friction+pulley.quadratic_drag",
        "pulley.coulomb_friction",
        "parameter_r.wrong_value",
    ),
    model=model,
    outputs=(("encoder", "laser"), ("encoder",)),
    course=course,
    manoeuvres={"shuttled": shuttled, "shaken": shaken, "running": running},
    pairs=(("shuttled", "shaken"), ("shaken", "running"), ("running", "shuttled")),
    units={"T": "N m", "encoder": "rad/s", "laser": "m/s"},
)
