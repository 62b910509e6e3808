"""An effect whose size may be zero, or rests on a bound, is confirmed by nothing."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.withdrawal import held_to_sizes
from casadi_engine.estimation.fit import Estimate


@dataclass(frozen=True)
class Answer:
    effects: tuple
    confirmed: bool | None = True
    messages: tuple[str, ...] = ()


def effect(value, error, side=False, *, shape=False, interval=None):
    amplitude = Estimate(value, error, "N m", side, None, fixed=False, interval=interval)
    fading = Estimate(0.23, None, "rad/s", shape, None, fixed=False)
    parameters = {"torque": amplitude, "fading": fading}
    return SimpleNamespace(name="stribeck_friction", at="shaft", amplitude=amplitude, parameters=parameters)


@pytest.mark.parametrize(
    ("size", "confirmed"),
    [
        (effect(2.0, 0.1), True),
        (effect(1.6e7, 2.5e7), None),
        (effect(2604.0, None, "max"), None),
        # a peak at the lowest speeds that there are, beside dry friction whose corner is still rounded
        (effect(24.1, None, shape="min"), None),
        (effect(24.1, None), True),
        (effect(24.1, 0.3, shape="min"), True),
        (effect(24.1, None, shape="min", interval=(22.0, 26.0)), True),
    ],
)
def test_a_size_that_may_be_zero_or_is_at_a_bound_confirms_nothing(size, confirmed):
    found = held_to_sizes(Answer((size,)))
    assert found.confirmed is confirmed
    assert len(found.messages) == (confirmed is None)
    for words in found.messages:
        assert (
            "stribeck_friction at shaft, whose size may be zero within its errors, is at a bound, or has no error and "
            "a shape at a bound: that is no confirmation"
        ) in words


@pytest.mark.parametrize(
    ("delay", "error", "confirmed"), [(-5.8e-4, 5e-5, None), (5.8e-4, 5e-5, True), (-5.8e-4, 9e-4, None)]
)
def test_a_sensor_that_would_be_early_is_confirmed_by_nothing(delay, error, confirmed):
    """An eddy current brake with a memory of 10 ms was a sensor 0.6 ms early, confirmed, with a stiffness 70 standard
    errors off."""
    size = Estimate(delay, error, "s", False, None, fixed=False)
    one = SimpleNamespace(name="sensor_delay", at="sensor_x", amplitude=size, parameters={"delay": size})
    found = held_to_sizes(Answer((one,)))
    assert found.confirmed is confirmed
    assert any("x shown early, as no sensor does" in words for words in found.messages) is (
        delay < -2 * error
    )
