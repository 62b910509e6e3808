"""A repair looks for effects on records of a lower rate, and tells what it found in numbers of the whole data."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce

SIGMA, STEP, SAMPLES = 0.005, 0.002, 4200
TIME = np.arange(SAMPLES) * STEP
DRIVE = 40 * np.sin(6 * TIME) + 30 * np.sin(9.7 * TIME) + 20 * np.sin(2.1 * TIME * (1 + 0.02 * TIME))


def _model():
    b = ce.Blueprint("oscillator")
    k = b.parameter("k", 80.0, unit="N/m", min=1)
    c = b.parameter("c", 0.5, unit="N s/m", min=0)
    q, v, force = b.state("q", unit="m"), b.state("v", unit="m/s"), b.input("F", unit="N")
    spring = b.port("spring", "coupling", {"twist": q, "twist_rate": v})
    b.ode("q", v)
    b.ode("v", force - c * v - k * q - spring)
    b.output("q", q, unit="m")
    return b.model()


def _record(name, cubic, seed):
    def slope(t, x):
        return [x[1], np.interp(t, TIME, DRIVE) - 0.8 * x[1] - 100 * x[0] - cubic * x[0] ** 3]

    run = solve_ivp(slope, (0, TIME[-1]), [0, 0], t_eval=TIME, rtol=1e-8, atol=1e-10, max_step=0.01)
    q = run.y[0] + SIGMA * np.random.default_rng(seed).standard_normal(SAMPLES)
    return ce.Experiment.from_arrays(name, time=TIME, units={"F": "N", "q": "m"}, F=DRIVE, q=q)


def _repair(fresh):
    return ce.repair(
        _model(), _record("a", 200.0, 0), fresh=fresh, effects=["cubic_stiffness"], progress=False
    )


@pytest.mark.slow
def test_fits_errors_and_gaps_are_of_the_whole_data():
    fresh = _record("b", 200.0, 1)
    found = _repair(fresh)
    assert found.options["searched on"].startswith("records of a rate ")
    assert (found.verdict, found.confirmed) == ("named", True)
    size = found.effects[0].amplitude
    assert abs(size.value - 200) < 4 * size.stderr
    assert found.fit.n == found.null_fit.n == SAMPLES
    assert len(found.data[0]["q"]) == len(found.fresh[0]["q"]) == SAMPLES
    assert found.noise.sigma["q"][0] == pytest.approx(SIGMA, rel=0.05)
    for side in (found.gaps.estimation_after, found.gaps.validation_after):
        assert side.gap.samples == SAMPLES
        assert side.gap.rmse["q"] == pytest.approx(SIGMA, rel=0.05)
        assert side.gap.chi2_per_sample == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_a_gap_that_stays_is_not_taken_for_noise():
    """The fresh record has another spring: the effect is withdrawn, and the model without it does not fit."""
    found = _repair(_record("b", 20.0, 1))
    assert found.verdict == "unnamed"
    before = found.gaps.estimation_before.gap
    sigma = found.noise.sigma["q"][0]
    assert sigma < 3 * SIGMA
    assert before.chi2_per_sample == pytest.approx((before.rmse["q"] / sigma) ** 2)
    assert before.chi2_per_sample > 100
