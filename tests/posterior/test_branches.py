"""Posteriors of models that do not tell a sign: first states of the other one count as those of the fit do."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.posterior.modes import find_modes
from casadi_engine.posterior.target import Target

TIME = np.linspace(0, 3, 31)


@pytest.fixture(scope="module")
def squared():
    """x' = -k x, seen as x squared."""
    b = ce.Blueprint("squared")
    k = b.parameter("k", 1.0, unit="1/s", min=0.1, max=10)
    x = b.state("x")
    b.ode("x", -k * x)
    b.output("y", x**2)
    noise = 0.02 * np.random.default_rng(2).standard_normal(len(TIME))
    data = ce.Experiment.from_arrays("r", time=TIME, units={"y": "1"}, y=1.44 * np.exp(-1.4 * TIME) + noise)
    model, noise = b.model(), ce.Noise(y=0.02)
    begun = ce.estimate(model, data, noise=noise, initial={"x": 1.2}, progress=False)
    return ce.estimate(model, data, noise=noise, warm=begun, errors="quadratic", progress=False)


def test_first_states_of_either_sign_count(squared):
    """By symmetry they double the likelihood."""
    target = Target(squared)
    points = target.start + np.array([[0.0], [0.02], [-0.03]])
    both = target.log_density(points)
    assert [np.sign(one.best[-1]) for one in target.likelihood.branches] in ([1, -1], [-1, 1])
    del target.likelihood.branches[1]
    assert both - target.log_density(points) == pytest.approx(np.log(2), abs=0.02)


def test_of_branches_that_lead_to_one_end_one_counts(squared):
    target = Target(squared)
    first = target.likelihood.branches[0]
    points = target.start[None]
    before = target.log_density(points)
    target.likelihood.branches.append(first)
    assert target.log_density(points) == pytest.approx(before, abs=1e-9)
    sigma = np.array([0.02])
    assert target.likelihood.leads_to({"r": first.best[-1:]}, target.start, sigma)
    assert not target.likelihood.leads_to({"r": 5 * first.best[-1:]}, target.start, sigma)


def test_a_parameter_of_the_other_sign_is_where_a_search_starts():
    """A phase seen through its cosine: both signs of the detuning are as probable."""
    b = ce.Blueprint("loop")
    detuning = b.parameter("detuning", 1.0, unit="rad/s", min=-20, max=20)
    gain = b.parameter("gain", 2.0, unit="rad/s", min=0.1, max=50)
    phase = b.state("phase", unit="rad")
    b.ode("phase", detuning - gain * ca.sin(phase))
    b.output("x", ca.cos(phase), unit="1")
    time = np.arange(0, 2.01, 0.05)
    truth = solve_ivp(lambda _, x: 3.0 - 4.0 * np.sin(x), (0, 2), [0.0], t_eval=time, rtol=1e-10, atol=1e-12)
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(time))
    data = ce.Experiment.from_arrays("r", time=time, units={"x": "1"}, x=np.cos(truth.y[0]) + noise)
    fit = ce.estimate(
        b.model(), data, noise=ce.Noise(x=0.05), initial={"phase": 0.0}, progress=False, errors="quadratic"
    )
    target = Target(fit)
    modes = find_modes(target, fit, np.random.default_rng(0), wide=0)
    found = target.values(modes.at)[:, 0]
    assert sorted(np.sign(found)) == [-1, 1]
    assert modes.height[0] - modes.height[1] == pytest.approx(0.0, abs=1e-3)


def test_every_combination_of_signs_is_found():
    """Two inertias driven alike, each seen by its square: four optima, of which one sign at a time leads to two."""
    b = ce.Blueprint("squares")
    push = b.input("u")
    for k in (1, 2):
        gain = b.parameter(f"g{k}", 1.0, min=-5, max=5)
        x = b.state(f"x{k}")
        b.ode(f"x{k}", -k * x + gain * push)
        b.output(f"y{k}", x**2)
    u, noise = np.where(TIME < 1.5, 1.0, 0.3), 0.01 * np.random.default_rng(4).standard_normal((2, len(TIME)))
    begun = {"x1": 0.0, "x2": 0.0}
    bare = ce.Experiment.from_arrays("r", time=TIME, units={"u": "1"}, hold="zero", u=u)
    model = b.model()
    seen = ce.simulate(model, bare, initial=begun)
    data = ce.Experiment.from_arrays(
        "r", time=TIME, units=dict.fromkeys(("u", "y1", "y2"), "1"), hold="zero", u=u,
        y1=seen["y1"].values + noise[0], y2=seen["y2"].values + noise[1],
    )  # fmt: skip
    fit = ce.estimate(
        model, data, noise=ce.Noise(y1=0.01, y2=0.01), initial=begun, progress=False, errors="quadratic"
    )
    target = Target(fit)
    modes = find_modes(target, fit, np.random.default_rng(0), wide=0)
    signs = {tuple(np.sign(one).astype(int)) for one in target.values(modes.at)}
    assert signs == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
