"""Times of events beside which other swings explain the data as well."""

from types import SimpleNamespace as stub

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import event_intervals as module
from casadi_engine.discrepancy.start import Start
from casadi_engine.estimation import Estimate

NAME, AT, PERIOD, SIGMA = "body.load_step.time", 5.02, 0.13, 0.1
HEAVY, LIGHT, LOSS = 2.0, 0.5, 0.05
STIFF = HEAVY * LIGHT / (HEAVY + LIGHT) * (2 * np.pi / PERIOD) ** 2


def body():
    """A heavy body on a damper that pulls a light one by a spring, of which the force is measured."""
    b = ce.Blueprint("body")
    u = b.input("u", unit="N")
    c = b.parameter("c", 1.2, unit="N s/m", min=0.1, max=10)
    x, v, w = b.state("x", unit="m", scale=1e-3), b.state("v", unit="m/s"), b.state("w", unit="m/s")
    port = b.port("body", "inertia", {"speed": v}, unit="N")
    link = STIFF * x + LOSS * (v - w)
    b.ode("x", v - w)
    b.ode("v", (u - c * v - link + port) / HEAVY)
    b.ode("w", link / LIGHT)
    b.output("f", link, unit="N")
    return b.model()


def record(name, seed, sigma):
    """A slow push on it, and a load of 5 N from a time on, by SciPy piece by piece."""
    t = np.arange(0, 12, 0.01)
    push = 6 * np.sin(0.8 * t + seed)
    ends, f = np.zeros(3), np.zeros(len(t))

    def rate(time, y, load):
        link = STIFF * y[0] + LOSS * (y[1] - y[2])
        return [y[1] - y[2], (6 * np.sin(0.8 * time + seed) - y[1] - link - load) / HEAVY, link / LIGHT]

    for begin, end, load in ((0.0, AT, 0.0), (AT, t[-1], 5.0)):
        run = solve_ivp(
            rate, (begin, end), ends, args=(load,), rtol=1e-9, atol=1e-12, max_step=0.02, dense_output=True
        )
        inside = (t >= begin) & (t <= end)
        y, ends = run.sol(t[inside]), run.y[:, -1]
        f[inside] = STIFF * y[0] + LOSS * (y[1] - y[2])
    f += sigma * np.random.default_rng(seed).standard_normal(len(t))
    return ce.Experiment.from_arrays(name, time=t, units={"u": "N", "f": "N"}, u=push, f=f)


def repaired():
    return ce.repair(
        body(), record("found_on", 1, SIGMA), fresh=record("fresh", 2, SIGMA), effects=["load_step"],
        noise=ce.Noise(f=SIGMA), starts=1, progress=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found():
    return repaired()


def cost_at(fit, time):
    """Chi-squared of a whole fit that begins at a time, and where it ends."""
    start = Start({**fit.values, NAME: time}, {})
    own = ce.estimate(
        fit.model, fit.data, parameters=fit.parameters, noise=ce.Noise(f=SIGMA), warm=start, progress=False,
        errors="quadratic",
    )  # fmt: skip
    return own.cost, own.values[NAME]


def test_one_optimum_keeps_its_error(found):
    own = found.fit.estimates[NAME]
    assert own.stderr is not None
    assert abs(own.value - AT) < 4 * own.stderr
    assert not any("swing" in text for text in found.messages)


def test_swings_that_explain_as_much_are_in_the_interval(found, monkeypatch):
    """As much is here what whole fits that begin one swing earlier and later end at."""
    ends = [cost_at(found.fit, found.fit.values[NAME] + k * PERIOD) for k in (-1, 1)]
    assert all(abs(time - found.fit.values[NAME]) > 0.7 * PERIOD for _, time in ends)
    monkeypatch.setattr(module, "_WITHIN", 1.1 * (max(cost for cost, _ in ends) - found.fit.cost))
    again = repaired()
    own = again.fit.estimates[NAME]
    assert (own.stderr, own.value) == (None, found.fit.values[NAME])
    assert own.why == "another swing of what it excites explains the data as well"
    low, high = own.interval
    assert all(low < time < high for _, time in ends)
    assert high - low < 6 * PERIOD
    (said,) = (text for text in again.messages if "may be a swing earlier or later" in text)
    assert said.startswith(f"{NAME} may be a swing")
    assert said.endswith(" s; all other errors are those at this one")
    assert again.effects[0].parameters[NAME] == own
    assert again.effects[0].amplitude.stderr is not None


def ride(name, seed, at):
    """A mass on a damper, and a load of 3 N from a time on: chi-squared has one optimum over its time."""
    t = np.arange(0, 60, 0.05)
    push = 6 * np.sin(0.8 * t + seed) + 4 * np.sin(0.13 * t + 2 * seed)
    v, ends = np.zeros(len(t)), [0.0]
    for begin, end, load in ((0.0, at, 0.0), (at, t[-1], 3.0)):
        run = solve_ivp(
            lambda x, y, load=load: [np.interp(x, t, push) - y[0] * (1 + 0.05 * abs(y[0])) - load],
            (begin, end), ends, rtol=1e-9, atol=1e-12, max_step=0.05, dense_output=True,
        )  # fmt: skip
        inside = (t >= begin) & (t <= end)
        v[inside], ends = run.sol(t[inside])[0], run.y[:, -1]
    v += 0.03 * np.random.default_rng(seed).standard_normal(len(t))
    return ce.Experiment.from_arrays(name, time=t, units={"u": "N", "v": "m/s"}, u=push, v=v)


def test_times_in_several_records_of_one_amplitude_have_errors():
    """Each time was asked without the load of the other record, which other parameters then took: 130 s had the
    interval from 129.8 to 388."""
    b = ce.Blueprint("cart")
    u, c = b.input("u", unit="N"), b.parameter("c", 1.2, unit="N s/m", min=0.1, max=10)
    d = b.parameter("d", 0.1, unit="N s2/m2", min=0, max=1)
    v = b.state("v", unit="m/s")
    b.ode("v", u - c * v - d * v * ca.fabs(v) + b.port("cart", "inertia", {"speed": v}, unit="N"))
    b.output("v", v, unit="m/s")
    wanted = {"a": 17.3, "b": 31.2}
    data = [ride(name, 1 + k, at) for k, (name, at) in enumerate(wanted.items())]
    made = ce.repair(
        b.model(), data, fresh=[ride("c", 5, 24.1), ride("d", 6, 40.3)], effects=["load_step"], starts=1,
        progress=False,
    )  # fmt: skip
    for record, at in wanted.items():
        own = made.effects[0].parameters[f"cart.load_step.time@{record}"]
        assert own.stderr is not None
        assert own.stderr < 0.1
        assert abs(own.value - at) < 4 * own.stderr


# ---- over time


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
