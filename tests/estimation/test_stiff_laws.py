"""Friction of a light mass: its law answers faster than any explicit step between samples can follow."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation.corner_widths import paths_of
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.estimation.single_shots import SingleShots
from casadi_engine.simulation.exponential_runge_kutta import TooStiff
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

M, K, C, TAU, F, NOISE = 0.25, 4e4, 400.0, 0.4, 60.0, 3e-5


@pytest.fixture(scope="module")
def data():
    """A valve's stem, driven through an actuator that lags, by SciPy with a law far sharper than any fit's."""
    t = np.arange(0, 6, 0.01)
    u = 0.5 * (1 - np.exp(-t)) + 0.3 * np.sin(2.1 * t) + 0.1 * np.sin(5.3 * t)

    def rate(s, y):
        force, x, v = y
        return [
            (1000 * np.interp(s, t, u) - force) / TAU,
            v,
            (force - K * x - C * v - F * np.tanh(v / 2e-6)) / M,
        ]

    run = solve_ivp(rate, (0, t[-1]), [0, 0, 0], "Radau", t, rtol=1e-7, atol=1e-10, max_step=0.02)
    x = run.y[1] + np.random.default_rng(5).normal(0, NOISE, t.size)
    return ce.Experiment.from_arrays("valve", time=t, units={"u": "1", "x": "m"}, u=u, x=x)


@pytest.fixture(scope="module")
def model():
    b = ce.Blueprint("valve")
    k, tau = b.parameter("k", 3.5e4, unit="N/m", min=0), b.parameter("tau", 0.3, unit="s", min=1e-3)
    force, x, v = (
        b.state("force", unit="N", scale=1000),
        b.state("x", unit="m", scale=0.01),
        b.state("v", unit="m/s"),
    )
    u = b.input("u", unit="1")
    slot = b.port("stem", "inertia", {"speed": v, "angle": x})
    b.ode("force", (1000 * u - force) / tau)
    b.ode("x", v)
    b.ode("v", (force - k * x - C * v + slot) / M)
    b.output("x", x, unit="m")
    return b.model().with_effect(ce.effects.CoulombFriction(), at="stem", values={"torque": 50.0})


@pytest.fixture(scope="module")
def fit(model, data):
    pars = model.parameters()
    pars["stem.coulomb_friction.width"].set(3e-5)
    return ce.estimate(model, data, parameters=pars, progress=False)


def test_a_law_too_stiff_for_explicit_steps_is_fitted_by_implicit_ones(fit):
    """0.35 called the model unstable: 'a change of its start grows 1e3622 times'."""
    assert fit.converged
    (about,) = fit.integration.values()
    assert about.integrator.startswith("implicit Radau")
    assert about.shift < 0.02
    ((sigma, _),) = fit.noise.values()
    assert sigma == pytest.approx(NOISE, rel=0.1)
    for name, truth in {"k": K, "tau": TAU, "stem.coulomb_friction.torque": F}.items():
        found = fit.parameters[name].value
        assert found == pytest.approx(truth, rel=0.02), name


def test_what_such_a_fit_is_judged_along_is_its_own_simulation(fit, data):
    """Explicit steps leap to and fro across the corner, where slopes are zero, and look stable."""
    (path,) = paths_of(fit)
    x = np.interp(data["x"].time, path.grid.time, path.x[1])
    assert np.std(x - data["x"].values) == pytest.approx(NOISE, rel=0.1)


def test_steps_that_no_explicit_scheme_can_take_are_refused(fit):
    pars = fit.parameters.copy()
    problem = RefitProblem(fit.model, fit.data, pars, levels={"x": NOISE})
    (record,) = problem.records
    v = problem.coordinates.of(np.array([fit.parameters[n].value for n in problem.pmap.free]))
    rest = np.zeros((record.plan.m, record.n))
    with pytest.raises(TooStiff, match="faster than the shortest integration steps"):
        record.evaluate(v, rest)
    assert record.stiff
    assert record.step_in_places()
    assert isinstance(record.propagator, RungeKuttaPropagator)
    assert not record.stiff
    assert np.isfinite(record.evaluate(v, rest).r).all()


def test_states_of_a_refit_with_other_intervals_are_simulated_anew(fit):
    """Stribeck friction beside dry friction at a door's hinge: a rival's refit had cut the record otherwise."""
    first = {"valve": {name: e.value for name, e in fit.initial["valve"].items()}}
    values = {name: fit.parameters[name].value for name in fit.free}
    problem = RefitProblem(fit.model, fit.data, fit.parameters, levels={"x": NOISE}, interval=20)
    problem.step_in_places()
    other = SimpleNamespace(nodes=[np.zeros((7, 3))], values=values, initial=first)
    (nodes,) = problem.nodes_of(other)
    assert nodes.shape == (problem.records[0].plan.m, 3)
    np.testing.assert_allclose(nodes[0] * problem.records[0].scale, list(first["valve"].values()))
    same = SimpleNamespace(nodes=[nodes], values=values, initial=first)
    assert problem.nodes_of(same)[0] is nodes


def test_a_fresh_record_is_judged_by_the_same_steps(fit, data):
    """Its parameters, too: "could not be fitted to the fresh data" stood in a note below PASSED."""
    shots = SingleShots(fit.model, (data,), fit.parameters, ce.Noise(x=NOISE))
    first = {"valve": np.array([e.value for e in fit.initial["valve"].values()])}
    x = shots.start({name: fit.parameters[name].value for name in shots.free}, first)
    residuals, slopes = shots.evaluate(x)
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(NOISE, rel=0.1)
    np.testing.assert_allclose(shots.residuals(x), residuals, atol=1e-3 * NOISE)
    k = shots.free.index("stem.coulomb_friction.torque")
    step = np.zeros(len(x))
    step[k] = 1e-4
    foretold = (shots.residuals(x + step) - shots.residuals(x - step)) / 2e-4
    assert np.linalg.norm(slopes[:, k] - foretold) < 0.02 * np.linalg.norm(foretold)


def test_a_law_whose_steps_leave_all_numbers_is_followed_by_shorter_ones():
    # at one step to a sample the drag is eleven times as stiff as an explicit step can follow, and overflows
    b = ce.Blueprint("lung")
    e = b.parameter("E", 25.98, unit="mbar/L", min=2, max=200)
    r = b.parameter("R", 6.4, unit="mbar s/L", min=0, max=200)
    flow, volume = b.state("F", unit="L/s", scale=0.5), b.state("V", unit="L", scale=0.5)
    pressure = b.input("P", unit="mbar")
    tube = b.port("tube", "inertia", {"speed": flow})
    b.ode(
        "F", (pressure - e * volume - r * flow + tube) / b.parameter("I", 0.035, unit="mbar s2/L", vary=False)
    )
    b.ode("V", flow)
    b.output("flow", 60 * flow, unit="L/min")
    t = np.arange(0, 8, 0.02)
    given = np.interp(t, [0.3, 0.42, 1.5, 1.62, 4, 4.12, 5, 5.12], [0, 20, 20, 0, 0, 14, 14, 0])

    def rate(now, z):
        loss = 6.5 * z[0] + 9 * abs(z[0]) * z[0]
        return [(np.interp(now, t, given) - 26 * z[1] - loss) / 0.035, z[0]]

    z = solve_ivp(rate, t[[0, -1]], [0, 0], t_eval=t, method="Radau", rtol=1e-9, atol=1e-11, max_step=0.02).y
    seen = 60 * z[0] + 0.8 * np.random.default_rng(0).standard_normal(len(t))
    data = ce.Experiment.from_arrays(
        "breath", time=t, units={"P": "mbar", "flow": "L/min"}, P=given, flow=seen
    )
    drag = ce.effects.library("quadratic_drag")[0]
    model = b.model().with_effect(drag, at="tube", values={"coefficient": 9.12})
    fit = ce.estimate(model, data, progress=False)
    assert fit.status == "converged"
    for name, value in {"E": 26.0, "R": 6.5, "tube.quadratic_drag.coefficient": 9.0}.items():
        assert abs(fit.values[name] - value) < 4 * fit.stderr[name]
