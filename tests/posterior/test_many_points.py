"""Many points side by side say what each of them says by itself."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.posterior.laplace_likelihood import LaplaceLikelihood
from casadi_engine.posterior.target import Target


def enzyme(*, start=None, stiff=1.0):
    """Michaelis-Menten, and a second substance that follows the first one fast."""
    b = ce.Blueprint("enzyme")
    top = b.parameter("Vm", 0.5, unit="mM/s", min=0.05, max=5)
    half = b.parameter("K", 0.5, unit="mM", min=0.05, max=5)
    sub, seen = b.state("S", unit="mM"), b.state("seen", unit="mM")
    feed = b.input("feed", unit="mM/s")
    b.ode("S", feed - top * sub / (half + sub))
    b.ode("seen", (sub - seen) * 3.0 * stiff)
    b.output("seen", seen, unit="mM")
    b.output("rate", top * sub / (half + sub), unit="mM/s")
    t = np.linspace(0, 10, 60)
    given = 0.3 * (1 + np.sin(t))

    def rate(s, x):
        return [np.interp(s, t, given) - 0.8 * x[0] / (0.4 + x[0]), (x[0] - x[1]) * 3.0 * stiff]

    run = solve_ivp(rate, (0, 10), [3.0, 3.0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.17, method="LSODA")
    noise = np.random.default_rng(3).standard_normal((2, t.size))
    shown = 0.8 * run.y[0] / (0.4 + run.y[0]) + 0.02 * noise[1]
    data = ce.Experiment.from_arrays(
        "run", time=t, units={"feed": "mM/s", "seen": "mM", "rate": "mM/s"}, feed=given,
        seen=run.y[1] + 0.03 * noise[0], rate=shown,
    )  # fmt: skip
    return ce.estimate(b.model(), data, initial=start, progress=False)


KNOWN = {"S": 3.0, "seen": 3.0}


@pytest.mark.parametrize("start", [None, {"S": 3.0}, KNOWN])
@pytest.mark.parametrize("stiff", [1.0, 200.0])
def test_logs_and_squares_are_those_of_single_points(start, stiff):
    target = Target(enzyme(start=start, stiff=stiff))
    likelihood = target.likelihood
    assert isinstance(likelihood, LaplaceLikelihood)
    implicit = likelihood._shots._search.records[0].single().propagator.fineness.scheme.implicit
    assert implicit is (stiff > 1)
    rng = np.random.default_rng(0)
    u = target.start + 0.05 * rng.standard_normal((40, len(target.start)))
    v, sigma = u[:, : target.nv], target.sigma(u)
    many = likelihood._side_by_side(v, sigma)
    assert np.isfinite(many).all()
    alone = np.array([likelihood._value(*one) for one in zip(v, sigma, strict=True)])
    np.testing.assert_allclose(many, alone, rtol=0, atol=1e-5 * np.ptp(alone) + 1e-6)
    for one, found in zip(v[:3], target.squares_of(v[:3]), strict=True):
        expected = target.squares(one)
        assert found.cost == pytest.approx(expected.cost, rel=1e-6)
        np.testing.assert_allclose(found.gradient, expected.gradient, rtol=1e-4, atol=1e-4 * expected.cost)
        np.testing.assert_allclose(
            found.matrix, expected.matrix, rtol=1e-4, atol=1e-6 * np.abs(expected.matrix).max()
        )


def test_what_runs_off_is_asked_by_itself(monkeypatch):
    target = Target(enzyme(start=KNOWN))
    likelihood = target.likelihood
    v, sigma = np.tile(target.start[: target.nv], (20, 1)), target.sigma(np.tile(target.start, (20, 1)))
    run = likelihood._shots.side_by_side

    def lost(x, *more):
        found = run(x, *more)
        found[5] = np.nan
        return found

    monkeypatch.setattr(likelihood._shots, "side_by_side", lost)
    assert np.isnan(likelihood._side_by_side(v, sigma)).nonzero()[0].tolist() == [5]
    assert likelihood.value(v, sigma) == pytest.approx(np.full(20, likelihood._value(v[0], sigma[0])))


def test_what_does_not_agree_with_single_points_is_not_used(monkeypatch):
    target = Target(enzyme(start=KNOWN))
    likelihood = target.likelihood
    v, sigma = np.tile(target.start[: target.nv], (20, 1)), target.sigma(np.tile(target.start, (20, 1)))
    run = likelihood._shots.side_by_side
    monkeypatch.setattr(likelihood._shots, "side_by_side", lambda x, *more: 1.1 * run(x, *more))
    assert np.isnan(likelihood._side_by_side(v, sigma)).all()
    assert np.isnan(likelihood._side_by_side(v[:3], sigma[:3])).all()  # few are not worth it


def test_linear_models_have_ways_of_their_own():
    b = ce.Blueprint("decay")
    k = b.parameter("k", 1.0, unit="1/s", min=0.1, max=10)
    x = b.state("x", unit="V")
    b.ode("x", -k * x)
    b.output("x", x, unit="V")
    t = np.linspace(0, 3, 30)
    noise = 0.01 * np.random.default_rng(0).standard_normal(30)
    data = ce.Experiment.from_arrays("run", time=t, units={"x": "V"}, x=np.exp(-1.3 * t) + noise)
    target = Target(ce.estimate(b.model(), data, initial={"x": 1.0}, progress=False))
    assert not target.likelihood._shots.runs_side_by_side(target.likelihood.branches[0].best)
    points = target.start[None, : target.nv] + np.array([[0.0], [0.1]])
    each = [target.squares(one) for one in points]
    assert [one.cost for one in target.squares_of(points)] == [one.cost for one in each]
