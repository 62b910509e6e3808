"""Errors that count with coloured noise where a parameter rests on a bound that another one may make up for."""

import numpy as np
import pytest
from scipy import signal, stats

import casadi_engine as ce

J1, J2, K, D, B = 0.22, 2.6, 800.0, 3.0, 0.25
STEP, SAMPLES = 0.01, 800


def driveline():
    b = ce.Blueprint("driveline")
    start = {"J1": 0.25, "J2": 2.4, "k": 700.0, "d": 2.5, "b": 0.2, "be": 0.02}
    p = {name: b.parameter(name, value, min=0) for name, value in start.items()}
    w1, w2, twist = (b.state(name) for name in ("w1", "w2", "twist"))
    torque = b.input("T")
    shaft = p["k"] * twist + p["d"] * (w1 - w2)
    b.ode("w1", (torque - p["be"] * w1 - shaft) / p["J1"])
    b.ode("w2", (shaft - p["b"] * w2) / p["J2"])
    b.ode("twist", w1 - w2)
    b.output("n1", w1)
    b.output("n2", w2)
    return b.model()


def records(draws):
    """Runs from rest by exact discretisation of SciPy; without friction at the first inertia, whose reading is
    coloured."""
    rng = np.random.default_rng(11)
    time = np.arange(SAMPLES) * STEP
    torque = np.repeat(rng.uniform(-40, 90, SAMPLES // 40), 40)
    a = [[-D / J1, D / J1, -K / J1], [D / J2, -(D + B) / J2, K / J2], [1, -1, 0]]
    system = signal.StateSpace(a, [[1 / J1], [0], [0]], [[1, 0, 0], [0, 1, 0]], [[0], [0]])
    clean = signal.dlsim(system.to_discrete(STEP, method="zoh"), torque)[1]
    for _ in range(draws):
        white = rng.standard_normal((SAMPLES + 200, 2))
        coloured = signal.lfilter([0.6], [1, -0.8], white[:, 0])[200:]
        yield ce.Experiment.from_arrays(
            "run", time=time, units={"T": "1", "n1": "1", "n2": "1"}, hold={"T": "zero"}, T=torque,
            n1=clean[:, 0] + 0.3 * coloured, n2=clean[:, 1] + 0.3 * white[200:, 1],
        )  # fmt: skip


@pytest.mark.parametrize("draws", [4, pytest.param(60, marks=pytest.mark.slow)])
def test_errors_are_those_of_many_draws(draws):
    """The colour counted the errors of what may make up for the bound as if the outputs moved with them: up to 1e34
    times."""
    resting = 0
    off = {"J1": [], "J2": [], "k": []}
    for record in records(draws):
        fit = ce.estimate(driveline(), record, progress=False)
        resting += fit.estimates["be"].at_bound == "min"
        for name, truth in (("J1", J1), ("J2", J2), ("k", K)):
            one = fit.estimates[name]
            error = one.stderr or one.quadratic
            off[name].append((one.value - truth) / error)
    assert resting > 0
    low, high = stats.chi2.ppf([0.0005, 0.9995], draws)
    for name, errors in off.items():
        assert low < np.sum(np.square(errors)) < high, name
