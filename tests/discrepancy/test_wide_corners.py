"""Refits of laws with corners: from wide corners to sharp ones, from any start."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.discrepancy.path import Path
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.start import Start

GAP = 0.02


def drive():
    b = ce.Blueprint("drive")
    j1, j2 = (b.parameter(n, v, unit="kg m2", min=1e-4) for n, v in (("J1", 0.015), ("J2", 0.02)))
    k, c = b.parameter("k", 90.0, unit="N m/rad", min=1), b.parameter("c", 0.1, unit="N m s/rad", min=0)
    d1, d2 = (b.parameter(n, v, unit="N m s/rad", min=0) for n, v in (("d1", 0.01), ("d2", 0.1)))
    w1, w2 = (b.state(n, unit="rad/s") for n in ("w1", "w2"))
    twist, torque = b.state("twist", unit="rad"), b.input("T", unit="N m")
    coupling = b.port("coupling", "coupling", {"twist": twist, "twist_rate": w1 - w2, "stiffness": k})
    passed = k * twist + c * (w1 - w2) + coupling
    b.ode("w1", (torque - passed - d1 * w1) / j1)
    b.ode("w2", (passed - d2 * w2) / j2)
    b.ode("twist", w1 - w2)
    for name, state in (("w1", w1), ("w2", w2)):
        b.output(name, state, unit="rad/s")
    return b.model()


@pytest.fixture(scope="module")
def fitted():
    times = np.arange(500) * 0.004
    torque = 2.5 * np.sin(2 * np.pi * 1.1 * times) + 1.2 * np.sin(2 * np.pi * 2.7 * times)

    def rate(t, x):
        passed = 120 * (x[2] - np.clip(x[2], -GAP, GAP)) + 0.05 * (x[0] - x[1])
        now = np.interp(t, times, torque)
        return [(now - passed - 0.02 * x[0]) / 0.01, (passed - 0.08 * x[1]) / 0.03, x[0] - x[1]]

    x = solve_ivp(rate, (0, times[-1]), [0, 0, 0], t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.002).y
    noise = 0.1 * np.random.default_rng(3).standard_normal((2, times.size))
    record = ce.Experiment.from_arrays(
        "drive", time=times, units={"T": "N m", "w1": "rad/s", "w2": "rad/s"}, T=torque,
        w1=x[0] + noise[0], w2=x[1] + noise[1],
    )  # fmt: skip
    fit = ce.estimate(drive(), record, noise=ce.Noise(w1=0.1, w2=0.1), progress=False)
    return fit, record


@pytest.mark.parametrize(
    ("gap", "known"),
    [
        (0.002, False),
        *(
            pytest.param(gap, known, marks=pytest.mark.slow)
            for gap, known in ((0.002, True), (0.02, True), (0.02, False), (0.05, True), (0.05, False))
        ),
    ],
)
def test_a_play_is_found_from_any_start(fitted, gap, known):
    fit, record = fitted
    (candidate, *_) = screen(fit, ["backlash"], at=["coupling"]).candidates
    refitter = Refitter(fit.model, fit.model.parameters(), (record,), ce.Noise(w1=0.1, w2=0.1), base=fit)
    path = Path(refitter, {"w1": 0.1, "w2": 0.1})
    start = Start({"coupling.backlash.gap": gap} | (fit.values if known else {}))
    found = path.from_windows([addition(candidate, gap)], start)
    assert found.settled
    assert found.values["coupling.backlash.gap"] == pytest.approx(GAP, rel=0.03)
    assert found.cost / (2 * len(record["w1"].time)) == pytest.approx(1, abs=0.1)
