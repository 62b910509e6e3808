"""Symbols stand where they may be used, and a fault says what to write instead."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import candidate, library
from casadi_engine.errors import ModelError
from casadi_engine.simulation.candidate_sensitivities import grid_sensitivities, slot_direction
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.null_path import null_path

TIME = np.arange(600) * 0.02
FORCE = 4 * np.sin(2.1 * TIME) + 3 * np.sin(5.3 * TIME)
M, K, C, DRAG, CUBIC = 2.0, 40.0, 0.6, 0.5, 30.0
START = [0.3, 0.2]


def cart():
    """A cart on a spring, of which an accelerometer shows the acceleration, with what a port adds."""
    b = ce.Blueprint("cart")
    m = b.parameter("m", M, unit="kg", vary=False)
    k, c = b.parameter("k", 30.0, unit="N/m", min=1), b.parameter("c", 0.4, unit="N s/m", min=0)
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    acting = b.input("F", unit="N") - k * x - c * v
    acting += b.port("body", "inertia", {"speed": v}) - b.port(
        "spring", "coupling", {"twist": x, "twist_rate": v}
    )
    b.ode("x", v)
    b.ode("v", acting / m)
    b.output("acc", acting / m, unit="m/s2")
    return b.model()


def shown(drag=DRAG, cubic=0.0, push=0.0, time=TIME, force=FORCE):
    """The acceleration (N,) by SciPy."""

    def acting(t, x):
        acts = np.interp(t, time, force) + push - K * x[0] - C * x[1]
        return (acts - drag * x[1] * abs(x[1]) - cubic * x[0] ** 3) / M

    run = solve_ivp(
        lambda t, x: [x[1], acting(t, x)], (0, time[-1]), START, t_eval=time, rtol=1e-10, atol=1e-11, max_step=0.02
    ).y  # fmt: skip
    return np.array([acting(t, x) for t, x in zip(time, run.T, strict=True)])


def run(name, y, time=TIME, force=FORCE):
    return ce.Experiment.from_arrays(name, time=time, units={"F": "N", "acc": "m/s2"}, F=force, acc=y)


def test_an_accelerometer_shows_what_effects_add():
    model = cart().with_effect(library("quadratic_drag")[0], at="body", values={"coefficient": DRAG})
    record = ce.Experiment.from_arrays("r", time=TIME, units={"F": "N"}, F=FORCE)
    found = ce.simulate(
        model, record, parameters={"k": K, "c": C}, initial=dict(zip("xv", START, strict=True))
    )
    np.testing.assert_allclose(found["acc"].values, shown(), atol=2e-4)


@pytest.mark.parametrize("effect", ["constant_torque", "cubic_stiffness"])
def test_an_accelerometer_feels_a_further_effect_at_once_and_by_its_motion(effect):
    """The slopes to an amplitude, beside a law that is there, are the differences of an independent simulation."""
    model = cart().with_effect(library("quadratic_drag")[0], at="body", values={"coefficient": DRAG})
    p = model.parameter_vector({"k": K, "c": C})
    path = null_path(model, lay_grid(model, run("r", np.zeros(600))), p, np.array(START))
    made = candidate(model, library(effect)[0], "body" if effect == "constant_torque" else "spring")
    direction = slot_direction(made.model, made.slots, name=effect, drives=made.drives, outputs=made.outputs)
    found = grid_sensitivities(path, [direction])[0, 0]
    step = 1e-3
    name = "push" if effect == "constant_torque" else "cubic"
    more, less = (shown(**{name: h}) for h in (step, -step))
    wanted = (more - less) / (2 * step)
    assert np.abs(found - wanted).max() < 5e-3 * np.abs(wanted).max()


def test_what_hides_behind_an_accelerometer_is_named():
    """Its output had to be a state: the commonest sensor of a rig could not be written as it is."""
    rng = np.random.default_rng(5)
    fresh = 5 * np.sin(1.4 * TIME) + 2 * np.sin(6.1 * TIME)
    data = run("a", shown(0.0, CUBIC) + 0.02 * rng.standard_normal(600))
    other = run("b", shown(0.0, CUBIC, force=fresh) + 0.02 * rng.standard_normal(600), force=fresh)
    names = ["cubic_stiffness", "quadratic_drag", "sensor_gain"]
    found = ce.repair(cart(), data, fresh=other, effects=names, progress=False)
    (one,) = found.effects
    assert (one.key, found.verdict, found.confirmed) == ("spring.cubic_stiffness", "named", True)
    assert one.amplitude.value == pytest.approx(CUBIC, abs=4 * one.amplitude.stderr)


def test_a_symbol_of_another_place_is_told():
    b = ce.Blueprint("cart")
    v = b.state("v", unit="m/s")
    b.ode("v", -v)
    b.output("v", v + ca.SX.sym("other"), unit="m/s")
    with pytest.raises(ModelError, match="the output v uses a symbol that was not declared; seen: other"):
        b.model()
