"""A model that is written with jumps: what a repair gives back where nothing is missing."""

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import own_jumps
from casadi_engine.discrepancy.own_jumps import with_own_jumps
from casadi_engine.errors import ExperimentError

TRUTH = {"J": 0.004, "c": 0.03, "k": 0.06, "spring": 0.15}
REST, SIGMA = 0.2, 0.01


def throttle():
    b = ce.Blueprint("throttle")
    inertia = b.parameter("J", TRUTH["J"], unit="kg m2", min=1e-5)
    damping = b.parameter("c", 0.05, unit="N m s/rad", min=0)
    stiffness = b.parameter("k", 0.08, unit="N m/rad", min=0)
    spring = b.parameter("spring", 0.1, unit="N m", min=0)
    angle, speed = b.state("angle", unit="rad"), b.state("speed", unit="rad/s")
    torque = b.input("T", unit="N m")
    slot = b.port("plate", "inertia", {"speed": speed, "angle": angle})
    back = stiffness * (angle - REST) + spring * ca.sign(angle - REST)
    b.ode("angle", speed)
    b.ode("speed", (torque - damping * speed - back + slot) / inertia)
    b.output("angle", angle, unit="rad")
    return b.model()


@pytest.fixture(scope="module")
def record():
    times, rng = np.arange(340) * 0.015, np.random.default_rng(4)
    torque = sum(0.3 * np.sin(2 * np.pi * f * times + p) for f, p in ((0.35, 0.2), (0.9, 1.7), (1.9, 3.0)))

    def rates(t, x):
        back = TRUTH["k"] * (x[0] - REST) + TRUTH["spring"] * np.tanh((x[0] - REST) / 1e-4)
        return [x[1], (np.interp(t, times, torque) - TRUTH["c"] * x[1] - back) / TRUTH["J"]]

    found = solve_ivp(
        rates, (0, times[-1]), [REST, 0.0], t_eval=times, method="LSODA", rtol=1e-8, atol=1e-10, max_step=0.01
    )
    measured = found.y[0] + SIGMA * rng.standard_normal(len(times))
    units = {"T": "N m", "angle": "rad"}
    return ce.Experiment.from_arrays("swing", time=times, units=units, T=torque, angle=measured)


@pytest.fixture(scope="module")
def parameters():
    made = throttle().parameters()
    made.fix("J")
    return made


@pytest.fixture(scope="module")
def repaired(record, parameters):
    """The answer, and what it was made of: the answer with rounded jumps, and the arguments beside it."""
    asked = []

    def noted(*arguments):
        asked.extend(arguments)
        return with_own_jumps(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("casadi_engine.discrepancy.repair"), "with_own_jumps", noted)
        found = ce.repair(
            throttle(),
            record,
            parameters=parameters,
            effects=["coulomb_friction"],
            starts=1,
            progress=False,
        )
    rounded, *rest = asked
    return SimpleNamespace(found=found, rounded=rounded, rest=rest)


def test_where_nothing_is_missing_the_fit_is_of_the_equations_as_they_were_written(repaired):
    found = repaired.found
    assert found.verdict == "nothing missing"
    assert not found.model.corners
    assert found.fit is found.null_fit
    assert "equations as they were written" in str(found)
    for name in ("c", "k", "spring"):
        one = found.fit.estimates[name]
        assert one.stderr is not None
        assert abs(one.value - TRUTH[name]) < 3.5 * one.stderr


def test_where_the_written_equations_do_not_fit_as_well_the_rounded_ones_stay(repaired, monkeypatch):
    monkeypatch.setattr(own_jumps, "estimate", lambda *_, **options: repaired.found.fit)
    assert with_own_jumps(repaired.rounded, *repaired.rest).fit.values == repaired.found.fit.values
    monkeypatch.setattr(own_jumps, "FELT", -1e6)
    found = with_own_jumps(repaired.rounded, *repaired.rest)
    assert found is repaired.rounded
    assert found.model.corners
    assert "tanh stands in place of their jumps" in str(found)


def test_an_output_without_a_number_is_refused_by_name(record, parameters):
    empty = record.with_channel(replace(record["angle"], values=np.full(len(record["angle"].time), np.nan)))
    with pytest.raises(ExperimentError, match="every sample of this output is missing"):
        ce.repair(throttle(), empty, parameters=parameters, progress=False)
