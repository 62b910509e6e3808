"""The shooting problem's derivatives against differences, its sparsity, and the pieces of the covariance."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation.assembly import Pattern
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.starts import chained_nodes, nodes_from_measurement
from casadi_engine.estimation.uncertainty import in_words, invert, joint_multipliers
from casadi_engine.experiment import Channel


def search(model, records, *, parameters=None, noise=None, loss="square", interval=20, **options):
    """A search that is set up and not run."""
    from casadi_engine.experiment.experiment import with_unique_names

    return Search(
        model, with_unique_names(records), parameters or model.parameters(), noise, interval=interval,
        initial=None, loss=read_loss(loss), ties="substitute", method="exact", max_iterations=9,
        tolerance=1e-9, warm=None, progress=None, **options,
    )  # fmt: skip


def nonlinear():
    b = ce.Blueprint("hardening")
    inertia = b.parameter("J_eng", 0.5, unit="kg m2", min=1e-3)
    damping, cubic = b.parameter("C_eng", 0.2, min=0), b.parameter("cubic", 1e-3)
    speed = b.state("omega_eng", unit="rad/s", scale=20)
    torque = b.input("T", unit="N m", scale=10)
    b.ode("omega_eng", (torque - damping * speed - cubic * speed**3 / 10) / inertia)
    b.output("omega", speed + 0.01 * speed**2, unit="rad/s", scale=20)
    return b.model()


def off_grid(data):
    channel = data["omega"]
    return data.with_channel(
        Channel("omega", "rad/s", time=channel.time[1:-1] + 0.007, values=channel.values[1:-1])
    )


@pytest.fixture
def case(run_up, shaft, shaft_model):
    """Problems of every kind, small."""

    def make(name):
        small = [run_up("a", n=50, sigma=0.5, missing=0.1), run_up("b", n=37, seed=1, sigma=0.5)]
        if name == "linear":
            return search(ce.one_inertia(), small)
        if name == "huber":
            return search(ce.one_inertia(), small, loss="huber", noise=ce.Noise(omega=0.5))
        if name == "general":
            return search(nonlinear(), small, interval=10)
        if name == "off the grid":
            return search(nonlinear(), [off_grid(run_up(n=40))], interval=10)
        if name == "predictor":
            return search(ce.one_inertia(), small[1:], noise=ce.Noise(omega=0.5, gain=[[0.3]]))
        model = shaft_model()
        pars = model.parameters()
        pars.add("ratio", 0.5, min=0.1, prior=(0.45, 0.1))
        pars.tie("J_load", "ratio*J_eng")
        pars.vary_by_experiment("C_eng")
        pars["K_el"].set(prior=(110.0, 5.0))
        pars.constrain("K_el*J_eng", 10.0, 80.0)
        pars.constrain_frequency(1, 1.0, 9.0)
        return search(model, [shaft("a", n=60).data, shaft("b", n=45, seed=1).data], parameters=pars)

    return make


KINDS = ["linear", "huber", "general", "off the grid", "predictor", "everything"]


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_of_the_whole_problem(case, kind):
    made = case(kind)
    problem = made.problem
    rng = np.random.default_rng(0)
    x = made._start(made.pmap.start, first=True) + 0.01 * rng.standard_normal(problem.size)
    lam = rng.standard_normal(problem.rows)
    problem.exact = True
    point = problem.at(x)
    jacobian = problem.jacobian_pattern.matrix(problem.jacobian(x)).full()
    upper = problem.hessian_pattern.matrix(problem.hessian(x, 0.7, lam)).full()
    np.testing.assert_array_equal(upper, np.triu(upper))
    hessian = upper + np.triu(upper, 1).T
    gradient, constraints = point.gradient.copy(), point.constraints.copy()
    assert len(constraints) == problem.rows
    size_j, size_h = np.abs(jacobian).max(), np.abs(hessian).max()
    for k in rng.permutation(problem.size)[:40].tolist() + list(range(problem.nv)):
        step = np.zeros(problem.size)
        step[k] = 1e-6
        ends = []
        for sign in (1, -1):
            p = problem.at(x + sign * step)
            j = problem.jacobian_pattern.matrix(problem.jacobian(p.x)).full()
            ends.append((p.objective, p.constraints.copy(), 0.7 * p.gradient + j.T @ lam))
        (f1, g1, l1), (f0, g0, l0) = ends
        assert (f1 - f0) / 2e-6 == pytest.approx(gradient[k], rel=1e-5, abs=1e-6 * np.abs(gradient).max())
        np.testing.assert_allclose((g1 - g0) / 2e-6, jacobian[:, k], atol=2e-7 * size_j)
        np.testing.assert_allclose((l1 - l0) / 2e-6, hessian[k], atol=3e-6 * size_h)


@pytest.mark.parametrize("kind", KINDS)
def test_what_stands_in_for_the_hessian_is_positive(case, kind):
    made = case(kind)
    problem = made.problem
    x = made._start(made.pmap.start, first=True)
    problem.exact, problem.damping = False, 0.0
    upper = problem.hessian_pattern.matrix(problem.hessian(x, 1.0, np.zeros(problem.rows))).full()
    values = np.linalg.eigvalsh(upper + np.triu(upper, 1).T)
    assert values[0] > -1e-12 * values[-1]
    problem.damping = 0.5
    damped = problem.hessian_pattern.matrix(problem.hessian(x, 1.0, np.zeros(problem.rows))).full()
    assert (np.diag(damped) >= np.diag(upper)).all()


def test_a_parabola_above_hubers_loss():
    loss = read_loss(("huber", 1.3))
    r, s = np.linspace(-9, 9, 37)[:, None], np.linspace(-9, 9, 53)[None]
    each = np.vectorize(lambda value: loss.value(np.array([value])))
    above = each(r) + loss.slope(r) * (s - r) + 0.5 * loss.secant(r) * (s - r) ** 2
    assert (above >= each(s) - 1e-12).all()


def test_a_pattern_sorts_raw_values():
    rows, columns = np.array([2, 0, 1, 2]), np.array([1, 1, 0, 2])
    matrix = Pattern(rows, columns, (3, 3)).matrix(np.array([1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_array_equal(matrix.full(), [[0, 2, 0], [3, 0, 0], [0, 1, 4]])
    assert isinstance(matrix, ca.DM)
    assert matrix.nnz() == 4


# ---- starts


def test_nodes_from_the_measurement_are_near_the_states(shaft, shaft_model):
    made = shaft(sigma=(0.01, 0.01))
    record = search(shaft_model(), [made.data], interval=40).records[0]
    nodes = nodes_from_measurement(record, np.array(list(made.truth.values()))) * record.scale
    true = made.states[::40]
    assert nodes.shape == true.shape
    assert np.abs(nodes[:, :2] - true[:, :2]).max() < 2.5
    assert np.abs(nodes[:, 2] - true[:, 2]).max() < 0.5  # of the mean twist only


@pytest.mark.parametrize("model", [ce.one_inertia, nonlinear])
def test_chained_nodes_are_continuous(run_up, model):
    made = search(model(), [run_up(n=90)], interval=20)
    record, v = made.records[0], made.coordinates.of(made.pmap.start)
    nodes = chained_nodes(record, v, np.array([1.1]))
    assert nodes.shape == (5, 1)
    path = record.propagator.propagate(v[record.active], nodes, 0)
    np.testing.assert_allclose(path.end[:, :-1].T, nodes[1:], rtol=1e-9)


def test_coordinates_go_there_and_back(shaft_model):
    model = shaft_model()
    pars = model.parameters()
    pars["C_el"].set(0.0)
    made = search(model, [shaft_data := _still()], parameters=pars)
    assert shaft_data.name == "still"
    coordinates, z = made.coordinates, made.pmap.start * 1.3 + 0.01
    v = coordinates.of(z)
    np.testing.assert_allclose(coordinates.values(v), z, rtol=1e-14)
    np.testing.assert_array_equal(coordinates.log, [True, True, True, False, False])
    step = 1e-6
    slope = (coordinates.values(v + step) - coordinates.values(v - step)) / (2 * step)
    np.testing.assert_allclose(coordinates.slope(v), slope, rtol=1e-8)
    assert coordinates.of(np.full(5, np.inf)).tolist() == [np.inf] * 5


def _still():
    time = np.arange(50) * 0.01
    units = {"T": "N m", "T_load": "N m", "omega": "rad/s", "omega_load": "rad/s"}
    rest = {"T": np.zeros(50), "T_load": np.zeros(50), "omega": np.ones(50), "omega_load": np.ones(50)}
    return ce.Experiment.from_arrays("still", time=time, units=units, **rest)


# ---- covariance


def test_covariance_is_the_inverse_where_all_is_open():
    root = np.random.default_rng(0).standard_normal((6, 4))
    information = root.T @ root * np.outer([1, 1e3, 1e-3, 1e6], [1, 1e3, 1e-3, 1e6])
    found = invert(information, np.zeros(4, dtype=bool), np.zeros((0, 4)))
    np.testing.assert_allclose(found.matrix, np.linalg.inv(information), rtol=1e-6)
    assert (found.rank, found.directions) == (4, [])


def test_covariance_with_a_closed_entry_and_a_row():
    root = np.random.default_rng(1).standard_normal((9, 4))
    information = root.T @ root
    row = np.array([[0.0, 1.0, 2.0, -1.0]])
    found = invert(information, np.array([True, False, False, False]), row)
    basis = np.linalg.svd(row[:, 1:])[2][1:].T
    inner = basis @ np.linalg.inv(basis.T @ information[1:, 1:] @ basis) @ basis.T
    np.testing.assert_allclose(found.matrix[1:, 1:], inner, rtol=1e-9)
    assert not found.matrix[0].any()
    assert found.rank == 2


def test_covariance_names_what_is_not_determined_whatever_the_scales():
    root = np.random.default_rng(2).standard_normal((9, 3))
    root[:, 2] = root[:, 0] * 1e-6  # the same effect in other units
    found = invert(root.T @ root, np.zeros(3, dtype=bool), np.zeros((0, 3)))
    (direction,) = found.directions
    np.testing.assert_allclose(direction / direction[2], [-1e-6, 0, 1], atol=1e-12)
    assert found.rank == 2
    assert (np.diag(found.matrix) >= 0).all()
    assert np.abs(found.matrix).max() < 1e13
    nothing = invert(np.zeros((2, 2)), np.zeros(2, dtype=bool), np.zeros((0, 2)))
    assert len(nothing.directions) == 2
    assert not nothing.matrix.any()


def test_an_entry_that_leaves_no_trace_does_not_hide_that_others_are_open():
    rng = np.random.default_rng(4)
    root = rng.standard_normal((2, 5)) * np.array([1, 1, 1, 1, 1e-9])
    found = invert(root.T @ root, np.zeros(5, dtype=bool), np.zeros((0, 5)))
    directions = np.array(found.directions)
    assert (found.rank, len(directions)) == (2, 3)
    np.testing.assert_allclose(directions @ directions.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(root @ directions.T, 0.0, atol=1e-12)
    assert (np.linalg.norm(directions, axis=0) > 0.3).all()  # two samples tell none of five unknowns


def test_nearly_singular_is_not_singular():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((50, 2))
    root[:, 1] = root[:, 0] + 1e-4 * root[:, 1]
    found = invert(root.T @ root, np.zeros(2, dtype=bool), np.zeros((0, 2)))
    assert found.directions == []
    np.testing.assert_allclose(found.matrix, np.linalg.inv(root.T @ root), rtol=1e-5)


@pytest.mark.parametrize(
    ("vector", "text"),
    [
        ([1.0, 0, 0, 0, 0], "a"),
        ([0, -0.3, 0, 0, 0], "b"),
        ([0.5, -0.5, 0, 0, 0], "a - b"),
        ([0.5, 1.0, -0.25, 0, 0], "b + 0.5*a - 0.25*c"),
        ([1.0, 1.0, 1.0, 1.0, 1.0], "a + b + c + d ..."),
        ([1.0, 1e-5, 0, 0, 0], "a"),
    ],
)
def test_directions_in_words(vector, text):
    found, weights = in_words(np.array(vector), list("abcde"))
    assert found == text
    assert max(weights.values()) == 1.0


@pytest.mark.parametrize("common", [True, False])
@pytest.mark.parametrize(("n", "m"), [(3, 5), (1, 7), (2, 1)])
def test_multipliers_cancel_the_gradient_in_the_later_nodes(n, m, common):
    """Against the dense continuity rows, end(i) - start(i+1)."""
    rng = np.random.default_rng(5)
    end_s, slope = 0.7 * rng.standard_normal((1 if common else m, n, n)), rng.standard_normal((m, n))
    rows = np.zeros(((m - 1) * n, m * n))
    for i in range(m - 1):
        at = slice(i * n, (i + 1) * n)
        rows[at, at] = end_s[0 if common else i]
        rows[at, (i + 1) * n : (i + 2) * n] = -np.eye(n)
    lam = joint_multipliers(end_s, slope)
    assert lam.shape == (n, m - 1)
    np.testing.assert_allclose((slope.ravel() + rows.T @ lam.T.ravel())[n:], 0, atol=1e-12)
