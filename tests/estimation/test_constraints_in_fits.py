"""Ties by substitution and as constraints, constraints on expressions and on natural frequencies."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.constraints import ParameterConstraints
from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.unreachable import unreachable
from casadi_engine.parameters import compile

SIGMA = 0.1
KNOWN = ce.Noise(y=SIGMA)
REST = {"x": 0.0}


def fitted(model, data, parameters=None, **options):
    """With the errors of the curvature: constraints, bounds and priors here speak against the data."""
    options = {"noise": KNOWN, "initial": REST, "progress": False, "errors": "quadratic", **options}
    return ce.estimate(model, data, parameters=parameters, **options)


def equality_constrained(phi, y, row, value, sigma=SIGMA):
    """Least squares with row @ p = value, and its covariance."""
    information = phi.T @ phi / sigma**2
    matrix = np.block([[information, row[:, None]], [row[None], np.zeros((1, 1))]])
    inverse = np.linalg.inv(matrix)
    return (inverse @ [*(phi.T @ y / sigma**2), value])[:2], inverse[:2, :2]


@pytest.mark.parametrize("noise", ["known", "estimated"])
def test_ties_as_constraints_give_the_same_answer(shaft, shaft_model, noise):
    model = shaft_model()
    pars = model.parameters()
    pars.add("ratio", 0.5, min=0.01, max=5)
    pars.tie("J_load", "ratio*J_eng")
    pars.tie("C_eng", "C_el*3/4")
    levels = ce.Noise(omega=0.05, omega_load=0.1) if noise == "known" else None
    fits = [
        ce.estimate(model, shaft().data, parameters=pars, ties=ties, noise=levels, progress=False)
        for ties in ("substitute", "constraint")
    ]
    one, other = fits
    assert one.status == other.status == "converged"
    assert set(one.free) == {"J_eng", "K_el", "C_el", "ratio"}
    assert set(other.free) == {*one.free, "J_load", "C_eng"}
    for name in one.values:
        assert other.values[name] == pytest.approx(one.values[name], rel=1e-6), name
        assert other.stderr[name] == pytest.approx(one.stderr[name], rel=1e-4), name
    assert other.cost == pytest.approx(one.cost, rel=1e-9)
    assert other.dof == one.dof
    for output in ("omega", "omega_load"):
        assert other.noise[output][0] == pytest.approx(one.noise[output][0], rel=1e-7)


def test_errors_go_through_ties_by_the_slope(shaft, shaft_model):
    model = shaft_model()
    pars = model.parameters()
    pars.add("period", 1.0)
    pars.tie("period", "2*pi*sqrt(J_load/K_el)")
    fit = ce.estimate(model, shaft().data, parameters=pars, progress=False)
    j, k = fit.values["J_load"], fit.values["K_el"]
    value = 2 * np.pi * np.sqrt(j / k)
    slope = np.zeros(len(fit.free))
    slope[fit.free.index("J_load")] = value / (2 * j)
    slope[fit.free.index("K_el")] = -value / (2 * k)
    assert fit.values["period"] == pytest.approx(value, rel=1e-12)
    assert fit.stderr["period"] == pytest.approx(np.sqrt(slope @ fit.covariance @ slope), rel=1e-9)


def test_bounds_of_a_tied_parameter_hold(line, line_data):
    made = line_data()
    pars = line().parameters()
    pars.add("sum", 1.0)
    pars.tie("sum", "p1 + p2")
    pars["sum"].set(max=0.6)
    fits = [fitted(line(), made.data, pars, ties=ties) for ties in ("substitute", "constraint")]
    values, covariance = equality_constrained(made.phi, made.y, np.ones(2), 0.6)
    for fit in fits:
        assert fit.values["sum"] == pytest.approx(0.6, abs=1e-7)
        np.testing.assert_allclose([fit.values["p1"], fit.values["p2"]], values, rtol=1e-6)
        np.testing.assert_allclose(
            [fit.stderr["p1"], fit.stderr["p2"]], np.sqrt(np.diag(covariance)), rtol=1e-5
        )
        assert fit.stderr["sum"] is None
        assert fit.estimates["sum"].why


# ---- constraints on expressions


@pytest.mark.parametrize(
    ("low", "high", "active"),
    [
        (0.2, 0.6, 0.6),
        (1.1, 1.4, 1.1),
        (1.0, 1.0, 1.0),
        (0.2, 1.4, None),
        (-np.inf, 0.6, 0.6),
        (1.1, np.inf, 1.1),
    ],
)
def test_a_two_sided_constraint_on_an_expression(line, line_data, low, high, active):
    made = line_data()
    pars = line().parameters()
    pars.constrain("p1 + p2", low, high)
    fit = fitted(line(), made.data, pars)
    assert fit.status == "converged"
    total = fit.values["p1"] + fit.values["p2"]
    if active is None:
        information = made.phi.T @ made.phi / SIGMA**2
        values, covariance = (
            np.linalg.solve(information, made.phi.T @ made.y / SIGMA**2),
            np.linalg.inv(information),
        )
    else:
        values, covariance = equality_constrained(made.phi, made.y, np.ones(2), active)
        assert total == pytest.approx(active, abs=1e-6)
        assert fit.correlation[0, 1] == pytest.approx(-1.0, abs=1e-6)
    np.testing.assert_allclose(fit.z, values, rtol=1e-6)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-4)
    assert fit.dof == (198 if active is None else 199)
    assert not any("not met" in message for message in fit.messages)


def test_a_constraint_that_hardly_acts_leaves_the_errors_of_the_data(line, line_data):
    """The truth may be inside by as much as the data tell: these errors are those without the constraint."""
    made = line_data()
    free = fitted(line(), made.data)
    pars = line().parameters()
    pars.constrain("p1 + p2", max=float(free.z.sum()) - 1e-4)
    fit = fitted(line(), made.data, pars)
    assert any("held by constraints" in message for message in fit.messages)
    np.testing.assert_allclose(fit.covariance, free.covariance, rtol=1e-2)


def test_errors_beside_a_constraint_count_with_all_of_its_range(line, line_data):
    """Data that tell the sum from 0.1 under its least to far above: it may be anywhere between both limits."""
    made = line_data(sigma=0.5)
    free = fitted(line(), made.data)
    slope = np.ones(2)
    error = float(np.sqrt(slope @ free.covariance @ slope))
    low = float(free.z.sum()) + 0.1 * error
    pars = line().parameters()
    pars.constrain("p1 + p2", low, low + 0.5 * error)
    fit = fitted(line(), made.data, pars)
    inside = slope @ fit.covariance @ slope
    assert inside == pytest.approx(error**2 / (1 + (1.96 / 0.5) ** 2), rel=0.02)


def test_a_nonlinear_constraint(shaft, shaft_model):
    model = shaft_model()
    pars = model.parameters()
    pars.constrain("K_el*(1/J_eng + 1/J_load)", 1000.0, 1010.0, name="stiffness over inertia")
    fit = ce.estimate(model, shaft().data, parameters=pars, progress=False)
    p = fit.values
    assert fit.status == "converged"
    assert p["K_el"] * (1 / p["J_eng"] + 1 / p["J_load"]) == pytest.approx(1000.0, rel=1e-7)
    slope = np.zeros(len(fit.free))
    slope[fit.free.index("K_el")] = 1 / p["J_eng"] + 1 / p["J_load"]
    slope[fit.free.index("J_eng")] = -p["K_el"] / p["J_eng"] ** 2
    slope[fit.free.index("J_load")] = -p["K_el"] / p["J_load"] ** 2
    spread = np.abs(slope) @ np.sqrt(np.diag(fit.covariance))
    assert np.sqrt(abs(slope @ fit.covariance @ slope)) < 1e-6 * spread


def test_a_constraint_in_casadi_symbols_is_that_of_the_text(line, line_data):
    fits = []
    for text in (True, False):
        pars = line().parameters()
        pars.constrain("p1 + p2" if text else pars.symbol("p1") + pars.symbol("p2"), max=0.6)
        fits.append(fitted(line(), line_data().data, pars))
    np.testing.assert_allclose(fits[0].z, fits[1].z, rtol=1e-9)


def test_a_constraint_holds_for_the_parameter_of_every_experiment(line, line_data):
    a, b = line_data("a"), line_data("b", seed=1, p=(1.5, 0.9))
    pars = line().parameters()
    pars.vary_by_experiment("p2")
    pars.constrain("p1 + p2", 0.9, 2.0)
    fit = fitted(line(), [a.data, b.data], pars)
    assert fit.values["p1"] + fit.values["p2@a"] == pytest.approx(0.9, abs=1e-6)
    assert fit.values["p1"] + fit.values["p2@b"] == pytest.approx(2.0, abs=1e-6)


def test_an_active_constraint_and_a_bound_together_hold_everything(line, line_data):
    pars = line().parameters()
    pars["p1"].set(1.0, max=1.2)
    pars.constrain("p1 + p2", min=0.8)
    fit = fitted(line(), line_data().data, pars)
    assert fit.values["p1"] == pytest.approx(1.2)
    assert fit.values["p1"] + fit.values["p2"] == pytest.approx(0.8, abs=1e-6)
    assert fit.stderr == {"p1": None, "p2": None}
    assert fit.estimates["p2"].why == "held by active bounds or constraints"


def test_a_constraint_that_cannot_be_met_is_said_so(line, line_data):
    pars = line().parameters()
    pars["p1"].set(1.0, min=-2, max=2)
    pars["p2"].set(1.0, min=-2, max=2)
    pars.constrain("p1**2 + p2**2", min=20.0, name="circle")
    fit = fitted(line(), line_data().data, pars, max_iterations=100)
    assert fit.status == (
        "not converged: no values within the bounds meet circle (the closest is 8, wanted at least 20)"
    )
    assert not fit.converged
    assert "not met: circle" in fit.messages


def test_a_linear_constraint_that_cannot_be_met_is_refused_before_the_fit(line, line_data, refused):
    pars = line().parameters()
    pars["p1"].set(1.0, min=-2, max=2)
    pars["p2"].set(1.0, min=-2, max=2)
    pars.constrain("p1 + p2", min=5.0)
    with refused(ce.errors.ConstraintError, "cannot be met"):
        fitted(line(), line_data().data, pars)


# ---- natural frequencies


@pytest.mark.parametrize("side", ["min", "max", "equal", "idle"])
def test_a_natural_frequency_is_kept(shaft, shaft_model, side):
    model = shaft_model()
    made = shaft()
    true = model.natural_frequency(1, made.truth)
    bounds = {"min": (1.02 * true, 2 * true), "max": (0.5 * true, 0.98 * true)}
    low, high = bounds.get(side, (0.5 * true, 2 * true) if side == "idle" else (1.01 * true, 1.01 * true))
    pars = model.parameters()
    pars.constrain_frequency(1, low, high)
    fit = ce.estimate(model, made.data, parameters=pars, progress=False)
    found = model.natural_frequency(1, fit.parameters)
    assert fit.status == "converged"
    gradient = frequency_slope(model, fit)
    sigma = np.sqrt(np.abs(gradient @ fit.covariance @ gradient))
    scale = np.abs(gradient) @ np.sqrt(np.diag(fit.covariance))
    if side == "idle":
        free = ce.estimate(model, made.data, progress=False)
        np.testing.assert_allclose(fit.z, free.z, rtol=1e-6)
        assert sigma > 1e-3 * scale
    else:
        assert found == pytest.approx({"min": low, "max": high, "equal": low}[side], rel=1e-7)
        assert sigma < 1e-5 * scale


def test_a_frequency_that_cannot_be_reached_is_named(shaft, shaft_model):
    model, made = shaft_model(), shaft()
    pars = model.parameters()
    pars["K_el"].set(120.0, min=50, max=200)
    pars["J_load"].set(0.18, min=0.1, max=1)
    pars["J_eng"].set(0.4, min=0.1, max=1)
    best = model.natural_frequency(
        1, {**made.truth, "K_el": 200.0, "J_load": 0.1, "J_eng": 0.1, "C_el": 0, "C_eng": 0}
    )
    pars.constrain_frequency(1, 2 * best, 3 * best)
    fit = ce.estimate(model, made.data, parameters=pars, max_iterations=60, progress=False)
    assert not fit.converged
    start, _, rest = fit.status.partition(" (the closest is ")
    assert start.startswith("not converged: no values within the bounds meet ")
    assert "frequency" in start
    assert float(rest.split(",")[0]) == pytest.approx(best, rel=0.02)
    assert rest.endswith(f"wanted at least {2 * best:.5g})")


def test_a_search_that_runs_out_of_iterations_does_not_blame_a_constraint_that_can_be_met(line, line_data):
    pars = line().parameters()
    pars.constrain("p1**2 + p2**2", min=20.0, name="circle")
    fit = fitted(line(), line_data().data, pars, max_iterations=1)
    assert fit.status == "not converged: the iterations ran out; allow more with max_iterations"


def test_two_constraints_that_exclude_each_other_are_both_named(line):
    pars = line().parameters()
    pars.constrain("p1 * p2", min=1.0, name="product")
    pars.constrain("p1**2 + p2**2", max=1.0, name="circle")
    coordinates = Coordinates(compile(pars, line().parameter_names))
    constraints = ParameterConstraints(line(), coordinates._pmap, coordinates)
    wide = np.full(2, np.inf)
    words = unreachable(constraints, [np.array([0.3, 0.1])], -wide, wide)
    assert [text.split(" (")[0] for text in words] == ["product", "circle"]
    # at the closest point p1 = p2 = p with (1 - p^2)^2 + ((2 p^2 - 1)/2)^2 least, as the circle is 2 at the start
    assert words[0] == "product (the closest is 0.75, wanted at least 1)"
    assert words[1] == "circle (the closest is 1.5, wanted at most 1)"
    assert unreachable(constraints, [], -wide, wide) == []
    held = np.array([0.5, 0.2])
    assert (
        unreachable(constraints, [held], held, held)[0] == "product (the closest is 0.1, wanted at least 1)"
    )


def frequency_slope(model, fit):
    """d f / d z by central differences."""
    slope = []
    for name in fit.free:
        step = 1e-5 * fit.values[name]
        up, down = ({**fit.values, name: fit.values[name] + s} for s in (step, -step))
        slope.append((model.natural_frequency(1, up) - model.natural_frequency(1, down)) / (2 * step))
    return np.array(slope)


def test_derivatives_of_all_constraints_are_exact(shaft_model):
    model = shaft_model()
    pars = model.parameters()
    pars.constrain("J_eng*K_el/exp(C_el)", 1.0, 100.0)
    pars.constrain("J_eng + 3*J_load", 0.1, 10.0)
    pars.constrain_frequency(1, 1.0, 30.0)
    coordinates = Coordinates(compile(pars, model.parameter_names))
    constraints = ParameterConstraints(model, coordinates._pmap, coordinates)
    v = coordinates.of(coordinates._pmap.start) + np.array([0.1, -0.2, 0.05, 0.3, 0.1])
    lam = np.array([0.7, -1.3, 2.1])
    _, jacobian = constraints.evaluate(v)
    hessian = constraints.hessian(v, lam)
    h = 1e-5
    for k, unit in enumerate(np.eye(5) * h):
        up, down = constraints.evaluate(v + unit), constraints.evaluate(v - unit)
        np.testing.assert_allclose(jacobian[:, k], (up[0] - down[0]) / (2 * h), rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(hessian[k], lam @ (up[1] - down[1]) / (2 * h), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12)


def test_a_frequency_constraint_needs_a_mode(line, line_data, refused, run_up):
    pars = ce.one_inertia().parameters()
    pars.constrain_frequency(1, 1.0, 2.0)
    with refused(ce.errors.ModelError, "there is no such oscillatory mode", seen="1", allowed="none"):
        ce.estimate(ce.one_inertia(), run_up(), parameters=pars, progress=False)


def test_a_frequency_constraint_needs_a_linear_core(refused):
    b = ce.Blueprint("pendulum")
    length = b.parameter("length", 1.0, min=0.1)
    angle, rate = b.state("angle"), b.state("rate")
    import casadi as ca

    b.ode("angle", rate)
    b.ode("rate", -9.81 / length * ca.sin(angle))
    b.output("y", angle)
    pars = b.model().parameters()
    pars.constrain_frequency(1, 0.1, 2.0)
    data = ce.Experiment.from_arrays("swing", time=np.arange(20) * 0.05, units={"y": "1"}, y=np.ones(20))
    with refused(
        ce.errors.ConstraintError,
        "a natural frequency is bounded, but the model has no linear core",
        seen="pendulum",
        allowed="a model with natural frequencies",
        cure="leave constrain_frequency out",
    ):
        ce.estimate(b.model(), data, parameters=pars, progress=False)


@pytest.mark.parametrize("width", [1e-9, 1e-4])
def test_limits_that_are_nearly_one_do_not_stop_the_profiles(width):
    """A tank that runs out: a distance of 0 from one of them, as 1e-12 of such a range is, had ended the process."""
    b = ce.Blueprint("tank")
    a, g = (
        b.parameter("a", 0.2, unit="1/s", min=0.05, max=25),
        b.parameter("g", 1.0, unit="m", min=0.1, max=50),
    )
    h = b.state("h", unit="m")
    b.ode("h", -a * h + a * g)
    b.output("h", h, unit="m")
    time = np.sort(np.append(0.0, np.random.default_rng(0).uniform(0, 20, 29)))
    level = 4 + 16 * np.exp(-0.3 * time) + 0.1 * np.random.default_rng(1).standard_normal(30)
    record = ce.Experiment.from_arrays("r", time=time, units={"h": "m"}, h=level)
    pars = b.model().parameters()
    pars.constrain("a + g", 3.0, 3.0 + width)
    fit = ce.estimate(b.model(), record, parameters=pars, progress=False)
    assert fit.converged
    assert 3.0 - 1e-6 < fit.values["a"] + fit.values["g"] < 3.0 + width + 1e-6
    interval = ce.profile(fit, "a")["a"].interval
    assert interval.low < fit.values["a"] < interval.high
