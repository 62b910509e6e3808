"""What flows between two vessels: laws of the pipe come before errors of the sensors at its ends."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.discrepancy.random_families import family_candidates, family_columns

GAS = 0.84  # R T [bar L/g]


def vessels():
    b = ce.Blueprint("vessels")
    v1 = b.parameter("V_1", 15.0, unit="L", min=1)
    c12 = b.parameter("C_12", 0.7, unit="g/(s bar)", min=0.01)
    out = b.parameter("C_out", 0.4, unit="g/(s bar)", min=0.01)
    feed, valve = b.input("feed", unit="g/s"), b.input("valve", unit="1")
    p1, p2 = b.state("p_1", unit="bar"), b.state("p_2", unit="bar")
    first = b.port("first", "inertia", {"pressure": p1}, unit="g/s")
    second = b.port("second", "inertia", {"pressure": p2}, unit="g/s")
    gas = b.parameter("gas", GAS, unit="bar L/g", vary=False)
    b.ode("p_1", gas / v1 * (feed - c12 * (p1 - p2) + first))
    b.ode("p_2", gas / 12.0 * (c12 * (p1 - p2) - out * valve * p2 + second))
    b.output("y_1", p1, unit="bar")
    b.output("y_2", p2, unit="bar")
    return b.model()


def measured(name, throttle, seed, samples=600):
    """A record of SciPy; throttle : difference of pressures -> flow."""
    time, turn = np.arange(samples) * 0.2, 1.3 * seed

    def drive(t):
        feed = 1.2 + 0.8 * np.sign(np.sin(2 * np.pi * t / 37 + turn))
        return feed, 0.5 + 0.3 * np.sin(2 * np.pi * t / 23 + turn) + 0.1 * np.sin(2 * np.pi * 0.2 * t)

    def rate(t, p):
        feed, valve = drive(0.2 * np.floor(t / 0.2 + 1e-9) + 1e-9)
        between = throttle(p[0] - p[1])
        return [GAS / 20 * (feed - between), GAS / 12 * (between - 0.55 * valve * p[1])]

    levels = np.array([[5.5, 4.5]])
    for start in time[:-1]:
        end = solve_ivp(rate, (start, start + 0.2), levels[-1], rtol=1e-9, atol=1e-10).y[:, -1]
        levels = np.vstack([levels, end])
    noise = 0.01 * np.random.default_rng(seed).standard_normal(levels.shape)
    feed, valve = drive(time + 1e-9)
    shown = dict(zip(("y_1", "y_2"), (levels + noise).T, strict=True))
    units = {"feed": "g/s", "valve": "1", "y_1": "bar", "y_2": "bar"}
    record = ce.Experiment.from_arrays(name, time=time, units=units, feed=feed, valve=valve, **shown)
    return record.with_hold(feed="zero", valve="zero")


def late(difference):
    """A valve that opens at 0.15 bar."""
    return 0.9 * max(difference - 0.15, 0.0)


def test_a_valve_that_opens_late_is_a_constant_of_the_pipe_or_an_offset_of_a_sensor():
    found = ce.repair(vessels(), measured("found", late, 1), fresh=measured("fresh", late, 2))
    (one,) = found.effects
    assert (one.name, one.at) == ("constant_torque", "first_and_second")
    assert {member.name for member in one.members} == {"constant_torque", "sensor_offset"}
    assert found.confirmed
    assert one.amplitude.value == pytest.approx(-0.9 * 0.15, abs=3 * one.amplitude.stderr)
    assert "a constant mass flow from first to second" in str(found)


def test_a_function_of_the_difference_leaves_one_vessel_and_enters_the_other():
    screened = screen(ce.estimate(vessels(), measured("found", late, 1)))
    candidates, families = family_candidates(screened.null)
    (pipe,) = [one for one in families if one.port == "first_and_second"]
    assert pipe.signal == "difference"
    columns = family_columns(screened.null, candidates)["found"]
    number = {(c.port, c.effect, c.nuisance["term"]): k for k, c in enumerate(candidates)}
    ends = [number[port, "function_of_time", 0] for port in ("second", "first")]  # the term of no change
    for output in ("y_1", "y_2"):
        second, first = (columns[output][:, k] for k in ends)
        assert columns[output][:, pipe.members[0]] == pytest.approx(second - first)
        assert np.ptp(first) > 0


def test_four_samples_that_a_fit_goes_through_are_no_missing_effect():
    """The noise of one output came out at 1e-15 bar, and "something is missing"."""
    found = ce.repair(vessels(), measured("found", late, 1, samples=4), progress=False)
    assert found.verdict is None
    told = " ".join(str(found).split())
    assert "no answer: the data are at fault" in told
    assert "the noise level of y_1 is not known, and so no error: of its 4 samples" in told
    assert "state it, noise=ce.Noise(y_1=...)" in told
