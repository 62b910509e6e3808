"""An input that no equation uses: nothing that is late or wrong of it acts."""

import numpy as np

import casadi_engine as ce
from casadi_engine.effects.candidate import candidates


def test_what_acts_on_nothing_is_neither_late_nor_wrong():
    """A lag of an input that was recorded in case it matters took part in the most probable repair so far."""
    b = ce.Blueprint("gimbal")
    j, w = b.parameter("J", 0.1, unit="kg m2"), b.state("w", unit="rad/s")
    torque, _ = b.input("T", unit="N m"), b.input("base", unit="rad/s")
    b.ode("w", torque / j)
    b.output("y", w, unit="rad/s")
    t = np.arange(50) * 0.1
    data = ce.Experiment.from_arrays(
        "run",
        time=t,
        units={"T": "N m", "base": "rad/s", "y": "rad/s"},
        T=np.sin(t),
        base=np.cos(t),
        y=np.sin(t),
    )
    skipped = []
    wanted = ce.effects.library("input_gain", "input_offset", "input_lag", "input_delay")
    found = candidates(b.model(), wanted, data, skipped=skipped)
    assert {one.at for one in found} == {"input_T"}
    assert {(one.at, one.why) for one in skipped if one.at == "input_base"} == {
        ("input_base", "no equation depends on base")
    }
