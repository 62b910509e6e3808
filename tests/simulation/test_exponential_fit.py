"""A fit through the exponential integrator: friction and a cubic spring found in a simulated record."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

import casadi_engine as ce
from casadi_engine.model.declarations import ParameterDeclaration

SIGMA = 0.1


def with_joint_laws(model):
    """Smooth Coulomb friction and a cubic stiffness in the coupling."""
    port = model.ports["coupling"]
    row = [other.name for other in model.ports.with_slot].index("coupling")
    friction, cubic = ca.SX.sym("T_c"), ca.SX.sym("K3")
    laws = ca.densify(model.laws)
    laws[row] = (
        friction * ca.tanh(port.signals["twist_rate"] / 0.2) + 1e5 * cubic * port.signals["twist"] ** 3
    )
    declared = (
        ParameterDeclaration("T_c", 1.0, "N m", 0.0, 50.0, True, "friction"),
        ParameterDeclaration("K3", 1.0, "N m/rad3", 0.0, 50.0, True, "cubic stiffness / 1e5"),
    )
    return replace(
        model,
        laws=laws,
        p=ca.vertcat(model.p, friction, cubic),
        declarations=(*model.declarations, *declared),
    )


def record(model, truth, rng):
    step, count = 1e-3, 1500
    t = step * np.arange(count)
    channels = {"theta": 126 * t, "omega": np.full(count, 126.0)}
    for k in range(4):
        channels[f"p{k + 1}"] = 1e5 + 2e6 * np.maximum(np.sin(63 * t - np.pi * k / 2), 0) ** 8
    channels["T_load"] = 57 + 25 * np.sign(np.sin(9 * t))
    units = {v.name: v.unit for v in model.inputs}
    noise = SIGMA * rng.normal(size=count)
    start = {"omega_eng": 126.0, "omega_load": 126.0, "twist": -57 / 1992}
    # The reciprocating torque is made of the measured speed, in the fit as here: measure again until it is that one.
    for _ in range(8):
        inputs = ce.Experiment.from_arrays(
            "run", time=t, units=units, **{name: channels[name] for name in units}
        )
        run = ce.simulate(model, inputs, parameters=truth, initial=start)
        before, channels["omega"] = channels["omega"], run["omega"].values + noise
    assert np.abs(channels["omega"] - before).max() < 1e-9
    return run.with_channel(replace(run["omega"], values=channels["omega"], origin="measured"))


def test_a_fit_finds_the_laws_parameters_within_their_errors():
    model = with_joint_laws(ce.two_mass(reciprocating_speed="measured"))
    truth = {"T_c": 6.0, "K3": 4.0}
    data = record(model, truth, np.random.default_rng(3))
    parameters = model.parameters()
    parameters.fix("C_el")
    fit = ce.estimate(model, data, parameters=parameters, noise=ce.Noise(omega=SIGMA), progress=False)
    assert fit.converged
    values = dict(zip(model.parameter_names, model.parameter_vector(truth), strict=True))
    for name in ("J_eng", "J_load", "K_el", "C_eng", "T_c", "K3"):
        found, error = fit.estimates[name].value, fit.estimates[name].stderr
        assert abs(found - values[name]) < 4 * error
        assert error < 0.5 * values[name]
    assert abs(fit.cost / 1500 - 1) < 0.1
