"""The null model of a fit is made once, and goes with the fit."""

import gc
import weakref

import casadi
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.null_model import null_model, refuse_jumps
from casadi_engine.errors import EstimationError


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


@pytest.mark.parametrize(("law", "jumps"), [(casadi.fmax, False), (lambda x, _: casadi.sign(x), True)])
def test_a_lag_of_a_sensor_whose_output_has_a_corner_is_no_jump_of_the_model(law, jumps):
    """The lag is driven by the output's rate, which jumps at a corner, and acts on nothing else; what the equations do
    themselves counts."""
    b = ce.Blueprint("diode")
    current = b.state("i")
    b.ode("i", b.input("u") - (law(current, 0) if jumps else current))
    b.output("light", casadi.fmax(current, 0.2))
    model = b.model().with_effect(ce.effects.SensorLag(), at="sensor_light")
    if jumps:
        with pytest.raises(EstimationError, match="the ode of i jumps"):
            refuse_jumps(model)
    else:
        refuse_jumps(model)
