"""Events of models that swing: their times are looked for between those of their grid."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.event_times import _over_time, finer_candidates, located
from casadi_engine.discrepancy.families import families_of
from casadi_engine.discrepancy.linearised import OneStep
from casadi_engine.discrepancy.refit import addition
from casadi_engine.discrepancy.screening import screen

STEP, SAMPLES, TURN = 0.02, 1001, 2 * np.pi * 1.3
J, C, SIGMA = 0.5, 0.02, 0.003
K = J * TURN**2


# ---- an oscillator that a load displaces


def oscillator(damping=0.05):
    b = ce.Blueprint("oscillator")
    u = b.input("u", unit="N m")
    inertia = b.parameter("J", 0.4, unit="kg m2", min=0.01, max=5)
    c = b.parameter("c", damping, unit="N m s/rad", min=0, max=50)
    k = b.parameter("k", 30.0, unit="N m/rad", min=1, max=1000)
    x, w = b.state("x", unit="rad"), b.state("w", unit="rad/s")
    mass = b.port("mass", "inertia", {"speed": w, "angle": x})
    b.ode("x", w)
    b.ode("w", (u - c * w - k * x + mass) / inertia)
    b.output("x", x, unit="rad")
    return b.model()


def record(name, seed, at, *, damping=C, samples=SAMPLES):
    """A random torque on the oscillator and a load of 1 N m from a time on, by SciPy, piece by piece."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(samples)
    torque = 2 * rng.standard_normal(samples)
    place, end = np.zeros(samples), [0.0, 0.0]
    for begin, stop, load in ((0.0, at, 0.0), (at, t[-1], 1.0)):
        run = solve_ivp(
            lambda s, x, load=load: [x[1], (np.interp(s, t, torque) - damping * x[1] - K * x[0] - load) / J],
            (begin, stop), end, rtol=1e-8, atol=1e-10, max_step=STEP, dense_output=True,
        )  # fmt: skip
        inside = (t >= begin) & (t <= stop)
        place[inside], end = run.sol(t[inside])[0], run.y[:, -1]
    x = place + SIGMA * rng.standard_normal(samples)
    return ce.Experiment.from_arrays(name, time=t, units={"u": "N m", "x": "rad"}, u=torque, x=x)


AT = 11.43


@pytest.fixture(scope="module")
def data():
    return record("search", 2, AT)


@pytest.fixture(scope="module")
def scored(data):
    """The model without the load, its candidates scored."""
    fit = ce.estimate(oscillator(), data, noise=ce.Noise(x=SIGMA), progress=False)
    return screen(fit, ["load_step", "constant_torque", "coulomb_friction"])


def members(scored, effect):
    return families_of(scored)[(effect, "mass")]


def added(scored, near):
    """The load of the grid next to a time, as an addition."""
    own = [scored.candidates[k] for k in members(scored, "load_step")]
    return addition(min(own, key=lambda one: abs(one.nuisance["time"] - near)), 1.0)


def test_a_finer_grid_is_about_where_the_event_is(scored, data):
    one = added(scored, AT).candidate
    effect, levels = one.source.effect, scored.noise.sigma
    grid = effect.nuisance["time"]
    step = (grid.stop - grid.start) / (grid.steps - 1) * data.duration
    made, found = finer_candidates(one, scored.null, (data,), levels, None)
    times = np.array([own.nuisance["time"] for own in made])
    np.testing.assert_allclose(np.diff(times), step / 16, rtol=1e-6)
    middle = one.nuisance["time"]
    low, high = data.span[0] + grid.start * data.duration, data.span[0] + grid.stop * data.duration
    assert times[0] == pytest.approx(max(middle - 4 * step, low))
    assert times[-1] == pytest.approx(min(middle + 4 * step, high))
    assert np.abs(times - middle).min() < 1e-9
    # each is the same effect, which keeps the grid that its parameters have
    assert all(own.key == one.key and own.source.effect is effect for own in made)
    assert effect.nuisance["time"] is grid
    best = int(np.argmin(found.cost))
    assert abs(times[best] - AT) <= step / 32 + 1e-9


@pytest.mark.parametrize("at", [3.0, 17.9])
def test_a_finer_grid_is_about_the_time_that_is_asked_for(scored, data, at):
    one = added(scored, AT).candidate
    made, _ = finer_candidates(one, scored.null, (data,), scored.noise.sigma, at)
    times = np.array([own.nuisance["time"] for own in made])
    assert min(times) < at < max(times)
    assert np.abs(times - at).min() < 1e-9  # it is one of them
    assert max(times) - min(times) < 0.5 * data.duration
    gone, none = finer_candidates(one, scored.null, (data,), scored.noise.sigma, at + 1e3)
    assert (gone, none) == ([], None)


def test_an_effect_without_a_time_has_no_finer_grid(scored, data):
    one = scored.candidates[members(scored, "coulomb_friction")[0]]
    assert finer_candidates(one, scored.null, (data,), scored.noise.sigma, None) == ([], None)


def test_an_event_is_found_at_its_time_by_one_step(scored, data):
    one = added(scored, AT)
    refits = stub(refitter=stub(data=(data,)), path=stub(levels=scored.noise.sigma))
    found, cost = located(refits, one, scored.null)
    assert found.key == one.key
    assert abs(found.candidate.nuisance["time"] - AT) < 0.03
    assert found.start == pytest.approx(1.0, abs=0.1)
    assert cost < 0.5 * sum(float(np.sum((r.residual["x"] / SIGMA) ** 2)) for r in scored.null.records)
    assert located(refits, one, scored.null, 1e4) is None


# ---- by the public verb


@pytest.mark.slow  # one step finds it at its time above
def test_a_load_between_the_times_of_the_grid_is_found_at_its_time(data):
    found = ce.repair(oscillator(), data, effects=["load_step", "constant_torque"], starts=1, progress=False)
    assert found.verdict == "named"
    (one,) = found.effects
    assert one.key == "mass.load_step"
    time, torque = (one.parameters[f"mass.load_step.{name}"] for name in ("time", "torque"))
    assert abs(time.value - AT) < 0.02
    assert abs(time.value - AT) < 4 * time.stderr
    assert abs(torque.value - 1.0) < 4 * torque.stderr
    for name, truth in (("J", J), ("c", C), ("k", K)):
        estimate = found.fit.estimates[name]
        assert abs(estimate.value - truth) < 4 * estimate.stderr


def candidates(times, record="a"):
    return [stub(nuisance={"time": t}, direction={record: None}) for t in times]


def steps(amplitude, error):
    amplitude, error = np.array(amplitude), np.array(error)
    return OneStep(10 - (amplitude / error) ** 2, amplitude, error, 10.0)


def test_chi_squared_over_time_falls_by_what_an_event_takes():
    made = [*candidates((1.0, 2.0, 3.0, 4.0)), *candidates((9.0,), "b")]
    step = steps([2.0, -1.0, 3.0, 1.0, 5.0], [1.0, 1.0, 2.0, np.inf, 1.0])
    times, cost = _over_time(made, step, "a", 2.0, None)
    np.testing.assert_array_equal(times, [1.0, 3.0])  # of this record, of the same sign, and testable
    np.testing.assert_allclose(cost, [-4.0, -2.25])
    times, cost = _over_time(made, step, "a", 2.0, 2.0)  # with the amplitude of all records
    np.testing.assert_allclose(cost, [-(2.0 * 2.0), -(2.0 * 4.0) / 4.0])
