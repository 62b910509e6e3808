"""A fit is the simulation from its first states: intervals that are joined within a tolerance only do not count."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.estimation.integration import alike
from casadi_engine.estimation.multistart import settled
from casadi_engine.estimation.refit_problem import RefitProblem
from casadi_engine.estimation.starts import chained_nodes, joined_nodes
from casadi_engine.simulation.propagator import bends_between_samples

T = np.arange(700) * 0.005


def voltage(t):
    return 9 * np.sin(2 * np.pi * 0.8 * t) + 3 * np.sin(2 * np.pi * 1.9 * t + 1)


def motor():
    b = ce.Blueprint("motor")
    inertia = b.parameter("J", 1e-3, unit="kg m2", min=1e-5)
    d, dry = b.parameter("d", 1e-3, unit="N m s/rad", min=0), b.parameter("Tc", 0.03, unit="N m", min=0)
    kt, resistance = (
        b.parameter("kt", 0.05, unit="N m/A", min=1e-3),
        b.parameter("R", 1.0, unit="ohm", min=0.05),
    )
    i, w, u = b.state("i", unit="A"), b.state("w", unit="rad/s"), b.input("U", unit="V")
    b.ode("i", (u - resistance * i - kt * w) / 0.004)
    b.ode("w", (kt * i - d * w - dry * ca.tanh(w / 0.05)) / inertia)
    b.output("w", w, unit="rad/s")
    b.output("i", i, unit="A")
    return b.model()


@pytest.fixture(scope="module")
def turned():
    def rate(t, x):
        return [(voltage(t) - 1.4 * x[0] - 0.06 * x[1]) / 0.004,
                (0.06 * x[0] - 4e-4 * x[1] - 0.07 * np.tanh(x[1] / 0.05)) / 6e-4]  # fmt: skip

    x = solve_ivp(rate, (0, T[-1]), [0, 0], t_eval=T, method="LSODA", rtol=1e-8, atol=1e-10, max_step=5e-3).y
    rng = np.random.default_rng(1)
    w, i = (y + 0.018 * y.std() * rng.standard_normal(T.size) for y in x[::-1])
    units = {"U": "V", "w": "rad/s", "i": "A"}
    return ce.Experiment.from_arrays("turned", time=T, units=units, U=voltage(T), w=w, i=i)


@pytest.mark.slow
def test_narrow_friction_that_is_written_by_hand_converges_from_several_starts(turned):
    fit = ce.estimate(motor(), turned, starts=3, progress=False)
    assert fit.status == "converged"
    for name, value in {"J": 6e-4, "d": 4e-4, "Tc": 0.07, "kt": 0.06, "R": 1.4}.items():
        assert fit.values[name] == pytest.approx(value, rel=0.06)


def test_gaps_close_side_by_side_to_the_same_run(turned):
    problem = RefitProblem(motor(), (turned,), motor().parameters(), levels={"w": 1.0, "i": 0.1})
    (record,), v = problem.records, problem.coordinates.of(problem.pmap.start)
    run = chained_nodes(record, v, np.zeros(2))
    near = run + 0.05 * np.abs(run) * np.random.default_rng(0).standard_normal(run.shape)
    near[0] = 0.0
    given = near.copy()
    joined = joined_nodes(record, v, near)
    run = chained_nodes(record, v, np.zeros(2))  # by the steps that are taken now
    assert joined == pytest.approx(run, abs=1e-8)
    assert (near == given).all()
    near[1:] = 1e300  # steps from there are no numbers
    assert joined_nodes(record, v, near) == pytest.approx(run, abs=1e-12)


def attempt(merit, *, status="converged", run=True):
    return SimpleNamespace(solution=SimpleNamespace(status=status), merit=merit, run=run)


def test_a_start_whose_simulation_is_another_is_passed_over():
    attempts = [attempt(3.0), attempt(1.0), attempt(2.0)]
    search = SimpleNamespace(integrated=lambda one: attempt(one.merit, run=one.merit != 1.0))
    best, every = settled(search, attempts)
    assert best.merit == 2.0
    assert [one.merit for one in every] == [3.0, 1.0, 2.0]
    lost = SimpleNamespace(integrated=lambda one: attempt(one.merit, run=False))
    assert settled(lost, attempts)[0].merit == 1.0  # the best of what there is; the fit says what it is


def test_chi_squared_is_alike_within_a_tenth_of_a_standard_error():
    assert alike(100.009, 100.0)
    assert not alike(100.02, 100.0)
    assert alike(1e6 + 0.9, 1e6)


def test_drives_that_bend_between_samples_keep_the_linear_core():
    assert bends_between_samples(ce.two_mass())
    assert not bends_between_samples(ce.one_inertia())
