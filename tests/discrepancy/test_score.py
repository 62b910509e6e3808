"""The score test against its definition with dense matrices, against draws, and against brute-force refits."""

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import toeplitz

import casadi_engine as ce
from casadi_engine.discrepancy.combustion_scatter import Scatter
from casadi_engine.discrepancy.compression import candidate_columns, compress, scatter_columns
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.discrepancy.score import saturated_variance, score, separation
from casadi_engine.effects import library
from casadi_engine.simulation.candidate_sensitivities import torque_direction
from tests.quick import few


@pytest.fixture(scope="module")
def plain(shaft):
    """Null model at the truth of one noisy record, its candidates, and their columns."""
    data = shaft.data(seed=3)
    null = shaft.null(data)
    candidates = shaft.candidates(shaft.model)
    columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    return data, null, candidates, columns


def dense(null, columns, covariance, *, prior=None):
    """z, q, psi and shift by the formulas of the method, with the covariance V of all samples written out."""
    record = null.records[0]
    outputs = record.outputs
    s_theta = np.concatenate([record.slopes[o] for o in outputs])
    s = np.concatenate([columns[record.name][o] for o in outputs])
    e = np.concatenate([record.residual[o] for o in outputs])
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    st, sc, ew = white @ s_theta, white @ s, white @ e
    size = np.linalg.norm(st, axis=0)
    information = (st / size).T @ (st / size)
    if prior is not None:
        information = information + prior / np.outer(size, size)
    inverse = np.linalg.inv(information)
    m = np.eye(len(e)) - (st / size) @ inverse @ (st / size).T
    q = np.einsum("ij,ik,kj->j", sc, m, sc)
    slope = sc.T @ m @ ew
    shift = -(inverse @ ((st / size).T @ sc))[: null.turn.shape[1]] / size[: null.turn.shape[1], None]
    testable = q > 1e-8 * (sc**2).sum(axis=0)
    return slope, q, sc.T @ m @ sc, null.turn @ shift, testable


def agrees(found, wanted):
    slope, q, r, shift, testable = wanted
    assert (found.testable == testable).all()
    t = testable
    assert found.z[t] == pytest.approx(slope[t] / np.sqrt(q[t]), rel=1e-5, abs=1e-6)
    assert found.information[t] == pytest.approx(q[t], rel=1e-5)
    assert found.amplitude[t] == pytest.approx(slope[t] / q[t], rel=1e-5, abs=1e-9)
    assert found.error[t] == pytest.approx(1 / np.sqrt(q[t]), rel=1e-5)
    own = r[np.ix_(t, t)] / np.sqrt(np.outer(q[t], q[t]))
    assert found.correlation[np.ix_(t, t)] == pytest.approx(own, abs=1e-5)
    moved = shift * found.amplitude
    assert found.shift[:, t] == pytest.approx(moved[:, t], rel=1e-4, abs=1e-8)


def white_covariance(null, sigma):
    return np.diag(
        np.concatenate([np.full(len(e), sigma[o] ** 2) for o, e in null.records[0].residual.items()])
    )


def test_white_noise_gives_the_textbook_score(shaft, plain):
    _, null, candidates, columns = plain
    found = score(compress(null, candidates, NoiseModel(shaft.sigma), columns=columns))
    agrees(found, dense(null, columns, white_covariance(null, shaft.sigma)))
    assert not found.testable[-1]  # viscous friction of the engine is one of the parameters
    assert not found.testable[-2]
    assert found.p_value[-1] == 1


def test_a_prior_is_part_of_the_projection(shaft, plain):
    data, _, candidates, columns = plain
    spread = {"K_el": 0.05, "C_eng": 1e-3}
    null = shaft.null(data, prior=spread)
    prior = np.zeros((8, 8))
    for k, (name, value) in enumerate(shaft.truth.items()):
        if name in spread:
            prior[k, k] = (value / spread[name]) ** 2  # the directions are relative
    found = score(compress(null, candidates, NoiseModel(shaft.sigma), columns=columns))
    agrees(found, dense(null, columns, white_covariance(null, shaft.sigma), prior=prior))
    assert found.testable[-1]  # a drag beyond what the prior lets the damper take


def test_colour_and_scatter_are_whitened_away(shaft, plain):
    _, null, candidates, columns = plain
    record = null.records[0]
    tau, phi = 0.7, 0.6
    t = shaft.model.t
    pulses = [
        torque_direction(shaft.model, "engine", (t > 0.2 * k) * (t < 0.2 * k + 0.1) * 1.0, name=str(k))
        for k in range(6)
    ]
    scatter = Scatter("pulse", record.name, tuple(pulses))
    colour = Colour((np.ones(1), np.array([1.0, -phi])), np.array([1 / (1 - phi**2), 1.0]))
    noise = NoiseModel(shaft.sigma, {(record.name, "omega"): colour}, {"pulse": tau}, "estimated")
    n = len(record.residual["omega"])
    covariance = white_covariance(null, shaft.sigma)
    covariance[:n, :n] = shaft.sigma["omega"] ** 2 * toeplitz(phi ** np.arange(n)) / (1 - phi**2)
    g = np.concatenate([scatter_columns(record, [scatter])[o] for o in record.outputs])
    covariance += tau**2 * g @ g.T
    found = score(compress(null, candidates, noise, scatter=[scatter], columns=columns))
    agrees(found, dense(null, columns, covariance))


def test_missing_samples_are_left_out_of_a_coloured_record(shaft):
    data = shaft.data(seed=4)
    keep = np.random.default_rng(0).random(400) > 0.2
    data = data.masked("omega", keep)
    null = shaft.null(data)
    candidates = shaft.candidates(shaft.model)[:6]
    columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    phi = 0.5
    colour = Colour((np.ones(1), np.array([1.0, -phi])), np.array([1 / (1 - phi**2), 1.0]))
    noise = NoiseModel(shaft.sigma, {("shaft", "omega"): colour})
    covariance = white_covariance(null, shaft.sigma)
    n, at = int(keep.sum()), np.flatnonzero(keep)
    covariance[:n, :n] = shaft.sigma["omega"] ** 2 * phi ** np.abs(at[:, None] - at) / (1 - phi**2)
    agrees(score(compress(null, candidates, noise, columns=columns)), dense(null, columns, covariance))


@pytest.mark.parametrize("prior", [None, {"K_el": 1.0, "C_eng": 2e-3, "J_load": 0.001}])
def test_scores_of_effect_free_records_are_normal_with_covariance_r(shaft, with_residual, plain, prior):
    """Noise of the known levels; with a prior the truth is drawn from it."""
    data, _, candidates, columns = plain
    null = shaft.null(data, prior=prior)
    rng = np.random.default_rng(11)
    noise, drawn = NoiseModel(shaft.sigma), []
    record = null.records[0]
    for _ in range(250):
        moved = np.zeros(5)
        if prior:
            moved = np.array([prior.get(k, 0) / v for k, v in shaft.truth.items()]) * rng.standard_normal(5)
        e = {
            o: record.slopes[o][:, :5] @ moved + shaft.sigma[o] * rng.standard_normal(len(v))
            for o, v in record.residual.items()
        }
        found = score(compress(with_residual(null, {record.name: e}), candidates, noise, columns=columns))
        drawn.append(found.z)
    z, t, r = np.array(drawn), found.testable, found.correlation
    covariance = z.T @ z / len(z)
    spread = np.sqrt((1 + r**2) / len(z))
    assert (np.abs(covariance - r)[np.ix_(t, t)] < 4.5 * spread[np.ix_(t, t)]).all()
    assert stats.kstest(z[:, t][:, 0], "norm").pvalue > 1e-3
    values, vectors = np.linalg.eigh(r[np.ix_(t, t)])
    good = values > 1e-6
    square = (((z[:, t] @ vectors[:, good]) ** 2) / values[good]).sum(axis=1)
    assert stats.kstest(square, stats.chi2(good.sum()).cdf).pvalue > 1e-3


@pytest.mark.slow
def test_scores_after_real_fits_are_normal(shaft):
    """Every record fitted anew, all parameters and initial states free, by the estimator itself."""
    candidates = shaft.candidates(shaft.model)[:10]
    noise = ce.Noise(**shaft.sigma)
    drawn = []
    for seed in range(25):
        fit = ce.estimate(shaft.model, shaft.data(seed=100 + seed), noise=noise, progress=False)
        assert fit.converged
        found = score(compress(null_model(fit), candidates, NoiseModel(shaft.sigma)))
        drawn.append(found.z)
    values, vectors = np.linalg.eigh(found.correlation)
    good = values > 1e-6
    square = (((np.array(drawn) @ vectors[:, good]) ** 2) / values[good]).sum()
    p = stats.chi2.cdf(square, good.sum() * len(drawn))
    assert 5e-4 < p < 1 - 5e-4


@pytest.mark.parametrize(
    "name", few(["coulomb_friction", "cubic_stiffness", "constant_torque"], "cubic_stiffness")
)
def test_predictions_are_those_of_brute_force_refits(shaft, name):
    """Amplitude, drop of chi-squared and shift of all parameters, with the effect as a part of the model."""
    effect = library(name)[0]
    at = "load" if name == "constant_torque" else "coupling"
    size = {"coulomb_friction": 0.3, "cubic_stiffness": 15.0, "constant_torque": 0.5}[name]
    pair = {
        "coulomb_friction": lambda t, x: size * np.sign(x[1] - x[0]) * np.array([1, -1]),
        "cubic_stiffness": lambda t, x: size * x[2] ** 3 * np.array([1, -1]),
        "constant_torque": lambda t, x: np.array([0, size]),
    }[name]
    data = shaft.data(hidden=pair, noise=False, n=500)
    noise, pars = ce.Noise(**shaft.sigma), shaft.model.parameters()
    for name, value in shaft.truth.items():
        pars[name].set(value)
    fit = ce.estimate(shaft.model, data, parameters=pars, noise=noise, progress=False)
    null = null_model(fit)
    from casadi_engine.discrepancy.library_candidates import library_candidates

    candidates = [c for c in library_candidates(null, [data], [effect]) if c.port == at and c.size is None]
    found = score(compress(null, candidates[:1], NoiseModel(shaft.sigma)))
    extended = shaft.model.with_effect(effect, at=at)
    pars = extended.parameters()
    free = [name for name in pars if pars[name].vary]
    for name, value in zip(free, [*null.values, found.amplitude[0]], strict=True):
        pars[name].set(value)
    full = ce.estimate(extended, data, parameters=pars, noise=noise, progress=False)
    assert found.amplitude[0] == pytest.approx(full.z[-1], rel=0.03)
    assert found.drop[0] == pytest.approx(fit.cost - full.cost, rel=0.03)
    moved = full.z[:-1] - null.values
    scale = np.abs(moved / null.values).max()
    assert (np.abs(found.shift[:, 0] - moved) / null.values < 0.05 * scale).all()


def test_cycles_can_be_left_out_and_records_put_together(shaft):
    first, second = shaft.data("first", seed=1), shaft.data("second", seed=2, inputs=8)
    candidates = shaft.candidates(shaft.model)[:10]
    noise = NoiseModel(shaft.sigma)
    both = compress(shaft.null(first, second), candidates, noise)
    assert len(both.cycles) == 20
    assert both.bytes < 400_000
    alone = score(compress(shaft.null(first), candidates, noise))
    part = score(both, [cycle for cycle in both.cycles if cycle[0] == "first"])
    assert part.z == pytest.approx(alone.z, rel=1e-6, abs=1e-7)
    whole = score(both)
    assert whole.samples == 1600
    assert (whole.information >= part.information * (1 - 1e-9)).all()
    half = score(both, both.cycles[::2])
    assert (half.information <= whole.information * (1 + 1e-9)).all()


def test_sides_and_groups(shaft, plain):
    _, null, candidates, columns = plain
    found = score(compress(null, candidates, NoiseModel(shaft.sigma), columns=columns))
    two, one = found.p_value[1], found.p_value[0]
    assert two == pytest.approx(2 * stats.norm.sf(abs(found.z[1])))
    assert one == pytest.approx(stats.norm.sf(found.z[0]))
    assert found.statistic[0] == max(found.z[0], 0)
    value, freedom, p = found.group([7, 8])
    r = found.correlation[np.ix_([7, 8], [7, 8])]
    assert freedom == 2
    assert value == pytest.approx(found.z[[7, 8]] @ np.linalg.solve(r, found.z[[7, 8]]))
    assert p == pytest.approx(stats.chi2.sf(value, 2))


def test_the_smallest_detectable_size_is_found_with_its_power(shaft, plain):
    _, null, candidates, columns = plain
    found = score(compress(null, candidates, NoiseModel(shaft.sigma), columns=columns))
    size = found.detectable(3.5)[0]
    mu = size * np.sqrt(found.information[0])
    assert stats.norm.sf(3.5 - mu) == pytest.approx(0.95, abs=1e-6)
    assert found.detectable(3.5)[-1] == np.inf


def test_the_variance_beside_the_whole_library_is_blind_to_its_effects(shaft, plain, with_residual):
    _, null, candidates, columns = plain
    record = null.records[0]
    pushed = {o: e + 50 * columns[record.name][o][:, 0] for o, e in record.residual.items()}
    moved = with_residual(null, {record.name: pushed})
    noise = NoiseModel(shaft.sigma)
    own, freedom = saturated_variance(compress(null, candidates, noise, columns=columns).reduced())
    other, _ = saturated_variance(compress(moved, candidates, noise, columns=columns).reduced())
    assert other == pytest.approx(own, rel=1e-6)
    assert own == pytest.approx(1, abs=5 * np.sqrt(2 / freedom))
    assert freedom == 800 - 5 - 10 - 3  # two of the twelve candidates are not told from parameters


@pytest.mark.parametrize(("d", "right"), [(3.3, 0.95), (4.65, 0.99)])
@pytest.mark.parametrize("rho", [0.99, -0.99])
def test_a_separation_says_how_often_the_true_effect_scores_higher(d, right, rho):
    """3.3 is right in 95 %, 4.65 in 99 %: against draws of both scores."""
    mu = d / np.sqrt(1 - rho**2)
    assert separation(mu, rho) == pytest.approx(d)
    noise = np.random.default_rng(0).standard_normal((2, 200_000))
    true = mu + noise[0]
    other = rho * true + np.sqrt(1 - rho**2) * noise[1]
    share = np.mean(np.abs(true) > np.abs(other))
    assert share == pytest.approx(right, abs=4 * np.sqrt(right * (1 - right) / 200_000) + 1e-3)
    assert right == pytest.approx(stats.norm.cdf(d / 2), abs=1e-3)
