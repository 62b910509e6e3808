"""Fresh records that can confirm nothing."""

import numpy as np
import pytest
from scipy.signal import lfilter

import casadi_engine as ce
from casadi_engine.discrepancy.fresh import check_fresh
from casadi_engine.errors import ExperimentError


@pytest.mark.parametrize(("kept", "fine"), [(1, False), (2, True)])
def test_a_fresh_record_of_no_more_samples_than_first_states_is_refused(kept, fine):
    """Two samples, which two first states meet to rounding, had contradicted a friction that was right."""
    b = ce.Blueprint("body")
    speed = b.state("v", unit="m/s")
    b.ode("v", b.input("F", unit="N") - b.parameter("c", 1.0, min=0) * speed)
    b.output("seen", speed, unit="m/s")
    model, time = b.model(), np.arange(200) * 0.05
    force = np.repeat(np.random.default_rng(1).uniform(-1, 1, 20), 10)
    seen = lfilter([0, 0.05], [1, -0.95], force) + 0.01 * np.random.default_rng(2).standard_normal(200)
    made = [
        ce.Experiment.from_arrays(
            n, time=time[:k], units={"F": "N", "seen": "m/s"}, F=force[:k], seen=seen[:k]
        )
        for n, k in (("run", 200), ("short", 2))
    ]
    short = made[1]
    if kept < 2:
        held = np.array([seen[0] + 1e-3, np.nan])
        short = ce.Experiment.from_arrays(
            "short", time=time[:2], units={"F": "N", "seen": "m/s"}, F=force[:2], seen=held
        )
    if fine:
        check_fresh(model, short)
    else:
        with pytest.raises(ExperimentError, match=r"short is too short to confirm anything; seen: 1 sample;"):
            ce.repair(model, made[0], fresh=short, progress=False)
