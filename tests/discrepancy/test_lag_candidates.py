"""Candidates with a state of their own: every time constant moves another one."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.compression import candidate_columns
from casadi_engine.discrepancy.families import costs_of, families_of
from casadi_engine.discrepancy.linearised import one_step
from casadi_engine.discrepancy.screening import screen

LAG, C, G = 20.0, 900.0, 6.0


@pytest.fixture(scope="module")
def screened():
    """A heated body whose probe follows with 20 s, by SciPy; the model shows its temperature at once."""
    t = np.arange(0, 900, 2.0)
    power = 300 + 250 * np.sign(np.sin(2 * np.pi * t / 210 + 0.4))

    def rate(s, x):
        return [(power[min(int(s // 2), len(t) - 1)] - G * x[0]) / C, (x[0] - x[1]) / LAG]

    run = solve_ivp(rate, (0, t[-1]), [0, 0], t_eval=t, rtol=1e-8, atol=1e-8, max_step=1.0)
    seen = run.y[1] + np.random.default_rng(3).normal(0, 0.2, t.size)
    data = ce.Experiment.from_arrays(
        "heat", time=t, units={"P": "W", "T": "K"}, hold={"P": "zero"}, P=power, T=seen
    )
    b = ce.Blueprint("body")
    c, g = b.parameter("C", 800.0, unit="J/K", min=1), b.parameter("G", 5.0, unit="W/K", min=0)
    temp, heat = b.state("temp", unit="K", scale=50), b.input("P", unit="W")
    b.ode("temp", (heat - g * temp) / c)
    b.output("T", temp, unit="K")
    fit = ce.estimate(b.model(), data, progress=False)
    return screen(fit, effects=[ce.effects.SensorLag(), ce.effects.SensorDelay()])


def test_every_time_constant_has_a_column_of_its_own(screened):
    """0.35 gave all of them that of the first one: lags from 15 s on were called delays, "confirmed"."""
    lags = [one for one in screened.candidates if one.effect == "sensor_lag"]
    (record,) = screened.null.records
    columns = candidate_columns(record, lags)["T"]
    sizes = np.linalg.norm(columns, axis=0)
    assert len(lags) > 3
    assert (np.diff(sizes) > 0.5 * sizes[:-1]).all()
    # what the sensor is behind by, de/dt = -dy/dt - e/tau, by differences of the simulated output
    trace = screened.null.records[0].path
    y, step = trace.x[0], 2.0
    for one, column in zip(lags, columns.T, strict=True):
        tau = one.nuisance["time"]
        if tau < 5 * step:
            continue
        behind = np.zeros(len(y))
        for k in range(len(y) - 1):
            keep = np.exp(-step / tau)
            behind[k + 1] = keep * behind[k] - tau * (1 - keep) * (y[k + 1] - y[k]) / step
        assert np.linalg.norm(behind - column) < 0.05 * np.linalg.norm(column), one.label


def test_what_lies_between_two_values_of_a_grid_is_foretold_by_both(screened):
    families = families_of(screened)
    step = one_step(screened.null, screened.candidates, screened.noise.sigma)
    own = families["sensor_lag", "sensor_T"]
    foretold = costs_of(screened, step, families)["sensor_lag", "sensor_T"]
    assert foretold <= step.cost[own].min()
    assert foretold == pytest.approx(step.between[own].min())
