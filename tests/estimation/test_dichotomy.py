"""A machine that a controller balances: its model alone falls over, and its parameters have errors all the same."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import casadi_engine as ce
from casadi_engine.estimation.dichotomy import eliminated, grows
from casadi_engine.estimation.single_shots import evaluator
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.estimation.uncertainty import chained_information, invert

GRAVITY, DAMPER, STEP, SIGMA = 9.0, 0.4, 0.02, 0.002
STARTS = (0.05, 0.0)


def _drive(time, state):
    """A controller's torque, held for a step of it."""
    return -30.0 * state[0] - 6.0 * state[1] + 0.5 * np.sin(3.0 * time)


def _balanced(duration, seed, sharp=False):
    """A rod held upright: angle'' = 9 sin(angle) - 0.4 angle' + torque, between samples by SciPy."""
    time = np.arange(0.0, duration, STEP)
    x, torque = np.zeros((len(time), 2)), np.zeros(len(time))
    x[0] = STARTS
    a = np.array([[0.0, 1.0, 0.0], [GRAVITY, -DAMPER, 1.0], [0.0, 0.0, 0.0]])
    move = expm(a * STEP)
    for k in range(len(time)):
        torque[k] = _drive(time[k], x[k])
        if k + 1 == len(time):
            break
        if sharp:
            x[k + 1] = move[:2] @ np.append(x[k], torque[k])
            continue

        def slope(t, y, u=torque[k]):
            del t
            return [y[1], GRAVITY * np.sin(y[0]) - DAMPER * y[1] + u]

        x[k + 1] = solve_ivp(slope, (0, STEP), x[k], rtol=1e-10, atol=1e-12).y[:, -1]
    noise = SIGMA * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        "rod",
        time=time,
        units={"torque": "N m", "angle": "rad"},
        hold={"torque": "zero"},
        inputs=("torque",),
        torque=torque,
        angle=x[:, 0] + noise,
    )


def _model(*, linear=False):
    import casadi as ca

    b = ce.Blueprint("rod")
    gravity = b.parameter("gravity", 7.0, unit="s-2", min=1, max=30)
    damper = b.parameter("damper", 0.2, unit="s-1", min=0, max=5)
    torque = b.input("torque", unit="N m")
    angle, speed = b.state("angle", unit="rad", scale=0.1), b.state("speed", unit="rad/s")
    b.ode("angle", speed)
    b.ode("speed", gravity * (angle if linear else ca.sin(angle)) - damper * speed + torque)
    b.output("angle", angle, unit="rad")
    return b.model()


@pytest.mark.parametrize("duration", [3.0, 12.0])
def test_its_errors_are_right_however_long_the_record(duration):
    """Changes of the start grow 1e4 and 1e15 times; eight fits, two parameters and two states in their errors."""
    apart = []
    for seed in range(8):
        fit = ce.estimate(_model(), _balanced(duration, seed), noise=ce.Noise(angle=SIGMA), progress=False)
        assert fit.converged
        truth = {"gravity": GRAVITY, "damper": DAMPER}
        apart.append([(fit.values[name] - value) / fit.stderr[name] for name, value in truth.items()])
        first = fit.initial["rod"]
        apart[-1] += [
            (first[name].value - value) / first[name].stderr
            for name, value in zip(("angle", "speed"), STARTS, strict=True)
        ]
    spread = np.sqrt(np.mean(np.square(apart)))
    assert 0.6 < spread < 1.4  # 32 numbers, of which half go together
    assert any("grows" in words for words in fit.messages)
    assert (fit.followed is not None) == (duration > 10)


def test_a_linear_model_that_falls_over_says_what_its_errors_leave_out():
    fit = ce.estimate(
        _model(linear=True), _balanced(6.0, 0, sharp=True), noise=ce.Noise(angle=SIGMA), progress=False
    )
    assert fit.converged
    assert any("with white noise, and were not checked" in words for words in fit.messages)
    for name, value in (("gravity", GRAVITY), ("damper", DAMPER)):
        assert abs(fit.values[name] - value) < 4 * fit.stderr[name] < value


def test_taken_out_states_leave_the_information_of_the_chain():
    """Where slopes can still be chained, both ways give the same covariance."""
    search = evaluator(_model(), [_balanced(1.5, 0)], _model().parameters(), ce.Noise(angle=SIGMA))
    record = search.records[0].again(gain=None, length=10)
    record.set_sigma(np.array([SIGMA]))
    v = search.coordinates.of(np.array([GRAVITY, DAMPER]))
    point = record.evaluate(v, chained_nodes(record, v, np.array(STARTS) / record.scale))
    assert not grows(record, point)
    chained = chained_information(record, point, record.gauss_newton(point))
    for kept in (np.array([False, False]), np.array([True, False])):
        found = eliminated(record, point, kept, np.zeros_like(point.r))
        own, turn = found.information, found.turn
        found = turn @ invert(own, np.zeros(4, dtype=bool), np.zeros((0, 4))).matrix @ turn.T
        np.testing.assert_allclose(found, np.linalg.inv(chained), rtol=1e-6)


def test_a_state_that_no_output_tells_is_not_taken_out():
    b = ce.Blueprint("two")
    rate = b.parameter("rate", 1.0, unit="1/s")
    seen, hidden = b.state("seen", unit="1"), b.state("hidden", unit="1")
    b.ode("seen", rate * seen**2)
    b.ode("hidden", hidden)
    b.output("y", seen, unit="1")
    model = b.model()
    time = np.linspace(0, 0.5, 50)
    record = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=1 / (1 - time))
    search = evaluator(model, [record], model.parameters(), ce.Noise(y=0.1))
    term = search.records[0].again(gain=None, length=10)
    term.set_sigma(np.array([0.1]))
    v = search.coordinates.of(np.array([1.0]))
    point = term.evaluate(v, chained_nodes(term, v, np.array([1.0, 1.0])))
    assert eliminated(term, point, np.array([False, False]), np.zeros_like(point.r)) is None
