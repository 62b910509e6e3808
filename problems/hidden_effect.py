"""An engine and its load that have something which the two-mass model lacks: what is it, and how large?

States   omega_eng, omega_load [rad/s], twist = theta_load - theta_eng [rad]
Inputs   theta [rad], p1..p4 [Pa], T_load [N m]        Output   omega [rad/s], crank speed alone

    casadi-engine repair problems/hidden_effect.py

The records are those of an independent simulator; what it hid is told in a file that nothing here reads.
"""

from pathlib import Path

import casadi_engine as ce

DATA = Path(__file__).resolve().parent.parent / "data" / "hidden_effect"
GEOMETRY = {"r": 0.043, "L": 0.145, "A_p": 0.0058, "m_eq": 0.7, "p_crank": 1.0e5}  # SI units


def model():
    return ce.two_mass(
        cylinders=4,
        firing_order=(1, 3, 4, 2),
        geometry=GEOMETRY,
        reciprocating_speed="model",
    )


def parameters(m):
    p = (
        m.parameters()
    )  # guesses and wide bounds: all five are estimated again with every effect that is tried
    p["J_eng"].set(0.4, min=0.05, max=4)  # kg m2
    p["J_load"].set(0.2, min=0.02, max=2)  # kg m2
    p["K_el"].set(1800, min=200, max=20_000)  # N m/rad
    p["C_el"].set(3, min=0.05, max=50)  # N m s/rad
    p["C_eng"].set(0.2, min=0.005, max=5)  # N m s/rad
    return p


def read(path):
    return ce.read_experiment(path)


def problem():
    m = model()
    return ce.Problem(
        name="hidden_effect",
        goal=__doc__,
        model=m,
        parameters=parameters(m),
        read=read,
        records=[DATA / "normal_1200rpm.csv.gz", DATA / "misfire_1200rpm.csv.gz"],
        validation=[DATA / "normal_1400rpm.csv.gz"],  # a speed that the repair has not seen
        noise=ce.Noise(omega="estimate"),
    )
