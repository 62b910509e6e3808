"""Null models, scores and repairs of records that are not equally spaced, and of equations that depend on time.

The truth is simulated by SciPy: a shaft on a torsion spring, with dry friction or without.
"""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.errors import EstimationError
from casadi_engine.experiment import Channel
from casadi_engine.simulation.candidate_sensitivities import torque_direction

TRUTH = {"J": 0.02, "c": 0.05, "k": 3.0}
FRICTION, SIGMA, STEP = 0.08, 0.004, 1.2345
FEW = ["coulomb_friction", "quadratic_drag", "constant_torque"]


def rotor(forcing):
    b = ce.Blueprint("rotor")
    inertia = b.parameter("J", 0.03, unit="kg m2", min=1e-4, max=1)
    damping = b.parameter("c", 0.1, unit="N m s/rad", min=0, max=5)
    stiffness = b.parameter("k", 4.0, unit="N m/rad", min=0, max=100)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    slot = b.port("shaft", "inertia", {"speed": speed})
    torque = {"none": lambda: 0, "input": lambda: b.input("T", unit="N m")}.get(forcing)
    if torque is None:
        at = b.time
        late = b.parameter("late", 1.1, unit="s", min=0.9, max=1.4) if forcing == "step" else 0
        course = ca.if_else(at > late, 1.0, -0.6) if forcing == "step" else drive(at, ca)
        applied = b.drive("T", course)
    else:
        applied = torque()
    sign = ca.sign(speed) * 0.01 if forcing == "none" else 0
    b.ode("angle", speed)
    b.ode("speed", (applied + slot - damping * speed - stiffness * angle - sign) / inertia)
    b.output("angle", angle, unit="rad")
    return b.model()


def drive(t, math=np):
    return math.sin(2 * np.pi * 0.9 * t) + 0.5 * math.cos(2 * np.pi * 2.3 * t)


def swing(torque, times, *, friction=0.0, start=(0.0, 0.0), values=TRUTH, jump=None):
    """The angle at the times (N,), by pieces where the torque jumps."""
    out, x = np.empty(len(times)), np.array(start)
    inner = [] if jump is None else [jump]
    for low, high in zip([times[0], *inner], [*inner, times[-1]], strict=True):

        def rates(t, x, middle=0.5 * (low + high)):
            own = torque(t if jump is None else middle)
            own -= values["c"] * x[1] + values["k"] * x[0] + friction * np.tanh(x[1] / 1e-3)
            return [x[1], own / values["J"]]

        inside = (times >= low) & (times <= high)
        found = solve_ivp(
            rates, (low, high), x, method="LSODA", rtol=1e-9, atol=1e-11, dense_output=True, max_step=0.02
        )
        out[inside], x = found.sol(times[inside])[0], found.y[:, -1]
    return out


def record(times, angle, *, torque=None):
    channels = [Channel("angle", unit="rad", time=times, values=angle)]
    if torque is not None:
        channels.append(Channel("T", unit="N m", time=torque[0], values=torque[1]))
    return ce.Experiment("record", tuple(channels))


def null(model, data, start, **values):
    pars = model.parameters()
    for name, value in values.items():
        pars[name].set(value)
    found = null_at(model, [data], pars, np.array(list(values.values())), {"record": np.array(start)})
    return found.records[0]


def at_times(kind):
    rng = np.random.default_rng(2)
    return np.arange(150) * 0.02 if kind == "equal" else np.sort(np.r_[0.0, 3 * rng.uniform(size=149)])


@pytest.mark.parametrize("kind", ["equal", "random"])
def test_the_instant_of_a_step_has_its_slope(kind):
    """Slopes of J, c, k, of the instant and of the start, against differences of SciPy's solutions."""
    times, start = at_times(kind), (0.1, 0.5)
    step = lambda t, late: 1.0 if t > late else -0.6  # noqa: E731
    found = null(rotor("step"), record(times, np.zeros(150)), start, **TRUTH, late=STEP)

    def angle(first=start, late=STEP, **values):
        return swing(lambda t: step(t, late), times, start=first, values={**TRUTH, **values}, jump=late)

    np.testing.assert_allclose(-found.residual["angle"], angle(), rtol=0, atol=1e-7)
    wanted = []
    for name, value in {**TRUTH, "late": STEP}.items():
        h = 1e-4 * value
        wanted.append((angle(**{name: value + h}) - angle(**{name: value - h})) / 2e-4)
    for unit in np.eye(2) * 1e-3:
        wanted.append((angle(first=start + unit) - angle(first=start - unit)) / 2e-3)
    for own, true in zip(found.slopes["angle"].T, wanted, strict=True):
        np.testing.assert_allclose(own, true, rtol=0, atol=1e-3 * np.abs(true).max())


@pytest.mark.parametrize("kind", ["equal", "random"])
def test_scores_of_a_motion_driven_by_time_are_slopes_of_its_equations(kind):
    """3 samples to a period of the drive: dy/dpsi of a torque psi cos(4 t), by linearity a swing from rest."""
    times = np.arange(60) * 0.15 if kind == "equal" else at_times(kind)
    model = rotor("drive")
    found = null(model, record(times, np.zeros(len(times))), (0.0, 0.0), **TRUTH)
    np.testing.assert_allclose(-found.residual["angle"], swing(drive, times), rtol=0, atol=1e-7)
    extra = torque_direction(model, "shaft", ca.cos(4 * model.t), name="extra")
    own = found.columns([extra])["angle"][:, 0]
    true = swing(lambda t: np.cos(4 * t), times)
    np.testing.assert_allclose(own, true, rtol=0, atol=1e-3 * np.abs(true).max())


def measured(kind):
    rng = np.random.default_rng(0)
    even = np.arange(800) * 0.01
    course = lambda t: drive(t) + 0.3 * np.sign(np.sin(2 * np.pi * 0.31 * t))  # noqa: E731
    model, given = rotor("input"), even
    if kind == "jittered":
        given = even + np.r_[0.0, 0.003 * rng.uniform(-1, 1, 799)]
    times = {"offset": 0.0043 + np.arange(480) * 0.0163, "time": np.arange(200) * 0.06}.get(kind, given)
    if kind == "time":
        model, torque, pushed = rotor("drive"), None, drive
    else:
        torque = (given, course(given))
        pushed = lambda t: np.interp(t, *torque)  # noqa: E731
    angle = swing(pushed, times, friction=FRICTION) + SIGMA * rng.standard_normal(len(times))
    if kind == "missing":
        angle[200:320] = np.nan
        angle[rng.integers(0, 800, 60)] = np.nan
    return model, record(times, angle, torque=torque)


@pytest.mark.slow  # slopes and scores of such records stand above
@pytest.mark.parametrize(
    "kind", ["missing", *(pytest.param(k, marks=pytest.mark.slow) for k in ("offset", "jittered", "time"))]
)
def test_the_friction_of_a_swing_is_found_whatever_the_samples(kind):
    model, data = measured(kind)
    found = ce.repair(model, data, noise=ce.Noise(angle=SIGMA), effects=FEW, starts=1, progress=False)
    assert found.verdict == "named"
    assert [one.key for one in found.effects] == ["shaft.coulomb_friction"]
    wanted = {**TRUTH, "shaft.coulomb_friction.torque": FRICTION}
    for name, value in wanted.items():
        estimate = found.fit.estimates[name]
        assert abs(estimate.value - value) < 3.5 * estimate.stderr, name


def test_a_jump_with_the_states_is_refused_with_its_place():
    times = np.arange(100) * 0.02
    data = record(times, np.cos(times))
    stepped = ce.Blueprint("stepped")
    speed = stepped.state("speed", unit="rad/s")
    slot = stepped.port("shaft", "inertia", {"speed": speed})
    stepped.ode("speed", slot - ca.floor(10 * speed) * stepped.parameter("loss", 0.1, unit="rad/s2", min=0))
    stepped.output("speed", speed, unit="rad/s")
    with pytest.raises(EstimationError, match=r"the ode of speed jumps at .*speed.* = a whole number"):
        ce.repair(stepped.model(), data, progress=False)
    values = {**TRUTH}
    with pytest.raises(EstimationError, match="the equations jump with the states"):
        null(rotor("none"), data, (1.0, 0.0), **values)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_effect_without_any_signal_is_scored_in_a_model_without_inputs(whole):
    """A load step in a free swing: a law of time alone."""
    b = ce.Blueprint("free")
    decay = b.parameter("decay", 1.0, unit="1/s", min=0, max=10)
    speed = b.state("speed", unit="rad/s")
    slot = b.port("shaft", "inertia", {"speed": speed})
    b.ode("speed", slot - decay * speed)
    b.output("speed", speed, unit="rad/s")
    times = np.arange(300) * 0.02
    rng = np.random.default_rng(1)
    # from 2 s on a torque of 0.5 on an inertia of 1, where a load brakes
    true = np.exp(-0.8 * times) + np.where(times > 2, 0.5 / 0.8 * (1 - np.exp(-0.8 * (times - 2))), 0.0)
    data = record(times, 0 * times)
    data = ce.Experiment(
        "free", (Channel("speed", unit="rad/s", time=times, values=true + 0.01 * rng.standard_normal(300)),)
    )
    model = b.model()
    scores = screen(
        ce.estimate(model, data, noise=ce.Noise(speed=0.01), progress=False), ["load_step", "constant_torque"]
    )
    first = scores.order[0]
    assert scores.candidates[first].effect == "load_step"
    assert scores.candidates[first].nuisance["time"] == pytest.approx(2.0, abs=0.1)
    assert scores.scores.amplitude[first] < 0
    assert scores.alarm
    if not whole:
        return
    found = ce.repair(
        model,
        data,
        noise=ce.Noise(speed=0.01),
        effects=["load_step", "constant_torque"],
        starts=1,
        progress=False,
    )
    (one,) = found.effects
    assert one.key == "shaft.load_step"
    assert one.amplitude.value == pytest.approx(-0.5, abs=4 * one.amplitude.stderr + 0.01)
