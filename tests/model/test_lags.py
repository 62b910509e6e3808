"""Late sensors: lags of whole samples near a delay, and a law that holds the rest in whatever order effects came."""

import copy
import itertools
import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import SensorDelay, SensorGain, SensorOffset, ViscousFriction
from casadi_engine.model.lags import delays, lagged, nearest_lags, with_delays, with_nearest_lags
from casadi_engine.model.parcel import pack, unpack

STEP, DELAY, OTHER = 0.01, "sensor_y.sensor_delay.delay", "sensor_z.sensor_delay.delay"
INERTIA, DAMPING = 0.4, 0.5


def rotor(outputs=1):
    """J dw/dt = 2 u - c w: the rate of its speed shows the channel u, and so has a rate of its own."""
    b = ce.Blueprint("rotor")
    u = b.input("u", unit="N m")
    inertia = b.parameter("J", INERTIA, unit="kg m2")
    damping = b.parameter("c", DAMPING, unit="N m s/rad")
    w = b.state("w", unit="rad/s")
    shaft = b.port("shaft", "inertia", {"speed": w})
    b.ode("w", (2 * u - damping * w + shaft) / inertia)
    for name in ("y", "z")[:outputs]:
        b.output(name, w, unit="rad/s")
    return b.model()


def late(outputs=1):
    model = rotor(outputs)
    for name in ("y", "z")[:outputs]:
        model = model.with_effect(SensorDelay(), at=f"sensor_{name}")
    return model


def record(name="run", *, hold="first", step=STEP, count=101, **steps):
    """A torque and outputs, each sampled at a step of its own."""
    time = step * np.arange(count)
    made = {"u": (time, np.sin(time))}
    for channel, own in steps.items():
        at = own * np.arange(round(time[-1] / own) + 1)
        made[channel] = (at, np.cos(at))
    units = {"u": "N m", "y": "rad/s", "z": "rad/s"}
    return ce.Experiment.from_arrays(
        name, units={channel: units[channel] for channel in made}, hold={"u": hold}, **made
    )


def closed(model, **values):
    """The closed outputs in numbers; channels, rates and parameters by name."""
    given = dict.fromkeys(model.parameter_names, 0.0) | {"J": INERTIA, "c": DAMPING} | values
    symbols = [model.x, model.u, model.t, model.p]
    found = ca.Function("g", symbols, [model.closed_outputs])
    numbers = [[given[s.name()] for s in ca.vertsplit(one)] for one in (model.x, model.u)]
    return found(*numbers, 0.3, [given[name] for name in model.parameter_names]).full().ravel()


# ---- which outputs are late, and by how much


def test_the_delays_of_a_model_are_told_by_output():
    assert delays(rotor(2)) == {}
    assert delays(rotor().with_effect(SensorOffset(), at="sensor_y")) == {}
    assert delays(rotor(2).with_effect(SensorDelay(), at="sensor_z")) == {"z": OTHER}
    assert delays(late(2)) == {"y": DELAY, "z": OTHER}


@pytest.mark.parametrize(
    ("delay", "steps"),
    [(0.1, 10), (0.1049, 10), (0.1051, 11), (0.0059, 0), (0.0061, 1), (-0.043, -4), (0.0, 0)],
)
def test_a_lag_is_the_nearest_whole_number_of_steps(delay, steps):
    found = nearest_lags(late(), {DELAY: delay}, [record(y=STEP)])
    assert found == {"y": pytest.approx(steps * STEP, abs=1e-12)}


@pytest.mark.parametrize(("delay", "steps"), [(0.1059, 10), (0.0941, 10), (0.1061, 11), (0.0939, 9)])
def test_a_lag_is_kept_while_the_delay_is_near_it(delay, steps):
    """So that a delay between two samples settles at one of them."""
    model = lagged(late(), {"y": 10 * STEP})
    assert nearest_lags(model, {DELAY: delay}, [record(y=STEP)])["y"] == pytest.approx(steps * STEP)


@pytest.mark.parametrize("delay", np.linspace(-0.05, 0.05, 41).tolist())
@pytest.mark.parametrize("hold", ["first", "zero"])
def test_what_is_left_of_a_delay_is_a_part_of_a_step(delay, hold):
    """Where an input jumps and then holds, on the side that looks ahead; and a lag that was chosen is chosen again."""
    data, model = [record(hold=hold, y=STEP)], late()
    lag = nearest_lags(model, {DELAY: delay}, data)["y"]
    low, high = (-1.1, 0.1) if hold == "zero" else (-0.6, 0.6)
    assert low - 1e-9 <= (delay - lag) / STEP <= high + 1e-9
    again = with_nearest_lags(model, {DELAY: delay}, data)
    assert nearest_lags(again, {DELAY: delay}, data)["y"] == lag
    assert with_nearest_lags(again, {DELAY: delay}, data) is again


def test_one_input_that_is_held_in_one_record_is_enough_to_look_ahead():
    both = [record("a", y=STEP), record("b", hold="zero", y=STEP)]
    assert nearest_lags(late(), {DELAY: 0.103}, both[:1])["y"] == pytest.approx(0.10)
    assert nearest_lags(late(), {DELAY: 0.103}, both)["y"] == pytest.approx(0.11)
    # another channel that is held is no input
    stair = ce.Experiment.from_arrays(
        "c", time=np.arange(101) * STEP, units={"u": "N m", "y": "rad/s"}, hold={"u": "first", "y": "zero"},
        u=np.zeros(101), y=np.zeros(101),
    )  # fmt: skip
    assert nearest_lags(late(), {DELAY: 0.103}, [stair])["y"] == pytest.approx(0.10)


@pytest.mark.parametrize(("delay", "sign"), [(7.0, 1), (1e12, 1), (-7.0, -1), (-1e12, -1)])
def test_a_lag_leaves_half_of_the_longest_record_and_a_tenth_of_the_shortest(delay, sign):
    long, short = record("a", y=STEP, count=801), record("b", y=STEP, count=101)
    assert nearest_lags(late(), {DELAY: delay}, [long])["y"] == pytest.approx(sign * 400 * STEP)
    assert nearest_lags(late(), {DELAY: delay}, [long, short])["y"] == pytest.approx(sign * 90 * STEP)
    # a simulation has nothing to leave
    assert nearest_lags(late(), {DELAY: delay}, [short], most=math.inf)["y"] == pytest.approx(delay)


def test_several_records_take_whole_steps_of_the_slowest():
    data = [record("a", step=0.01, y=0.01), record("b", step=0.04, y=0.04), record("c", step=0.02, y=0.02)]
    assert nearest_lags(late(), {DELAY: 0.074}, data)["y"] == pytest.approx(0.08)
    assert nearest_lags(late(), {DELAY: 0.074}, [data[0], data[2]])["y"] == pytest.approx(0.08)
    assert nearest_lags(late(), {DELAY: 0.074}, data[:1])["y"] == pytest.approx(0.07)


def test_samples_are_moved_by_steps_of_the_inputs_where_these_are_faster():
    """Of an output that is read every 0.2 s a part of a sample is long; on the inputs' points it is exact too."""
    assert nearest_lags(late(), {DELAY: 0.113}, [record(step=0.01, y=0.2)])["y"] == pytest.approx(0.11)
    assert nearest_lags(late(), {DELAY: 0.113}, [record(step=0.2, y=0.01)])["y"] == pytest.approx(0.11)


def test_every_output_has_the_lag_of_its_own_delay_and_rate():
    found = nearest_lags(late(2), {DELAY: 0.033, OTHER: 0.033}, [record(step=0.04, y=0.01, z=0.02)])
    assert found == {"y": pytest.approx(0.03), "z": pytest.approx(0.04)}


def test_an_output_that_was_not_measured_has_steps_of_the_inputs():
    assert nearest_lags(late(2), {OTHER: 0.047}, [record(step=0.01, y=0.02)]) == {"z": pytest.approx(0.05)}
    assert nearest_lags(late(2), {OTHER: 0.047}, [record(step=0.05, y=0.02)]) == {"z": pytest.approx(0.05)}


@pytest.mark.parametrize("values", [{}, {DELAY: math.nan}, {DELAY: math.inf}, {DELAY: -math.inf}])
def test_a_delay_without_a_number_has_no_lag(values):
    data = [record(y=STEP, z=STEP)]
    assert nearest_lags(late(2), values | {OTHER: 0.04}, data) == {"z": pytest.approx(0.04)}
    assert nearest_lags(late(), values, data) == {}


def test_without_records_there_are_no_steps():
    assert nearest_lags(late(), {DELAY: 0.1}, []) == {}


def test_a_model_without_delays_has_no_lags():
    model = rotor()
    assert nearest_lags(model, {DELAY: 0.1}, [record(y=STEP)]) == {}
    assert with_nearest_lags(model, {DELAY: 0.1}, [record(y=STEP)]) is model
    assert with_delays(model) is model
    assert lagged(model, {"y": 0.1}) is model


# ---- models with lags


def test_a_model_that_has_these_lags_is_the_same_one():
    model = late(2)
    assert lagged(model, {}) is model
    assert lagged(model, {"y": 0.0, "z": 0.0}) is model
    moved = lagged(model, {"y": 0.03})
    assert moved is not model
    assert moved.lags == (("y", 0.03),)
    assert lagged(moved, {"y": 0.03}) is moved
    assert lagged(moved, {"y": 0.03, "z": 0.0}) is moved


def test_the_law_holds_what_is_left_of_the_delay():
    """A delay of 37 ms read at 30 ms shows what one of 7 ms does."""
    model = late(2)
    moved = lagged(model, {"y": 0.03})
    at = {"w": 1.2, "u": 0.7}
    small, whole = (closed(model, **at, **{DELAY: tau, OTHER: 0.004}) for tau in (0.007, 0.037))
    found = closed(moved, **at, **{DELAY: 0.037, OTHER: 0.004})
    np.testing.assert_allclose(found, small, rtol=1e-13)
    assert abs(found[0] - whole[0]) > 0.01
    assert found[1] == whole[1]


def test_from_one_lag_to_another_and_back_to_none_nothing_is_left():
    model, at = late(2), {"w": 1.2, "u": 0.7, DELAY: 0.06, OTHER: -0.02}
    direct = lagged(model, {"y": 0.05, "z": -0.01})
    on_the_way = lagged(lagged(model, {"y": 0.02, "z": 0.03}), {"y": 0.05, "z": -0.01})
    assert on_the_way.lags == direct.lags == (("y", 0.05), ("z", -0.01))
    np.testing.assert_allclose(closed(on_the_way, **at), closed(direct, **at), rtol=1e-12)
    for back in (lagged(direct, {}), lagged(on_the_way, {"y": 0.0, "z": 0.0})):
        assert back.lags == ()
        np.testing.assert_allclose(closed(back, **at), closed(model, **at), rtol=1e-12)
        assert back.equations() == model.equations()


def test_a_lag_moves_no_equation_of_the_motion():
    model = late()
    moved = lagged(model, {"y": 0.05})
    for column in ("closed_ode", "slot_laws", "drive_expressions"):
        assert str(getattr(moved, column)) == str(getattr(model, column))
    assert moved.parameter_names == model.parameter_names


# ---- what a delay holds


VALUES = {
    DELAY: 0.012,
    "shaft.viscous_friction.coefficient": 0.3,
    "sensor_y.sensor_gain.gain": 0.2,
    "sensor_y.sensor_offset.offset": -0.4,
}


def by_hand(model, w, u, lag=0.0):
    """y(t - rest) to second order, of the speed as its sensor shows it while the torque is held."""
    own = {name: VALUES[name] if name in model.parameter_names else 0.0 for name in VALUES}
    delay, friction, gain, offset = own.values()
    first = (2 * u - (DAMPING + friction) * w) / INERTIA
    second = -(DAMPING + friction) * first / INERTIA
    rest = delay - lag
    return (1 + gain) * (w - rest * first + rest**2 * second / 2) + offset


@pytest.mark.parametrize("shown", [SensorGain(), SensorOffset()])
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_order_in_which_effects_come_makes_no_difference(order, shown):
    effects = [(SensorDelay(), "sensor_y"), (ViscousFriction(), "shaft"), (shown, "sensor_y")]
    model, again = rotor(), lagged(late(), {"y": STEP})
    for k in order:
        effect, port = effects[k]
        model = model.with_effect(effect, at=port)
        again = again if k == 0 else again.with_effect(effect, at=port)
    at = {"w": 1.2, "u": 0.7}
    own = {name: value for name, value in VALUES.items() if name in model.parameter_names}
    assert closed(model, **at, **own)[0] == pytest.approx(by_hand(model, *at.values()), rel=1e-12)
    read = by_hand(model, *at.values(), lag=STEP)
    assert again.lags == (("y", STEP),)  # in a model that is late already
    for made in (lagged(model, {"y": STEP}), again):
        assert closed(made, **at, **own)[0] == pytest.approx(read, rel=1e-12)


@pytest.mark.parametrize("delay", [0.004, -0.005, 0.124])
def test_a_torque_that_is_joined_by_lines_is_held_over_a_part_of_a_sample(delay):
    """Against SciPy: what is left out is what the torque changes within that part."""
    t, turn = np.arange(150) * STEP, 2 * np.pi * 1.5
    torque = np.sin(turn * t)
    run = solve_ivp(
        lambda s, w: (2 * np.interp(s, t, torque) - DAMPING * w) / INERTIA, (0, t[-1]), [0.4], method="LSODA",
        rtol=1e-10, atol=1e-12, dense_output=True, max_step=STEP / 2,
    )  # fmt: skip
    data = ce.Experiment.from_arrays("run", time=t, units={"u": "N m"}, u=torque)
    model = rotor().with_effect(SensorDelay(), at="sensor_y", values={"delay": delay})
    found = ce.simulate(model, data, initial={"w": 0.4})["y"].values
    inside = (t >= max(delay, 0.0)) & (t <= t[-1] + min(delay, 0.0))
    error = np.abs(found - run.sol(t - delay)[0])[inside].max()
    rest = abs(delay - STEP * round(delay / STEP))
    assert error < 1.05 * rest**2 / 2 * 2 * turn / INERTIA


def pressed():
    """A pressure behind a valve: what flows in is joined by lines, and shown at once."""
    b = ce.Blueprint("pressed")
    u, w = b.input("u", unit="N m"), b.state("w", unit="rad/s")
    b.ode("w", (2 * u - DAMPING * w) / INERTIA)
    b.output("y", w + 3.0 * u, unit="rad/s")
    return b.model().with_effect(SensorDelay(), at="sensor_y")


@pytest.mark.parametrize(
    ("delay", "steps"),
    [(0.1001, 11), (0.1049, 11), (0.1099, 11), (0.0059, 1), (0.0009, 0), (-0.043, -4), (0.0, 0)],
)
def test_where_a_channel_is_shown_at_once_the_lag_is_behind_the_delay(delay, steps):
    """There the line goes on that begins at a sample."""
    found = nearest_lags(pressed(), {DELAY: delay}, [record(y=STEP)])
    assert found == {"y": pytest.approx(steps * STEP, abs=1e-12)}


@pytest.mark.parametrize("delay", [0.004, -0.0051, 0.015, 0.124])
def test_a_channel_that_is_shown_at_once_is_exact_along_its_lines(delay):
    """Against SciPy, a channel with a corner at every sample: what is left out is the third order of the state."""
    t = np.arange(150) * STEP
    torque = np.random.default_rng(3).normal(size=150)
    run = solve_ivp(
        lambda s, w: (2 * np.interp(s, t, torque) - DAMPING * w) / INERTIA, (0, t[-1]), [0.4], method="LSODA",
        rtol=1e-10, atol=1e-12, dense_output=True, max_step=STEP / 4,
    )  # fmt: skip
    data = ce.Experiment.from_arrays("run", time=t, units={"u": "N m"}, u=torque)
    model = with_nearest_lags(pressed(), {DELAY: delay}, [data])
    parameters = model.parameters()
    parameters[DELAY].set(delay)
    found = ce.simulate(model, data, parameters=parameters, initial={"w": 0.4})["y"].values
    at = t - delay
    inside = (at >= 0) & (at <= t[-1])
    expected = run.sol(at[inside])[0] + 3.0 * np.interp(at[inside], t, torque)
    slope = np.abs(np.diff(torque)).max() / STEP
    assert np.abs(found[inside] - expected).max() < 2 * slope * DAMPING / INERTIA**2 * STEP**3 / 6 + 1e-6


@pytest.mark.parametrize("delay", [0.004, -0.005, 0.124])
def test_a_torque_that_jumps_and_holds_is_held_as_it_is(delay):
    """Ahead of a sample, where nothing jumps."""
    t = np.arange(150) * STEP
    steps = np.random.default_rng(4).normal(size=150)
    w, held = 0.4, [0.4]
    decay = np.exp(-DAMPING / INERTIA * STEP)
    for u in steps:
        w = decay * w + (1 - decay) * 2 * u / DAMPING
        held.append(w)
    at = np.arange(150) - delay / STEP
    whole = np.clip(np.floor(at + 1e-9).astype(int), 0, 149)
    part = np.exp(-DAMPING / INERTIA * STEP * (at - whole))
    speed = part * np.array(held)[whole] + (1 - part) * 2 * steps[whole] / DAMPING
    data = ce.Experiment.from_arrays("run", time=t, units={"u": "N m"}, hold="zero", u=steps)
    model = rotor().with_effect(SensorDelay(), at="sensor_y", values={"delay": delay})
    found = ce.simulate(model, data, initial={"w": 0.4})["y"].values
    inside = (t >= max(delay, 0.0)) & (t <= t[-1] + min(delay, 0.0))
    # third order of what is left, with c / J the rate at which the speed settles
    most = np.abs(steps).max() * 2 / INERTIA * (DAMPING / INERTIA) ** 2 * (1.1 * STEP) ** 3 / 6
    assert np.abs(found - speed)[inside].max() < 2 * most


# ---- sent, copied and printed


def test_a_model_with_lags_is_sent_and_copied_with_them():
    model = lagged(late(2), {"y": 0.03, "z": -0.02})
    at = {"w": 1.2, "u": 0.7, DELAY: 0.034, OTHER: -0.017}
    for made in (unpack(pack(model)), copy.deepcopy(model)):
        assert made is not model
        assert made.lags == model.lags
        assert delays(made) == delays(model)
        assert made.equations() == model.equations()
        np.testing.assert_array_equal(closed(made, **at), closed(model, **at))
        back = lagged(made, {})
        np.testing.assert_allclose(closed(back, **at), closed(late(2), **at), rtol=1e-12)
        one, two = (m.with_effect(ViscousFriction(), at="shaft") for m in (made, model))
        assert one.equations() == two.equations()


@pytest.mark.parametrize("lags", [{}, {"y": 0.03}])
def test_a_late_output_is_printed_exactly_whatever_its_lag(lags):
    """Not the law, which is what holds it at one instant."""
    model = lagged(late(), lags)
    assert model.equations().splitlines()[-1] == f"y(t + {DELAY}) = w"
    name = r"\mathrm{sensor}_{\mathrm{y\,sensor\,delay\,delay}}"
    assert rf"y(t + {name}) &= w" in model.latex()
    assert "delay" not in rotor().equations() + rotor().latex()


def test_what_else_a_late_sensor_does_is_printed_too():
    model = lagged(late(2), {"y": 0.03}).with_effect(SensorGain(), at="sensor_y")
    assert model.equations().splitlines()[-2:] == [
        f"y(t + {DELAY}) = w + sensor_y.sensor_gain.gain*w",
        f"z(t + {OTHER}) = w",
    ]
