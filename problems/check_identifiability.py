"""Can the five parameters of the two masses be told, in principle and from one record with a misfiring cylinder?

States   omega_eng, omega_load [rad/s], twist = theta_load - theta_eng [rad]
Drives   T_1..T_4 (cylinders), T_load [N m]        Output   omega [rad/s], the engine's speed alone

    python problems/check_identifiability.py                    verdict, remedies, expected errors, profiles
    python problems/check_identifiability.py --inputs zero      another experiment: ask, and see what is lost
    python problems/check_identifiability.py --check            end with exit code 1 if a parameter is lost

It prints one screen and writes result.json and report.html (with the profiles) into
results/check_identifiability-identify. To ask about your own system, copy this page and change model, parameters
and record; what you write after the file's name comes on top of ASK. A question without data takes 0.1 s:
leave the record and "--profiles" out.
"""

import sys
from pathlib import Path

import casadi_engine as ce

DATA = Path(__file__).resolve().parent.parent / "data"
ASK = [
    *("--inputs", "generic"),  # constant, zero, unknown; or each: T_load=unknown,*=generic
    *("--start", "free"),  # known, rest; or each: twist=rest,*=free
    *("--outputs", "omega"),  # a state is a further sensor: omega,omega_load
    *("--combination", "K_el/J_eng"),  # told even where its parts are not?
    "--profiles",  # fit the record, and follow the cost along each parameter (20 s)
]


def model():
    return ce.two_mass(reciprocating_speed="measured")


def problem():
    m = model()
    return ce.Problem(
        name="check_identifiability",
        goal=__doc__,
        model=m,
        parameters=m.parameters(),  # all five free; m.parameters().fix("J_load") asks without one
        records=[DATA / "misfire_1200rpm.csv.gz"],
        noise=ce.Noise(omega="estimate"),
    )


if __name__ == "__main__":
    from casadi_engine.cli import main

    sys.exit(main(["identify", __file__, *ASK, *sys.argv[1:]]))
