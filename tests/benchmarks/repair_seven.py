"""The time of a whole repair of the crankshaft with seven inertias, with an effect hidden or with none.

The record is problem B's, 14 400 samples of the linear form; where an effect is hidden it is made again by the package
with the effect in the model, so that it tells the time alone and nothing of the truth of what is found.

    OPENBLAS_NUM_THREADS=1 PYTHONPATH=. python tests/benchmarks/repair_seven.py drag

none, drag (of the dynamometer), coulomb (in the last coupling) or misfire (of cylinder 2 in cycle 4).
"""

import sys
import time

import numpy as np
import ours
from cases import case_b

import casadi_engine as ce

SIGMA = 0.1
# Simulations of a record until its speed is that of its own torques.
TIMES = 4
HIDDEN = {
    "drag": (ce.effects.QuadraticDrag, "inertia_7", {"coefficient": 5e-4}),
    "coulomb": (ce.effects.CoulombFriction, "coupling_76", {"torque": 8.0}),
    "misfire": (ce.effects.Misfire, "cylinder_2", {"lost": 0.1, "first": 4, "last": 4}),
}


def record(model, parameters, given, kind):
    """The record with an effect hidden: simulated at the optimum of the model without it, with noise of its own."""
    if kind == "none":
        return given
    effect, at, values = HIDDEN[kind]
    fit = ce.estimate(model, given, parameters=parameters, noise=ce.Noise(omega=SIGMA), progress=False)
    plant = model.with_effect(effect(), at=at, values=values)
    first = {name: one.value for name, one in fit.initial[given.name].items()}
    known = {**plant.parameters().as_dict(), **fit.values}
    noise = SIGMA * np.random.default_rng(0).standard_normal(len(given["omega"].values))
    units = {name: str(given[name].unit) for name in given.names}
    made = given
    for _ in range(
        TIMES
    ):  # the torques of the gas and the masses are those at the speed that the record holds
        run = ce.simulate(plant, made, parameters=known, initial=first)
        columns = {name: given[name].values for name in given.names} | {"omega": run["omega"].values + noise}
        made = ce.Experiment.from_arrays("record", time=given["omega"].time, units=units, **columns)
    return made


def loop_time():
    """CPU time [s] of 3e6 additions: how fast the machine is just now."""
    begun, total = time.process_time(), 0
    for k in range(3_000_000):
        total += k
    return time.process_time() - begun


def main(kind):
    case = case_b()
    model, names = ours.model_of(case)
    parameters = ours.parameters_of(case, model, names, case.start(0))
    data = record(model, parameters, ours.experiments(case)[0], kind)
    print(f"3e6 additions {loop_time():.2f} s", flush=True)
    begun = time.process_time()

    def tell(text):
        print(f"{time.process_time() - begun:7.1f} s  {text}", flush=True)

    noise = ce.Noise(omega=SIGMA)
    found = ce.repair(model, data, parameters=parameters, noise=noise, starts=2, neighbours=1, progress=tell)
    tell("end")
    print(f"3e6 additions {loop_time():.2f} s", found, found.timing, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "drag")
