"""Parameters of effects that have no bounds: the data end their posterior, or it is refused."""

from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import PosteriorError
from casadi_engine.posterior.open_ends import REACH, check_ends, with_ends


@pytest.fixture(scope="module")
def with_torque(run_up):
    """A fit of a run-up with a constant torque, which may have either sign."""
    model = ce.one_inertia()
    at = next(port.name for port in model.ports if port.kind == "inertia")
    model = model.with_effect(ce.effects.ConstantTorque(), at=at)
    pars = model.parameters()
    pars.fix("C_eng", 0.5)
    return ce.estimate(model, run_up(), parameters=pars, noise=ce.Noise(omega=0.02), progress=False), at


def test_an_effect_of_either_sign_has_a_posterior(with_torque):
    fit, at = with_torque
    name = f"{at}.constant_torque.torque"
    assert fit.parameters[name].min == -np.inf
    found = ce.posterior(fit)
    assert found[name].mean() == pytest.approx(fit.values[name], abs=0.2 * fit.stderr[name])
    assert found[name].std() == pytest.approx(fit.stderr[name], rel=0.1)
    assert "flat in the value" in found.priors[name]


def test_ends_are_far_beyond_what_is_drawn(with_torque):
    fit, at = with_torque
    name = f"{at}.constant_torque.torque"
    pars, within = with_ends(fit)
    reach = REACH * fit.stderr[name]
    assert (pars[name].min, pars[name].max) == pytest.approx(
        (fit.values[name] - reach, fit.values[name] + reach)
    )
    assert list(within) == [name]
    assert fit.parameters[name].max == np.inf
    assert pars["J_eng"].max == fit.parameters["J_eng"].max


def test_draws_that_come_near_an_end_are_refused():
    fit = SimpleNamespace(values={"a": 1.0})
    check_ends(fit, {"a": 2.0}, ("b", "a"), np.array([[9.0, 2.5], [9.0, -0.5]]))
    with pytest.raises(PosteriorError, match=r"do not bound a parameter.*seen: a: draws as far as 3 from 1"):
        check_ends(fit, {"a": 2.0}, ("b", "a"), np.array([[9.0, 2.5], [9.0, -2.0]]))
