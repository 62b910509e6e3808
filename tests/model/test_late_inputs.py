"""Inputs that act late, read off the record: against closed forms of a lag that a late stair or line drives."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.effects import InputDelay, InputGain, InputLag, InputOffset
from casadi_engine.errors import IdentifiabilityError
from casadi_engine.model.lags import lagged
from casadi_engine.model.late_inputs import as_they_act, between, finer, input_lags, read_late
from casadi_engine.simulation.grid import lay_grid

TIME = 0.1 * np.arange(400)
STAIR = np.repeat(np.random.default_rng(1).uniform(-1.0, 1.0, 40), 10)
RATE, GAIN, SHOWN = 0.8, 1.5, 0.4


def model(*, shown=0.0):
    """A lag; its sensor may show the input at once."""
    b = ce.Blueprint("lag", time_unit="s")
    k, g = (
        b.parameter("k", RATE, unit="1/s", min=0.01, max=10),
        b.parameter("g", GAIN, unit="1/s", min=0.01, max=10),
    )
    x, u = b.state("x", unit="V"), b.input("u", unit="V")
    b.ode("x", -k * x + g * u)
    b.output("y", x + shown * u, unit="V")
    return b.model()


def late(time, values, delay, hold):
    """What acts at these times."""
    if hold == "first":
        return np.interp(time - delay, TIME, values)
    return values[np.clip(np.floor((time - delay) / 0.1 + 1e-9).astype(int), 0, len(values) - 1)]


def truth(delay, hold, *, shown=0.0, fine=200):
    """The sensor (N,): the lag is solved exactly over short steps, over which what acts is all but constant."""
    step = 0.1 / fine
    acts = late((np.arange((len(TIME) - 1) * fine) + 0.5) * step, STAIR, delay, hold).reshape(-1, fine)
    decay = np.exp(-RATE * step)
    weights = (1 - decay) * decay ** np.arange(fine - 1, -1, -1)
    x = [0.3]
    for part in acts @ weights:
        x.append(decay**fine * x[-1] + GAIN / RATE * part)
    return np.array(x) + shown * late(TIME, STAIR, delay, hold)


def record(y=None, hold="first", noise=0.0):
    y = np.zeros_like(TIME) if y is None else y + noise * np.random.default_rng(0).standard_normal(len(TIME))
    return ce.Experiment.from_arrays("run", time=TIME, units={"u": "V", "y": "V"}, hold=hold, u=STAIR, y=y)


def delayed(own, delay, **settings):
    return own.with_effect(InputDelay(**settings), at="input_u", values={"share": 1.0, "time": delay})


@pytest.mark.parametrize("hold", ["first", "zero"])
@pytest.mark.parametrize(("delay", "shown"), [(0.5, 0.0), (0.5, SHOWN), (1.73, 0.0)])
def test_a_delay_is_simulated_as_what_it_says(hold, delay, shown):
    """By a rational law alone the record was off by a fifth of the jumps where the sensor shows the input at once."""
    run = ce.simulate(delayed(model(shown=shown), delay), record(hold=hold), initial={"x": 0.3})
    off = run["y"].values - truth(delay, hold, shown=shown)
    assert np.abs(off).max() < (3e-3 if delay == 0.5 else 0.03)
    assert np.sqrt(np.mean(off**2)) < (5e-4 if delay == 0.5 else 5e-3)


@pytest.mark.parametrize("hold", ["first", "zero"])
@pytest.mark.parametrize("shown", [0.0, SHOWN])
def test_a_fit_finds_a_delay_and_its_error_where_the_input_jumps(hold, shown):
    own = delayed(model(shown=shown), 0.45, span=(0.2, 10.0))
    pars = own.parameters()
    pars["input_u.input_delay.share"].set(1.0, vary=False)
    pars["input_u.input_delay.time"].set(0.43, vary=True)
    data = record(truth(0.5, hold, shown=shown), hold, noise=0.005)
    fit = ce.estimate(own, data, parameters=pars, noise=ce.Noise(y=0.005), progress=False)
    assert [state.name for state in fit.model.states] == ["x"]
    assert fit.cost / fit.n < 1.15
    found = fit.estimates["input_u.input_delay.time"]
    assert abs(found.value - 0.5) < 3.5 * found.stderr < 0.003
    assert "u_late = u(t - input_u.input_delay.time)" in fit.model.equations()
    assert "u(t - " in fit.model.latex()
    check = ce.validate(fit, record(truth(0.5, hold, shown=shown), hold, noise=0.005))
    assert not check.failed


@pytest.mark.parametrize("other", [(InputGain(), {"gain": 0.2}), (InputOffset(), {"offset": 0.3})])
@pytest.mark.parametrize("behind", [InputDelay(), InputLag()])
def test_a_change_of_an_input_and_its_lateness_do_the_same_in_either_order(other, behind):
    """With a gain first, a delay took the gain of what it delays a second time; behind one, a gain was refused."""
    effect, values = other
    time = {"share": 1.0, "time": 0.7}
    first = model().with_effect(effect, at="input_u", values=values)
    first = first.with_effect(behind, at="input_u", values=time)
    last = model().with_effect(behind, at="input_u", values=time)
    last = last.with_effect(effect, at="input_u", values=values)
    runs = [
        ce.simulate(one, record(), initial={"x": 0.3, **behind_at_rest(one)})["y"].values
        for one in (first, last)
    ]
    changed = 1.2 * STAIR if "gain" in values else STAIR + 0.3
    plain = model().with_effect(behind, at="input_u", values=time)
    data = ce.Experiment.from_arrays("run", time=TIME, units={"u": "V", "y": "V"}, u=changed, y=0 * TIME)
    expected = ce.simulate(plain, data, initial={"x": 0.3, **behind_at_rest(plain, changed[0])})["y"].values
    for run in runs:
        np.testing.assert_allclose(run[120:], expected[120:], atol=1e-3)


def behind_at_rest(own, value=STAIR[0]):
    return {one.name: value for one in own.states if one.name.endswith("_acts")}


def test_an_effect_on_an_input_that_is_read_late_acts_on_what_is_read():
    own = read_late(delayed(model(), 0.5), {"lag of input u": 0.5})
    assert own.late == (("u", 0.5),)
    wider = own.with_effect(InputGain(), at="input_u", values={"gain": 0.2})
    run, plain = (ce.simulate(one, record(), initial={"x": 0.0})["y"].values for one in (wider, own))
    np.testing.assert_allclose(run, 1.2 * plain, atol=1e-9)
    ((delay, value),) = as_they_act(wider).values()
    assert delay == "input_u.input_delay.time"
    assert not value.is_symbolic()
    assert "(at t - input_u.input_delay.time)" in wider.equations()


def test_a_lag_is_kept_while_its_step_holds_the_delay():
    own = read_late(delayed(model(), 0.5), {"lag of input u": 0.52})
    data = [record()]

    def lags(value, begun=True, of=own):
        return input_lags(of, {"input_u.input_delay.time": value}, data, begun=begun)

    assert lags(0.539) == lags(0.521) == lags(0.519) == {"lag of input u": 0.52}  # of a fifth of a step
    assert lags(0.51) == {"lag of input u": 0.51}
    assert lags(0.63, of=delayed(model(), 0.5)) == {}  # the law shows the way first
    assert lags(0.63, begun=False, of=delayed(model(), 0.5)) == {"lag of input u": 0.63}
    assert lagged(own, lags(0.53)) is own
    assert [between(lag, 0.1) for lag in (-0.25, 0.0, 0.0999999999, 0.55, 0.6)] == [-3, 0, 1, 5, 6]


def test_records_of_two_rates_have_lines_of_their_own():
    own = read_late(delayed(model(), 0.5), {"lag of input u": 0.53})
    slow = ce.Experiment.from_arrays(
        "slow", time=TIME[::2], units={"u": "V", "y": "V"}, u=STAIR[::2], y=0 * TIME[::2]
    )
    for data, parts in ((record(), 7), (slow, 6)):  # 5.3 and 2.65 steps: 37.1 and 15.9 parts
        grid = lay_grid(own, data)
        assert grid.parts == parts
        first, u = between(0.53, grid.step) * grid.step, data["u"]
        at, slope = grid.rows[-2:]
        for delay in (first, first + grid.step):
            expected = np.interp(grid.time - delay, u.time, u.values)
            np.testing.assert_allclose(at + delay * slope, expected, atol=1e-12)
    run = ce.simulate(own, slow, parameters={"input_u.input_delay.time": 0.53}, initial={"x": 0.0})
    np.testing.assert_allclose(run["y"].time, slow["u"].time, atol=1e-9)  # as the record is, not its parts


@pytest.mark.parametrize(
    ("lag", "parts"), [(0.5, 1), (0.5003, 1), (0.55, 2), (0.54, 5), (0.5333, 3), (0.537, 8)]
)
def test_a_grid_is_finer_where_a_lag_is_no_whole_number_of_steps(lag, parts):
    """A motor whose voltage is held and late by 2.4 samples came out with numbers that were off by 57 errors."""
    assert finer(lag, 0.1) == parts


def test_the_exact_test_has_no_rule_for_it():
    own = read_late(delayed(model(), 0.5), {"lag of input u": 0.5})
    with pytest.raises(IdentifiabilityError, match="no rule for an input that acts late") as caught:
        ce.identifiability(own)
    assert "seen: u" in str(caught.value)
    assert "test the model without the delay of that input" in str(caught.value)


@pytest.mark.parametrize("first", [True, False])
def test_a_late_sensor_beside_a_late_input_knows_no_state_of_the_law(first):
    """A repair that tried both died: "variables [d_input_E_input_delay_bend] are free"."""
    sensor = ce.effects.SensorDelay()
    own = model().with_effect(sensor, at="sensor_y") if first else model()
    own = delayed(own, 0.5)
    own = own if first else own.with_effect(sensor, at="sensor_y")
    read = read_late(own, {"lag of input u": 0.5})
    known = ca.vertcat(read.x, read.u, read.d, read.w, read.t, read.p)
    names = {one.name() for one in ca.symvar(known)}
    written = [read.ode, read.output_expressions, *(s for port in read.ports for s in port.signals.values())]
    assert {one.name() for one in ca.symvar(ca.vertcat(*written))} <= names
    run = ce.simulate(read, record(), parameters={"sensor_y.sensor_delay.delay": 0.03}, initial={"x": 0.0})
    assert np.isfinite(run["y"].values).all()


@pytest.mark.parametrize(("noise", "told"), [(0.005, False), (3.0, True)])
def test_an_error_that_is_longer_than_a_step_is_said_to_be_along_a_line(noise, told):
    own = delayed(model(), 0.5, span=(0.2, 10.0))
    pars = own.parameters()
    pars["input_u.input_delay.share"].set(1.0, vary=False)
    pars["input_u.input_delay.time"].set(0.5, vary=True)
    for name in ("k", "g"):
        pars[name].vary = False
    data = record(truth(0.5, "first"), noise=noise)
    fit = ce.estimate(own, data, parameters=pars, noise=ce.Noise(y=noise), progress=False)
    words = "the error of input_u.input_delay.time is longer than a step of the record"
    assert any(one.startswith(words) for one in fit.messages) is told


@pytest.mark.parametrize("ahead", [-1.0, -0.3])
def test_an_input_that_acts_early_is_read_where_it_is_too(ahead):
    run = ce.simulate(
        delayed(model(), 0.5), record(), parameters={"input_u.input_delay.time": ahead}, initial={"x": 0.3}
    )
    off = run["y"].values - truth(ahead, "first")
    assert np.sqrt(np.mean(off**2)) < 5e-4


def test_a_channel_that_is_called_as_the_late_one_keeps_its_name():
    b = ce.Blueprint("two", time_unit="s")
    x, u, other = b.state("x", unit="V"), b.input("u", unit="V"), b.input("u_late", unit="V")
    b.ode("x", u + other - x)
    b.output("y", x, unit="V")
    lines = read_late(delayed(b.model(), 0.5), {"lag of input u": 0.5}).equations().splitlines()
    assert lines.count("u_late_ = u(t - input_u.input_delay.time)") == 1
    assert not any(line.startswith("u_late =") for line in lines)
