"""A record worked on part by part of its bins is the record."""

from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.estimation import spectral
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.search import Search

DATA = Path(__file__).resolve().parents[2] / "data"


def _search():
    model = ce.two_mass(reciprocating_speed="measured")
    data = ce.read_experiment(DATA / "misfire_1200rpm.csv.gz", optional=("omega_load",)).cycles(1, 2)
    return Search(
        model, (data,), model.parameters(), ce.Noise(omega=0.1), interval="auto", initial=None,
        loss=read_loss("square"), ties="substitute", method="exact", max_iterations=10, tolerance=1e-9, warm=None,
        progress=None,
    )  # fmt: skip


@pytest.mark.parametrize("part", [100, 511, 10_000])
def test_the_gram_matrix_is_that_of_all_bins_at_once(part, monkeypatch):
    monkeypatch.setattr(spectral, "_PART", part)
    search = _search()
    record = spectral.SpectralRecord(search.records[0])
    record.sigma = np.array([0.1])
    v = search.coordinates.of(search.pmap.start)
    columns, _ = record.columns(v, slice(0, record.size))
    expected = columns @ columns.T
    found = record.gram(v, [300, record.size])
    size = np.sqrt(np.diag(expected))
    assert found[-1] / np.outer(size, size) == pytest.approx(expected / np.outer(size, size), abs=1e-8)
    assert (np.diag(found[0]) < np.diag(found[-1])).all()


def test_series_are_transformed_one_by_one_as_all_at_once():
    rng = np.random.default_rng(2)
    series = rng.standard_normal((2, 3, 101))
    found = spectral.half_bins(series)
    assert found.shape == (2, 3, 51)
    k, n = np.arange(51)[:, None], np.arange(101)
    direct = np.exp(-1j * np.pi * (2 * k + 1) * n / 101) @ series[1, 2]
    assert found[1, 2] == pytest.approx(direct, abs=1e-9)
