"""Starts that cost many times what the best one did are given up; a fit whose time is over has the best point."""

import math

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp, ask
from casadi_engine.estimation import cut_short, multistart, workers
from casadi_engine.estimation.cut_short import GIVEN_UP, Starts, fineness_kept
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.search import Search
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

T = np.arange(120) * 0.05
TRUE = {"mu": 0.9, "rate": 1.3}


def swinging():
    b = ce.Blueprint("oscillator")
    mu, rate = (b.parameter(n, 1.05 * v, unit="1/s", min=0.1, max=5.0) for n, v in TRUE.items())
    x, v = b.state("x", unit="1"), b.state("v", unit="1/s")
    b.ode("x", v)
    b.ode("v", mu * (1 - x**2) * v - rate**2 * x)
    b.output("y", x, unit="1")
    return b.model()


@pytest.fixture(scope="module")
def record():
    model = swinging()
    pars = model.parameters()
    for name, value in TRUE.items():
        pars[name].set(value)
    bare = ce.Experiment.from_arrays("swing", time=T, units={"y": "1"}, y=np.zeros(len(T)))
    run = ce.simulate(model, bare, parameters=pars, initial={"x": 1.0, "v": 0.0})
    y = run["y"].values + 0.01 * np.random.default_rng(0).standard_normal(len(T))
    return ce.Experiment.from_arrays("swing", time=T, units={"y": "1"}, y=y)


@pytest.fixture
def costly(monkeypatch):
    """Drawn starts ask for work without end."""
    real = Search.run

    def run(self, z, *, first=True, **options):
        attempt = real(self, z, first=first, **options)
        if not first:
            for _ in range(100_000):  # without a limit it would come to an end all the same
                ask(1e3)
        return attempt

    monkeypatch.setattr(Search, "run", run)


def test_a_start_that_costs_too_much_is_given_up_and_said(record, costly):
    fit = ce.estimate(swinging(), record, starts=3, progress=False)
    assert fit.converged
    assert {name: round(fit.values[name], 1) for name in TRUE} == TRUE
    said = "2 of 3 starts given up: together they cost 20 times as much as the best one, and were not lower"
    assert said in fit.messages
    assert {one.status for one in fit.optima} == {"converged", GIVEN_UP}


def test_what_starts_have_lost_is_not_lost_again(record, costly, monkeypatch):
    """Each of three cost twenty times the first one, a minute in place of a second."""
    monkeypatch.setattr(cut_short, "FREE", 1e3)
    search = search_of(record)
    run = Starts(search)
    starts = search.drawn(4, 0)
    spent = []
    for k, start in enumerate(starts):
        with Deadline() as own:
            tuple(run([start], k == 0))
        spent.append(own.done)
    best = run._best[1]
    assert sum(spent[1:]) < 1.2 * cut_short.MANY * best + 3e3
    assert spent[1] > 0.9 * cut_short.MANY * best


def test_no_start_is_given_up_where_all_are_quick(record):
    fit = ce.estimate(swinging(), record, starts=3, progress=False)
    assert not any("given up" in text for text in fit.messages)
    assert all(one.status != GIVEN_UP for one in fit.optima)


def test_a_start_is_not_given_up_where_the_best_one_cost_nothing(record):
    """As a search in the frequency domain, which integrates nothing."""
    search = search_of(record)
    run = Starts(search)
    run._best = (-math.inf, 0.0)
    (found,) = run([search.drawn(2, 0)[1]], False)
    assert found.solution.status == "converged"


def test_a_costly_start_that_is_lower_goes_on(record, monkeypatch):
    """What it had come to is held against the best one so far."""
    search = search_of(record)
    starts = search.drawn(2, 0)
    with Deadline() as whole:
        assert search.run(starts[1], first=False).solution.status == "converged"
    monkeypatch.setattr(cut_short, "MANY", 0.7)
    monkeypatch.setattr(cut_short, "FREE", 0.0)
    run = Starts(search)
    run._best = (math.inf, whole.done)
    (found,) = run([starts[1]], False)
    assert found.solution.status == "converged"
    assert not found.cut
    run._best = (-math.inf, whole.done)
    (found,) = run([starts[1]], False)
    assert found.solution.status == GIVEN_UP
    assert found.cut


def search_of(record):
    return Search(
        swinging(), (record,), swinging().parameters(), None, interval="auto", initial=None,
        loss=read_loss("square"), ties="substitute", method="exact", max_iterations=50,
        tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


def test_what_one_start_asks_of_the_integration_is_not_asked_of_the_next(record):
    search = search_of(record)
    search.first_point()
    (term,) = search.records
    assert isinstance(term.propagator, RungeKuttaPropagator)
    before = term.propagator.fineness.counts.copy()
    back = fineness_kept(search)
    term.propagator._finer(8.0)
    assert term.propagator.fineness.counts.sum() > before.sum()
    back()
    assert np.array_equal(term.propagator.fineness.counts, before)


def stopped_after(search, evaluations, **options):
    """The attempts of a search under a deadline that is over after so many evaluations."""
    real, done = search.problem.at, []
    with Deadline(**options) as deadline:

        def at(x):
            done.append(1)
            if len(done) > evaluations:
                deadline.stop()
            ask()
            return real(x)

        search.problem.at = at
        return multistart.attempts_from(search, search.drawn(1, 0))


def test_once_the_time_is_over_the_best_point_so_far_is_the_outcome(record):
    search = search_of(record)
    (found,) = stopped_after(search, 30, best=True)
    assert (found.solution.status, found.cut) == ("interrupted", True)
    assert np.isfinite(found.merit)
    assert np.isfinite(found.v).all()


def test_who_wants_no_unfinished_answer_gets_none(record):
    with pytest.raises(TimeUp):
        stopped_after(search_of(record), 8)


def test_before_the_first_point_there_is_no_outcome(record):
    search = search_of(record)
    with pytest.raises(TimeUp):
        stopped_after(search, 0, best=True)


def test_a_fit_whose_time_is_over_is_interrupted_and_says_by_whom(record):
    steps = []
    now = [0.0]
    for by, end in (("the time budget", lambda _: now.append(9.0)), ("the user", Deadline.stop)):
        steps.clear()
        now[:] = [0.0]
        with Deadline(5.0, best=True, clock=lambda: now[-1]) as deadline:

            def progress(*_, end=end, deadline=deadline):
                steps.append(1)
                if len(steps) == 3:
                    end(deadline)

            fit = ce.estimate(swinging(), record, progress=progress)
        assert fit.status == "interrupted"
        assert any(text.startswith(f"stopped by {by}: this is") for text in fit.messages)
        assert len(steps) == 3


def test_a_process_whose_time_is_over_sends_what_it_has(record, monkeypatch):
    """Nothing where that was before the first point, and its best point after it."""
    arguments = {
        "model": swinging(), "data": (record,), "parameters": swinging().parameters(), "noise": None,
        "interval": "auto", "initial": None, "loss": read_loss("square"), "ties": "substitute", "method": "exact",
        "max_iterations": 50, "tolerance": 1e-9, "warm": None,
    }  # fmt: skip
    start = np.array([1.0, 1.2])
    assert workers._outcome(workers._Piece("one", arguments, start, True, 0.0)) is None
    whole = workers._outcome(workers._Piece("one", arguments, start, True, math.inf))
    assert whole.solution.status == "converged"

    def run(self, z, **options):
        real(self, z, **options)
        raise TimeUp

    real = Search.run
    monkeypatch.setattr(Search, "run", run)
    cut = workers._outcome(workers._Piece("one", arguments, start, True, math.inf))
    assert (cut.solution.status, cut.cut) == ("interrupted", True)
    np.testing.assert_allclose(cut.v, whole.v)


@pytest.mark.slow  # the process of the test above has none either
def test_two_processes_without_time_have_no_outcome(record):
    with Deadline(best=True) as deadline:
        deadline.stop()
        several = workers.Workers({}, 2, Interrupts())
        with pytest.raises(TimeUp):
            list(several.outcomes([np.zeros(2)] * 2, True))
