"""Free parameters that nothing asks for stay where they are, and the fit says so."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce


def _heated(used: bool = False) -> tuple[ce.Model, ce.Experiment]:
    b = ce.Blueprint("cup")
    C, G = (
        b.parameter("C", 30.0, unit="J/K", min=1, max=100),
        b.parameter("G", 3.0, unit="W/K", min=0.1, max=100),
    )
    idle = b.parameter("idle", 1.0, unit="K", min=0, max=1e4)
    T, P = b.state("T", unit="K"), b.input("P", unit="W")
    b.ode("T", (P - G * T) / C)
    b.output("T_cup", T + (idle - 1.0 if used else 0), unit="K")
    time = np.arange(120) * 0.5
    heat = np.where(time < 30, 60.0, 0.0)
    risen = 20.0 * (1 - np.exp(-np.minimum(time, 30) * 3 / 20)) * np.exp(-np.maximum(time - 30, 0) * 3 / 20)
    noise = 0.05 * np.random.default_rng(1).standard_normal(120)
    record = ce.Experiment.from_arrays(
        "run", time=time, units={"P": "W", "T_cup": "K"}, hold="zero", P=heat, T_cup=risen + noise
    )
    return b.model(), record


def test_what_stands_in_no_equation_is_kept_and_said() -> None:
    model, record = _heated()
    fit = ce.estimate(model, record)
    assert fit.values["idle"] == 1.0
    assert "idle" not in fit.free
    assert "idle stands in no equation of cup and was kept at 1" in str(fit)
    assert "Not determined" not in str(fit)
    assert abs(fit.values["C"] - 20) < 0.2
    assert model.parameters()["idle"].vary  # the model's own set is as it was


def test_what_is_used_is_estimated() -> None:
    model, record = _heated(used=True)
    fit = ce.estimate(model, record, initial={"T": 0.0})
    assert "idle" in fit.free
    assert "stands in no equation" not in str(fit)


def test_what_has_a_prior_or_a_tie_is_asked_for() -> None:
    model, record = _heated()
    pars = model.parameters()
    pars["idle"].set(prior=(2.0, 0.1))
    fit = ce.estimate(model, record, parameters=pars)
    assert abs(fit.values["idle"] - 2.0) < 1e-6
    pars = model.parameters()
    pars.tie("G", "3 * idle")
    fit = ce.estimate(model, record, parameters=pars)
    assert abs(fit.values["idle"] - 1.0) < 0.05
    assert "idle" in fit.free


def test_what_a_set_says_and_nothing_asks_for_is_said():
    """A prior on what is fixed, 15 standard deviations away, and a misspelt record went by in silence."""
    b = ce.Blueprint("decay")
    rate, size = b.parameter("k", 0.5, min=0.01, max=10), b.parameter("a", 1.0, min=0.1, max=5)
    x = b.state("x")
    b.ode("x", -rate * size * x)
    b.output("y", x)
    time = np.arange(100) * 0.02
    noise = 0.02 * np.random.default_rng(0).standard_normal(100)
    data = ce.Experiment.from_arrays("run", time=time, units={"y": "1"}, y=np.exp(-1.2 * time) + noise)
    pars = b.model().parameters()
    pars["a"].set(prior=(3, 0.1))
    pars.fix("a", 1.0)
    pars.vary_by_experiment("k", values={"rum": 1.0})
    said = ce.estimate(b.model(), data, parameters=pars, progress=False).messages
    assert "a is fixed at 1: its prior, 3 ± 0.1, is not used" in said
    words = "k has its own value for rum, which is none of the records (run): look whether a name is misspelt"
    assert words in said
    pars.vary_by_experiment("k", values={"run": 1.0})
    pars.free("a")
    assert not ce.estimate(b.model(), data, parameters=pars, progress=False).messages
