"""The drivetrain of a small wind turbine: rotor, soft rubber coupling, gear and generator, driven by the wind."""

from __future__ import annotations

import casadi as ca
import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import simulate

import casadi_engine as ce

RADIUS, AIR, RATIO = 5.0, 1.225, 16.0
# Tip speed ratio at which the torque coefficient is largest, and how far from it the blades still pull.
BEST, REACH = 5.5, 4.0


def pull(coefficient, speed, wind, math):
    """Torque of the wind on the rotor [N m]."""
    ratio = speed * RADIUS / wind
    bell = math.exp(-(((ratio - BEST) / REACH) ** 2))
    return 0.5 * AIR * np.pi * RADIUS**3 * wind**2 * coefficient * bell


def model(outputs):
    b = ce.Blueprint("wind_turbine")
    j_rotor = b.parameter("Jr", 1200.0, unit="kg m2", min=50, max=2e4)
    j_generator = b.parameter("Jg", 0.5, unit="kg m2", min=0.02, max=10)
    stiffness = b.parameter("K", 12.0, unit="kN m/rad", min=0.5, max=300)
    damper = b.parameter("D", 200.0, unit="N m s/rad", min=5, max=4000)
    viscous = b.parameter("c", 0.05, unit="N m s/rad", min=0, max=1)
    blades = b.parameter("cm", 0.0686, unit="1", vary=False, description="largest torque coefficient")
    demanded = b.parameter("kopt", 2e-3, unit="N m s2/rad2", vary=False)
    w_rotor = b.state("w_rotor", unit="rad/s", scale=10)
    w_generator = b.state("w_generator", unit="rad/s", scale=160)
    twist = b.state("twist", unit="rad", scale=0.1)
    wind, demand = b.input("wind", unit="m/s", scale=8), b.input("demand", unit="1")
    rate = w_rotor - w_generator / RATIO
    rotor = b.port("rotor", "inertia", {"speed": w_rotor}, unit="N m")
    generator = b.port("generator", "inertia", {"speed": w_generator}, unit="N m")
    elastic = 1e3 * stiffness
    signals = {"twist": twist, "twist_rate": rate, "stiffness": elastic}
    shaft = elastic * twist + damper * rate + b.port("shaft", "coupling", signals, unit="N m")
    taken = demand * demanded * w_generator**2 + viscous * w_generator
    b.ode("w_rotor", (pull(blades, w_rotor, wind, ca) - shaft + rotor) / j_rotor)
    b.ode("w_generator", (shaft / RATIO - taken + generator) / j_generator)
    b.ode("twist", rate)
    if "tacho" in outputs:
        b.output("tacho", w_generator, unit="rad/s", scale=160)
    if "hub" in outputs:
        b.output("hub", w_rotor, unit="rad/s", scale=10)
    return b.model()


def course(v, run):
    gap, cubic = v.get("shaft.backlash", 0.0), v.get("shaft.cubic_stiffness", 0.0)
    fan, brake = v.get("generator.quadratic_drag", 0.0), v.get("rotor.load_step", 0.0)
    blades, lag = v["cm"] * (1 + v.get("parameter_cm.wrong_value", 0.0)), v.get("rotor.dynamic_inflow", 0.0)

    def rate(t, x, u):
        w_rotor, w_generator, twist, felt = x
        turn = w_rotor - w_generator / RATIO
        inside = twist - np.clip(twist, -gap, gap)
        shaft = 1e3 * v["K"] * inside + v["D"] * turn + cubic * twist**3
        driven = pull(blades, w_rotor, felt if lag else u["wind"], np) - brake * (t > run.event)
        taken = u["demand"] * v["kopt"] * w_generator**2 + v["c"] * w_generator + fan * w_generator**2
        follows = (u["wind"] - felt) / lag if lag else 0.0
        return (driven - shaft) / v["Jr"], (shaft / RATIO - taken) / v["Jg"], turn, follows

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if brake else ())
    return {"tacho": x[:, 1], "hub": x[:, 0] + v.get("sensor_hub.sensor_offset", 0.0), "states": x}


def gusty(rng):
    time = 0.05 * np.arange(1000)
    wind = 8 + sines(rng, time, 2.5, (0.03, 0.071, 0.17))
    inputs = {"wind": wind, "demand": levels(rng, 1000, 25, 0.0, 2.0)}
    return Manoeuvre.of(rng, time, inputs, (10.5, 10.5 * RATIO, 0.08, wind[0]))


def switched(rng):
    """The generator drives the rotor in between, so that the shaft is twisted both ways."""
    time = 0.05 * np.arange(900)
    signs = np.resize((1.0, -0.4), 30)
    wind = 7 + sines(rng, time, 1.5, (0.02, 0.05))
    inputs = {"wind": wind, "demand": np.repeat(signs * rng.uniform(1.0, 2.6, 30), 30)}
    return Manoeuvre.of(rng, time, inputs, (9.0, 9.0 * RATIO, 0.06, wind[0]))


def started(rng):
    time = 0.05 * np.arange(900)
    wind = levels(rng, 900, 180, 5.5, 10.0)
    speed = float(rng.uniform(3.5, 5.0))
    inputs = {"wind": wind, "demand": levels(rng, 900, 30, -0.8, 2.2)}
    return Manoeuvre.of(rng, time, inputs, (speed, speed * RATIO, 0.03, wind[0]))


KIND = Kind(
    name="wind_turbine",
    sentence="the drivetrain of a wind turbine",
    truth={"Jr": 1200.0, "Jg": 0.5, "K": 12.0, "D": 200.0, "c": 0.05, "cm": 0.0686, "kopt": 2e-3},
    terms={
        "shaft.backlash": Hidden(0.02, ce.effects.Backlash(), "shaft", unseen=("gusty",)),
        "shaft.cubic_stiffness": Hidden(1e6, ce.effects.CubicStiffness(), "shaft"),
        "generator.quadratic_drag": Hidden(5e-4, ce.effects.QuadraticDrag(), "generator"),
        "rotor.load_step": Hidden(300.0, ce.effects.LoadStep(), "rotor", {"time": "event"}),
        "sensor_hub.sensor_offset": Hidden(0.5, ce.effects.SensorOffset(), "sensor_hub"),
        # of both torques motion tells the ratio alone
        "parameter_cm.wrong_value": Hidden(-0.25, wrong="cm", right=("parameter_kopt.wrong_value",)),
        "rotor.dynamic_inflow": Hidden(3.0),
    },
    choices=(
        "generator.quadratic_drag",
        "shaft.backlash",
        "rotor.load_step",
        "rotor.dynamic_inflow",
        "shaft.backlash+generator.quadratic_drag",
        "parameter_cm.wrong_value",
        "shaft.cubic_stiffness",
        "sensor_hub.sensor_offset",
    ),
    model=model,
    outputs=(("tacho", "hub"), ("tacho",)),
    course=course,
    manoeuvres={"gusty": gusty, "switched": switched, "started": started},
    pairs=(("switched", "gusty"), ("gusty", "started"), ("started", "switched")),
    units={"wind": "m/s", "demand": "1", "tacho": "rad/s", "hub": "rad/s"},
)
