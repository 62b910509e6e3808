"""An engine and its load on a shaft (two masses): crank speed, pressures and load torque, by ``data/simulator``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "data"))

from simulator.hidden import Hidden as HiddenEffect
from simulator.hidden_runs import Case, simulate_hidden
from simulator.shaft import Shaft

RATE, COUNT = 1440.2, 1440
INPUTS = ("theta", "p1", "p2", "p3", "p4", "T_load")
UNITS = {"theta": "rad", **dict.fromkeys(INPUTS[1:5], "Pa"), "T_load": "N m"}
GEOMETRY = {"r": 0.043, "L": 0.145, "A_p": 0.0058, "m_eq": 0.7, "p_crank": 1e5}
# The cycle of a cylinder in which its combustion is lost.
CYCLE = 4
INPUTS = ("theta", "p1", "p2", "p3", "p4", "T_load")


def model(outputs):
    return ce.two_mass(outputs=outputs, reciprocating_speed="model")


def course(v, run):
    """The record of the simulator: `run.start` is mean speed [rpm], brake [N m] and the seed of its combustions."""
    speed, brake, seed = run.start
    effects = []
    for name in KIND.terms:
        if name in v:
            at, _, effect = name.partition(".")
            details = {"load_step": {"time": run.event}, "misfire": {"cycles": (CYCLE,)}}.get(effect, {})
            effects.append(HiddenEffect(effect, at, v[name], details))
    plant = Shaft(
        inertia=np.array([v["J_eng"], v["J_load"]]),
        stiffness=np.array([v["K_el"]]),
        coupling_damping=np.array([v["C_el"]]),
        absolute_damping=np.array([v["C_eng"], 0.0]),
        throws=(0, 0, 0, 0),
    )
    (record,) = simulate_hidden(
        "two_mass", [Case(tuple(effects), int(seed), 0)], speed_rpm=speed, load=brake, shaft=plant,
        duration=COUNT / RATE, rate=RATE, sigma=0.0,
    )  # fmt: skip
    outputs = {name: record[f"{name}_true"][:COUNT] for name in ("omega", "omega_load")}
    states = {"states": record["states"][1:4, :COUNT].T}
    return outputs | {name: record[name][:COUNT] for name in INPUTS} | states


def steady(rpm, brake):
    def made(rng):
        time = np.arange(COUNT) / RATE
        blank = {name: np.zeros(COUNT) for name in INPUTS}
        return Manoeuvre.of(rng, time, blank, (rpm, brake * rng.uniform(0.9, 1.1), float(rng.integers(1000))))

    return made


KIND = Kind(
    name="engine",
    sentence="an engine and its load",
    truth={"J_eng": 0.391, "J_load": 0.177, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541, **GEOMETRY},
    terms={
        "coupling.coulomb_friction": Hidden(15.0, ce.effects.CoulombFriction(), "coupling"),
        "coupling.cubic_stiffness": Hidden(
            1.5e6, ce.effects.CubicStiffness(), "coupling", needs=("omega", "omega_load")
        ),
        "load.load_step": Hidden(4.0, ce.effects.LoadStep(), "load", {"time": "event"}),
        "cylinder_2.cylinder_imbalance": Hidden(0.25, ce.effects.CylinderImbalance(), "cylinder_2"),
        "cylinder_3.misfire": Hidden(
            0.8, ce.effects.Misfire(), "cylinder_3", {"first": CYCLE, "last": CYCLE}
        ),
        "sensor_omega.sensor_delay": Hidden(5e-4, ce.effects.SensorDelay(), "sensor_omega"),
    },
    choices=(
        "coupling.coulomb_friction",
        "cylinder_2.cylinder_imbalance",
        "load.load_step",
        "coupling.cubic_stiffness",
        "coupling.coulomb_friction+cylinder_2.cylinder_imbalance",
        "cylinder_3.misfire",
        "sensor_omega.sensor_delay",
    ),
    model=model,
    outputs=(("omega", "omega_load"), ("omega",)),
    course=course,
    manoeuvres={"slow": steady(1000.0, 60.0), "middle": steady(1200.0, 75.0), "fast": steady(1450.0, 55.0)},
    pairs=(("middle", "fast"), ("slow", "middle"), ("fast", "slow")),
    units=UNITS | {"omega": "rad/s", "omega_load": "rad/s"},
)
