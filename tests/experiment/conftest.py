"""Shared by the tests of the experiment room."""

import numpy as np
import pytest

from casadi_engine.experiment import Experiment

SPEED = 40 * np.pi  # 1200 rpm in rad/s


@pytest.fixture
def engine():
    """Three whole engine cycles at a swinging speed, 2 kHz, all channels on one time."""
    time = np.arange(601) / 2000
    theta = SPEED * time + 0.05 * np.sin(2 * SPEED * time)
    cycle = np.floor(theta / (4 * np.pi))
    return Experiment.from_arrays(
        "engine",
        time=time,
        units={"theta": "rad", "p1": "bar", "p2": "bar", "T_load": "N m", "omega": "rad/s"},
        theta=theta,
        p1=1 + 40 * np.exp(-30 * (1 - np.cos(theta / 2))) * (1 + 0.1 * cycle),
        p2=1 + 39 * np.exp(-30 * (1 - np.cos(theta / 2 - 1.5 * np.pi))),
        T_load=57 + 0.1 * np.sin(700 * time),
        omega=SPEED * (1 + 0.1 * np.cos(2 * SPEED * time)),
    )


@pytest.fixture
def refused():
    """Call something that must raise exactly one class, with every given piece of text in its message."""

    def check(error, pieces, call, *args, **kwargs):
        with pytest.raises(error) as caught:
            call(*args, **kwargs)
        assert type(caught.value) is error, repr(caught.value)
        message = str(caught.value)
        for piece in pieces:
            assert piece in message, f"{piece!r} is not in: {message}"
        assert caught.value.cure or caught.value.allowed
        return message

    return check
