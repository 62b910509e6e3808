"""Run-downs of a single-cylinder engine without combustion (../shared/data/engine_tue): what their rigs share.

Records and conditioning are those of problems/run_down.py: crank speed tooth by tooth, angle and cylinder pressure as
inputs. The model is one inertia with the gas torque, the reciprocating mass and friction.
"""

import math
from dataclasses import replace

import casadi as ca
import numpy as np
from rigs_common import page, shared
from scipy_fits import Record, Structure, fit

import casadi_engine as ce

writings = (
    "the package's own one-inertia model",
    "equations of one's own, ports by Blueprint",
    "rpm, and everything per inertia",
)
BORE, RADIUS, ROD, MASS = 0.0677, 0.0275, 0.0842, 0.22  # m, kg
AREA = math.pi * BORE**2 / 4
RATIO = RADIUS / ROD
INERTIA, DRY, CRANKCASE = (
    0.022,
    0.8,
    1.5e4,
)  # start values: kg m2, N m, Pa above the pressure as compression starts
INTAKE = 0.9e5  # Pa, at the start of compression
ESTIMATION, FRESH = ("ENGINEOFF4", "ENGINEOFF"), ("ENGINEOFF3",)
# the mean of the squared lever that the package takes away from the variable inertia
MEAN = 1 / (1 + math.sqrt(1 - RATIO**2))


def build(writing=0, *, dry=True, absolute=False):
    crankcase = CRANKCASE + INTAKE * absolute
    if writing == 0:
        return _ours(dry, crankcase)
    b = ce.Blueprint("run_down", description="a single-cylinder engine that runs down")
    (_own, _per_inertia)[writing - 1](b, dry, crankcase)
    m = b.model()
    return m, m.parameters()


def _ours(dry, crankcase):
    whole = page("run_down").model()
    if not dry:
        geometry = page("run_down").GEOMETRY
        whole = ce.one_inertia(
            name="run_down", cylinders=1, geometry=geometry, reciprocating_speed="model",
            reciprocating_inertia="variable",
        )  # fmt: skip
    p = whole.parameters()
    p["J_eng"].set(INERTIA, min=0.002, max=0.2)
    p["p_crank"].set(crankcase, min=-1e5, max=3e5, vary=True)
    if dry:
        p["T_f"].set(DRY, min=0, max=10)
        p.fix("C_eng", 0)
    else:
        p["C_eng"].set(DRY / 140, min=0, max=1)
    return whole, p


def lever(theta, math=ca):
    """Piston travel per crank angle in shares of the crank radius, and its slope."""
    s, c = math.sin(theta), math.cos(theta)
    root = math.sqrt(1 - (RATIO * s) ** 2)
    return s + RATIO * s * c / root, c + RATIO * (c**2 - s**2 + (RATIO * s * c / root) ** 2) / root


def _inputs(b):
    theta = b.input("theta", unit="rad", scale=10)
    return theta, b.input("p1", unit="Pa", scale=1e5), *lever(theta)


def _own(b, dry, crankcase):
    inertia = b.parameter("J", INERTIA, unit="kg m2", min=0.002, max=0.2)
    mass = b.parameter("m_eq", MASS, unit="kg", vary=False)
    reference = b.parameter("p_crank", crankcase, unit="Pa", min=-1e5, max=3e5)
    if dry:
        friction = b.parameter("T_f", DRY, unit="N m", min=0, max=10)
    else:
        damping = b.parameter("C", DRY / 140, unit="N m s/rad", min=0, max=1)
    omega = b.state("omega_eng", unit="rad/s", scale=100)
    theta, pressure, f, slope = _inputs(b)
    engine = b.port("engine", "inertia", {"speed": omega, "angle": theta})
    lost = friction if dry else damping * omega
    torque = (
        (pressure - reference) * AREA * RADIUS * f - mass * RADIUS**2 * f * slope * omega**2 - lost + engine
    )
    b.ode("omega_eng", torque / (inertia + mass * RADIUS**2 * (f**2 - MEAN)))
    b.output("omega", omega, unit="rad/s", scale=100)


def _per_inertia(b, dry, crankcase):
    shape = b.parameter("volume_per_inertia", AREA * RADIUS / INERTIA, unit="m/kg", min=5e-4, max=0.05)
    share = b.parameter("moved_share", MASS * RADIUS**2 / INERTIA, unit="1", vary=False)
    reference = b.parameter("p_crank", crankcase / 1e5, unit="bar", min=-1, max=3)
    rpm = math.pi / 30
    if dry:
        friction = b.parameter("decay", DRY / INERTIA / rpm, unit="rpm/s", min=0, max=1e4)
    else:
        damping = b.parameter("decay", DRY / 140 / INERTIA, unit="1/s", min=0, max=100)
    n = b.state("n", unit="rpm", scale=1000)
    theta = b.input("theta", unit="rad", scale=10)
    pressure = b.input("p1", unit="bar", scale=1)
    f, slope = lever(theta)
    engine = b.port("engine", "inertia", {"speed": n * rpm, "angle": theta}, unit="rad/s2")
    lost = rpm * friction if dry else damping * rpm * n
    moved = share * f * slope * (rpm * n) ** 2
    b.ode(
        "n",
        (1e5 * (pressure - reference) * shape * f - moved - lost + engine)
        / rpm
        / (1 + share * (f**2 - MEAN)),
    )
    b.output("omega", n, unit="rpm", scale=1000)


def initial(writing=0):
    return {"n": 150 * 30 / math.pi} if writing == 2 else {"omega_eng": 150.0}


def records(*, absolute=False):
    """Two run-downs at different speeds tell dry friction from viscous, one does not; a third is fresh.

    The sensor's pressure is relative. absolute : add the pressure that a cylinder has as its compression starts
    """
    return tuple([_record(name, absolute) for name in part] for part in (ESTIMATION, FRESH))


def _record(name, absolute):
    exp = page("run_down").read(shared("engine_tue", f"{name}.npz"))
    return exp.with_channel(replace(exp["p1"], values=exp["p1"].values + INTAKE)) if absolute else exp


def plain(exp):
    """A record for scipy_fits, on the times of inputs and outputs together."""
    theta, p1, omega = exp["theta"], exp["p1"], exp["omega"]
    time = np.union1d(theta.time, omega.time[omega.mask])
    time = time[(time >= theta.time[0]) & (time <= theta.time[-1])]
    output = np.full(len(time), np.nan)
    keep = omega.mask & (omega.time >= time[0]) & (omega.time <= time[-1])
    output[np.searchsorted(time, omega.time[keep])] = omega.values[keep]
    inputs = np.column_stack([np.interp(time, theta.time, one.values) for one in (theta, p1)])
    return Record(time, inputs, output)


def structure(*free):
    """Structure with J, the crankcase pressure and what is named free: dry, viscous, drag, mass, timing."""

    def rhs(x, u, p):
        w = x[0]
        angle = u[0] + p.get("timing", 0.0)
        f, slope = lever(angle, np)
        moved = p.get("mass", MASS) * RADIUS**2
        torque = (u[1] - 1e5 * p["crankcase"]) * AREA * RADIUS * f - moved * f * slope * w**2
        if "dry" in p:
            torque = torque - p["dry"]
        if "viscous" in p:
            torque = torque - p["viscous"] * w / 100
        if "drag" in p:
            torque = torque - p["drag"] * (w / 100) ** 2
        return (torque / (p["J"] + moved * (f**2 - MEAN)))[None]

    every = {"J": [0.022], "crankcase": [0.5], "dry": [0.8], "viscous": [0.5], "drag": [0.1], "mass": [0.15]}
    every |= {"timing": [0.0]}
    bounds = {"mass": (0.0, 2.0), "viscous": (0.0, 20.0), "dry": (0.0, 20.0)}
    starts = {name: every[name] for name in ("J", "crankcase", *free)}
    first = lambda one: np.array([one.output[np.isfinite(one.output)][0]])  # noqa: E731
    return Structure(rhs, lambda x, u, p: x[0], starts, first, steps=1, bounds=bounds, state_scale=10.0)


def by_hand(structures, **kind):
    estimation, fresh = ([plain(one) for one in part] for part in records(**kind))
    return {name: fit(structure(*free), estimation, fresh) for name, free in structures.items()}
