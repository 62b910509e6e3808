"""Records in the frequency domain against the same records in time: cost, slopes, information, nodes."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import casadi_engine as ce
from casadi_engine.estimation.loss import Loss
from casadi_engine.estimation.other_optima import OtherOptima
from casadi_engine.estimation.resolvent import Orthonormal, Resolvent
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.spectral import SpectralRecord, half_bins
from casadi_engine.estimation.spectral_modes import Modes
from casadi_engine.estimation.spectral_search import SpectralSearch
from casadi_engine.estimation.spectral_squares import largest_share
from casadi_engine.estimation.spectral_start import best_nodes


def search_of(model, data, noise=None, **options):
    records = data if isinstance(data, tuple) else (data,)
    parameters = options.pop("parameters", model.parameters())
    return Search(
        model, records, parameters, noise, interval="auto", initial=None, loss=Loss(), ties="substitute",
        max_iterations=200, tolerance=1e-9, warm=None, progress=None, **{"method": "exact", **options},
    )  # fmt: skip


def in_time(record, v, sigma):
    """Residual and Jacobian (1 + na, samples) of a record, what its initial state explains projected out."""
    record = record.single()
    record.set_sigma(sigma)
    counted = record.weight.ravel() > 0

    def rows(first):
        point = record.evaluate(v, first[None])
        slope = (point.js * record.weight)[counted]
        found = np.concatenate([point.r[None], point.jz]).reshape(1 + len(record.active), -1)
        return found[:, counted], slope

    found, slope = rows(np.zeros(record.n))
    first = -np.linalg.lstsq(slope, found[0], rcond=None)[0]
    found, slope = rows(first)
    q = np.linalg.qr(slope)[0]
    return found - (found @ q) @ q.T, first


def in_bins(record, v, sigma):
    spectral = SpectralRecord(record)
    spectral.sigma = sigma
    return spectral.columns(v, spectral.below(np.inf))[0]


def alike(record, v, sigma, digits=1e-7):
    """By columns, for which matrices are multiplied, and by products alone, for which the modes are taken."""
    one, other = in_time(record, v, sigma)[0], in_bins(record, v, sigma)
    wanted = one @ one.T
    size = np.sqrt(np.maximum(np.diag(wanted), 1e-12 * np.diag(wanted).max()))
    spectral = SpectralRecord(record)
    spectral.sigma = sigma
    for found in (other @ other.T, spectral.gram(v, [spectral.size])[0]):
        np.testing.assert_allclose(found / np.outer(size, size), wanted / np.outer(size, size), atol=digits)


# ---- the transform


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 60), st.integers(0, 10**6))
def test_half_bins_keep_the_sum_of_squares(count, seed):
    series = np.random.default_rng(seed).standard_normal(count)
    bins = half_bins(series)
    assert bins.shape == ((count + 1) // 2,)
    weight = np.full(len(bins), 2.0)
    if count % 2:
        weight[-1] = 1.0
    assert weight @ np.abs(bins) ** 2 / count == pytest.approx(series @ series)


@pytest.mark.parametrize("f", [
    np.array([[1.0, 0.1], [0.0, 1.0]]),  # two integrators in a row: one eigenvector
    np.array([[0.9, 1e6], [-1e-8, 0.8]]),  # states of very different sizes
    np.array([[0.5, 0.2, 0.0], [-0.2, 0.5, 0.0], [0.3, 0.1, -0.7]]),
])  # fmt: skip
def test_the_resolvent_solves_its_equation(f):
    n, z = len(f), np.exp(1j * np.pi * (2 * np.arange(7) + 1) / 14)
    rng = np.random.default_rng(0)
    drive, c = rng.standard_normal((n, 7)) + 1j, rng.standard_normal((2, n))
    found = Resolvent(f, z)
    states, rows = found.states(drive), found.rows(c)
    for k, at in enumerate(z):
        matrix = at * np.eye(n) - f
        np.testing.assert_allclose(states[:, k], np.linalg.solve(matrix, drive[:, k]), rtol=1e-9)
        np.testing.assert_allclose(rows[:, :, k], np.linalg.solve(matrix.T, c.T).T, rtol=1e-9)
    assert found.radius == pytest.approx(np.abs(np.linalg.eigvals(f)).max())


def test_rows_are_made_orthonormal_even_if_two_are_almost_one():
    rng = np.random.default_rng(1)
    given_ = rng.standard_normal((3, 50))
    for rows in (given_, np.vstack([given_, given_[0] * (1 + 1e-12)]), np.vstack([given_, np.zeros(50)])):
        found = Orthonormal.of(rows)
        target = rng.standard_normal(50)
        rest = target + found.best(target) @ rows
        np.testing.assert_allclose(given_ @ rest, 0, atol=1e-6)
        np.testing.assert_allclose(target - (found.rows @ target) @ found.rows, rest, atol=1e-5)


# ---- cost and slopes


@pytest.mark.parametrize("method", ["exact", "euler"])
@pytest.mark.parametrize("n", [399, 400])
def test_one_state(run_up, method, n):
    search = search_of(ce.one_inertia(), run_up(n=n), ce.Noise(omega=0.05), method=method)
    alike(search.records[0], np.array([0.1, 0.3]), np.array([0.05]))


def test_two_outputs_with_levels_of_their_own(shaft, shaft_model):
    search = search_of(shaft_model(), shaft().data, ce.Noise(omega=0.05, omega_load=0.1))
    alike(search.records[0], np.full(5, 0.2), np.array([0.05, 0.2]))


def integrators():
    b = ce.Blueprint("cart")
    m, f = b.parameter("m", 2.0, min=0.1), b.input("f")
    x, w = b.state("x"), b.state("w")
    b.ode("x", w)
    b.ode("w", f / m)
    b.output("y", x)
    return b.model()


def test_a_double_integrator_is_no_singularity():
    rng = np.random.default_rng(2)
    time, f = np.arange(200) * 0.05, rng.standard_normal(200)
    units = {"f": "1", "y": "1"}
    y = 3 + 0.2 * time + 0.1 * np.cumsum(np.cumsum(f)) * 0.05**2 + 0.01 * rng.standard_normal(200)
    data = ce.Experiment.from_arrays("cart", time=time, units=units, f=f, y=y)
    search = search_of(integrators(), data, ce.Noise(y=0.01))
    alike(search.records[0], np.array([0.4]), np.array([0.01]), digits=1e-6)


def driven_by_parameters():
    """The drive depends on a parameter, and the output has a constant."""
    b = ce.Blueprint("scaled")
    a, g, c = b.parameter("a", 1.5), b.parameter("g", 0.7), b.parameter("c", 0.2)
    x, u = b.state("x"), b.input("u")
    b.ode("x", -a * x + b.drive("F", (g * u) ** 2) + c)
    b.output("y", x + 0.3 * c)
    return b.model()


def scaled_record(n=240):
    rng = np.random.default_rng(3)
    time, u = np.arange(n) * 0.05, rng.standard_normal(n)
    y = np.cos(time) + 0.1 * rng.standard_normal(n)
    return ce.Experiment.from_arrays("scaled", time=time, units={"u": "1", "y": "1"}, u=u, y=y)


def test_drives_that_depend_on_parameters():
    search = search_of(driven_by_parameters(), scaled_record(), ce.Noise(y=0.1))
    record = search.records[0]
    assert record.linear
    for v in (np.zeros(3), np.array([0.3, -0.2, 0.4]) + 1):
        alike(record, v, np.array([0.1]))


def test_the_gradient_is_that_of_the_cost():
    search = search_of(driven_by_parameters(), scaled_record(), ce.Noise(y=0.1))
    spectral = spectral_of(search)
    v, step = np.array([1.1, 0.8, 1.3]), 1e-6
    slope = spectral.squares(v, 4.0).gradient
    for k, unit in enumerate(np.eye(3)):
        ends = [spectral.squares(v + side * step * unit, 4.0).cost for side in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slope[k], rel=1e-5)


# ---- modes


def core_of(a, method="exact"):
    """A linear core with two inputs and outputs, one joined by lines, and slopes of everything in two parameters."""
    rng, n = np.random.default_rng(4), len(a)
    made = [0.1 * rng.standard_normal((3, *shape)) for shape in ((n, n), (n, 2), (2, n), (2, 2))]
    made[0][0] = a
    return SimpleNamespace(
        finite=lambda _z, _order: [jet.copy() for jet in made], step=0.5, method=method, drives=2,
        first=np.array([True, False]), jets=made,
    )  # fmt: skip


def response_of(core, z, t):
    """The outputs' response (K, 2, 2) at z, by exponentials of matrices, t along the first parameter."""
    a, b, c, d = (jet[0] + t * jet[1] for jet in core.jets)
    n, h = len(a), core.step
    if core.method == "euler":
        f, g0, g1 = np.eye(n) + h * a, h * b, np.zeros_like(b)
    else:
        whole = np.zeros((n + 4, n + 4))
        whole[:n, :n], whole[:n, n : n + 2], whole[n : n + 2, n + 2 :] = h * a, h * b, np.eye(2)
        f, held, ramp = np.split(expm(whole)[:n], [n, n + 2], axis=1)
        g1 = ramp * core.first
        g0 = held - g1
    return np.array([c @ np.linalg.solve(at * np.eye(n) - f, g0 + at * g1) + d for at in z])


@pytest.mark.parametrize("method", ["exact", "euler"])
@pytest.mark.parametrize("faster", [1.0, 4.0])  # rates within and beyond the reach of the series
def test_modes_give_values_and_slopes_of_the_response(method, faster):
    """A real mode and a pair, against matrices at every frequency and differences of these."""
    core = core_of(faster * np.array([[-0.2, 1.1, 0.0], [-1.1, -0.2, 0.3], [0.0, 0.0, -0.7]]), method)
    modes, z = Modes.of(core, np.zeros(2)), np.exp(1j * np.array([0.1, 0.5, 2.0]))
    assert (modes.real, modes.poles.shape) == (1, (3, 2))

    def of_modes(c, b, poles, d):
        found = np.einsum("yi,im,ki->kym", c, b, 1 / (z[:, None] - poles))
        pairs = np.einsum("yi,im,ki->kym", c[:, 1:].conj(), b[1:].conj(), 1 / (z[:, None] - poles[1:].conj()))
        return found + pairs + d

    parts = (modes.c, modes.b, modes.poles, modes.d)
    np.testing.assert_allclose(of_modes(*(p[0] for p in parts)), response_of(core, z, 0.0), atol=1e-12)
    step = 1e-6
    slopes = (of_modes(*(p[0] + s * p[1] for p in parts)) for s in (step, -step))
    wanted = (response_of(core, z, step) - response_of(core, z, -step)) / (2 * step)
    np.testing.assert_allclose(-np.diff(list(slopes), axis=0)[0] / (2 * step), wanted, atol=1e-7)


@pytest.mark.parametrize("a", [
    np.array([[0.0, 0.1], [0.0, 0.0]]),  # two integrators in a row
    np.diag([-0.1, -0.1]),  # every vector is an eigenvector
])  # fmt: skip
def test_modes_that_are_no_basis_are_not_taken(a):
    assert Modes.of(core_of(a), np.zeros(2)) is None


def test_two_integrators_in_a_row_are_searched_without_modes():
    b = ce.Blueprint("cart")
    m, x, w, force = b.parameter("m", 2.0, min=0), b.state("x"), b.state("w"), b.input("F")
    b.ode("x", w)
    b.ode("w", force / m)
    b.output("seen", x)
    t = np.arange(300) * 0.01
    data = ce.Experiment.from_arrays(
        "r", time=t, units={"F": "1", "seen": "1"}, F=np.sin(5 * t), seen=t**2 + 0.1 * np.cos(9 * t)
    )
    search = search_of(b.model(), data, ce.Noise(seen=0.1))
    record = search.records[0]
    assert Modes.of(record.propagator.core, np.array([0.3])) is None
    alike(record, np.array([0.3]), np.array([0.1]), digits=1e-6)


# ---- the search in a band


def spectral_of(search, longest=np.ones_like):
    nv = search.problem.nv
    found = SpectralSearch(
        search.records, search.problem.priors.evaluate, search.lower[:nv], search.upper[:nv], longest
    )
    found.weigh(search.sigma)
    return found


def test_the_share_of_information_left_out_is_that_of_brute_force(shaft, shaft_model):
    search = search_of(shaft_model(), shaft().data, ce.Noise(omega=0.05, omega_load=0.1))
    spectral, v = spectral_of(search), np.full(5, 0.1)
    record = spectral.records[0]
    edges = record.hertz[-1] * np.array([0.2, 0.5, 2.0])
    grams = spectral.grams(v, edges)
    whole = record.columns(v, record.below(np.inf))[0]
    for edge, gram in zip(edges, grams, strict=True):
        part = record.columns(v, record.below(edge))[0]
        # the residual of a band has a transient of its own, so only the slopes at one transient can be the same
        if edge > record.hertz[-1]:
            np.testing.assert_allclose(gram, whole @ whole.T, rtol=1e-6, atol=1e-6 * np.abs(gram).max())
        share = largest_share(grams[-1][1:, 1:], gram[1:, 1:])
        wanted = largest_share(whole[1:] @ whole[1:].T, part[1:] @ part[1:].T)
        assert share == pytest.approx(wanted, rel=0.2, abs=1e-3)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_the_largest_share_is_that_of_the_worst_direction(seed, n):
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((2, n + 3, n))
    part, rest = a.T @ a, 0.1 * b.T @ b
    share = largest_share(part + rest, part)
    directions = rng.standard_normal((500, n))
    ratio = np.einsum("ij,jk,ik->i", directions, rest, directions)
    ratio /= np.einsum("ij,jk,ik->i", directions, part + rest, directions)
    assert 0 <= ratio.max() <= share * (1 + 1e-9) <= 1 + 1e-9
    assert share == pytest.approx(np.linalg.eigvals(np.linalg.solve(part + rest, rest)).real.max())


def test_what_leads_back_to_an_optimum_is_that_optimum(shaft, shaft_model):
    search = search_of(shaft_model(), shaft().data, ce.Noise(omega=0.05, omega_load=0.1))
    spectral = spectral_of(search)
    known = spectral.run(np.full(5, 0.1), steps=100, stop=lambda _: False)
    assert known.kept < known.bins
    others = OtherOptima(spectral, known)
    assert not others.ways  # the lowest frequencies tell all parameters: there is no room for another optimum
    size = 4 / np.sqrt(np.diag(known.information))
    for step in np.diag(np.concatenate([size[:2], -size[2:]])):
        costs = []
        found = others.run(known.minimum.x + step, steps=100, stop=lambda cost, to=costs: to.append(cost))
        assert np.array_equal(found.minimum.x, known.minimum.x)
        assert found.minimum.squares.cost == known.minimum.squares.cost
        assert found.minimum.converged
        assert not found.strayed
        assert costs[0] > known.minimum.squares.cost


def test_a_point_at_which_one_search_ends_and_the_next_begins_is_shown_once(shaft, shaft_model):
    search = search_of(shaft_model(), shaft().data, ce.Noise(omega=0.05, omega_load=0.1))
    costs = []
    found = spectral_of(search).run(np.full(5, 0.1), steps=100, stop=lambda cost: costs.append(cost))
    assert len(costs) == len(set(costs))
    assert len(costs) <= found.minimum.steps + 1
    assert costs[-1] == pytest.approx(found.minimum.squares.cost, rel=1e-3)


def test_the_bins_above_the_band_are_not_lost(shaft, shaft_model):
    """The optimum of the band with its quadratic above is that of all bins, within a hundredth of a standard error."""
    made = shaft()
    search = search_of(shaft_model(), made.data, ce.Noise(omega=0.05, omega_load=0.1))
    spectral = spectral_of(search)
    found = spectral.run(search.coordinates.of(search.pmap.start), steps=100, stop=lambda _: False)
    assert found.minimum.converged
    assert found.kept < found.bins
    assert 0 < found.share < 0.15
    whole = spectral.squares(found.minimum.x)
    step = np.linalg.solve(whole.matrix, whole.gradient)
    assert np.sqrt(step @ whole.matrix @ step) < 0.01
    assert f"{found.kept} of {found.bins} frequency bins" in str(found)


def test_priors_pull_as_they_do_on_all_samples(run_up):
    pars = ce.one_inertia().parameters()
    pars["C_eng"].prior = (0.9, 0.01)
    search = search_of(ce.one_inertia(), run_up(), ce.Noise(omega=0.05), parameters=pars)
    free = spectral_of(search_of(ce.one_inertia(), run_up(), ce.Noise(omega=0.05)))
    v = search.coordinates.of(search.pmap.start)
    cost, gradient, _, matrix = search.problem.priors.evaluate(v)
    with_, without = spectral_of(search).squares(v), free.squares(v)
    assert with_.cost - without.cost == pytest.approx(cost)
    np.testing.assert_allclose(with_.gradient - without.gradient, gradient, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(with_.matrix - without.matrix, matrix, atol=1e-6 * np.abs(matrix).max())


def test_points_at_which_states_run_away_are_refused(run_up):
    search = search_of(ce.one_inertia(), run_up(), ce.Noise(omega=0.05))
    spectral = spectral_of(search)
    v = search.coordinates.of(np.array([0.4, -0.5]))  # negative damping: growth by e^10 over the record
    assert spectral.squares(v) is not None
    assert spectral.squares(search.coordinates.of(np.array([0.4, -5.0]))) is None


# ---- nodes


@pytest.mark.parametrize("interval", ["auto", "single", 7])
def test_nodes_lie_on_the_trajectory_that_explains_the_record_best(shaft, shaft_model, interval):
    model, data = shaft_model(), shaft().data
    search = Search(
        model, (data,), model.parameters(), ce.Noise(omega=0.05, omega_load=0.1), interval=interval, initial=None,
        loss=Loss(), ties="substitute", method="exact", max_iterations=200, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip
    record, v = search.records[0], np.full(5, 0.1)
    first = in_time(record, v, search.sigma)[1]
    nodes = best_nodes(record, v)
    np.testing.assert_allclose(nodes[0], first, rtol=1e-6, atol=1e-9)
    point = record.evaluate(v, nodes)
    np.testing.assert_allclose(point.path.end[:, :-1].T, nodes[1:], rtol=1e-9, atol=1e-12)
