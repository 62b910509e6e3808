"""How many inertias does a record ask for? The crankshaft lumped to 2, 3 and 5, and whole with 7, by their evidence.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/inertia_count.py [--dof N] [--seed N] [--plot FILE]

--dof : of the model that the record is simulated with, 7 (independent simulator of the study) or 3 (the package's own),
noise 0.1 rad/s. Inertias, stiffnesses and sums that the lumped models have in their place are free within a factor 1.5
of their values, flat in the logarithm, with the ties of the thesis; the load's inertia and shaft are known.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from ours import experiments, model_of, parameters_of  # noqa: E402
from posterior_study import drawn  # noqa: E402

import casadi_engine as ce  # noqa: E402
from casadi_engine.errors import PosteriorError  # noqa: E402
from casadi_engine.model.reduction import reduce  # noqa: E402
from casadi_engine.posterior import Comparison, Posterior, compare  # noqa: E402

COUNTS, WIDTH, SIGMA, LOAD = (2, 3, 5, 7), 1.5, 0.1, ("J7", "K76")


def problem(dof: int, seed: int) -> tuple[ce.Model, ce.Parameters, ce.Experiment]:
    """The full model with its parameters, and a record of so many inertias."""
    case, _ = drawn("B", seed)
    full, names = model_of(case)
    pars = parameters_of(case, full, names, case.true_values)
    (record,) = experiments(case)
    if dof == 7:
        return full, pars, record
    lumped = reduce(full, dof=dof, parameters=values(full, pars)).model
    start = {state.name: 125.7 * state.name.startswith("omega") for state in lumped.states}
    speed = ce.simulate(lumped, record, initial=start)["omega"].values
    noisy = speed + SIGMA * np.random.default_rng([17, seed]).standard_normal(len(speed))
    return full, pars, record.with_channel(replace(record["omega"], values=noisy))


def values(full: ce.Model, pars: ce.Parameters) -> dict[str, float]:
    """Name -> value of the model's parameters."""
    return {name: pars[name].value for name in full.parameter_names}


def fit_of(dof: int, full: ce.Model, pars: ce.Parameters, record: ce.Experiment) -> ce.Fit:
    """With so many inertias. Two and three are sums that stand for themselves, as the record tells no more."""
    model, own = full, pars.copy()
    if dof < 7:
        lumped = reduce(full, dof=dof, parameters=values(full, pars))
        model, own = lumped.model, lumped.parameters(own) if dof > 3 else lumped.model.parameters()
    for name in own:
        if own[name].tie is None and own[name].vary and name[0] in "JK" and name not in LOAD:
            value = own[name].value
            own[name].set(value, min=value / WIDTH, max=value * WIDTH)
        elif own[name].tie is None:
            own.fix(name)
    return ce.estimate(model, record, parameters=own, noise=ce.Noise(omega=SIGMA), progress=False)


def posterior_of(dof: int, full: ce.Model, pars: ce.Parameters, record: ce.Experiment) -> Posterior:
    """Of the model with so many inertias."""
    return ce.posterior(fit_of(dof, full, pars, record))


def counted(dof: int, seed: int = 0, counts: Sequence[int] = COUNTS) -> tuple[Comparison, dict[str, str]]:
    """The models by their evidence, for a record of so many inertias, and why some have none that can be trusted."""
    made, found, refused = problem(dof, seed), {}, {}
    for count in counts:
        try:
            found[f"{count} inertias"] = posterior_of(count, *made)
        except PosteriorError as error:
            refused[f"{count} inertias"] = str(error)
    return compare(found), refused


def main() -> None:
    """Print the comparison, and draw it if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dof", type=int, choices=(3, 7), default=7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path)
    asked = parser.parse_args()
    begun = time.process_time()
    found, refused = counted(asked.dof, asked.seed)
    print(found, *(f"{name}: {why}" for name, why in refused.items()), sep="\n")
    print(f"{time.process_time() - begun:.0f} s CPU")
    if asked.plot:
        ce.plot(found, path=asked.plot)


if __name__ == "__main__":
    main()
