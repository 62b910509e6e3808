"""Starts from far away: predictions over short pieces with free states, then over longer ones."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

import casadi_engine as ce
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.options import chosen
from casadi_engine.estimation.pieces import Pieces, _without_states, lengths
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.starts import nodes_from_measurement

NAMES = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
FACTORS = ((15.0, 0.1, 0.05, 5.0, 12.0), (0.03, 0.05, 30.0, 0.1, 20.0), (20.0, 20.0, 0.05, 0.05, 0.05))


def set_off(model, truth, factors):
    pars = model.parameters()
    for name, factor in zip(NAMES, factors, strict=True):
        pars[name].set(truth[name] * factor, min=0 if name[0] == "C" else 1e-6, max=1e6)
    return pars


def search_of(model, data, pars, noise=None):
    return Search(
        model, tuple(data), pars.copy(), noise, interval="auto", initial=None, loss=Loss(), ties="substitute",
        method="exact", max_iterations=50, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


def pieces_of(search, length):
    z = search.pmap.start
    return Pieces(
        search.records,
        [length] * len(search.records),
        lambda record: nodes_from_measurement(record, search.pmap.unpack(z, record.experiment.name)),
        search.sigma,
    )


@pytest.fixture
def swing():
    """A pendulum without linear core, and a record of it."""
    b = ce.Blueprint("pendulum")
    k, c = b.parameter("k", 20.0, min=0.1, max=1000), b.parameter("c", 0.1, min=0, max=10)
    angle, rate = b.state("angle", scale=1), b.state("rate", scale=5)
    torque = b.input("T")
    b.ode("angle", rate)
    b.ode("rate", torque - k * ca.sin(angle) - c * rate)
    b.output("y", angle)
    model, time = b.model(), np.arange(400) * 0.02
    push = 6 * np.sin(1.7 * time) + 4 * np.sin(5.1 * time + 1)
    plain = ce.Experiment.from_arrays("swing", time=time, units={"T": "1"}, T=push)
    y = ce.simulate(model, plain, initial={"angle": 1.0, "rate": 0.0})["y"].values
    y = y + 0.01 * np.random.default_rng(0).standard_normal(len(time))
    return model, ce.Experiment.from_arrays("swing", time=time, units={"T": "1", "y": "1"}, T=push, y=y)


# ---- hard starts


@pytest.mark.parametrize(
    "factors", [pytest.param(one, marks=pytest.mark.slow) if k != 1 else one for k, one in enumerate(FACTORS)]
)
def test_a_hard_start_arrives(shaft, shaft_model, factors):
    made, model = shaft(two=False), shaft_model(False)
    easy = ce.estimate(model, made.data, parameters=set_off(model, made.truth, (1,) * 5), progress=False)
    pars = set_off(model, made.truth, factors)
    fit = ce.estimate(model, made.data, parameters=pars, approach="prediction", progress=False)
    assert fit.converged
    assert fit.iterations < 15
    np.testing.assert_allclose(fit.z, easy.z, rtol=1e-4)
    assert fit.start == {name: pars[name].value for name in fit.free}
    assert fit.options["approach"] == "prediction"


@pytest.mark.slow
def test_the_direct_way_loses_what_the_approach_finds(shaft, shaft_model):
    made, model = shaft(two=False), shaft_model(False)
    levels = {}
    for way in ("direct", "prediction"):
        pars = set_off(model, made.truth, FACTORS[1])
        fit = ce.estimate(model, made.data, parameters=pars, approach=way, max_iterations=80, progress=False)
        levels[way] = fit.noise["omega"][0]
    assert levels["direct"] > 0.1
    assert levels["prediction"] == pytest.approx(0.05, rel=0.1)


def test_two_records_and_missing_samples(shaft, shaft_model):
    model, made = shaft_model(), [shaft("a", n=300), shaft("b", n=300, seed=3)]
    y = made[1].data["omega_load"].values.copy()
    y[::3] = np.nan
    second = ce.Experiment.from_arrays(
        "b",
        time=made[1].data["T"].time,
        units={"T": "N m", "T_load": "N m", "omega": "rad/s", "omega_load": "rad/s"},
        **{name: made[1].data[name].values for name in ("T", "T_load", "omega")},
        omega_load=y,
    )
    data = [made[0].data, second]
    easy = ce.estimate(model, data, parameters=set_off(model, made[0].truth, (1,) * 5), progress=False)
    pars = set_off(model, made[0].truth, FACTORS[1])
    fit = ce.estimate(model, data, parameters=pars, approach="prediction", progress=False)
    assert fit.converged
    np.testing.assert_allclose(fit.z, easy.z, rtol=1e-4)


def test_a_nonlinear_model_far_off(swing):
    model, data = swing
    pars = model.parameters()
    pars["k"].set(300.0)
    pars["c"].set(3.0)
    direct = ce.estimate(model, data, parameters=pars, max_iterations=20, progress=False)
    fit = ce.estimate(model, data, parameters=pars, approach="prediction", progress=False)
    assert fit.converged
    assert fit.values["k"] == pytest.approx(20.0, rel=0.01)
    assert fit.values["c"] == pytest.approx(0.1, rel=0.2)
    assert fit.cost <= direct.cost * (1 + 1e-6) or not direct.converged


@pytest.mark.slow
def test_a_fit_with_a_free_gain_is_approached_by_its_physical_parameters(shaft, shaft_model):
    made, model = shaft(two=False), shaft_model(False)
    noise = ce.Noise(omega="innovations")
    easy = ce.estimate(
        model, made.data, parameters=set_off(model, made.truth, (1,) * 5), noise=noise, errors="quadratic",
        progress=False,
    )  # fmt: skip
    pars = set_off(model, made.truth, FACTORS[0])
    fit = ce.estimate(model, made.data, parameters=pars, noise=noise, approach="prediction", progress=False)
    assert fit.converged
    # the gain is close to zero here, and the last fit ends in one of the optima that differ by it
    assert abs(fit.values["K_el"] - easy.values["K_el"]) < easy.stderr["K_el"]


def test_bounds_hold_and_a_warm_start_goes_straight(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    pars = set_off(model, made.truth, (1.0, 1.0, 0.1, 1.0, 1.0))
    pars["K_el"].set(max=100.0)
    fit = ce.estimate(model, made.data, parameters=pars, approach="prediction", progress=False)
    assert fit.estimates["K_el"].at_bound == "max"
    again = ce.estimate(model, made.data, parameters=pars, approach="prediction", warm=fit, progress=False)
    assert again.start == pytest.approx(fit.values)


def test_nothing_free(shaft, shaft_model):
    made, model = shaft(), shaft_model()
    pars = model.parameters()
    for name in NAMES:
        pars.fix(name, made.truth[name])
    fit = ce.estimate(model, made.data, parameters=pars, approach="prediction", progress=False)
    assert fit.converged
    assert fit.free == ()


@pytest.mark.parametrize("given", ["pieces", None, 1])
def test_another_approach_is_refused(given, run_up, refused):
    with refused(
        ce.errors.EstimationError,
        "approach is not acceptable",
        seen=repr(given),
        allowed='"direct" or "prediction"',
        cure="leave approach out",
    ):
        ce.estimate(ce.one_inertia(), run_up(), approach=given, progress=False)


def test_chosen_returns_the_word():
    assert chosen("way", "b", ("a", "b")) == "b"


# ---- one problem of pieces


@pytest.mark.parametrize("kind", ["one output", "two outputs, missing samples", "nonlinear"])
def test_the_projected_problem_is_that_of_dense_least_squares(kind, shaft, shaft_model, swing):
    if kind == "nonlinear":
        model, data = swing
        search = search_of(model, [data], model.parameters(), ce.Noise(y=0.1))
    else:
        two = kind.startswith("two")
        made, model = shaft(two=two, n=300), shaft_model(two)
        noise = ce.Noise(omega=0.05, omega_load=0.1) if two else ce.Noise(omega=0.05)
        search = search_of(model, [made.data], set_off(model, made.truth, (1.2,) * 5), noise)
    pieces = pieces_of(search, 48)
    record = pieces.records[0]
    if kind.startswith("two"):
        record.weight = record.weight * (np.random.default_rng(0).random(record.weight.shape) > 0.3)
        record._common = None
    v = search.coordinates.of(search.pmap.start)
    point = record.evaluate(v, pieces.starts[0])
    found = pieces.project(v, pieces.starts)
    k, m = point.r.shape
    wide = point.js if point.js.ndim == 3 else np.repeat(point.js[:, None], m, axis=1)
    js = block_diag(*[wide[:, i] * record.weight[:, i, None] for i in range(m)])  # pieces follow each other
    r, jz = point.r.T.ravel(), point.jz.transpose(2, 1, 0).reshape(m * k, -1)
    keep = np.eye(m * k) - js @ np.linalg.pinv(js, rcond=1e-9)
    assert found.cost == pytest.approx(0.5 * r @ keep @ r, rel=1e-6)
    np.testing.assert_allclose(found.gradient, jz.T @ keep @ r, rtol=1e-5, atol=1e-6 * np.abs(jz.T @ r).max())
    expected = jz.T @ keep @ jz
    np.testing.assert_allclose(found.matrix, expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
    states = np.linalg.lstsq(js, -r, rcond=1e-9)[0].reshape(m, -1)
    np.testing.assert_allclose(
        js @ found.nodes[0][0].ravel(), js @ states.ravel(), atol=1e-5 * np.abs(r).max()
    )


def test_pieces_end_where_scipy_does(shaft, shaft_model):
    made, model = shaft(two=False, n=400), shaft_model(False)
    search = search_of(
        model, [made.data], set_off(model, made.truth, (1.3, 0.8, 1.2, 1.5, 0.7)), ce.Noise(omega=0.05)
    )
    pieces = pieces_of(search, 64)
    record, nodes = pieces.records[0], pieces.starts[0]

    def rest(v):
        return _without_states(record, record.evaluate(v, nodes), np.ones(nodes.shape[1]))[0][0].ravel()

    v = search.coordinates.of(search.pmap.start)
    bounds = search.lower[:5], search.upper[:5]
    theirs = least_squares(rest, v, x_scale="jac", bounds=bounds, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    at, cost = pieces.descend(v, bounds, search.coordinates.log, 60)
    assert cost == pytest.approx(theirs.cost, rel=2e-4)
    assert pieces.cost(at) == pytest.approx(cost, rel=1e-6)
    np.testing.assert_allclose(at, theirs.x, rtol=0.05, atol=0.05)


def test_a_state_that_the_output_never_shows_stays(shaft, shaft_model):
    b = ce.Blueprint("unseen")
    p, x, u = b.parameter("p", 1.0, min=0.01), b.state("x"), b.input("u")
    b.state("z")
    b.ode("x", u - p * x)
    b.ode("z", u)
    b.output("y", x)
    rng = np.random.default_rng(0)
    u, y = np.sin(np.arange(80) * 0.3), np.zeros(80)
    for k in range(79):
        y[k + 1] = np.exp(-0.2) * y[k] + (1 - np.exp(-0.2)) / 2.0 * u[k]
    y += 1e-3 * rng.standard_normal(80)
    data = ce.Experiment.from_arrays(
        "r", time=np.arange(80) * 0.1, units={"u": "1", "y": "1"}, hold="zero", u=u, y=y
    )
    pars = b.model().parameters()
    pars["p"].set(30.0)
    fit = ce.estimate(
        b.model(), data, parameters=pars, noise=ce.Noise(y=1e-3), approach="prediction", progress=False
    )
    assert fit.values["p"] == pytest.approx(2.0, rel=0.01)


def test_process_noise_with_one_parameter_and_an_unseen_mode_is_refused(refused):
    b = ce.Blueprint("unseen")
    p, x, u = b.parameter("p", 1.0), b.state("x"), b.input("u")
    b.state("z")
    b.ode("x", u - p * x)
    b.ode("z", u)
    b.output("y", x)
    rng = np.random.default_rng(0)
    data = ce.Experiment.from_arrays(
        "r",
        time=np.arange(50) * 0.1,
        units={"u": "1", "y": "1"},
        u=rng.normal(size=50),
        y=rng.normal(size=50),
    )
    with refused(ce.errors.EstimationError, "the predictor has no stable gain at the start values"):
        ce.estimate(b.model(), data, noise=ce.Noise(y=0.1, process={"x": 1.0, "z": 1.0}), progress=False)


def test_lengths_grow_from_a_hundredth_to_less_than_a_half(shaft, shaft_model):
    made, model = shaft(two=False, n=3600), shaft_model(False)
    record = search_of(model, [made.data], model.parameters()).records[0]
    assert lengths(record) == [32, 128, 512]


def test_where_the_model_fails_a_candidate_is_passed_over(shaft, shaft_model):
    made, model = shaft(two=False, n=300), shaft_model(False)
    search = search_of(model, [made.data], model.parameters())
    pieces = pieces_of(search, 48)
    bad = np.full(5, 250.0)
    assert pieces.project(bad, pieces.starts) is None or np.isfinite(pieces.project(bad, pieces.starts).cost)
    bad = np.full(5, np.nan)
    assert pieces.cost(bad) == np.inf
    _, cost = pieces.descend(bad, (search.lower[:5], search.upper[:5]), search.coordinates.log, 5)
    assert cost == np.inf


def test_a_stop_ends_the_approach(shaft, shaft_model):
    made, model = shaft(two=False, n=300), shaft_model(False)
    search = search_of(model, [made.data], set_off(model, made.truth, (2,) * 5))
    pieces = pieces_of(search, 48)
    v = search.coordinates.of(search.pmap.start)
    at, _ = pieces.descend(v, (search.lower[:5], search.upper[:5]), search.coordinates.log, 20, lambda: True)
    np.testing.assert_array_equal(at, v)
