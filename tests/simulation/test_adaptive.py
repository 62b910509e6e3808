"""Simulation of what jumps, sticks, is stiff or cannot be simulated, through ``ce.simulate``."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj

import casadi_engine as ce
from casadi_engine.errors import SimulationError

EVERY_TENTH = np.linspace(0, 4, 41)


def simulated(rates, time, start, *, inputs=None, hold="first", **options):
    """States (n, N) and the record of a model whose ``rates`` (t, x list, u list) are the equations."""
    b = ce.Blueprint("small")
    x = [b.state(f"x{k}") for k in range(len(start))]
    u = [b.input(name) for name in inputs or {}]
    for k, rate in enumerate(rates(b.time, x, u)):
        b.ode(f"x{k}", rate)
        b.output(f"y{k}", x[k])
    columns = inputs or {"y0": np.zeros(len(time))}
    data = ce.Experiment.from_arrays(
        "r", time=np.asarray(time, dtype=float), units=dict.fromkeys(columns, "1"), hold=hold, **columns
    )
    run = ce.simulate(b.model(), data, initial={f"x{k}": v for k, v in enumerate(start)}, **options)
    return np.array([run[f"y{k}"].values for k in range(len(start))]), run


def within(found, wanted, share=1e-6):
    """Each row within a share of its largest value."""
    wanted = np.atleast_2d(wanted)
    worst = np.abs(found - wanted).max(axis=1) / np.maximum(np.abs(wanted).max(axis=1), 1e-30)
    assert (worst < share).all(), worst


# ---- dry friction


def rest_and_start(t):
    """From 3 rad/s down to rest at 0.75 s; the torque 2 (t - 1) passes the friction of 2 at 2 s."""
    return np.where(t < 0.75, 3 - 4 * t, 0) + np.where(t > 2, 2 * (t - 2) ** 2, 0)


@pytest.mark.parametrize(
    "friction",
    [
        lambda w: 2 * ca.sign(w),
        lambda w: ca.if_else(w > 0, 2, -2),
        lambda w: ca.if_else(w > 0, 2, ca.if_else(w < 0, -2, 0)),
        lambda w: ca.if_else(w >= 0, 2, 0) - ca.if_else(w < 0, 2, 0),
    ],
)
def test_a_shaft_stops_is_held_and_starts_again(friction):
    torque = np.interp(EVERY_TENTH, [0, 1, 4], [0, 0, 6])
    found, run = simulated(
        lambda t, x, u: [(u[0] - friction(x[0])) / 0.5], EVERY_TENTH, [3.0], inputs={"T": torque}
    )
    within(found, rest_and_start(EVERY_TENTH))
    rest = (EVERY_TENTH > 0.76) & (EVERY_TENTH < 1.99)
    assert np.abs(found[0][rest]).max() < 1e-12  # held, without any creep
    assert "events" in run.history[-1].arguments["integrator"]


@pytest.mark.parametrize("level", [1.9, -1.9])
def test_a_torque_below_breakaway_moves_nothing(level):
    found, _ = simulated(
        lambda t, x, u: [(u[0] - 2 * ca.sign(x[0])) / 0.5],
        EVERY_TENTH,
        [0.0],
        inputs={"T": np.full(41, level)},
    )
    assert np.abs(found).max() < 1e-12


def test_a_swing_with_dry_friction_loses_the_same_at_each_turn():
    t = np.linspace(0, 20, 90)
    found, _ = simulated(lambda t, x, u: [x[1], -x[0] - 0.5 * ca.sign(x[1])], t, [5.3, 0.0])
    half = np.minimum(np.floor(t / np.pi), 5)
    amplitude, side = 5.3 - half, np.where(half % 2, -1.0, 1.0)
    moving = side * (0.5 + (amplitude - 0.5) * np.cos(t - half * np.pi))
    speed = -side * (amplitude - 0.5) * np.sin(t - half * np.pi)
    # at the fifth turn the spring no longer overcomes the friction
    within(found, [np.where(half < 5, moving, -0.3), np.where(half < 5, speed, 0.0)])


def test_friction_beside_other_friction_sticks_to_the_body_that_moves():
    """Two bodies that rub: momentum is kept, they come together at 1 s and stay together."""
    t = np.linspace(0, 2, 21)
    found, _ = simulated(
        lambda t, x, u: [-3 * ca.sign(x[0] - x[1]) / 1.0, 3 * ca.sign(x[0] - x[1]) / 3.0], t, [4.0, 0.0]
    )
    within(found, [np.where(t < 1, 4 - 3 * t, 1.0), np.where(t < 1, t, 1.0)])


# ---- a belt that a block sticks to and slips on

_BELT, _STIFF = 0.4, 5.0


def kinetic(slip):
    return 1.0 / (1 + 2 * abs(slip)) + 0.2


def by_hand(time):
    """The block on the belt by SciPy, one piece after the other: sticking until the spring overcomes 1.2, slipping
    until it moves with the belt."""
    t, x, sticks = 0.0, np.array([0.0, _BELT]), True
    found = np.empty((2, len(time)))
    tight = {"rtol": 1e-11, "atol": 1e-12}
    while t < time[-1]:
        if sticks:
            after = t + (1.2 / _STIFF - x[0]) / _BELT
            here = (time >= t) & (time <= after)
            found[:, here] = [x[0] + _BELT * (time[here] - t), np.full(here.sum(), _BELT)]
            t, x, sticks = after, np.array([1.2 / _STIFF, _BELT]), False
            continue

        def slips(now, s):
            return [s[1], -_STIFF * s[0] + kinetic(_BELT - s[1])]

        def together(now, s):
            return s[1] - _BELT

        together.terminal, together.direction = True, 1
        run = solve_ivp(slips, (t, t + 20), x, events=together, dense_output=True, **tight)
        after = run.t[-1]
        here = (time >= t) & (time <= after)
        found[:, here] = run.sol(time[here])
        t, x, sticks = after, np.array([run.y[0, -1], _BELT]), True
    return found


def test_a_block_on_a_belt_sticks_and_slips():
    time = np.linspace(0, 12, 150)

    def rates(t, x, u):
        slip = _BELT - x[1]
        return [x[1], -_STIFF * x[0] + ca.sign(slip) * (1 / (1 + 2 * ca.fabs(slip)) + 0.2)]

    found, run = simulated(rates, time, [0.0, _BELT])
    within(found, by_hand(time), 5e-6)
    assert "events" in run.history[-1].arguments["integrator"]


# ---- end stops and backlash


@pytest.mark.parametrize(
    "stop",
    [
        lambda x: ca.fmax(x - 0.5, 0) + ca.fmin(x + 0.5, 0),
        lambda x: ca.if_else(x > 0.5, x - 0.5, ca.if_else(x < -0.5, x + 0.5, 0)),
        lambda x: ca.sign(x) * ca.fmax(ca.fabs(x) - 0.5, 0),
    ],
)
def test_a_ball_between_two_springy_stops(stop):
    t = np.linspace(0, 6, 61)
    found, _ = simulated(lambda t, x, u: [x[1], -100 * stop(x[0])], t, [0.0, 1.0])
    contact = np.pi / 10
    turn = np.floor((t + 0.5) / (1 + contact))
    inside = (t + 0.5) - turn * (1 + contact)  # from -0.5 at the speed 1, then the stop
    side = np.where(turn % 2, -1.0, 1.0)
    flies = inside < 1
    x = np.where(flies, -0.5 + inside, 0.5 + np.sin(10 * (inside - 1)) / 10)
    v = np.where(flies, 1.0, np.cos(10 * (inside - 1)))
    within(found, [side * x, side * v])


# ---- jumps in time


def test_a_step_between_two_samples():
    t = np.linspace(0, 2, 21)
    found, run = simulated(lambda t, x, u: [ca.if_else(t > 0.537, 2, 0) - x[0]], t, [0.0])
    within(found, 2 * (1 - np.exp(-np.maximum(t - 0.537, 0))))
    assert ", 1 event" in run.history[-1].arguments["integrator"]


def test_stairs_in_time():
    t = np.linspace(0, 3, 14)
    found, _ = simulated(lambda t, x, u: [ca.floor(t / 0.3)], t, [0.0])
    steps = 0.3 * np.arange(1, 11)
    within(found, np.maximum(t[:, None] - steps, 0).sum(axis=1))


def test_a_square_wave_in_time():
    t = np.linspace(0, 3.1, 23)
    found, _ = simulated(lambda t, x, u: [ca.sign(ca.sin(2 * np.pi * t / 0.8))], t, [0.0])
    within(found, 0.4 - np.abs(t % 0.8 - 0.4))


def test_a_switch_of_a_recorded_channel_is_met_on_its_line():
    """The channel passes 0.3 between two samples."""
    t = np.linspace(0, 1, 6)
    found, _ = simulated(lambda t, x, u: [ca.if_else(u[0] > 0.3, 1, 0)], t, [0.0], inputs={"u": t})
    within(found, np.maximum(t - 0.3, 0))


def test_a_held_channel_jumps_at_its_samples():
    t = np.linspace(0, 1, 11)
    level = np.where(np.arange(11) < 4, 1.0, -1.0)
    found, _ = simulated(
        lambda t, x, u: [ca.sign(u[0]) - 1e-9 * x[0] ** 2], t, [0.0], inputs={"u": level}, hold="zero"
    )
    within(found, 0.4 - np.abs(t - 0.4))


# ---- stiff, and impossible


def test_van_der_pol_that_is_stiff():
    t = np.linspace(0, 900, 46)  # the jump is at 807 s

    def rate(t, x, u=None):
        return [x[1], 1000 * (1 - x[0] ** 2) * x[1] - x[0]]

    found, run = simulated(rate, t, [2.0, 0.0])
    true = solve_ivp(rate, (0, 900), [2.0, 0.0], method="Radau", t_eval=t, rtol=1e-9, atol=1e-11)
    within(found[:1], true.y[:1], 1e-5)
    assert "CVODES" in run.history[-1].arguments["integrator"]


def test_a_coil_far_faster_than_its_samples():
    """L di/dt = u - i - 0.1 i³ with 1e-5 s, sampled at 10 ms: the current follows the voltage."""
    t = np.linspace(0, 0.5, 51)
    u = 1 + 0.5 * np.sin(20 * t)
    found, _ = simulated(lambda t, x, u: [(u[0] - x[0] - 0.1 * x[0] ** 3) / 1e-5], t, [0.0], inputs={"u": u})
    # the lag of 1e-5 s beside the rise of a piece of the channel
    rise = np.concatenate([[0.0], np.diff(u) / 0.01])
    still = np.array([np.roots([0.1, 0, 1, -level])[-1].real for level in u])
    late = still - rise * 1e-5 / (1 + 0.3 * still**2) ** 2
    within(found[:, 1:], late[1:])


def test_equations_that_are_stiff_at_a_corner_are_stiff_no_longer_behind_it():
    """Friction over 1e-5 of the speed sticks for a while and slides on: CVODES would begin anew at every sample."""
    t = np.linspace(0, 1.4, 281)
    force = 1.5 * np.sin(2 * t)

    def rate(now, x, u):
        return [u[0] - 0.1 * x[0] - ca.tanh(x[0] / 1e-5)]

    found, run = simulated(rate, t, [0.0], inputs={"u": force})

    def slides(now, x):
        return [1.5 * np.sin(2 * now) - 0.1 * x[0] - 1]

    begin = 0.5 * np.arcsin(1 / 1.5)
    true = solve_ivp(slides, (begin, 1.4), [0.0], t_eval=t[t > begin], rtol=1e-10, atol=1e-12)
    within(found[:, t > begin], true.y, 3e-4)  # the corner, and the force by lines between samples
    assert "CVODES" not in run.history[-1].arguments["integrator"]


def test_a_state_that_grows_without_limit_names_the_time():
    t = np.linspace(0, 2, 21)
    with pytest.raises(SimulationError, match=r"the simulation is not finite; seen: at (1|0\.9999\d*) s"):
        simulated(lambda t, x, u: [x[0] ** 2], t, [1.0])


def test_a_chaotic_motion_for_too_long_is_refused_with_its_cause():
    def lorenz(t, x, u):
        return [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]]

    with pytest.raises(SimulationError) as refused:
        simulated(lorenz, np.linspace(0, 60, 301), [1.0, 1.0, 1.0])
    assert "does not reach its tolerance" in str(refused.value)
    assert "a chaotic motion forgets its start" in str(refused.value)


def test_a_chaotic_motion_is_simulated_as_long_as_it_can_be():
    def lorenz(t, x, u=None):
        return [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]]

    t = np.linspace(0, 10, 101)
    found, _ = simulated(lorenz, t, [1.0, 1.0, 1.0])
    within(found, solve_ivp(lorenz, (0, 10), [1.0] * 3, method="DOP853", t_eval=t, rtol=1e-13, atol=1e-13).y)


# ---- tolerance and history


def duffing(t, x, u):
    return [x[1], -x[0] - x[0] ** 3]


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_the_error_is_within_the_tolerance_and_what_is_said_is_no_less(tolerance):
    """Duffing's swing has a closed form: 20 cn(w t)."""
    t, w = np.linspace(0, 10, 61), np.sqrt(401.0)
    found, run = simulated(duffing, t, [20.0, 0.0], tolerance=tolerance)
    sn, cn, dn, _ = ellipj(w * t, 200 / 401)
    true = np.array([20 * cn, -20 * w * sn * dn])
    off = np.abs(found - true).max(axis=1) / np.abs(true).max(axis=1)
    assert (off < tolerance).all()
    said = run.history[-1].arguments
    assert said["integrator"] == "explicit steps of order 8 that follow the error"
    assert said["tolerance"] == tolerance
    assert off[0] < max(3 * said["relative"]["y0"], 1e-11)
    assert said["relative"]["y0"] < tolerance


def test_tighter_takes_more_steps():
    counts = []
    for tolerance in (1e-4, 1e-8):
        run = simulated(duffing, np.linspace(0, 5, 11), [20.0, 0.0], tolerance=tolerance)[1]
        counts.append(run.history[-1].arguments["steps"])
    assert counts[1] > 1.5 * counts[0]
