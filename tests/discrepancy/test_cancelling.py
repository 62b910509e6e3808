"""Effects that take each other back: a small difference of two large laws is neither of them."""

from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy.cancelling import left_together, work_against_each_other

TIME = np.linspace(0, 1, 50)


def effect(port, name):
    return SimpleNamespace(candidate=SimpleNamespace(port=port), amplitude=f"{port}.{name}.size")


def linearised(effects, values, columns, scale=1.0):
    """A model linearised at these amplitudes, whose slopes (N, k) are of one output in some unit."""
    names = ("d", *(one.amplitude for one in effects))
    slopes = np.column_stack([np.ones(len(TIME)), *columns]) * scale
    measured = SimpleNamespace(values=scale * np.sin(6 * TIME))
    record = SimpleNamespace(
        slopes={"y": slopes}, path=SimpleNamespace(grid=SimpleNamespace(measured={"y": measured}))
    )
    turn = np.diag([2.0, *(0.5 for _ in effects)])  # directions are scaled parameters
    return SimpleNamespace(parameters=names, values=np.array([1.0, *values]), turn=turn, records=(record,))


def test_what_two_laws_do_together_is_held_against_the_larger():
    pair = [effect("body", "load"), effect("body", "fading")]
    null = linearised(pair, [3.0, -3.0], [np.ones(50), 0.98 * np.ones(50)])
    assert left_together(null, pair) == pytest.approx(0.02)
    assert work_against_each_other(null, pair)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_two_laws_that_differ_are_two(scale):
    pair = [effect("body", "friction"), effect("body", "drag")]
    null = linearised(pair, [3.0, -3.0], [TIME, TIME**3], scale)
    expected = np.linalg.norm(TIME - TIME**3) / np.linalg.norm(TIME)
    assert left_together(null, pair) == pytest.approx(expected)
    assert not work_against_each_other(null, pair)


def test_effects_at_two_ports_are_held_against_none_of_the_other():
    pair = [effect("body", "load"), effect("sensor_y", "offset")]
    null = linearised(pair, [3.0, -3.0], [np.ones(50), np.ones(50)])
    assert left_together(null, pair) == 1.0


def test_two_of_three_are_enough():
    three = [effect("body", one) for one in ("load", "fading", "drag")]
    null = linearised(three, [3.0, -3.0, 9.0], [np.ones(50), 0.98 * np.ones(50), TIME**2])
    assert work_against_each_other(null, three)


def test_effects_that_do_nothing_take_nothing_back():
    pair = [effect("body", "load"), effect("body", "fading")]
    assert left_together(linearised(pair, [0.0, 0.0], [TIME, TIME]), pair) == 1.0
