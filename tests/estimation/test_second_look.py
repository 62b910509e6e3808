"""A fit that hardly follows its data is searched once more, over short pieces of them first."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.second_look import BOTH, is_lost, looked_at_twice

NOT_WHITE = ("the residual of r/y is not white (neighbours correlate by 0.9): the model lacks something",)


@dataclass(frozen=True)
class Found:
    cost: float
    percent: float = 40.0
    messages: tuple[str, ...] = NOT_WHITE
    options: dict = field(default_factory=lambda: {"approach": "direct", "starts": 1})
    converged: bool = True
    innovations: object = None
    noise: dict = field(default_factory=dict)
    traces: dict = field(default_factory=dict)
    timing: dict = field(default_factory=lambda: {"total": 0.1})

    @property
    def fit_percent(self):
        return {"r": {"y": {"simulation": self.percent, "prediction": None}}}


@pytest.mark.parametrize(
    ("fit", "lost"),
    [(Found(50.0), True), (Found(50.0, percent=90.0), False), (Found(50.0, messages=()), False)],
)
def test_which_fits_are_lost(fit, lost):
    assert is_lost(fit) == lost
    if not lost:
        assert looked_at_twice(fit, None) is fit


@pytest.mark.parametrize(("cost", "taken"), [(40.0, True), (50.0, False)])
def test_the_better_one_is_the_answer_and_says_how_it_was_searched(cost, taken):
    asked = []

    def again(changed):
        asked.append(changed)
        return Found(cost)

    found = looked_at_twice(Found(50.0), again)
    assert asked == [{"approach": "prediction"}]
    assert found.cost == (40.0 if taken else 50.0)
    assert found.options["approach"] == BOTH


@pytest.mark.parametrize(
    "options", [{"approach": "prediction", "starts": 1}, {"approach": "direct", "starts": 5}]
)
def test_what_was_searched_otherwise_is_left(options):
    fit = Found(50.0, options=options)
    assert looked_at_twice(fit, None) is fit


def test_an_oscillator_that_was_met_at_a_wrong_frequency_is_found():
    """x' = v, v' = -w^2 x of 2.0 rad/s over 20 s, from 3.4: one search stays between the lines of the spectrum."""
    b = ce.Blueprint("oscillator")
    w, x, v = b.parameter("w", 3.4, unit="rad/s", min=0.1, max=20), b.state("x"), b.state("v", unit="1/s")
    b.ode("x", v)
    b.ode("v", -(w**2) * x - 0.02 * x**3)
    b.output("x", x)
    time = np.linspace(0, 20, 200)
    from scipy.integrate import solve_ivp

    swing = solve_ivp(
        lambda s, z: [z[1], -4 * z[0] - 0.02 * z[0] ** 3], (0, 20), [1.0, 0.0], t_eval=time, rtol=1e-9
    )
    seen = swing.y[0] + 0.05 * np.random.default_rng(0).standard_normal(200)
    record = ce.Experiment.from_arrays("r", time=time, units={"x": "1"}, x=seen)
    fit = ce.estimate(b.model(), record, initial={"x": 1.0, "v": 0.0}, interval="single", progress=False)
    assert fit.values["w"] == pytest.approx(2.0, abs=0.01)
    assert SimpleNamespace(**fit.options).approach in ("direct", BOTH)
