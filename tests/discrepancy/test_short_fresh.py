"""Fresh records that can confirm nothing."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.fresh import check_fresh
from casadi_engine.errors import ExperimentError


def cart():
    b = ce.Blueprint("cart")
    place, speed = b.state("x", unit="m"), b.state("v", unit="m/s")
    b.ode("x", speed)
    b.ode("v", b.input("F", unit="N") - b.parameter("c", 1.0, min=0) * speed)
    b.output("seen", place, unit="m")
    return b.model()


def record(name, count):
    time = np.arange(count) * 0.1
    units = {"F": "N", "seen": "m"}
    return ce.Experiment.from_arrays(name, time=time, units=units, F=np.sin(time), seen=0.5 * time**2)


def test_a_fresh_record_of_no_more_samples_than_first_states_is_refused():
    """Two samples, which two first states meet to rounding, had contradicted a friction that was right."""
    check_fresh(cart(), record("long", 3))
    with pytest.raises(
        ExperimentError,
        match="short' is too short to confirm anything; seen: 2 samples; allowed: more than the 2 first states",
    ):
        ce.repair(cart(), record("run", 200), fresh=record("short", 2), progress=False)
