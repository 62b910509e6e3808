"""A mine hoist: a driven sheave, a counterweight and a cage on an elastic rope, held at its speed by the drive.

The inertia of the sheave holds that of the counterweight. Upwards is positive, the rope's force in kN.
"""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

import casadi_engine as ce

GRAVITY, RADIUS, COUNTER = 9.81, 0.8, 2000.0
# Of the speed controller [N m s/rad].
LOOP = 4000.0


def model(outputs):
    b = ce.Blueprint("mine_hoist")
    inertia = b.parameter("J", 1800.0, unit="kg m2", min=100, max=4e4)
    mass = b.parameter("m", 2000.0, unit="kg", min=200, max=2e4)
    stiffness = b.parameter("K", 1.2e6, unit="N/m", min=5e4, max=3e7)
    damper = b.parameter("D", 6000.0, unit="N s/m", min=0, max=2e5)
    viscous = b.parameter("c", 300.0, unit="N s/m", min=0, max=1e4)
    counter = b.parameter("mc", COUNTER, unit="kg", vary=False, description="weighs on the sheave")
    turn = b.state("turn", unit="rad/s", scale=2)
    v, stretch = b.state("v", unit="m/s", scale=2), b.state("stretch", unit="m", scale=0.01)
    wanted = b.input("wanted", unit="m/s", scale=2)
    rate = RADIUS * turn - v
    sheave = b.port("sheave", "inertia", {"speed": turn}, unit="N m")
    cage = b.port("cage", "inertia", {"speed": v}, unit="N")
    pull = stiffness * stretch + damper * rate
    drive = LOOP * (wanted / RADIUS - turn)
    b.ode("turn", (drive + RADIUS * (counter * GRAVITY - pull) + sheave) / inertia)
    b.ode("v", (pull - mass * GRAVITY - viscous * v + cage) / mass)
    b.ode("stretch", rate)
    if "encoder" in outputs:
        b.output("encoder", turn, unit="rad/s", scale=2)
    if "cell" in outputs:
        b.output("cell", 1e-3 * pull, unit="kN", scale=5)
    return b.model()


def course(v, run):
    counter = v["mc"] * (1 + v.get("parameter_mc.wrong_value", 0.0))
    asked, heavy = 1 + v.get("input_wanted.input_gain", 0.0), v.get("rope.own_weight", 0.0)

    def pulled(x):
        return v["K"] * x[2] + v["D"] * (RADIUS * x[0] - x[1])

    def rate(t, x, u):
        turn, speed, _, height = x
        pull = pulled(x)
        # rope that a rising cage takes from its own side is on the other one afterwards
        over = RADIUS * (counter * GRAVITY + 2 * heavy * GRAVITY * height - pull)
        drive = LOOP * (asked * u["wanted"] / RADIUS - turn)
        rises = (pull - v["m"] * GRAVITY - v["c"] * speed) / v["m"]
        return (drive + over) / v["J"], rises, RADIUS * turn - speed, RADIUS * turn

    held = []
    for name, row, inertia in (("sheave", (1, 0, 0, 0), v["J"]), ("cage", (0, 1, 0, 0), v["m"])):
        size = v.get(f"{name}.coulomb_friction", 0.0)
        if size:
            held.append(Dry(row, [one / inertia for one in row], lambda x, size=size: size))
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    cell = 1e-3 * pulled(x.T) + v.get("sensor_cell.sensor_offset", 0.0)
    return {"encoder": x[:, 0], "cell": cell, "states": x}


def _ramped(steps):
    """Levels that the drive's setpoint takes thirty-one samples to reach, so that the rope is never slack."""
    return np.convolve(np.pad(steps, (15, 15), mode="edge"), np.full(31, 1 / 31), mode="valid")


def shuttled(rng):
    """Up and down in turn, as between two levels of a mine."""
    time = 0.02 * np.arange(900)
    wanted = np.repeat(np.resize((1.0, -1.0), 10) * rng.uniform(0.8, 2.5, 10), 90)
    return Manoeuvre.of(rng, time, {"wanted": _ramped(wanted)}, (0.0, 0.0, 0.0164, 0.0))


def waved(rng):
    time = 0.02 * np.arange(900)
    wanted = sines(rng, time, 3.5, (0.11, 0.37, 0.83, 1.9))
    return Manoeuvre.of(rng, time, {"wanted": wanted}, (0.0, 0.0, 0.0164, 0.0))


def lowered(rng):
    """From a descent at speed, then levels by chance."""
    time = 0.02 * np.arange(800)
    speed = float(-rng.uniform(2.0, 3.0))
    wanted = levels(rng, 800, 80, -3.0, 3.0)
    wanted[:80] = speed
    return Manoeuvre.of(rng, time, {"wanted": _ramped(wanted)}, (speed / RADIUS, speed, 0.0164, 0.0))


KIND = Kind(
    name="mine_hoist",
    sentence="a mine hoist with its rope",
    truth={"J": 1800.0, "m": 2000.0, "K": 1.2e6, "D": 6000.0, "c": 300.0, "mc": COUNTER},
    terms={
        "cage.coulomb_friction": Hidden(1100.0, ce.effects.CoulombFriction(), "cage"),
        "sheave.coulomb_friction": Hidden(800.0, ce.effects.CoulombFriction(), "sheave"),
        # it weighs on the sheave and does nothing else; an encoder's offset is a constant torque through the drive's
        # gain, but for viscous friction at that speed, which is some N of the rope's 20 kN. The encoder alone does
        # not tell where a constant force pulls.
        "parameter_mc.wrong_value": Hidden(
            0.12,
            wrong="mc",
            right=("sheave.constant_torque", "sensor_encoder.sensor_offset"),
            needs=("encoder", "cell"),
        ),
        "sensor_cell.sensor_offset": Hidden(1.5, ce.effects.SensorOffset(), "sensor_cell"),
        "input_wanted.input_gain": Hidden(0.12, ce.effects.InputGain(), "input_wanted"),
        "rope.own_weight": Hidden(9.0),
    },
    choices=(
        "cage.coulomb_friction",
        "parameter_mc.wrong_value",
        "rope.own_weight",
        "sensor_cell.sensor_offset",
        "sheave.coulomb_friction",
        "input_wanted.input_gain",
        "cage.coulomb_friction+sensor_cell.sensor_offset",
        "input_wanted.input_gain|cage.coulomb_friction",
    ),
    model=model,
    outputs=(("encoder", "cell"), ("encoder",)),
    course=course,
    manoeuvres={"shuttled": shuttled, "waved": waved, "lowered": lowered},
    pairs=(("shuttled", "waved"), ("waved", "lowered"), ("lowered", "shuttled")),
    units={"wanted": "m/s", "encoder": "rad/s", "cell": "kN"},
    absent=("c",),
)
