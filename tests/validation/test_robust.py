"""A fit with a robust loss is tested by what that loss makes of outliers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.experiment import Channel

SIGMA = 0.02


def _record(name: str, seed: int, gain: float = 1.0) -> ce.Experiment:
    """A heated body, 5 % of whose samples are 20 standard deviations off."""
    random = np.random.default_rng(seed)
    time = np.arange(300) * 0.1
    heat = 1.0 + np.sin(0.7 * time + seed) + 0.5 * np.sin(2.1 * time)
    run = solve_ivp(
        lambda t, y: [(np.interp(t, time, heat) - 0.8 * y[0]) / 1.5],
        (0, time[-1]),
        [0.4],
        t_eval=time,
        rtol=1e-9,
        max_step=0.05,
    )
    read = gain * run.y[0] + SIGMA * random.standard_normal(len(time))
    off = random.random(len(time)) < 0.05
    read[off] += 20 * SIGMA * random.standard_normal(np.count_nonzero(off))
    return ce.Experiment.from_arrays(name, time=time, units={"P": "W", "T": "K"}, P=heat, T=read)


@pytest.fixture(scope="module")
def robust() -> ce.Fit:
    b = ce.Blueprint("body")
    C, G = (
        b.parameter("C", 1.0, unit="J/K", min=0.1, max=10),
        b.parameter("G", 1.0, unit="W/K", min=0.1, max=10),
    )
    T, P = b.state("T_body", unit="K"), b.input("P", unit="W")
    b.ode("T_body", (P - G * T) / C)
    b.output("T", T, unit="K")
    return ce.estimate(b.model(), _record("fitted", 1), loss="huber", progress=False)


@pytest.mark.parametrize("seed", range(2, 8))
def test_a_right_fit_passes_on_records_with_like_outliers(robust, seed):
    """40 of 40 failed: the mean square of a residual with outliers stood beside the noise without them."""
    fresh = _record("fresh", seed)
    check = ce.validate(robust, fresh)
    assert check.passed, check.failed
    assert "residuals beyond the knee of the Huber loss are clipped to it" in " ".join(str(check).split())
    seen = check.records["fresh"]["T"]
    assert np.array_equal(seen.trace.measured, fresh["T"].values)  # drawn and measured as it is
    assert seen.rmse > 3 * SIGMA


def test_a_wrong_gain_is_seen_beside_them(robust):
    check = ce.validate(robust, _record("other", 3, gain=1.1))
    assert "parameters" in check.failed or not check.passed


def test_a_louder_core_is_seen(robust):
    record = _record("loud", 4)
    loud = record["T"].values + 4 * SIGMA * np.random.default_rng(5).standard_normal(len(record["T"].values))
    record = record.with_channel(Channel("T", "K", time=record["T"].time, values=loud))
    assert "loud/T/size" in ce.validate(robust, record).failed


def test_its_own_data_are_no_fresh_ones(robust):
    check = ce.validate(robust)
    assert check.passed
    assert "tells nothing of fresh data" not in str(check)
