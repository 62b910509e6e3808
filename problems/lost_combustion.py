"""An engine whose combustion is lost in the middle of a record, from crank speed alone.

State    omega_eng [rad/s]
Inputs   theta [rad], p1 [Pa]        Output   omega [rad/s], one value for each tooth of a 60-2 wheel

The record is of the kind that problems/run_down.py reads, and conditioned there. From the time LOST on the measured
pressure is withheld: in its place stands the mean cycle of the time before, as if combustion went on. What the model
then lacks is a misfire of cylinder 1 from one cycle to the end; the withheld pressure says whether it is right.

    casadi-engine repair problems/lost_combustion.py --data E0FULLOAD4EngineOff.npz
"""

import sys
from pathlib import Path

import numpy as np

import casadi_engine as ce
from casadi_engine.model import Geometry

sys.path.insert(0, str(Path(__file__).resolve().parent))

import run_down

LOST = 0.24  # s
INTAKE = 0.9e5  # Pa, absolute, at the start of compression: the sensor tells pressure differences
GEOMETRY = Geometry.from_bore(0.0677, stroke=0.055, rod=0.0842, mass=run_down.MASS, p_crank=1.0e5)


def model():
    return ce.one_inertia(
        name="lost_combustion",
        cylinders=1,
        geometry=GEOMETRY,
        reciprocating_speed="model",
        reciprocating_inertia="variable",
        friction_torque=8.0,  # with the load of the generator
    )


def parameters(m):
    p = m.parameters()
    p["J_eng"].set(0.02, min=0.002, max=0.2)  # kg m2
    p["T_f"].set(8.0, min=0, max=40)  # N m
    p.fix("C_eng", 0)  # one record does not tell it from T_f
    return p


def read(path):
    return as_if_burning(measured(path))


def measured(path):
    """The record with the pressure as it was, absolute."""
    exp = run_down.read(path)
    return run_down.changed(exp, "p1", exp["p1"].values + INTAKE, "absolute", intake=INTAKE)


def as_if_burning(exp):
    """The mean cycle of the time before LOST in place of the pressure after it, by crank angle."""
    theta, p, time = exp["theta"].values, exp["p1"].values, exp["theta"].time
    before = time < LOST
    angle = np.radians(np.arange(720.0))
    inside = np.digitize(np.mod(theta[before], 4 * np.pi), angle) - 1
    mean = np.bincount(inside, p[before], 720) / np.maximum(np.bincount(inside, minlength=720), 1)
    burning = np.interp(np.mod(theta, 4 * np.pi), angle + np.radians(0.5), mean, period=4 * np.pi)
    return run_down.changed(exp, "p1", np.where(before, p, burning), "as_if_burning", lost=LOST)


def problem():
    m = model()
    return ce.Problem(
        name="lost_combustion",
        goal=__doc__,
        model=m,
        parameters=parameters(m),
        read=read,
        noise=ce.Noise(omega="estimate"),
    )
