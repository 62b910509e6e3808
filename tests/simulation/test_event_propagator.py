"""Sensitivities through events and corners, beside differences of SciPy's solutions from event to event."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.simulation.event_propagator import EventPropagator
from casadi_engine.simulation.grid import lay_grid
from casadi_engine.simulation.intervals import cut

PUSH, TIME = -1.5, np.linspace(0, 4, 33)
VALUES = {"friction": 0.1, "rate": 5.0, "clearance": 1.0}


def slide():
    """A mass on a spring, pushed against dry friction and a stop: a jump and a corner."""
    b = ce.Blueprint("slide")
    friction, rate, clearance = (b.parameter(name, value) for name, value in VALUES.items())
    x, v = b.state("x"), b.state("v")
    b.ode("x", v)
    b.ode("v", PUSH - x - friction * ca.sign(v) + rate * ca.fmax(-x - clearance, 0))
    b.output("y", x)
    return b.model()


def by_scipy(start, friction, rate, clearance):
    """(33, 2) states; at each turn the friction changes its side, for what pushes is larger."""

    def turns(_, state, side):
        return state[1]

    def touches(_, state, side):
        return state[0] + clearance

    turns.terminal = touches.terminal = True
    found, t, state = np.empty((len(TIME), 2)), 0.0, np.array(start)
    inside = start[0] < -clearance  # from where the stop pushes back
    side = 1.0 if inside else -1.0
    while t < TIME[-1]:

        def rates(_, s, side, inside=inside):
            push = PUSH - s[0] - friction * side + (rate * (-s[0] - clearance) if inside else 0.0)
            return [s[1], push]

        left = np.unique([t, *TIME[t < TIME]])
        turns.direction, touches.direction = -side, 1.0 if inside else -1.0
        run = solve_ivp(
            rates, (t, TIME[-1]), state, args=(side,), method="DOP853", t_eval=left, events=(turns, touches),
            rtol=1e-13, atol=1e-13,
        )  # fmt: skip
        for moment, row in zip(run.t, run.y.T, strict=True):
            found[np.isclose(TIME, moment, rtol=0, atol=1e-14)] = row
        if run.status == 0:
            break
        met = 0 if len(run.t_events[0]) else 1
        t, state = float(run.t_events[met][0]), run.y_events[met][0].copy()
        if met == 0:
            side, state[1] = -side, 0.0
        else:
            inside = not inside
    return found


# At rest the sensitivities to the stop are 0 until it is touched: they jump from nothing.
@pytest.mark.parametrize("start", [(0.0, 0.0), (-2.0, 0.0), (-0.5, -0.5)], ids=["rest", "in it", "moving"])
@pytest.mark.parametrize("finer", [False, True])
def test_sensitivities_through_a_jump_and_a_corner(start, finer):
    model = slide()
    data = ce.Experiment.from_arrays("r", units={"time": "s", "y": "1"}, time=TIME, y=0 * TIME)
    grid, z = lay_grid(model, data), ca.SX.sym("z", 3)
    propagator = EventPropagator(model, grid, cut(grid, None), z, z, scale=np.ones(2))
    propagator = propagator.finer(2).finer(2).finer(2) if finer else propagator
    values = np.array(list(VALUES.values()))
    path = propagator.propagate(values, np.array([start]))
    truth = by_scipy(start, *values)
    limit = 1e-10 if finer else 1e-6
    np.testing.assert_allclose(path.x[: len(TIME), :, 0], truth, atol=limit)
    for k, size in enumerate(1e-4 * np.eye(3)):
        ahead, behind = by_scipy(start, *(values + size)), by_scipy(start, *(values - size))
        slope = (ahead - behind) / 2e-4
        np.testing.assert_allclose(path.s[: len(TIME), 0, :, 2 + k], slope, atol=2e-5)
        assert np.abs(slope).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("start", [(0.0, 0.0), (-0.5, -0.5), (-2.0, 0.0)])
def test_a_pair_of_sharp_laws_is_fitted_from_where_it_can_be_simulated(start):
    """The start values are the true ones: what can be simulated with them can be fitted with them."""
    model = slide()
    data = ce.Experiment.from_arrays("r", units={"time": "s", "y": "1"}, time=TIME, y=0 * TIME)
    at = dict(zip(("x", "v"), start, strict=True))
    made = ce.simulate(model, data, parameters=model.parameters(), initial=at)
    fit = ce.estimate(model, made, noise=ce.Noise(y=0.01), initial=at, progress=False)
    assert fit.converged
    for name, value in VALUES.items():
        assert fit.parameters[name].value == pytest.approx(value, rel=1e-6)
