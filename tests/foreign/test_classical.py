"""The classical test problems, simulated as written, to a relative 1e-5 of SciPy; stiff ones may be refused by name."""

import classical
import numpy as np
import pytest
from classical import LIMIT, NON_STIFF, PROBLEMS, STIFF, simulated

import casadi_engine as ce


@pytest.mark.parametrize("name", [problem.name for problem in NON_STIFF])
def test_non_stiff(name):
    """DETEST, 0 to 20 s, at 41 times."""
    answer = simulated(PROBLEMS[name])
    assert answer.refused is None, answer.refused
    assert answer.error <= LIMIT
    np.testing.assert_allclose(answer.run["out1"].time, PROBLEMS[name].time, rtol=1e-9)


@pytest.mark.parametrize("name", [problem.name for problem in STIFF])
def test_stiff(name):
    """Right, or refused with a message that says that the equations are stiff, or ask for too many steps."""
    answer = simulated(PROBLEMS[name])
    if answer.refused is not None:
        assert answer.refused.startswith("SimulationError")
        assert any(word in answer.refused for word in ("stiff", "steps", "tolerance")), answer.refused
        return
    assert answer.error <= LIMIT
    np.testing.assert_allclose(answer.run["out1"].time, PROBLEMS[name].time, rtol=1e-9)


@pytest.mark.parametrize("name", [problem.name for problem in STIFF])
def test_oracle_ends_at_the_published_values(name):
    """The stored numbers of the stiff problems are those of the Test Set for IVP Solvers."""
    problem = PROBLEMS[name]
    truth = problem.truth(problem.time)
    off = np.abs(truth[:, -1] - problem.published) / np.abs(truth).max(axis=1)
    assert off.max() < 1e-9


@pytest.mark.parametrize("name", ["A1", "A2", "A3", "A4", "D1", "D5", "E1", "E4"])
def test_oracle_meets_the_closed_forms(name):
    """The solutions that are known on paper, held against SciPy's."""
    t = classical.TWENTY
    known = {
        "A1": lambda: np.exp(-t),
        "A2": lambda: 1 / np.sqrt(1 + t),
        "A3": lambda: np.exp(np.sin(t)),
        "A4": lambda: 20 / (1 + 19 * np.exp(-t / 4)),
        "D1": lambda: _kepler(0.1, t),
        "D5": lambda: _kepler(0.9, t),
        "E1": lambda: np.sqrt(2 / np.pi / (t + 1)) * np.sin(t + 1),  # the Bessel function of order one half
        "E4": lambda: 30 + 2.5 * np.log(np.cosh(np.sqrt(0.0128) * t)),
    }
    assert np.abs(PROBLEMS[name].truth(t)[0] - known[name]()).max() < 2e-9 * np.abs(known[name]()).max()


def _kepler(e, t):
    """Kepler's equation by Newton steps; the abscissa of the orbit."""
    anomaly = t + e * np.sin(t)
    for _ in range(60):
        step = (anomaly - e * np.sin(anomaly) - t) / (1 - e * np.cos(anomaly))
        anomaly -= np.clip(step, -0.5, 0.5)
    return np.cos(anomaly) - e


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_both_ways_of_writing_agree(name):
    """CasADi's right-hand side and NumPy's, at random states near those of the run."""
    problem = PROBLEMS[name]
    import casadi as ca

    t, y = ca.SX.sym("t"), ca.SX.sym("y", len(problem.start))
    written = ca.Function("f", [t, y], [ca.vertcat(*problem.symbolic(t, ca.vertsplit(y)))])
    truth = problem.truth(problem.time)
    rng = np.random.default_rng(1)
    for k in (1, len(problem.time) // 2, -1):
        state = truth[:, k] * rng.uniform(0.9, 1.1, len(truth)) + 1e-3 * np.abs(truth).max(axis=1)
        now = float(problem.time[k])
        first, second = np.array(written(now, state)).ravel(), np.array(problem.numeric(now, state))
        np.testing.assert_allclose(first, second, rtol=1e-9, atol=1e-12 * max(np.abs(second).max(), 1e-30))


def test_a_wrong_answer_is_seen():
    """The measure of the error: one sample of the smallest component off by 1e-4 of its largest value."""
    problem = PROBLEMS["ROBER"]
    truth = problem.truth(problem.time)
    wrong = truth.copy()
    wrong[1, 20] += 1e-4 * truth[1].max()
    assert classical.relative_error(wrong, truth) > LIMIT
    assert isinstance(problem.model(), ce.Model)
