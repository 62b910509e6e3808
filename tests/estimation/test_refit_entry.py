"""Refits: the optimum of ``estimate`` at known levels, without what a person reads."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.estimation.refit_entry import RefitProblem, refit

LEVEL = 0.002


def pendulum(scale=5):
    b = ce.Blueprint("pendulum")
    stiff = b.parameter("w2", 40.0, unit="rad2/s2", min=1, max=200)
    damping = b.parameter("c", 0.05, unit="1/s", min=0, max=5)
    angle, rate = b.state("angle", unit="rad"), b.state("rate", unit="rad/s", scale=scale)
    pivot = b.port("pivot", "inertia", {"speed": rate, "angle": angle})
    b.ode("angle", rate)
    b.ode("rate", pivot - damping * rate - stiff * ca.sin(angle))
    b.output("y", angle, unit="rad")
    return b.model()


def decay(model, *, name="decay", seed=0, samples=500, begun=1.5, **values):
    """A free decay of the model with these values, sampled at 100 Hz."""
    pars = model.parameters()
    for key, value in values.items():
        pars[key.replace("__", ".")].set(value)
    time = np.arange(samples) * 0.01
    blank = ce.Experiment.from_arrays(name, time=time, units={"y": "rad"}, y=np.zeros(samples))
    run = ce.simulate(model, blank, parameters=pars, initial={"angle": begun, "rate": 0.0})
    y = run["y"].values + LEVEL * np.random.default_rng(seed).standard_normal(samples)
    return ce.Experiment.from_arrays(name, time=time, units={"y": "rad"}, y=y)


@pytest.fixture(scope="module")
def swing():
    model = pendulum()
    return model, [decay(model, w2=41.3), decay(model, name="again", seed=1, begun=0.4, samples=333, w2=41.3)]


@pytest.fixture(scope="module")
def rubbing():
    model = pendulum().with_effect(ce.effects.CoulombFriction(), at="pivot", values={"torque": 0.2})
    return model, [decay(model, w2=41.3, pivot__coulomb_friction__torque=0.6)]


def agree(found, fit, share=0.01):
    """Values within a share of their standard errors, and the same chi-squared."""
    assert found.converged
    assert found.cost == pytest.approx(fit.cost, abs=1e-3)
    errors = np.sqrt(np.diag(np.linalg.inv(found.information)))
    for k, name in enumerate(found.free):
        assert abs(found.values[name] - fit.values[name]) < share * errors[k]
        assert errors[k] == pytest.approx(fit.stderr[name], rel=1e-3)


def test_the_optimum_of_estimate_and_its_errors(swing):
    model, data = swing
    fit = ce.estimate(model, data, noise=ce.Noise(y=LEVEL), progress=False)
    found = refit(model, data, model.parameters(), levels={"y": LEVEL})
    agree(found, fit)
    size = len(found.free)
    errors = np.sqrt(np.diag(np.linalg.inv(found.information)))[size:]
    for number, record in enumerate(data):
        for k, state in enumerate(("angle", "rate")):
            own = fit.initial[record.name][state]
            assert abs(found.initial[record.name][state] - own.value) < 0.01 * own.stderr
            assert errors[2 * number + k] == pytest.approx(own.stderr, rel=1e-3)


def test_friction_and_a_warm_start_from_the_model_without(rubbing):
    model, data = rubbing
    pars = model.parameters()
    pars["pivot.coulomb_friction.width"].set(0.05)
    fit = ce.estimate(model, data, parameters=pars, noise=ce.Noise(y=LEVEL), progress=False)
    cold = refit(model, data, pars, levels={"y": LEVEL})
    base = pendulum()
    null = refit(base, data, base.parameters(), levels={"y": LEVEL})
    assert null.cost > 2 * fit.cost
    warm = refit(model, data, pars, levels={"y": LEVEL}, warm=null)
    for found in (cold, warm):
        agree(found, fit)
    again = refit(model, data, pars, levels={"y": LEVEL}, warm=cold)
    agree(again, fit)
    assert again.steps < 0.7 * cold.steps
    assert again.fineness["decay"].counts.sum() >= cold.fineness["decay"].counts.sum()


def test_corners_become_as_sharp_as_the_motion_asks(rubbing, monkeypatch):
    """A width that was declared for speeds of 100 rad/s is far too wide here, until the motion is known."""
    width = "pivot.coulomb_friction.width"
    model = pendulum(scale=100).with_effect(ce.effects.CoulombFriction(), at="pivot", values={"torque": 0.2})
    pars = model.parameters()
    wide = refit(model, rubbing[1], pars, levels={"y": LEVEL}, corners=False)
    found = refit(model, rubbing[1], pars, levels={"y": LEVEL})
    assert wide.widths == {}
    assert found.widths[width] < pars[width].value / 2
    assert found.converged
    assert found.steps > wide.steps
    set_by_user = pars.copy()
    set_by_user[width].set(0.2)
    assert refit(model, rubbing[1], set_by_user, levels={"y": LEVEL}).widths == {}

    def fails(*_):
        raise FloatingPointError("not finite")

    monkeypatch.setattr(RefitProblem, "paths", fails)
    assert refit(model, rubbing[1], pars, levels={"y": LEVEL}).cost == pytest.approx(wide.cost)


def test_states_that_are_not_given_come_from_the_measurement(swing):
    model, data = swing
    part = {data[0].name: {"angle": 1.5}, data[1].name: {"angle": 0.4, "rate": "free"}}
    found = refit(model, data, model.parameters(), levels={"y": LEVEL}, initial=part, horizons=(None,))
    assert found.converged
    assert found.values["w2"] == pytest.approx(41.3, rel=1e-3)


def test_a_linear_model(shaft, shaft_model):
    made, model = shaft("a"), shaft_model()
    pars = model.parameters()
    for name in ("J_eng", "K_el"):
        pars[name].set(made.truth[name] * 1.2)
    levels = {"omega": 0.05, "omega_load": 0.05}
    fit = ce.estimate(
        model, made.data, parameters=pars, noise=ce.Noise(**levels), progress=False, errors="quadratic"
    )
    found = refit(model, [made.data], pars, levels=levels)
    agree(found, fit)


def test_residuals_in_time_with_their_slopes(rubbing):
    model, data = rubbing
    y = data[0]["y"].values.copy()
    y[40:60] = np.nan
    record = ce.Experiment.from_arrays("decay", time=data[0]["y"].time, units={"y": "rad"}, y=y)
    problem = RefitProblem(model, [record], model.parameters(), levels={"y": LEVEL})
    found = problem.run()
    own = found.records["decay"]
    assert np.array_equal(own.time["y"], record["y"].time[np.isfinite(y)])

    def simulated(values, initial):
        pars = model.parameters()
        for name, value in values.items():
            pars[name].set(value)
        run = ce.simulate(model, record, parameters=pars, initial=initial, tolerance=1e-9)
        return np.interp(own.time["y"], run["y"].time, run["y"].values)

    first = found.initial["decay"]
    base = simulated(found.values, first)
    # the integration of a fit moves no estimate, and its outputs by less than a fiftieth of the noise
    np.testing.assert_allclose(own.residual["y"], (base - y[np.isfinite(y)]) / LEVEL, atol=0.02)
    assert found.cost == pytest.approx(float(np.sum(own.residual["y"] ** 2)))
    for k, name in enumerate(found.free):
        step = 1e-5 * abs(found.values[name])
        moved = simulated({**found.values, name: found.values[name] + step}, first)
        slope = (moved - base) / LEVEL / step
        np.testing.assert_allclose(own.jacobian["y"][:, k], slope, atol=0.02 * np.abs(slope).max())
    for k, name in enumerate(first):
        moved = simulated(found.values, {**first, name: first[name] + 1e-6})
        slope = (moved - base) / LEVEL / 1e-6
        np.testing.assert_allclose(own.jacobian["y"][:, 2 + k + 1], slope, atol=0.02 * np.abs(slope).max())


def test_priors_bounds_starts_and_horizons(swing):
    model, data = swing
    pars = model.parameters()
    pars["w2"].set(41.0, prior=(41.0, 1e-3))
    pars["c"].set(0.4, min=0.2)
    fit = ce.estimate(model, data, parameters=pars, noise=ce.Noise(y=LEVEL), progress=False)
    found = refit(model, data, pars, levels={"y": LEVEL})
    assert found.converged
    assert found.cost == pytest.approx(fit.cost, rel=1e-6)
    assert found.values["c"] == 0.2
    assert found.prior_cost == pytest.approx(((found.values["w2"] - 41.0) / 1e-3) ** 2)
    plain = model.parameters()
    short = refit(model, data, plain, levels={"y": LEVEL}, horizons=(0.64, None), start={"w2": 60.0})
    assert short.converged
    direct = refit(
        model, data, plain, levels={"y": LEVEL}, horizons=(None,), start=short.values, initial=short.initial
    )
    assert direct.converged
    assert direct.cost == pytest.approx(short.cost, abs=1e-3)
    assert direct.steps < short.steps


@pytest.mark.parametrize("far", [1.5, 10.0, 190.0])
def test_a_start_far_off_arrives_over_short_windows(swing, far):
    model, data = swing
    near = refit(model, data, model.parameters(), levels={"y": LEVEL})
    found = refit(model, data, model.parameters(), levels={"y": LEVEL}, start={"w2": far, "c": 2.0})
    assert found.converged
    assert found.cost == pytest.approx(near.cost, abs=1e-3)


def test_what_ends_a_refit_is_its_status(swing):
    model, data = swing
    found = refit(model, data, model.parameters(), levels={"y": LEVEL}, most=1, start={"w2": 90.0})
    assert not found.converged
    assert "1 steps" in found.status
    b = ce.Blueprint("root")
    k = b.parameter("k", 1.0, min=0.1, max=10)
    x = b.state("y", unit="rad")
    b.ode("y", -k * ca.sqrt(x - 5))
    b.output("y", x, unit="rad")
    broken = b.model()
    found = refit(broken, data[:1], broken.parameters(), levels={"y": LEVEL})
    assert not found.converged
    assert "cannot be evaluated" in found.status
    assert found.cost == np.inf


def test_what_cannot_be_used_is_refused(swing):
    model, data = swing
    with pytest.raises(EstimationError, match="the noise level of y is not acceptable"):
        refit(model, data, model.parameters(), levels={})
    pars = model.parameters()
    pars.constrain(pars.symbols["w2"] - pars.symbols["c"], min=1.0)
    with pytest.raises(EstimationError, match="a refit keeps bounds, ties and priors alone"):
        refit(model, data, pars, levels={"y": LEVEL})


@pytest.mark.parametrize("linear", [True, False])
def test_the_motion_of_pieces_is_that_of_the_records(linear):
    """A model that is linear steps by blocks of samples, and has states at each of them all the same."""
    model = pendulum()
    if linear:
        b = ce.Blueprint("swing")
        angle, rate = b.state("angle", unit="rad"), b.state("rate", unit="rad/s", scale=5)
        b.ode("angle", rate)
        stiff, damping = b.parameter("w2", 40.0, unit="rad2/s2"), b.parameter("c", 0.05, unit="1/s")
        b.ode("rate", -damping * rate - stiff * angle)
        b.output("y", angle, unit="rad")
        model = b.model()
    record = decay(model, w2=41.3)
    problem = RefitProblem(model, [record], model.parameters(), levels={"y": LEVEL})
    (path,) = problem.measured_paths({"w2": 41.3, "c": 0.05})
    assert path.x.shape == (2, 500)
    assert np.std(path.x[0] - record["y"].values) < 2 * LEVEL
