"""A sensor that reads in steps, with no noise beside them: what comes back with the motion is no missing effect."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.rounding import beyond_rounding, rounded, rounded_levels, step_of


@given(st.floats(1e-6, 1e6), st.floats(-1e3, 1e3), st.integers(0, 1000))
def test_the_step_is_read_off_the_data(step, offset, seed):
    turns = np.random.default_rng(seed).integers(-20, 20, 200)
    assert step_of(step * (turns + offset)) == pytest.approx(step, rel=1e-6)


def test_noise_has_no_step():
    assert step_of(np.random.default_rng(0).standard_normal(200)) is None


def test_two_values_have_no_step():
    assert step_of(np.array([0.0, 1.0, 0.0, 1.0])) is None


def _spring():
    b = ce.Blueprint("spring")
    k = b.parameter("k", 7.0, unit="N/m", min=0, max=100)
    c = b.parameter("c", 1.0, unit="N s/m", min=0, max=50)
    g = b.parameter("g", 16.0, unit="1", min=0, max=100)
    y, v, u = b.state("y", unit="m"), b.state("v", unit="m/s"), b.input("u", unit="N")
    p = b.port("mass", "inertia", {"speed": v, "angle": y})
    b.ode("y", v)
    b.ode("v", g * u - k * y - c * v + p)
    b.output("y", y, unit="m")
    return b.model()


def _record(name, *, frequency, size, step, noise=0.0, friction=0.0, seed=0):
    """A spring driven by a square wave, read in steps; by SciPy."""
    t = np.arange(900) * 0.05
    u = size * np.sign(np.sin(2 * np.pi * frequency * t + 1.0))

    def rate(x, s):
        return [s[1], 20 * np.interp(x, t, u) - 9 * s[0] - 1.2 * s[1] - friction * np.tanh(s[1] / 1e-2)]

    run = solve_ivp(rate, (0, t[-1]), [0, 0], t_eval=t, max_step=0.025, rtol=1e-8, atol=1e-10)
    y = run.y[0] + noise * step * np.random.default_rng(seed).standard_normal(900)
    return ce.Experiment.from_arrays(
        name, time=t, units={"u": "N", "y": "m"}, u=u, y=step * np.round(y / step)
    )


def _null(step, noise):
    record = _record("run", frequency=0.31, size=1.0, step=step, noise=noise)
    fit = ce.estimate(_spring(), record, initial={"y": 0.0, "v": 0.0}, progress=False)
    return null_model(fit)


def test_noise_beside_the_steps_hides_them():
    assert rounded(_null(0.5, 0.0).records[0], "y") is not None
    assert rounded(_null(0.5, 1.0).records[0], "y") is None


def test_scores_by_rounding_alone_raise_the_level():
    null = _null(0.8, 0.0)
    (record,) = null.records
    columns = {record.name: {"y": record.slopes["y"] + np.sin(record.time["y"])[:, None]}}
    sigma = float(np.std(record.residual["y"]))
    made = rounded_levels(null, columns, {"y": sigma})
    assert all(level > sigma for level in made.values())
    assert not rounded_levels(_null(0.8, 1.0), columns, {"y": sigma})


def test_a_test_that_rounding_alone_fails_is_no_alarm():
    (record,) = _null(0.8, 0.0).records
    known = beyond_rounding(record, "y", lambda _: 1e-10)
    assert known(1e-10) == pytest.approx(np.exp(-1.0))
    assert known(1e-300) < 1e-12  # far beyond what rounding does
    assert beyond_rounding(record, "y", lambda _: 0.5)(1e-3) == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("frequency", "step"),
    [(0.49, 1.6), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((0.25, 1.6), (0.42, 0.16)))],
)
def test_nothing_is_missing_where_only_the_sensor_rounds(frequency, step):
    found = ce.repair(
        _spring(),
        _record("run", frequency=frequency, size=1.0, step=step),
        fresh=_record("fresh", frequency=1.3 * frequency, size=1.4, step=step),
        initial={"y": 0.0, "v": 0.0},
        starts=1,
        progress=False,
    )
    assert found.verdict == "nothing missing"


@pytest.mark.slow
def test_friction_is_found_behind_steps():
    found = ce.repair(
        _spring(),
        _record("run", frequency=0.31, size=1.0, step=0.16, friction=4.0),
        fresh=_record("fresh", frequency=0.4, size=1.4, step=0.16, friction=4.0),
        initial={"y": 0.0, "v": 0.0},
        progress=False,
    )
    assert [one.key for one in found.effects] == ["mass.coulomb_friction"]
    assert abs(found.effects[0].amplitude.value - 4.0) < 4 * found.effects[0].amplitude.stderr
