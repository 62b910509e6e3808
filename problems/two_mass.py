"""Two-mass engine-load setup (thesis 4.1): inertias, coupling and engine damping from crank speed.

States   omega_eng, omega_load [rad/s], twist = theta_load - theta_eng [rad]
Inputs   theta [rad], p1..p4 [Pa], T_load [N m]        Output   omega [rad/s] (omega_load may be there)

    casadi-engine fit problems/two_mass.py
"""

from pathlib import Path

import casadi_engine as ce

DATA = Path(__file__).resolve().parent.parent / "data"
GEOMETRY = {"r": 0.043, "L": 0.145, "A_p": 0.0058, "m_eq": 0.7, "p_crank": 1.0e5}  # Table 4.2, SI units


def model():
    return ce.two_mass(
        cylinders=4,
        firing_order=(1, 3, 4, 2),
        geometry=GEOMETRY,
        reciprocating_speed="model",  # "measured": the thesis's linear form (4.3), channel omega as input
    )


def parameters(m):
    p = m.parameters()  # the defaults are Table 4.1; a fit starts from these values
    p["J_eng"].set(0.39, min=0.05, max=4)  # kg m2
    p["J_load"].set(0.18, min=0.02, max=2)  # kg m2
    p["K_el"].set(2000, min=200, max=20_000)  # N m/rad
    p["C_el"].set(2.5, min=0.05, max=50)  # N m s/rad
    p["C_eng"].set(0.15, min=0.005, max=5)  # N m s/rad
    return p


def read(path):
    # Pressures that were shifted from p1 and p2, not measured: add assumed=("p3", "p4").
    return ce.read_experiment(path, optional=("omega_load",))


def problem():
    m = model()
    return ce.Problem(
        name="two_mass",
        goal=__doc__,
        model=m,
        parameters=parameters(m),
        read=read,
        records=[DATA / "normal_1200rpm.csv.gz", DATA / "misfire_1200rpm.csv.gz"],
        validation=[DATA / "normal_1400rpm.csv.gz"],
        noise=ce.Noise(omega="estimate"),
    )
