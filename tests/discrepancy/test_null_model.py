"""The null model of a fit is made once, and goes with the fit."""

import gc
import weakref

import numpy as np

import casadi_engine as ce
from casadi_engine.discrepancy.null_model import null_model


def fitted():
    t = np.arange(300) * 0.01
    torque = 2 * np.sin(3 * t)
    plain = ce.Experiment.from_arrays("swing", time=t, units={"T": "N m"}, T=torque)
    speed = ce.simulate(ce.one_inertia(), plain, initial={"omega_eng": 0.0})["omega"].values
    speed = speed + 0.01 * np.random.default_rng(0).standard_normal(len(t))
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays("swing", time=t, units=units, T=torque, omega=speed)
    return ce.estimate(ce.one_inertia(), data, progress=False)


def test_a_null_model_is_made_once_and_released_with_its_fit():
    fit, other = fitted(), fitted()
    null = null_model(fit)
    assert null_model(fit) is null
    assert null_model(other) is not null
    seen = weakref.ref(null)
    del fit, null
    gc.collect()
    assert seen() is None
