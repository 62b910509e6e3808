"""Long records are evaluated part by part: the same numbers as in one piece, and little memory."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import casadi_engine as ce
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.scales import felt_scale
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.slopes import check_slopes
from casadi_engine.simulation.linear import LinearPropagator


def pulled(ratio):
    """A mass on a spring and a damper, pulled by a force whose size is a parameter: a drive with derivatives."""
    b = ce.Blueprint("pulled")
    k, c = b.parameter("k", 4.0, unit="N/m", min=0.1), b.parameter("c", 0.4, unit="N s/m", min=0.0)
    size = b.parameter("size", 1.3)
    place, speed = b.state("place", unit="m"), b.state("speed", unit="m/s")
    force = b.drive("force", size**2 * b.input("pull", unit="N"))
    b.ode("place", speed)
    b.ode("speed", force - k * place - c * speed)
    b.output("x", place, unit="m")
    if ratio > 1:
        b.output("v", speed, unit="m/s")
    return b.model()


def record(samples, seed, *, ratio=1, missing=0):
    rng = np.random.default_rng(seed)
    time = 0.05 * np.arange(samples)
    shown = {"x": rng.standard_normal(samples)}
    if missing:
        shown["x"][rng.integers(0, samples, missing)] = np.nan
    if ratio > 1:
        shown["v"] = (time[::ratio], rng.standard_normal(len(time[::ratio])))
    return ce.Experiment.from_arrays(
        "run", time=time, units={"pull": "N", "x": "m", "v": "m/s"} if ratio > 1 else {"pull": "N", "x": "m"},
        pull=rng.standard_normal(samples), **shown,
    )  # fmt: skip


def search(model, data, *, interval, loss="square", noise=None):
    return Search(
        model, (data,), model.parameters(), noise, interval=interval, initial=None, loss=read_loss(loss),
        ties="substitute", method="exact", max_iterations=9, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


def everything(made, x, lam, *, exact):
    """All that the solver asks of a point, and what the start asks of it."""
    problem = made.problem
    problem.forget()
    problem.exact = exact
    point = problem.at(x)
    check_slopes(made.records, point)
    v, lay, term = x[: problem.nv], problem.layouts[0], made.records[0]
    scale = felt_scale(problem, made.coordinates, 0 * v, x)
    return {
        "objective": point.objective,
        "gradient": point.gradient.copy(),
        "constraints": point.constraints.copy(),
        "jacobian": problem.jacobian(x),
        "hessian": problem.hessian(x, 0.7, lam),
        "residual": point.records[0].r.copy(),
        "slopes": point.records[0].jz.copy(),
        "slopes in the starts": point.records[0].js.copy(),
        "outputs": term.outputs_at(v, lay.take(x))[0],
        "scale": scale,
        "drives": term.drives_at(v),
    }


def parted(made, samples):
    term = made.records[0]
    term.long, term.part = 0, samples * len(term.outputs) * (1 + len(term.active))
    return term


@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_parts_of_any_size_give_the_same(data):
    samples, part = data.draw(st.integers(40, 400)), data.draw(st.integers(1, 300))
    ratio, missing = data.draw(st.sampled_from([1, 2])), data.draw(st.sampled_from([0, 5]))
    interval = data.draw(st.sampled_from(["single", 20, 50]))
    loss = data.draw(st.sampled_from(["square", "huber"]))
    noise = ce.Noise(x=0.7, v=1.3) if ratio > 1 else ce.Noise(x=0.7)
    if ratio == 1 and not missing and data.draw(st.booleans()):
        noise = ce.Noise(x=0.7, gain=[[0.2], [0.1]])
    made = search(
        pulled(ratio),
        record(samples, 3, ratio=ratio, missing=missing),
        interval=interval,
        loss=loss,
        noise=noise,
    )
    rng = np.random.default_rng(samples)
    x = made._start(made.pmap.start, first=True) + 0.1 * rng.standard_normal(made.problem.size)
    lam = rng.standard_normal(made.problem.rows)
    for exact in (False, True):
        whole = everything(made, x, lam, exact=exact)
        term = parted(made, part)
        expected = len(term.propagator.parts(part)) if isinstance(term.propagator, LinearPropagator) else 1
        assert len(term._cuts()) == expected
        split = everything(made, x, lam, exact=exact)
        term.long = 10**9
        for name, value in whole.items():
            size = 1e-300 + np.abs(value).max(initial=0.0)
            np.testing.assert_allclose(split[name], value, rtol=0, atol=1e-12 * size, err_msg=name)


def test_a_record_in_parts_is_cut_where_it_is_asked_to():
    made = search(pulled(1), record(400, 0), interval=20, noise=ce.Noise(x=0.7))
    assert len(made.records[0]._cuts()) == 1
    cuts = parted(made, 100)._cuts()
    assert len(cuts) == 4 if made.records[0].plan.b >= 4 else len(cuts) == made.records[0].plan.b
    assert cuts[0].start == 0
    assert cuts[-1].stop == made.records[0].plan.b
    assert all(a.stop == b.start for a, b in pairwise(cuts))


def test_a_state_that_overflows_in_a_later_part_is_reported():
    made = search(pulled(1), record(400, 0), interval="single", noise=ce.Noise(x=0.7))
    term = parted(made, 40)
    v = made.coordinates.of(np.array([4.0, 0.4, 1.3]))
    v[:] = np.where(np.arange(3) == 1, -1e6, v)
    with pytest.raises(FloatingPointError, match="not finite"):
        term.evaluate(v, np.ones((1, 2)))


def test_the_estimate_is_the_same():
    rng = np.random.default_rng(1)
    time, pull = 0.05 * np.arange(3000), rng.standard_normal(3000).cumsum() / 5
    model = pulled(1)
    bare = ce.Experiment.from_arrays("run", time=time, units={"pull": "N"}, pull=pull)
    x = ce.simulate(model, bare, initial={"place": 0.0, "speed": 0.0})["x"].values
    data = ce.Experiment.from_arrays(
        "run", time=time, units={"pull": "N", "x": "m"}, pull=pull, x=x + 0.01 * rng.standard_normal(3000)
    )
    parameters = model.parameters()
    for name in parameters.names:
        parameters[name].set(1.1 * parameters[name].value)
    parameters["size"].set(min=0.0)  # its square is what acts
    found = []
    for long in (2_000_000, 0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("casadi_engine.estimation.record._LONG", long)
            patch.setattr("casadi_engine.estimation.record._PART", 600)
            found.append(ce.estimate(model, data, parameters=parameters, interval=50))
    one, other = found
    assert one.status == other.status == "converged"
    for name, value in one.estimates.items():
        assert other.estimates[name].value == pytest.approx(value.value, rel=1e-6)
        assert other.estimates[name].stderr == pytest.approx(value.stderr, rel=1e-6)
    trace = other.traces["run"]["x"].simulated
    np.testing.assert_allclose(trace, one.traces["run"]["x"].simulated, atol=1e-7 * np.abs(trace).max())


def test_a_fit_shares_its_arrays_with_the_data():
    time = 0.05 * np.arange(200)
    pull, x = np.sin(time), np.cos(time)
    for array in (time, pull, x):
        array.setflags(write=False)
    data = ce.Experiment.from_arrays("run", time=time, units={"pull": "N", "x": "m"}, pull=pull, x=x)
    assert data["pull"].values is pull
    assert data["x"].time is time
    fit = ce.estimate(pulled(1), data, interval=20)
    trace, drive = fit.traces["run"]["x"], fit.drives["run"]["force"]
    assert trace.time is time
    assert trace.measured is x
    assert drive.shape == (2, 200)
    np.testing.assert_allclose(drive[0], time, atol=1e-12)
    assert not drive.flags.writeable


@pytest.mark.slow
def test_the_slopes_of_a_long_record_take_little_memory():
    samples = 300_000
    model, rng = ce.crankshaft(cylinders=2, reciprocating_speed="measured"), np.random.default_rng(0)
    units = {"theta": "rad", "T_load": "N m", "omega": "rad/s", "p1": "Pa", "p2": "Pa"}
    channels = {name: rng.standard_normal(samples) for name in units}
    data = ce.Experiment.from_arrays("run", time=1e-4 * np.arange(samples), units=units, **channels)
    peaks = []
    for long in (None, 10**9):
        made = search(model, data, interval="auto", noise=ce.Noise(omega=1.0))
        x = made._start(made.pmap.start, first=True)
        made.problem.exact = True
        made.records[0].long = long or made.records[0].long
        tracemalloc.start()
        made.problem.at(x)
        made.problem.hessian(x, 1.0, np.zeros(made.problem.rows))
        peaks.append(tracemalloc.get_traced_memory()[1] / (8 * samples))
        tracemalloc.stop()
    drives = len(model.drives) + 2
    parted, whole = peaks  # numbers for each sample
    assert parted < 4 * drives
    assert whole > 2 * parted
