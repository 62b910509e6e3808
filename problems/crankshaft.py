"""Crankshaft of a four-cylinder engine on a dynamometer, 7 inertias (thesis figure 3.6 and appendix A).

States   omega_1..omega_7 [rad/s]: damping wheel, cylinders 1 to 4, flywheel, dynamometer;
         twist_21..twist_76 [rad], each the next angle less the one before
Inputs   theta [rad], p1..p4 [Pa], omega [rad/s] (for the reciprocating torque), T_load [N m]
Output   omega [rad/s], the wheel's speed (omega_load, the dynamometer's, may be there)

Six parameters are free, as in Table 4.12; the others are tied by (4.15), (4.16) or fixed. Free C21, C76 and C_eng
as well if you like: the records tell them. They do not tell C32 and C65, nor C2..C5 one by one.

    casadi-engine fit problems/crankshaft.py
"""

from pathlib import Path

import casadi_engine as ce
from casadi_engine.model import thesis_ties

DATA = Path(__file__).resolve().parent.parent / "data" / "crankshaft"
GEOMETRY = {"r": 0.043, "L": 0.145, "A_p": 0.0058, "m_eq": 0.7, "p_crank": 1.0e5}  # Table 4.2, SI units


def model():
    return ce.crankshaft(
        cylinders=4,
        firing_order=(1, 3, 4, 2),
        geometry=GEOMETRY,
        reciprocating_speed="measured",  # linear; "model" takes each cylinder's own speed and angle, and longer
    )


def parameters(m):
    p = thesis_ties(m.parameters())  # the defaults are Table 4.12; a fit starts from these values
    p["J1"].set(0.033, min=0.003, max=0.3)  # kg m2, damping wheel
    p["J2"].set(0.041, min=0.004, max=0.4)  # kg m2, and J3, J4, J5: a cylinder
    p["J6"].set(0.180, min=0.02, max=2)  # kg m2, flywheel
    p["K21"].set(220e3, min=2e4, max=2e6)  # N m/rad
    p["K32"].set(1350e3, min=1e5, max=1e7)  # N m/rad, and K43, K54
    p["K65"].set(1300e3, min=1e5, max=1e7)  # N m/rad
    return p


def read(path):
    return ce.read_experiment(path, optional=("omega_load",))


def problem():
    m = model()
    return ce.Problem(
        name="crankshaft",
        goal=__doc__,
        model=m,
        parameters=parameters(m),
        read=read,
        records=[DATA / "normal_1200rpm.csv.gz", DATA / "misfire_1200rpm.csv.gz"],
        validation=[DATA / "normal_1400rpm.csv.gz"],
        noise=ce.Noise(omega="estimate"),
    )
