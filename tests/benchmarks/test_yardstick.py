"""The benchmarks' ground: equations, records, bound and opponents agree with one another and with other codes."""

import json

import cases
import chain
import numpy as np
import opponent_spectral
import ours
import pytest
import yardstick
from scipy.integrate import solve_ivp


@pytest.fixture(scope="module")
def case_b():
    return cases.case_b()


def test_matrices_are_those_of_the_reference_simulator():
    """The chain of `data/simulator`, written by another hand."""
    from simulator import crankshaft_shaft, two_mass_shaft

    pairs = (
        (crankshaft_shaft(), cases.CRANKSHAFT, cases.CRANKSHAFT_TRUTH),
        (two_mass_shaft(), cases.TWO_MASS, cases.TWO_MASS_TRUTH),
    )
    for shaft, shape, truth in pairs:
        a, b = shape.matrices(truth)
        expected = shaft.matrix()[1:, 1:]
        np.testing.assert_allclose(a, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
        if shape is cases.CRANKSHAFT:
            np.testing.assert_allclose(b[:, :-1], shaft.torque_columns()[1:], rtol=1e-14)
        assert b[shape.size - 1, -1] == pytest.approx(-1 / truth[shape.size - 1])


def test_hold_is_exact():
    """A ramp of torque over one sample, by an adaptive integrator."""
    shape, truth = cases.CRANKSHAFT, cases.CRANKSHAFT_TRUTH
    f, g, h = chain.discretise(shape, truth, cases.STEP)
    a, b = shape.matrices(truth)
    rng = np.random.default_rng(3)
    x0 = rng.standard_normal(13) * np.r_[np.ones(7), np.full(6, 1e-3)]
    u0, u1 = 100 * rng.standard_normal((2, 5))
    found = solve_ivp(
        lambda t, x: a @ x + b @ (u0 + (u1 - u0) * t / cases.STEP),
        (0, cases.STEP),
        x0,
        "DOP853",
        rtol=1e-12,
        atol=1e-15,
    )
    np.testing.assert_allclose(f @ x0 + g @ u0 + h @ u1, found.y[:, -1], rtol=1e-9, atol=1e-12)


def test_the_residual_at_the_truth_is_the_noise():
    """The record obeys the linear form with drives of the measured speed, noise and all."""
    record = cases.crankshaft_record("misfire", 1000, 7)
    noise = cases.SIGMA * np.random.default_rng(7).standard_normal(record.samples)
    start = np.array(json.loads(cases.STARTS_FILE.read_text())["misfire_1000rpm"])
    f, g, h = chain.discretise(cases.CRANKSHAFT, cases.CRANKSHAFT_TRUTH, cases.STEP)
    source = cases.kept_channels("crankshaft/misfire_1000rpm.csv.gz")
    drives = source.torques(record.speed)
    x, speed = start, []
    for k in range(2000):
        speed.append(x[0])
        x = f @ x + g @ drives[:, k] + h @ drives[:, k + 1]
    np.testing.assert_allclose(record.speed[:2000] - np.array(speed), noise[:2000], atol=1e-8)


def test_two_codes_give_the_same_chi_squared_and_bound(case_b):
    """Stepping and finite differences against bins and complex steps; a bound with a prior is smaller."""
    values = case_b.start(0)
    problem = opponent_spectral._Problem(
        case_b, values, [opponent_spectral.bins_of(r, case_b.sigma) for r in case_b.records]
    )
    residual = problem.residual(np.zeros(6))
    assert residual @ residual == pytest.approx(yardstick.chi_squared(case_b, values), rel=1e-6)
    truth = case_b.true_values
    scale = np.outer(truth, truth)
    one = yardstick.covariance_bound(case_b) / scale
    other = opponent_spectral.covariance(case_b, truth) / scale
    np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-3 * np.abs(one).max())


@pytest.mark.slow
def test_the_spectral_opponent_finds_the_optimum(case_b):
    """No parameter moved by a tenth of its error makes the answer's chi-squared smaller."""
    found = opponent_spectral.fit(case_b, case_b.start(0), lambda: None)["values"]
    least = yardstick.chi_squared(case_b, found)
    assert least < yardstick.chi_squared(case_b, case_b.true_values)
    errors = np.sqrt(np.diag(opponent_spectral.covariance(case_b, found)))
    for i, error in enumerate(errors):
        for sign in (-0.1, 0.1):
            moved = found.copy()
            moved[i] += sign * error
            assert yardstick.chi_squared(case_b, moved) > least


def test_the_package_sees_the_same_problem():
    """Free parameters, ties, bounds and priors of B21 arrive as they are, and A's answer is the opponent's."""
    wide = cases.case_b21()
    model, names = ours.model_of(wide)
    parameters = ours.parameters_of(wide, model, names, wide.start(0))
    free = [name for name in parameters if parameters[name].vary and not parameters[name].tie]
    assert free == list(wide.free)
    assert parameters["C4"].tie is not None
    assert parameters["C43"].prior == (2.5, 1.25)
    case = cases.case_a()
    package = ours.fit(case, case.start(0), lambda: None)["values"]
    other = opponent_spectral.fit(case, case.start(0), lambda: None)["values"]
    np.testing.assert_allclose(package, other, rtol=1e-5)


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=pytest.mark.slow) for seed in (13, 3, 7)]
)  # a search that ends at the first valley it meets misses the lowest
def test_of_the_valleys_of_noise_the_lowest_is_found_from_any_start(seed):
    records = tuple(
        cases.crankshaft_record(kind, 1200, 2000 + 10 * seed + k)
        for k, kind in enumerate(("normal", "misfire"))
    )
    case = cases.Case("two", cases.CRANKSHAFT, cases.CRANKSHAFT_TRUTH, tuple(cases.SIX), records, cases.SIX)
    fits = [
        ours.estimate(case, start) for start in (case.start(seed), case.start(seed + 1), case.true_values)
    ]
    ends = np.array([fit.cost for fit in fits])
    assert np.ptp(ends) < 1e-3
    assert ends.max() < yardstick.chi_squared(case, case.true_values)
