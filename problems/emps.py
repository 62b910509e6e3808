"""Electro-mechanical positioning system (a servo drive, EMPS): mass and viscous friction from its speed.

State    speed [m/s]        Input   F [N], the motor's force        Output   v [m/s], mean speed over 5 ms

    casadi-engine repair problems/emps.py --data DATA_EMPS.mat --validate DATA_EMPS_PULSES.mat

A. Janot, M. Gautier, M. Brunot, Data set and reference models of EMPS, 2019 (nonlinearbenchmark.org). The file's vir is
the control signal in volts; the force is gtau vir. Published with dry friction: M = 95.109 kg, Fv = 203.50 N s/m,
Fc = 20.39 N, offset -3.165 N. This model has no dry friction: repair finds it.

Closed loop: a position controller made vir, so that F answers to the position's noise. It is computed by the controller
and known to the digit; the encoder's noise is a thousandth of what dry friction does. F is taken as a known input, and
the plant is simulated from it, open loop; nothing is predicted from measured values, so that the feedback cannot teach
the model the controller's inverse. Speed, not position, is compared: an open-loop position drifts without end. What the
simulated speed is off by, slowly, goes into the noise as its colour.
"""

from pathlib import Path

import numpy as np
from scipy.io import loadmat

import casadi_engine as ce

EVERY = 5  # samples of 1 ms in a block: mean force in it, and mean speed from the positions at its ends


def model():
    b = ce.Blueprint("emps", description="a carriage on a ball screw, driven by a force")
    mass = b.parameter("M", 95.0, unit="kg", min=1, max=1000, description="moved mass")
    viscous = b.parameter("Fv", 200.0, unit="N s/m", min=0, max=5000, description="viscous friction")
    offset = b.parameter("offset", 0.0, unit="N", min=-100, max=100, description="offset of the force")
    speed = b.state("speed", unit="m/s", scale=0.1)
    force = b.input("F", unit="N", scale=100, description="force of the motor")
    carriage = b.port("carriage", "inertia", {"speed": speed}, description="the moved mass")
    b.ode("speed", (force - viscous * speed - offset + carriage) / mass)
    b.output("v", speed, unit="m/s", scale=0.1)
    return b.model()


def parameters(m):
    p = m.parameters()
    p["M"].set(90.0)
    p["Fv"].set(250.0)
    return p


def read(path):
    raw = loadmat(path)
    time, volts, position = (raw[name].ravel() for name in ("t", "vir", "qm"))
    count = (len(time) - 1) // EVERY
    ends = position[: EVERY * count + 1 : EVERY]
    step = EVERY * float(np.median(np.diff(time)))
    return ce.Experiment.from_arrays(
        Path(path).stem.lower(),
        time=float(time[0]) + step * (np.arange(count) + 0.5),
        units={"F": "N", "v": "m/s"},
        # a volt holds from its sample to the next one
        F=float(raw["gtau"].item()) * volts[: EVERY * count].reshape(count, EVERY).mean(axis=1),
        v=np.diff(ends) / step,
    )


def problem():
    m = model()
    return ce.Problem(
        name="emps", goal=__doc__, model=m, parameters=parameters(m), read=read, noise=ce.Noise(v="estimate")
    )
