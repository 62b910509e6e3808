"""Numbers that differ from record to record and are known: held at their own values in a fit, and in its validation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.validation.held import held_on

TIME = 0.01 * np.arange(300)
KNOWN = {"cold": 0.5, "warm": 0.2}


def record(name, seed):
    """0.4 w' = T - C w by SciPy, with the C of the record."""
    run = solve_ivp(
        lambda t, w: (6 + 3 * np.sin(4 * t) - KNOWN[name] * w) / 0.4,
        (0, TIME[-1]), [10.0], t_eval=TIME, rtol=1e-9, atol=1e-9,
    )  # fmt: skip
    speed = run.y[0] + 0.02 * np.random.default_rng(seed).standard_normal(len(TIME))
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(name, time=TIME, units=units, T=6 + 3 * np.sin(4 * TIME), omega=speed)


@pytest.fixture(scope="module")
def fit():
    model = ce.one_inertia()
    pars = model.parameters()
    pars.fix("C_eng")
    pars.vary_by_experiment("C_eng", values=KNOWN)
    data = [record(name, seed) for seed, name in enumerate(KNOWN)]
    return ce.estimate(model, data, parameters=pars, noise=ce.Noise(omega=0.02), progress=False)


def test_a_fit_holds_them(fit):
    assert fit.free == ("J_eng",)
    assert {name: fit.values[f"C_eng@{name}"] for name in KNOWN} == KNOWN
    found = fit.estimates["J_eng"]
    assert abs(found.value - 0.4) < 3 * found.stderr < 1e-2
    assert fit.cost / fit.n == pytest.approx(1.0, abs=0.15)


def test_validation_holds_them_too(fit):
    held = held_on(fit, record("warm", 7), noise=ce.Noise(omega=0.02), method="exact")
    assert held.free == ()
    assert held.values["C_eng"] == 0.2
    assert held.cost / held.n == pytest.approx(1.0, abs=0.2)


def test_a_record_of_another_name_takes_the_value_of_all(fit):
    assert fit.values_for("new")["C_eng"] == fit.parameters["C_eng"].value
    assert fit.averaged_for("new") == ("C_eng",)
