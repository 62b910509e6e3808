"""Switches that are flat at 0, that set each other off, that are passed twice within a step, and corners at rest."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce


def last(rates, time, start, *, inputs=None):
    """(n,) states at the end."""
    b = ce.Blueprint("small")
    x = [b.state(f"x{k}") for k in range(len(start))]
    u = [b.input(name) for name in inputs or {}]
    for k, rate in enumerate(rates(b.time, x, u)):
        b.ode(f"x{k}", rate)
        b.output(f"y{k}", x[k])
    columns = inputs or {"y0": np.full(len(time), np.nan)}
    data = ce.Experiment.from_arrays("r", time=time, units=dict.fromkeys(columns, "1"), **columns)
    run = ce.simulate(b.model(), data, initial={f"x{k}": v for k, v in enumerate(start)})
    return np.array([run[f"y{k}"].values[-1] for k in range(len(start))])


FLAT = {
    "sign": lambda u: ca.sign(ca.fmax(u - 0.75, 0)),
    "above": lambda u: ca.if_else(ca.fmax(u - 0.75, 0) > 0, 1, 0),
    "equal": lambda u: ca.if_else(ca.fmax(u - 0.75, 0) == 0, 0, 1),
}


@pytest.mark.parametrize("kind", FLAT)
def test_a_switch_that_is_flat_at_zero_goes_off_again(kind):
    """x' = switch - x, on while the input is above 0.75: pieces of exponentials."""
    time = np.arange(0, 4.01, 0.1)
    u = np.interp(time, [0, 1.33, 2.66, 4.1], [0, 1.5, -1.5, 0])
    found = last(lambda t, x, u: [FLAT[kind](u[0]) - x[0]], time, [0.2], inputs={"u": u})
    fine = np.linspace(0, 4, 4_000_001)
    on = np.interp(fine, time, u) > 0.75
    begin, end = fine[on][0], fine[on][-1]
    x = 0.2 * np.exp(-begin)
    x = 1 + (x - 1) * np.exp(-(end - begin))
    np.testing.assert_allclose(found, x * np.exp(-(4 - end)), atol=3e-6)


def test_a_carrier_and_its_comparator_jump_together():
    time = np.linspace(0, 3, 31)

    def pulses(t, x, u):
        return [ca.if_else(t - ca.floor(t) < 0.37, 1, 0) - x[0]]

    x = 0.0
    for _ in range(3):
        x = (1 + (x - 1) * np.exp(-0.37)) * np.exp(-0.63)
    np.testing.assert_allclose(last(pulses, time, [0.0]), x, rtol=1e-9)


@pytest.mark.parametrize(
    ("rate", "time", "truth"),
    [
        (lambda t: ca.sign(ca.sin(2 * np.pi * t / 0.3)), np.arange(0, 10.0, 1.0), 0.0),
        (lambda t: ca.floor(t / 0.3), np.arange(0, 11.0, 2.0), 0.3 * sum(range(33)) + 33 * 0.1),
        (
            lambda t: ca.if_else(t > 3.7001, 1000, 0) * ca.if_else(t < 3.7003, 1, 0),
            np.arange(0, 11.0, 2.0),
            0.2,
        ),
    ],
    ids=["square wave", "stairs", "short pulse"],
)
def test_what_switches_between_two_samples_is_met(rate, time, truth):
    found = last(lambda t, x, u: [rate(t)], time, [0.0])
    np.testing.assert_allclose(found, truth, atol=1e-9 * max(abs(truth), 1))


def test_what_has_always_been_at_rest_is_set_in_motion_by_a_corner():
    """x' = max(u - 0.75, 0) - x with u = t: x = t - 1.75 + exp(0.75 - t) from 0.75 s on."""
    time = np.arange(0, 2, 0.1)
    found = last(lambda t, x, u: [ca.fmax(u[0] - 0.75, 0) - x[0]], time, [0.0], inputs={"u": time})
    np.testing.assert_allclose(found, 1.9 - 1.75 + np.exp(0.75 - 1.9), rtol=1e-7)


def test_a_tank_runs_empty_and_stays_so():
    time = np.linspace(0, 3, 31)
    found = last(lambda t, x, u: [-ca.sqrt(ca.fmax(x[0], 0))], time, [1.0])
    assert abs(found[0]) < 1e-6


# End of the block [mm] by its start [mm/s]: parabolas damped by air, held in between, by SciPy from event to event.
BLOCK = {0.0: 46.1465995, 20.0: 46.2290948}


@pytest.mark.parametrize(
    ("scale", "start"),
    # held from the start by a switch that cannot be 0 to the last digit: a million steps, a minute
    [
        (1.0, 0.0),
        *(pytest.param(scale, 0.0, marks=pytest.mark.slow) for scale in (1000.0, 3.6)),
        (1.0, 20.0),
        (3.6, 20.0),
    ],
)
def test_friction_does_not_depend_on_how_its_switch_is_scaled(scale, start):
    """A block on dry friction pulled by a spring, in mm: it sticks and slips."""
    time = np.arange(0, 2, 0.02)

    def block(t, x, u):
        force = 300 * (0.03 * t - x[0] / 1e3) - 4 * ca.sign(x[1] / scale) - 0.5 * x[1] / 1e3
        return [x[1], force / 2 * 1e3]

    np.testing.assert_allclose(last(block, time, [0.0, start])[0], BLOCK[start], rtol=2e-9)


def test_two_bodies_that_are_held_from_the_start():
    time = np.arange(0, 5.0, 1.0)
    found = last(lambda t, x, u: [-ca.sign(x[0]) - 0.2 * ca.sign(x[1]), -ca.sign(x[1])], time, [0.0, 0.0])
    np.testing.assert_array_equal(found, 0.0)
