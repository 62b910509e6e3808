"""A torque that is held between its samples, read as joined by lines, is no delay of a sensor; a delay stays one."""

import sys
from itertools import chain, repeat
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.input_hold import OtherHold, other_hold

STEP, J, C, SIGMA = 0.05, 0.4, 0.5, 0.01


def record(*, held, late=0.0, read="first", seed=1, count=240):
    """A torque in random steps of eight samples on one inertia; speed shown ``late`` seconds late."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(count)
    torque = np.repeat(rng.uniform(-3, 3, count // 8), 8)

    def acting(s):
        return torque[min(int(s / STEP + 1e-9), count - 1)] if held else np.interp(s, t, torque)

    speed, w = [], 0.0
    for k in range(count):
        speed.append(w)
        run = solve_ivp(
            lambda s, y, k=k: (acting(0.5 * STEP + t[k]) if held else acting(s)) / J - C / J * y,
            (t[k], t[k] + STEP), [w], rtol=1e-10, atol=1e-12, dense_output=True,
        )  # fmt: skip
        w = run.y[0, -1]
        if late:
            speed[-1] = float(run.sol(t[k] + STEP - late)[0]) if k + 1 < count else w
    omega = np.array(speed) if not late else np.concatenate([[0.0], speed[:-1]])
    noisy = omega + SIGMA * rng.standard_normal(count)
    return ce.Experiment.from_arrays(
        "run", time=t, units={"T": "N m", "omega": "rad/s"}, hold={"T": read, "omega": "first"}, T=torque, omega=noisy
    )  # fmt: skip


def repaired(data, **options):
    return ce.repair(
        ce.one_inertia(),
        data,
        effects=["sensor_delay", "coulomb_friction"],
        starts=1,
        progress=False,
        **options,
    )


@pytest.fixture(scope="module")
def read_as_lines():
    return repaired(record(held=True))


def test_a_held_torque_is_said_to_be_held(read_as_lines):
    assert read_as_lines.verdict == "nothing missing"
    assert read_as_lines.data[0]["T"].hold == "zero"
    assert read_as_lines.fit.values["C_eng"] == pytest.approx(C, rel=0.02)
    words = " ".join(str(read_as_lines).split())
    assert "T is held between its samples: the records are " in words
    assert 'This answer is for record.with_hold(T="zero")' in words


def test_the_answer_is_that_of_records_read_so(read_as_lines):
    right = repaired(record(held=True, read="zero"))
    assert right.fit.values == pytest.approx(read_as_lines.fit.values, rel=1e-4)
    assert "hold" not in right.options


def test_lines_that_were_read_as_steps_are_said_to_be_lines():
    """That they are steps was asked for: a heater that a controller holds for 3 s was joined by lines, which did half
    of what a slow sensor does."""
    found = repaired(record(held=False, read="zero"))
    assert [one.key for one in found.effects] == ["sensor_omega.sensor_delay"]
    assert found.data[0]["T"].hold == "zero"
    words = " ".join(str(found).split())
    assert (
        "The delay is half a sample. If T is joined by lines between its samples, the records are " in words
    )


def test_a_sensor_that_is_late_by_half_a_sample_is_late():
    found = repaired(record(held=False, late=0.5 * STEP))
    assert [one.key for one in found.effects] == ["sensor_omega.sensor_delay"]
    assert found.effects[0].amplitude.value == pytest.approx(0.5 * STEP, rel=0.1)
    assert "hold" not in found.options


def test_where_the_time_does_not_last_for_another_search_both_are_said(monkeypatch):
    clock = chain([0.0], repeat(1000.0))  # what was done took a thousand seconds
    module = sys.modules["casadi_engine.discrepancy.repair"]
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    found = repaired(record(held=True), budget=1500)
    assert [one.key for one in found.effects] == ["sensor_omega.sensor_delay"]
    assert found.options["hold"].startswith("The delay is half a sample. If T is held between its samples, ")
    assert "where you know that, give record.with_hold" in " ".join(str(found).split())


def test_odds_that_decide_nothing_are_said_beside_the_delay(read_as_lines):
    other = OtherHold({"T": "zero"}, -1.0)
    assert not other.better
    assert other.told(read_as_lines, again=False).options["hold"] == (
        "The delay is half a sample. If T is held between its samples, the records are 0.61 times as probable without "
        'it: where you know that, give record.with_hold(T="zero")'
    )


@pytest.mark.parametrize(
    ("gain", "stands", "better"), [(0.7, True, True), (0.7, False, False), (20.0, False, True)]
)
def test_beside_a_delay_that_was_withdrawn_the_records_have_to_tell_it_alone(gain, stands, better):
    """An input that was joined by lines had been taken for held on odds of 1.4."""
    assert OtherHold({"T": "zero"}, gain, stands).better is better


def test_nothing_is_asked_without_a_delay(read_as_lines):
    assert other_hold(read_as_lines, None, {}, 1.0) is None
