"""Two masses in the linear form and one record: the problem file that `whole_processes.py` times."""

from pathlib import Path

import casadi_engine as ce

START = {"J_eng": 0.5, "J_load": 0.2, "K_el": 1500.0, "C_el": 3.0, "C_eng": 0.2}


def problem():
    model = ce.two_mass(reciprocating_speed="measured")
    parameters = model.parameters()
    for name, value in START.items():
        parameters[name].set(value, min=value / 50, max=50 * value)
    record = Path(__file__).resolve().parents[2] / "data" / "misfire_1200rpm.csv.gz"
    return ce.Problem(
        name="one_record",
        goal=__doc__,
        model=model,
        parameters=parameters,
        read=lambda path: ce.read_experiment(path, optional=("omega_load",)),
        records=[record],
        noise=ce.Noise(omega="estimate"),
    )
