"""The engine and all it turns as one rigid inertia (thesis 2.37): its inertia and damping from crank speed.

State    omega_eng [rad/s]
Inputs   theta [rad], p1..p4 [Pa], T_load [N m]        Output   omega [rad/s]

The simplest model of the bundled records, and one that cannot explain them: they come from two inertias
with a coupling. The residual tests fail and the report shows where; problems/two_mass.py is the next step.

    casadi-engine fit problems/one_inertia.py
"""

from pathlib import Path

import casadi_engine as ce

DATA = Path(__file__).resolve().parent.parent / "data"
GEOMETRY = {"r": 0.043, "L": 0.145, "A_p": 0.0058, "m_eq": 0.7, "p_crank": 1.0e5}  # Table 4.2, SI units


def model():
    return ce.one_inertia(cylinders=4, firing_order=(1, 3, 4, 2), geometry=GEOMETRY, load="measured")


def parameters(m):
    p = m.parameters()
    p["J_eng"].set(0.5, min=0.05, max=5)  # kg m2, engine and load together
    p["C_eng"].set(0.15, min=0.005, max=5)  # N m s/rad
    return p


def read(path):
    return ce.read_experiment(path, optional=("omega_load",))


def problem():
    m = model()
    return ce.Problem(
        name="one_inertia",
        goal=__doc__,
        model=m,
        parameters=parameters(m),
        read=read,
        records=[DATA / "normal_1200rpm.csv.gz"],
        validation=[DATA / "normal_1400rpm.csv.gz"],
        noise=ce.Noise(omega="estimate"),
    )
