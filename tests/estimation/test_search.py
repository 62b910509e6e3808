"""Several starts, warm starts, progress, interruption, and fits that do not converge."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.ipopt import Solution
from casadi_engine.estimation.search import Search, is_near
from casadi_engine.estimation.starts import drawn_starts
from casadi_engine.parameters import compile

SIGMA = 0.05


@pytest.fixture
def tone():
    """A model and a record with two optima: the frequency of a tone, far and near."""

    def make(start=0.9):
        b = ce.Blueprint("tone")
        f = b.parameter("f", start, unit="Hz", min=0.4, max=2.4)
        x = b.state("x")
        b.ode("x", 2 * np.pi * f * ca.cos(2 * np.pi * f * b.time))
        b.output("y", x)
        time_ = np.arange(300) * 0.01
        rng = np.random.default_rng(0)
        y = np.sin(2 * np.pi * 1.5 * time_) + SIGMA * rng.standard_normal(300)
        return b.model(), ce.Experiment.from_arrays("tone", time=time_, units={"y": "1"}, y=y)

    return make


KNOWN = {"noise": ce.Noise(y=SIGMA), "initial": {"x": 0.0}, "interval": "single", "progress": False}


def test_several_starts_find_the_better_optimum(tone):
    model, data = tone()
    one = ce.estimate(model, data, errors="quadratic", **KNOWN)  # no second look
    fit = ce.estimate(model, data, starts=8, seed=3, **KNOWN)
    assert one.status == fit.status == "converged"
    assert one.cost > 10 * fit.cost
    assert fit.values["f"] == pytest.approx(1.5, rel=1e-3)
    costs = [optimum.cost for optimum in fit.optima]
    assert costs == sorted(costs)
    assert fit.cost == pytest.approx(costs[0], rel=1e-9)
    assert len(fit.optima) >= 2
    assert sum(optimum.starts for optimum in fit.optima) == 8
    assert fit.optima[0].values["f"] == pytest.approx(fit.values["f"], rel=1e-6)
    assert any(optimum.cost == pytest.approx(one.cost, rel=1e-6) for optimum in fit.optima)
    assert len(one.optima) == 1
    assert one.optima[0].starts == 1


@pytest.mark.slow
def test_starts_are_compared_at_one_noise_level(tone):
    # An estimated level makes the cost of every optimum about n: they are told apart by the likelihood.
    model, data = tone()
    options = {**KNOWN, "noise": None}
    one = ce.estimate(model, data, **options)
    fit = ce.estimate(model, data, starts=8, seed=3, **options)
    assert one.cost == pytest.approx(fit.cost)
    assert fit.values["f"] == pytest.approx(1.5, rel=1e-3)
    assert fit.noise["y"][0] == pytest.approx(SIGMA, rel=0.15)
    assert fit.optima[0].cost == pytest.approx(fit.cost, rel=1e-9)
    assert fit.optima[1].cost > 10 * fit.cost


def test_starts_are_those_of_the_seed(tone):
    model, data = tone()
    fits = [ce.estimate(model, data, starts=3, seed=seed, **KNOWN) for seed in (1, 1, 2)]
    assert [o.cost for o in fits[0].optima] == [o.cost for o in fits[1].optima]
    starts = [drawn_starts(compile(model.parameters(), model.parameter_names), 4, seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[0][1:], starts[2][1:])
    assert fits[0].options["seed"] == 1
    assert fits[0].options["starts"] == 3


def test_starts_lie_within_the_bounds_and_reach(shaft_model):
    model = shaft_model()
    pars = model.parameters()
    pars["C_el"].set(0.0)
    pars["K_el"].set(100, min=90, max=110)
    pars.add("offset", -2.0)
    pars.constrain("offset + J_eng", -100.0, 100.0)
    pmap = compile(pars, model.parameter_names)
    sizes = np.where(np.array(pmap.free) == "C_el", 3.2, pmap.scale)  # as the data feel it: 0 is no size
    starts = np.array(drawn_starts(pmap, 200, 0, reach=3.0, scale=sizes))
    np.testing.assert_array_equal(starts[0], pmap.start)
    assert (starts >= pmap.lower).all()
    assert (starts <= pmap.upper).all()
    column = dict(zip(pmap.free, starts[1:].T, strict=True))
    assert 0.5 / 3 <= column["J_eng"].min() < 0.2
    assert 1.3 < column["J_eng"].max() <= 1.5
    assert np.median(column["J_eng"]) == pytest.approx(0.5, rel=0.2)  # in the logarithm
    assert column["K_el"].min() >= 90
    assert 9 < column["C_el"].max() <= 10
    assert -8 <= column["offset"].min() < column["offset"].max() <= 4


def test_some_of_many_starts_are_drawn_from_all_that_the_bounds_allow(shaft_model):
    pars = shaft_model().parameters()
    pars["K_el"].set(100, min=1e-2, max=1e6)
    pars["C_el"].set(1.0, min=0.0, max=1e3)
    pmap = compile(pars, shaft_model().parameter_names)
    starts = np.array(drawn_starts(pmap, 400, 0))
    column = dict(zip(pmap.free, starts.T, strict=True))
    assert column["K_el"][1:4] == pytest.approx(100, rel=2.1)  # the first ones are near
    assert column["K_el"][4::2].min() < 0.03
    assert column["K_el"][4::2].max() > 3e5
    assert np.abs(np.log(column["K_el"][5::2] / 100)).max() < np.log(3.001)
    assert column["C_el"][4::2].min() < 0.1  # from 0 on the logarithm has no end: a power of the reach
    assert column["C_el"].max() > 300
    assert (starts >= pmap.lower).all()
    assert (starts <= pmap.upper).all()


def test_a_start_at_which_the_model_fails_is_passed_over(line_data):
    b = ce.Blueprint("root")
    a = b.parameter("a", 3.0, min=1e-3, max=50)
    x = b.state("x")
    u1 = b.input("u1")
    b.input("u2")
    b.ode("x", ca.sqrt(a - 2.0) * u1)
    b.output("y", x)
    made = line_data(p=(1.5, 0.0))
    fit = ce.estimate(
        b.model(), made.data, starts=6, noise=ce.Noise(y=0.1), initial={"x": 0.0}, progress=False
    )
    assert fit.status == "converged"
    assert fit.values["a"] == pytest.approx(2 + 1.5**2, rel=0.05)
    assert 1 <= sum(optimum.starts for optimum in fit.optima) < 6


# ---- warm starts


def test_a_warm_start_needs_few_iterations(shaft, shaft_model):
    model, made = shaft_model(), shaft()
    cold = ce.estimate(model, made.data, progress=False)
    warm = ce.estimate(model, made.data, warm=cold, progress=False)
    assert warm.iterations < min(cold.iterations, 6)
    np.testing.assert_allclose(warm.z, cold.z, rtol=1e-7)
    np.testing.assert_allclose(warm.covariance, cold.covariance, rtol=1e-5)
    assert warm.start == pytest.approx(cold.values)


def test_a_warm_start_for_other_records_takes_the_parameters_alone(shaft, shaft_model):
    model = shaft_model()
    cold = ce.estimate(model, shaft().data, progress=False)
    other = shaft("other", seed=9)
    plain = ce.estimate(model, other.data, progress=False)
    fit = ce.estimate(model, other.data, warm=cold, progress=False)
    assert fit.status == "converged"
    np.testing.assert_allclose(fit.z, plain.z, rtol=1e-5)


def test_a_warm_start_is_moved_into_the_bounds(shaft, shaft_model):
    model = shaft_model()
    cold = ce.estimate(model, shaft().data, progress=False)
    pars = model.parameters()
    pars["K_el"].set(100, max=110)
    fit = ce.estimate(model, shaft().data, parameters=pars, warm=cold, progress=False)
    assert fit.estimates["K_el"].at_bound == "max"


def test_a_stored_result_warms_as_a_fit_does(shaft, shaft_model):
    class Stored:
        """What a result read from a file offers: numbers."""

        def __init__(self, fit):
            self.values = dict(fit.values)
            self.initial = {r: {s: e.value for s, e in states.items()} for r, states in fit.initial.items()}

    model, data = shaft_model(), shaft().data
    cold = ce.estimate(model, data, progress=False)
    warm = ce.estimate(model, data, warm=Stored(cold), progress=False)
    assert warm.start == pytest.approx(cold.values)
    assert warm.iterations <= cold.iterations
    np.testing.assert_allclose(warm.z, cold.z, rtol=1e-7)


def test_something_else_than_a_result_is_refused_as_a_warm_start(run_up, refused):
    with refused(
        ce.errors.EstimationError,
        "warm is not a result to start from",
        seen="0.4",
        allowed="a Fit, or a result loaded from a file",
        cure="give the fit itself: warm=fit",
    ):
        ce.estimate(ce.one_inertia(), run_up(), warm=0.4, progress=False)


def test_a_result_of_another_model_is_refused_as_a_warm_start(run_up, refused):
    class Stored:
        def __init__(self):
            self.values = {"mass": 1.0, "k@run": 2.0}

    with refused(
        ce.errors.EstimationError,
        "warm is the result of another model: it has none of the parameters",
        seen="mass, k@run",
        allowed="J_eng, C_eng",
        cure="give a fit of this model, or of one that shares parameters with it, or leave warm out",
    ):
        ce.estimate(ce.one_inertia(), run_up(), warm=Stored(), progress=False)


def test_an_unknown_name_of_a_fit_is_a_named_error(run_up, refused):
    fit = ce.estimate(ce.one_inertia(), run_up(), progress=False)
    for found in (fit.estimates, fit.values, fit.stderr):
        with refused(ce.errors.UnknownNameError, "nothing of this name", seen="'J'", allowed="J_eng, C_eng"):
            found["J"]
        assert found.get("J") is None
    assert issubclass(ce.errors.UnknownNameError, KeyError)


# ---- progress


def test_progress_is_told_iteration_cost_and_fit(run_up):
    calls = []
    fit = ce.estimate(
        ce.one_inertia(), run_up(), noise=ce.Noise(omega=SIGMA), progress=lambda *told: calls.append(told)
    )
    assert [iteration for iteration, _, _ in calls] == list(range(fit.iterations + 1))
    assert calls[-1][1] == pytest.approx(fit.cost, rel=1e-6)
    assert calls[-1][2] == pytest.approx(fit.fit_percent["run_up"]["omega"]["simulation"], abs=0.01)
    assert all(type(part) in (int, float) for told in calls for part in told)


def test_progress_of_several_starts_begins_anew(tone):
    model, data = tone()
    calls = []
    options = {**KNOWN, "progress": lambda *told: calls.append(told)}
    ce.estimate(model, data, starts=3, **options)
    assert [iteration for iteration, _, _ in calls].count(0) == 3


def test_an_error_in_the_progress_function_is_not_swallowed(run_up):
    def broken(*_):
        raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        ce.estimate(ce.one_inertia(), run_up(), progress=broken)


@pytest.mark.parametrize("given", [True, "bar", 3])
def test_other_progress_is_refused(run_up, refused, given):
    with refused(
        ce.errors.EstimationError,
        "progress is not acceptable",
        seen=repr(given),
        allowed="None, False, or a function of (iteration, cost, fit percent)",
        cure="leave it out",
    ):
        ce.estimate(ce.one_inertia(), run_up(), progress=given)


# ---- ends before the optimum


def test_a_progress_function_that_returns_true_stops_and_keeps_the_best(shaft, shaft_model):
    costs = []

    def stop(iteration, cost, _):
        costs.append(cost)
        return iteration == 3

    fit = ce.estimate(shaft_model(), shaft().data, noise=ce.Noise(omega=0.05, omega_load=0.1), progress=stop)
    assert fit.status == "interrupted"
    assert not fit.converged
    assert len(costs) == 4
    assert fit.iterations <= 4
    assert any("stopped by the user" in message for message in fit.messages)
    assert np.isfinite([e.value for e in fit.estimates.values()]).all()
    more = ce.estimate(shaft_model(), shaft().data, warm=fit, progress=False)
    assert more.status == "converged"


def test_an_interrupt_ends_all_starts(tone):
    model, data = tone()
    calls = []

    def stop(*told):
        calls.append(told)
        return True

    fit = ce.estimate(model, data, starts=5, **{**KNOWN, "progress": stop})
    assert fit.status == "interrupted"
    assert len(calls) == 1


def test_an_interrupt_in_a_later_start_keeps_the_best_so_far(tone):
    model, data = tone(start=1.45)
    seen = []

    def stop(iteration, cost, _):
        seen.append(iteration)
        return seen.count(0) == 2

    fit = ce.estimate(model, data, starts=5, **{**KNOWN, "progress": stop})
    assert fit.status == "interrupted"
    assert fit.values["f"] == pytest.approx(1.5, rel=1e-3)
    assert sum(optimum.starts for optimum in fit.optima) == 2


def test_ctrl_c_keeps_the_best_point(tmp_path):
    script = tmp_path / "long.py"
    script.write_text(
        textwrap.dedent(
            """
            import time
            import numpy as np, casadi_engine as ce
            t = np.arange(400) * 0.02
            data = ce.Experiment.from_arrays("r", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
                T=np.full(400, 2.0), omega=4 * (1 - np.exp(-t / 0.8)) + 0.01 * np.sin(50 * t))
            def slow(iteration, cost, percent):
                if iteration == 2:
                    print("ready", flush=True)
                time.sleep(0.3 if iteration >= 2 else 0)
            fit = ce.estimate(ce.one_inertia(), data, progress=slow)
            print(fit.status, fit.iterations, round(fit.values["J_eng"], 2))
            """
        )
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    status, iterations, inertia = out.split()
    assert status == "interrupted"
    assert 2 <= int(iterations) <= 4
    assert 0.01 < float(inertia) < 10


def test_the_handler_of_ctrl_c_is_put_back(run_up):
    before = signal.getsignal(signal.SIGINT)
    ce.estimate(ce.one_inertia(), run_up(), progress=False)
    assert signal.getsignal(signal.SIGINT) is before


def test_too_few_iterations(run_up):
    fit = ce.estimate(ce.one_inertia(), run_up(), max_iterations=1, progress=False)
    assert fit.status == "not converged: the iterations ran out; allow more with max_iterations"
    assert not fit.converged
    assert fit.iterations == 1
    assert np.isfinite(fit.cost)
    assert "Next: try other starts" in str(fit)


def test_a_converged_start_is_preferred_to_a_lower_cost(tone, monkeypatch):
    from casadi_engine.estimation import search as module

    run = module.Search.run

    def spoilt(self, z, *, first=True, **options):
        found = run(self, z, first=first, **options)
        if not first:
            found.solution.status, found.merit = "not converged: for the test", 0.0
        return found

    monkeypatch.setattr(module.Search, "run", spoilt)
    model, data = tone()
    fit = ce.estimate(model, data, starts=3, **KNOWN)
    assert fit.status == "converged"
    assert {optimum.status for optimum in fit.optima} == {"converged", "not converged: for the test"}


def test_a_model_that_is_not_finite_at_the_start_is_refused(run_up, refused):
    b = ce.Blueprint("bad")
    a = b.parameter("a", 0.5)
    speed = b.state("omega_eng")
    torque = b.input("T")
    b.ode("omega_eng", torque * ca.log(-a))
    b.output("omega", speed, unit="rad/s")
    data = run_up()
    plain = ce.Experiment.from_arrays(
        "r", time=data["T"].time, units={"T": "1", "omega": "rad/s"}, T=data["T"].values,
        omega=data["omega"].values,
    )  # fmt: skip
    with refused(
        ce.errors.EstimationError,
        "the model cannot be evaluated at the start values",
        seen="a=0.5",
        allowed="values for which the equations give finite numbers",
        cure="change the start values or the bounds, or give first states: initial={...}",
    ):
        ce.estimate(b.model(), plain, progress=False)


@pytest.mark.parametrize("status", ["converged", "not converged: the iterations ran out"])
def test_an_optimum_above_what_a_run_from_the_start_explains_is_none_to_end_at(status):
    """Where a play makes chi-squared rough, an optimum at 3.2 per sample was given for a start at 1.7."""
    cost = {"nodes": 5.0, "optimum": 3.2, "run": 1.7, "end": 1.6}
    nothing = np.zeros(0)
    ends = {
        "nodes": Solution("optimum", nothing, nothing, "converged", 4, ""),
        "run": Solution("end", nothing, nothing, status, 3, ""),
    }
    search = SimpleNamespace(
        _descended=lambda x, exact=False: ends[x],
        _followed=lambda _: 99.0,
        _simulated=lambda _, resting: "run",
        _lower=lambda one, other: cost[one] < cost[other],
    )  # fmt: skip
    found = Search._solved(search, "nodes", exact=False)
    assert (found.x, found.status, found.iterations) == ("end", status, 7)


@pytest.mark.parametrize(("gap", "end"), [(0.0, "end"), (0.1, "optimum")])
def test_a_search_from_an_optimum_that_ends_above_it_is_made_by_gauss_newton(gap, end):
    """The exact Hessian led from chi-squared 1619 to 3120; what has gaps is no simulation, and may explain anything."""
    cost = {"start": 1.7, "optimum": 3.2, "end": 1.6}
    nothing = np.zeros(0)
    search = SimpleNamespace(
        _descended=lambda x, exact=False: Solution("optimum" if exact else "end", nothing, nothing, "converged", 4, ""),
        _followed=lambda _: 99.0,
        _simulated=lambda _, resting: None,
        _lower=lambda one, other: cost[one] < cost[other],
        problem=SimpleNamespace(at=lambda _: SimpleNamespace(gap=gap)),
    )  # fmt: skip
    assert Search._solved(search, "start", exact=True).x == end


@pytest.mark.parametrize(
    ("converged", "status", "near"),
    [
        (True, "converged", True),
        (False, "not converged: one more step would still lower chi-squared by 0.003, more than 0.001", True),
        (False, "not converged: the iterations ran out; allow more with max_iterations", False),
    ],
)
def test_a_fit_that_is_a_step_short_of_its_optimum_is_gone_on_with_from_there(converged, status, near):
    """From far off the search would leave it first."""
    assert is_near(SimpleNamespace(converged=converged, status=status)) is near
