"""A belt axis whose play and dry friction are written as they are: found from values a third off, errors included.

The truth is SciPy's, from event to event: a motor, a belt with play, a carriage with friction that holds it at rest.
"""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation import rounded_start
from casadi_engine.estimation.rounded_start import rounded_refit

RADIUS, DRAG, BELT = 0.02, 2e-3, 30.0  # m, N m s/rad, N s/m
TRUE = {"J": 2e-3, "k": 4e4, "play": 2e-3, "m": 4.0, "F": 12.0}
HALF = TRUE["play"] / 2
LEVELS = {"speed": 0.2, "position": 2e-5}


def torque(time):
    return 0.9 * np.sin(2 * np.pi * 1.3 * time) + 0.5 * np.sin(2 * np.pi * 3.1 * time + 1)


def stretch(s):
    return RADIUS * s[0] - s[2]


def pull(s, side):
    """The belt's force where it is pulled to one side (1 or -1), or hangs in its play (0)."""
    drawn = TRUE["k"] * (stretch(s) - side * TRUE["play"] / 2) + BELT * (RADIUS * s[1] - s[3])
    return drawn if side else 0.0


def event(function, direction):
    def found(_, s):
        return function(s)

    found.terminal, found.direction = True, direction
    return found


def simulated(time, drive):
    """States (N, 4): angle, speed, position and velocity, from rest."""
    state, now, side, way = np.zeros(4), 0.0, 0, 0  # way : the carriage's direction, 0 at rest
    found = np.zeros((len(time), 4))
    while now < time[-1]:

        def slope(t, s, side=side, way=way):
            force = pull(s, side)
            turned = (np.interp(t, time, drive) - DRAG * s[1] - RADIUS * force) / TRUE["J"]
            return [s[1], turned, s[3], (force - way * TRUE["F"]) / TRUE["m"] if way else 0.0]

        edges = [side] if side else [1, -1]  # out of the play, or back into it
        events = [event(lambda s, e=e: stretch(s) - e * HALF, -e if side else e) for e in edges]
        if way:
            events.append(event(lambda s: s[3], -way))
        else:
            events.append(event(lambda s, side=side: abs(pull(s, side)) - TRUE["F"], 1))
        run = solve_ivp(
            slope,
            (now, time[-1]),
            state,
            events=events,
            rtol=1e-9,
            atol=1e-11,
            max_step=0.02,
            dense_output=True,
        )
        here = (time >= now) & (time <= run.t[-1])
        if here.any():
            found[here] = run.sol(time[here]).T
        now, state = run.t[-1], run.y[:, -1].copy()
        which = next((k for k, instants in enumerate(run.t_events) if len(instants)), None)
        if which is None:
            break
        if which < len(edges):
            side = 0 if side else edges[which]
        force = pull(state, side)
        if which == len(edges) or not way:  # at rest it stays while friction can hold it
            way = int(np.sign(force)) if abs(force) >= TRUE["F"] * (1 - 1e-9) else 0
            state[3] = way * 1e-12
    return found


@pytest.fixture(scope="module")
def record():
    time = np.arange(1001) / 1000
    states = simulated(time, torque(time))
    rng = np.random.default_rng(1)
    noise = {name: sigma * rng.standard_normal(len(time)) for name, sigma in LEVELS.items()}
    return ce.Experiment.from_arrays(
        "run", time=time, units={"T": "N m", "speed": "rad/s", "position": "m"}, hold="first", T=torque(time),
        speed=states[:, 1] + noise["speed"], position=states[:, 2] + noise["position"],
    )  # fmt: skip


@pytest.fixture(scope="module")
def axis():
    b = ce.Blueprint("belt_axis")
    inertia = b.parameter("J", 1.5e-3, unit="kg m2", min=1e-4, max=0.1)
    stiff = b.parameter("k", 3e4, unit="N/m", min=1e3, max=1e6)
    play = b.parameter("play", 1.2e-3, unit="m", min=1e-5, max=1e-2)
    mass = b.parameter("m", 3.2, unit="kg", min=0.1, max=100)
    friction = b.parameter("F", 9.0, unit="N", min=0.1, max=100)
    angle, speed = b.state("phi", unit="rad"), b.state("w", unit="rad/s", scale=10.0)
    place, velocity = b.state("x", unit="m", scale=0.02), b.state("v", unit="m/s", scale=0.2)
    drawn = RADIUS * angle - place
    force = ca.if_else(
        ca.fabs(drawn) < play / 2,
        0.0,
        stiff * (drawn - ca.sign(drawn) * play / 2) + BELT * (RADIUS * speed - velocity),
    )
    b.ode("phi", speed)
    b.ode("w", (b.input("T", unit="N m") - DRAG * speed - RADIUS * force) / inertia)
    b.ode("x", velocity)
    b.ode("v", (force - friction * ca.sign(velocity)) / mass)
    b.output("speed", speed, unit="rad/s")
    b.output("position", place, unit="m")
    return b.model()


@pytest.mark.slow
def test_play_and_friction_are_found_within_their_errors(axis, record):
    fit = ce.estimate(axis, record, noise=ce.Noise(**LEVELS), progress=False)
    assert fit.converged
    assert 0.9 < fit.cost / fit.n < 1.1
    for name, truth in TRUE.items():
        found = fit.estimates[name]
        assert found.stderr < 0.01 * truth, name
        assert abs(found.value - truth) < 4 * found.stderr, name


def test_a_refit_over_longer_windows_that_is_lost_is_left_alone(axis, monkeypatch):
    """The whole record is fitted from the last good one; of what fails there is none."""
    costs, calls = iter([100.0, 300.0, 1500.0, 7.0]), []

    class Problem:
        records = (
            SimpleNamespace(grid=SimpleNamespace(samples=100, step=0.01), plan=SimpleNamespace(length=8)),
        )

        def __init__(self, *_, **__):
            pass

        def measured_paths(self, start):
            return []

        def run(self, *, start, horizons, **_):
            calls.append((start["J"], horizons))
            return SimpleNamespace(cost=next(costs), values={"J": float(len(calls))}, initial={})

    monkeypatch.setattr(rounded_start, "RefitProblem", Problem)
    monkeypatch.setattr(rounded_start, "_passes", lambda *_: ({}, 6))
    found = rounded_refit(axis, (), axis.parameters(), LEVELS, {"J": 0.0})
    assert found.cost == 7.0
    assert calls == [(0.0, (0.16,)), (1.0, (0.32,)), (2.0, (0.32,)), (2.0, (None,))]
    costs = iter([np.inf])
    assert rounded_refit(axis, (), axis.parameters(), LEVELS, {"J": 0.0}) is None


def test_equations_without_jumps_have_no_corners_to_round(record):
    model = ce.one_inertia()
    assert rounded_refit(model, (record,), model.parameters(), LEVELS, {}) is None
