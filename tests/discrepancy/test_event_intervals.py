"""Times of events beside which other swings explain the data as well."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import event_intervals as module
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.discrepancy.start import Start
from casadi_engine.estimation import Estimate

NAME, AT, PERIOD, SIGMA = "body.load_step.time", 5.02, 0.4, 0.35


def body():
    """A heavy body on a damper, that swings a little against a light one of which nothing is measured."""
    b = ce.Blueprint("body")
    u = b.input("u", unit="N")
    c = b.parameter("c", 1.0, unit="N s/m", min=0.1, max=10)
    x, v, w = b.state("x", unit="m"), b.state("v", unit="m/s"), b.state("w", unit="m/s")
    port = b.port("body", "inertia", {"speed": v}, unit="N")
    rate = 2 * np.pi / PERIOD
    b.ode("x", v - w)
    b.ode("v", (u - c * v - 0.4 * rate**2 * x - 0.02 * (v - w) + port) / 2.0)
    b.ode("w", (0.4 * rate**2 * x + 0.02 * (v - w)) / 0.5)
    b.output("v", v, unit="m/s")
    return b.model()


def record(name, seed, sigma):
    t = np.arange(0, 12, 0.02)
    rng = np.random.default_rng(seed)
    push = 3 * np.sin(0.8 * t + seed)
    stiff, ends, v = 0.4 * (2 * np.pi / PERIOD) ** 2, np.zeros(3), np.zeros(len(t))

    def rate(time, y, load):
        link = stiff * y[0] + 0.02 * (y[1] - y[2])
        return [y[1] - y[2], (3 * np.sin(0.8 * time + seed) - y[1] - link - load) / 2.0, link / 0.5]

    for begin, end, load in ((0.0, AT, 0.0), (AT, t[-1], 2.0)):
        run = solve_ivp(rate, (begin, end), ends, args=(load,), rtol=1e-9, atol=1e-11, dense_output=True)
        inside = (t >= begin) & (t <= end)
        v[inside], ends = run.sol(t[inside])[1], run.y[:, -1]
    v += sigma * rng.standard_normal(len(t))
    return ce.Experiment.from_arrays(name, time=t, units={"u": "N", "v": "m/s"}, u=push, v=v)


def repaired(sigma):
    return ce.repair(
        body(), record("found_on", 1, sigma), fresh=record("fresh", 2, sigma), effects=["load_step"],
        noise=ce.Noise(v=sigma), starts=1, progress=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def loud():
    return repaired(SIGMA)


def cost_at(fit, time):
    """Chi-squared of a whole fit that begins at a time, and where it ends."""
    start = Start({**fit.values, NAME: time}, {})
    found = ce.estimate(
        fit.model, fit.data, parameters=fit.parameters, noise=ce.Noise(v=SIGMA), warm=start, progress=False,
        errors="quadratic",
    )  # fmt: skip
    return found.cost, found.values[NAME]


def test_swings_that_explain_as_much_are_in_the_interval(loud):
    """Whole fits from a swing earlier and later end within its bounds, as low but for what chance does."""
    own = loud.fit.estimates[NAME]
    assert own.stderr is None
    assert own.why == "another swing of what it excites explains the data as well"
    low, high = own.interval
    assert low < AT < high
    assert high - low > PERIOD
    ends = [cost_at(loud.fit, own.value + k * PERIOD) for k in (-1, 1)]
    others = [time for cost, time in ends if cost < loud.fit.cost + 3.0 and abs(time - own.value) > 0.2]
    assert others
    assert all(low <= time <= high for time in others)


def test_it_is_said_and_printed(loud):
    (said,) = (text for text in loud.messages if "may be a swing earlier or later" in text)
    assert said.startswith(f"{NAME} may be a swing")
    assert said.endswith(" s")
    (effect,) = loud.effects
    assert effect.parameters[NAME] == loud.fit.estimates[NAME]
    assert effect.amplitude.stderr is not None


def test_one_optimum_keeps_its_error():
    found = repaired(0.02)
    own = found.fit.estimates[NAME]
    assert own.stderr is not None
    assert abs(own.value - AT) < 4 * own.stderr
    assert not any("swing" in text for text in found.messages)


# ---- over time


def candidates(times, record="a"):
    return [stub(nuisance={"time": t}, direction={record: None}) for t in times]


def steps(amplitude, error):
    amplitude, error = np.array(amplitude), np.array(error)
    return OneStep(10 - (amplitude / error) ** 2, amplitude, error, 10.0)


def test_chi_squared_over_time_falls_by_what_an_event_takes():
    made = [*candidates((1.0, 2.0, 3.0, 4.0)), *candidates((9.0,), "b")]
    step = steps([2.0, -1.0, 3.0, 1.0, 5.0], [1.0, 1.0, 2.0, np.inf, 1.0])
    times, cost = module._over_time(made, step, "a", 2.0, None)
    np.testing.assert_array_equal(times, [1.0, 3.0])  # of this record, of the same sign, and testable
    np.testing.assert_allclose(cost, [-4.0, -2.25])
    times, cost = module._over_time(made, step, "a", 2.0, 2.0)  # with the amplitude of all records
    np.testing.assert_allclose(cost, [-(2.0 * 2.0), -(2.0 * 4.0) / 4.0])


@pytest.mark.parametrize(
    ("times", "interval"),
    [([4.9, 5.1], None), ([4.9, 5.6], (4.7, 5.8)), ([0.05, 5.0], (0.0, 5.2)), ([], None)],
)
def test_an_interval_takes_the_place_of_an_error_that_says_less(times, interval):
    bounds = stub(min=0.0, max=12.0)
    found = module._with_interval(
        Estimate(5.0, 0.1, "s"), np.array(times), stub(fit=stub(parameters={NAME: bounds})), NAME
    )
    if interval is None:
        assert found is None
    else:
        assert found.interval == pytest.approx(interval)
        assert (found.stderr, found.quadratic, found.value) == (None, 0.1, 5.0)
