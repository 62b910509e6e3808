"""Windows of a record: the least squares that are left when their states are projected out."""

import itertools

import numpy as np
import pytest

import casadi_engine.estimation.windows as windows_module
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.estimation.windows import Windows, chained


@pytest.fixture
def problem(shaft, shaft_model):
    made, model = shaft("a"), shaft_model()
    pars = model.parameters()
    for name in pars.names:
        if name in made.truth:
            pars[name].set(made.truth[name] * 1.1)
    return RefitProblem(model, [made.data], pars, levels={"omega": 0.05, "omega_load": 0.05})


def windows_of(problem, count):
    record = problem.records[0]
    nodes = np.ones((record.plan.m, record.n))
    return Windows(problem.records, problem.priors, [count], [nodes])


@pytest.mark.parametrize("count", [1, 3, 1000])
def test_the_states_at_their_best(problem, count):
    """A linear model: the cost over windows is that of a fit of all their states, and one step closes all gaps."""
    record, v = problem.records[0], problem.coordinates.of(problem.pmap.start)
    count = min(count, record.plan.m)
    windows = windows_of(problem, count)
    windows(v)
    assert windows.closed() < 1e-4 * windows.best.squares.cost  # a weak spring keeps what is not known
    cost = windows.best.squares.cost
    starts, n = windows.best.records[0].starts, record.n

    zero = record.evaluate(v, np.zeros((record.plan.m, n))).path

    def residual(states):
        nodes = np.empty((record.plan.m, n))
        for k in range(record.plan.m):
            own = np.flatnonzero(starts == k)
            before = None if len(own) else zero.end_s[0] @ nodes[k - 1] + zero.end[:, k - 1]
            nodes[k] = states.reshape(-1, n)[own[0]] if len(own) else before
        return record.evaluate(v, nodes, order=0).r.ravel()

    size = len(starts) * n
    left = residual(np.zeros(size))
    slope = np.array([residual(row) - left for row in np.eye(size)]).T
    best = 0.5 * np.sum((left - slope @ np.linalg.lstsq(slope, left)[0]) ** 2)
    assert cost == pytest.approx(best, rel=1e-7)


def test_gaps_are_closed_at_the_best_point_alone(problem, monkeypatch):
    monkeypatch.setattr(windows_module, "_OPEN", np.inf)  # a linear model would close them at once
    v = problem.coordinates.of(problem.pmap.start)
    windows = windows_of(problem, 1000)
    windows(v)
    open_ = windows.gaps
    assert windows.closed_at(v + 1.0, 0.0) is None
    assert windows.closed_at(v, 2 * open_) is None
    assert windows.gaps == open_
    assert windows.closed_at(v, 0.5 * open_) is windows.best.squares
    assert windows.gaps < 1e-6 * open_


@pytest.mark.parametrize("count", [2, 1000])
def test_gradient_and_matrix(problem, count):
    record, v = problem.records[0], problem.coordinates.of(problem.pmap.start)
    count = min(count, record.plan.m)
    windows = windows_of(problem, count)
    windows(v)
    windows.closed()
    here = windows.best.squares
    for k in range(len(v)):
        costs = []
        for side in (1, -1):
            other = Windows(problem.records, problem.priors, [count], windows.best.nodes)
            step = np.zeros(len(v))
            step[k] = 1e-5 * side
            other(v + step)
            other.closed()
            costs.append(other.best.squares.cost)
        assert (costs[0] - costs[1]) / 2e-5 == pytest.approx(here.gradient[k], rel=1e-3, abs=1e-3 * here.cost)
    assert np.linalg.eigvalsh(here.matrix)[0] >= -1e-9 * np.trace(here.matrix)


def test_a_point_without_values_is_none(problem):
    windows = windows_of(problem, 2)
    v = problem.coordinates.of(problem.pmap.start)
    windows(v)
    before = windows.best
    assert windows(np.full(len(v), np.nan)) is None
    assert windows.best is before


@pytest.mark.parametrize("starts", [[0], [0, 17, 180], [0, 1, 2, 150], list(range(0, 301, 7))])
def test_windows_are_chained_in_blocks_as_one_by_one(starts):
    rng = np.random.default_rng(3)
    steps = 0.5 * rng.standard_normal((301, 2, 5))
    found = chained(steps, np.array(starts))
    for window, end in itertools.pairwise([*starts, 301]):
        now = np.hstack([np.eye(2), np.zeros((2, 3))])
        for k in range(window, end):
            assert found[k] == pytest.approx(now, rel=1e-9, abs=1e-12)
            now = steps[k, :, :2] @ now
            now[:, 2:] += steps[k, :, 2:]
