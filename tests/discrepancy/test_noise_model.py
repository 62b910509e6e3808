"""Noise of the null residuals: levels, colour and combustion scatter, from residuals that may hold effects."""

from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.combustion_scatter import (
    Scatter,
    assumed_cylinders,
    combustion_scatter,
    scatter_level,
    scatter_likelihood,
)
from casadi_engine.discrepancy.compression import candidate_columns, compress, scatter_columns
from casadi_engine.discrepancy.library_candidates import direction_of
from casadi_engine.discrepancy.noise_model import NoiseModel, estimated_noise, fitted_colour
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.discrepancy.score import score
from casadi_engine.effects import candidate, library, port_view
from casadi_engine.simulation.candidate_sensitivities import torque_direction

DATA = Path(__file__).parents[2] / "data"


@pytest.fixture(scope="module")
def setting(shaft):
    data = shaft.data(n=2000, seed=5)
    null = shaft.null(data)
    candidates = shaft.candidates(shaft.model)[:10]
    columns = {r.name: candidate_columns(r, candidates) for r in null.records}
    return null, candidates, columns


def explained(null, columns):
    return {
        r.name: {o: np.column_stack([r.slopes[o], columns[r.name][o]]) for o in r.outputs}
        for r in null.records
    }


def test_levels_do_not_take_an_effect_of_the_library_for_noise(shaft, setting, with_residual):
    null, _, columns = setting
    record = null.records[0]
    pushed = {o: e + 30 * columns[record.name][o][:, 0] for o, e in record.residual.items()}
    for residual in (record.residual, pushed):
        made = estimated_noise(
            with_residual(null, {record.name: residual}), explained=explained(null, columns)
        )
        assert made.source == "estimated"
        for output, sigma in shaft.sigma.items():
            assert made.sigma[output] == pytest.approx(sigma, rel=4 / np.sqrt(2 * 2000))
    alone = {r.name: dict(r.slopes) for r in null.records}
    fooled = estimated_noise(with_residual(null, {record.name: pushed}), explained=alone)
    assert fooled.sigma["omega"] > 1.2 * shaft.sigma["omega"]


def test_a_coloured_residual_is_whitened_by_its_own_autoregression(shaft, setting, with_residual):
    null, candidates, columns = setting
    record = null.records[0]
    rng, phi = np.random.default_rng(2), 0.7
    white = {o: rng.standard_normal(len(e)) * shaft.sigma[o] for o, e in record.residual.items()}
    coloured = dict(white)
    coloured["omega"] = white["omega"].copy()
    for k in range(1, 2000):
        coloured["omega"][k] += phi * coloured["omega"][k - 1]
    null = with_residual(null, {record.name: coloured})
    made = estimated_noise(null, explained=explained(null, columns), colour=True)
    found = made.colour[record.name, "omega"]
    assert -found.predictors[-1][1] == pytest.approx(phi, abs=0.08)
    assert made.sigma["omega"] == pytest.approx(shaft.sigma["omega"], rel=0.07)
    flat = score(compress(null, candidates, NoiseModel(dict(made.sigma)), columns=columns))
    own = score(compress(null, candidates, made, columns=columns))
    assert np.abs(own.z).max() < np.abs(flat.z).max()
    assert np.abs(own.z).max() < 4.5


def test_known_levels_are_kept(shaft, setting):
    null, _, columns = setting
    made = estimated_noise(null, explained=explained(null, columns), colour=True, sigma=shaft.sigma)
    assert made.sigma == shaft.sigma


def test_scatter_is_told_from_noise_by_its_likelihood(shaft, setting, with_residual):
    null, candidates, columns = setting
    record, t = null.records[0], shaft.model.t
    pulses = [
        torque_direction(shaft.model, "engine", (t > 0.2 * k) * (t < 0.2 * k + 0.1) * 1.0, name=str(k))
        for k in range(38)
    ]
    scatter = Scatter("pulse", record.name, tuple(pulses))
    g = scatter_columns(record, [scatter])
    rng, tau = np.random.default_rng(8), 2.0
    amplitude = tau * rng.standard_normal(38)
    e = {o: rng.standard_normal(2000) * shaft.sigma[o] + g[o] @ amplitude for o in record.outputs}
    null = with_residual(null, {record.name: e})
    slopes = {record.name: dict(null.records[0].slopes)}
    made = estimated_noise(null, explained=slopes, scatter={record.name: g}, kind="pulse")
    assert made.scatter["pulse"] == pytest.approx(tau, rel=4 / np.sqrt(2 * 30))
    assert made.sigma["omega"] == pytest.approx(shaft.sigma["omega"], rel=0.1)
    blind = score(compress(null, candidates, NoiseModel(shaft.sigma), columns=columns))
    seeing = score(compress(null, candidates, made, scatter=[scatter], columns=columns))
    assert np.abs(blind.z).max() > 6
    assert np.abs(seeing.z).max() < 4.5


def test_no_scatter_is_found_in_plain_noise():
    rng = np.random.default_rng(1)
    g = rng.standard_normal((400, 20))
    e = rng.standard_normal(400)
    assert scatter_level(g, e) < 0.08
    best = scatter_level(g, e + g @ (0.5 * rng.standard_normal(20)))
    assert best == pytest.approx(0.5, rel=0.5)
    assert scatter_level(np.zeros((400, 0)), e) == 0


def test_the_scatter_likelihood_is_the_dense_one():
    rng = np.random.default_rng(1)
    g, e, tau = rng.standard_normal((50, 4)), rng.standard_normal(50), 0.3

    def dense(tau):
        v = np.eye(50) + tau**2 * g @ g.T
        return np.linalg.slogdet(v)[1] + e @ np.linalg.solve(v, e)

    assert scatter_likelihood(g, e, tau) == pytest.approx(dense(tau) - dense(0.0))


@pytest.fixture(scope="module")
def engine():
    data = ce.read_experiment(
        DATA / "normal_1200rpm.csv.gz", assumed=("p3", "p4"), optional=("omega_load",)
    ).cycles(1, 3)
    model = ce.two_mass()
    start = {data.name: np.array([125.6, 125.6, -0.03])}
    null = null_at(model, [data], model.parameters(), model.parameter_vector()[:5], start)
    return model, data, null


def test_combustion_scatter_has_a_direction_per_cylinder_and_cycle(engine):
    model, data, null = engine
    assert assumed_cylinders(data) == ("cylinder_3", "cylinder_4")
    record = null.records[0]
    made = combustion_scatter(model, record, cylinders=("cylinder_3",))
    columns = scatter_columns(record, [made])["omega"]
    # three whole cycles of the record touch four of cylinder 3
    assert columns.shape[1] == 4
    assert (np.abs(columns).max(axis=0) > 0).all()
    # together they are the cylinder's imbalance, above a motored trace pegged on the record
    numbers = dict(zip(model.parameter_names, model.parameter_vector(), strict=True))
    effect = library("cylinder_imbalance")[0].fitted(port_view(model, "cylinder_3"), data, numbers)
    whole = record.columns([direction_of(candidate(model, effect, "cylinder_3"))])["omega"][:, 0]
    assert columns.sum(axis=1) == pytest.approx(whole, abs=1e-3 * np.abs(whole).max())


def test_cycles_are_counted_by_the_crank_angle(engine):
    _, data, null = engine
    cycle = null.records[0].cycle["omega"]
    assert set(cycle) <= {0, 1, 2, 3}
    assert (np.diff(cycle) >= 0).all()
    assert np.bincount(cycle)[1] == pytest.approx(1440, abs=15)
    assert len(cycle) == len(data["omega"].time)


def test_a_record_whose_end_is_missing_has_the_colour_of_what_there_is():
    """A yacht that rolls over: its last 381 samples are none, and filling them ended in a LinAlgError."""
    rng = np.random.default_rng(2)
    noise = np.zeros(400)
    for k in range(1, 400):
        noise[k] = 0.8 * noise[k - 1] + rng.standard_normal()
    whole = fitted_colour(noise, np.arange(400), 400)
    cut = fitted_colour(noise, np.arange(400) + 7, 800)
    assert [p.tolist() for p in cut.predictors] == [p.tolist() for p in whole.predictors]
    grows = np.sin(0.3 * np.arange(419)) * np.exp(0.05 * np.arange(419))
    assert np.isfinite(fitted_colour(grows, np.arange(419), 800).variances).all()
