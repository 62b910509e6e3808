"""The smoother against one dense least-squares problem of the same record, and Bayes' rule against enumeration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from casadi_engine.detection import segments, smoother
from casadi_engine.detection.plant import Disturbances, make_plant
from casadi_engine.detection.segments import cut_segments, cylinder_pushes, window_edges
from casadi_engine.detection.smoother import (
    EXCESS_GAIN,
    EXCESS_STEP,
    LEVEL_DOUBT,
    WIDE,
    Decision,
    Prior,
    Smoother,
)
from casadi_engine.detection.torques import learn_torques

WINDOWS, PIECES = 4, 3


@pytest.fixture(scope="module")
def case(fit, made):
    tables = learn_torques(fit)
    h = float(np.diff(made["time"]).mean())
    edges, _ = window_edges(made["theta"], tables)
    unknown = Disturbances(step=15.0, road=20.0)
    plant = make_plant(fit, "omega", tables.enter, h, unknown)
    theta, omega = made["theta"][None], made["omega"][None]
    valid = np.random.default_rng(2).uniform(size=theta.shape) > 0.2
    edges = edges[None, : WINDOWS + 1]
    parts = cut_segments(theta, omega, valid, edges, PIECES, plant, tables, 0.1)
    return plant, unknown, parts, tables, theta, omega, valid[0], edges[0]


def dense(case):
    """Normal equations of the strengths of all windows, everything else eliminated."""
    plant, unknown, _, tables, theta, omega, valid, edges = case
    pushes = cylinder_pushes(theta, omega, tables)
    known, gas, burning = ([row[0] for row in kind] for kind in pushes)
    nz = plant.size
    # unknowns: strengths, start (nz + gas), noises (4 for each segment)
    count = WINDOWS + nz + 1 + 4 * WINDOWS * PIECES
    state = np.zeros((nz, count + 1))
    state[:, WINDOWS : WINDOWS + nz] = np.eye(nz)
    amount = np.zeros(count + 1)
    amount[WINDOWS + nz] = 1.0
    rows = []
    ends = [
        edges[k] + (edges[k + 1] - edges[k]) * (m + 1) // PIECES
        for k in range(WINDOWS)
        for m in range(PIECES)
    ]
    spread, piece = [], 0
    for k in range(edges[0], edges[WINDOWS]):
        window = int(np.searchsorted(edges, k, side="right")) - 1
        if valid[k]:
            row = plant.c @ state
            row[-1] = omega[0, k] - row[-1]
            rows.append(row / 0.1)
        push = np.zeros((len(known), count + 1))
        for column in range(len(known)):
            push[column] = gas[column][k] * amount
            push[column, -1] += known[column][k]
            push[column, window] += burning[column][k]
        state = plant.step @ state + plant.push @ push
        if k + 1 == ends[piece]:
            at = WINDOWS + nz + 1 + 4 * piece
            state[nz - 3 :, at : at + 3] += np.eye(3)
            amount[at + 3] += 1.0
            seconds = (ends[piece] - (ends[piece - 1] if piece else edges[0])) * plant.h
            road = unknown.road * np.sqrt(1 - np.exp(-2 * plant.road_decay * seconds))
            spread += [
                unknown.step / PIECES**0.5,
                unknown.step / PIECES**0.5,
                road,
                0.1 * unknown.gas / PIECES**0.5,
            ]
            piece += 1
    start = np.append(plant.start, unknown.gas)
    prior = np.concatenate([start, spread])
    mean = np.zeros(prior.size)
    mean[:nz] = omega[0, edges[0]] * plant.turning
    whole = np.array(rows)
    below = np.zeros((prior.size, count + 1))
    below[:, WINDOWS:-1] = np.diag(1 / prior)
    below[:, -1] = mean / prior
    triangle = np.linalg.qr(
        np.vstack([whole, below])[:, [*range(WINDOWS, count), *range(WINDOWS), count]], mode="r"
    )
    part = triangle[count - WINDOWS : count, count - WINDOWS :]
    return part[:, :-1], part[:, -1]


def test_the_strengths_are_those_of_one_dense_least_squares_problem(case, monkeypatch):
    monkeypatch.setattr(smoother, "EXCESS_GAIN", 0.0)  # the noise as it is said to be
    plant, unknown, parts, *_ = case
    made = Smoother(plant, unknown, parts, lag=WINDOWS - 1, speed=case[5][:, case[7][0]])
    flat = np.ones(1), np.full(1, WIDE**2)
    for k in range(WINDOWS):
        made.window(k, flat)
    root, right = (one[0] for one in made.strengths())
    exact, other = dense(case)
    np.testing.assert_allclose(root.T @ root, exact.T @ exact, rtol=1e-6)
    np.testing.assert_allclose(root.T @ right, exact.T @ other, rtol=1e-6)


def test_innovations_larger_than_the_noise_make_the_noise_larger(case):
    plant, unknown, parts, *_ = case
    for size in (1.0, 3.0):
        rows = parts.rows * size
        made = Smoother(plant, unknown, replace(parts, rows=rows), lag=0, speed=case[5][:, case[7][0]])
        flat = np.ones(1), np.full(1, WIDE**2)
        found = [made.window(k, flat)[0] for k in range(WINDOWS)]
        assert np.median(found) == pytest.approx(size**2, rel=0.15)
        # At most 1.3 times in a combustion: a jolt of the road must not pass for an error of the model.
        excess = 1.0
        for one in found:
            excess = max(excess * (1 + EXCESS_GAIN * (min(one / excess, EXCESS_STEP) - 1)), 1.0)
        assert made.excess[0] == pytest.approx(excess)
    assert 2 < excess < 3


def test_probabilities_are_bayes_rule_over_all_ways():
    random = np.random.default_rng(5)
    lag, level, prior = 2, 1.3, Prior(lost=0.05, scatter=0.07)
    root = np.triu(3 * random.standard_normal((lag + 1, lag + 1)))
    right = root @ np.array([1.2, 0.5, 1.4]) + random.standard_normal(lag + 1)
    weights = {}
    for way in np.ndindex(*(2,) * (lag + 1)):
        burns = 1.0 - np.array(way)
        cover = level**2 * (prior.scatter**2 * np.eye(lag + 1) + LEVEL_DOUBT**2 * np.outer(burns, burns))
        density = multivariate_normal(root @ (level * burns), np.eye(lag + 1) + root @ cover @ root.T)
        weights[way] = density.pdf(right) * prior.lost ** sum(way) * (1 - prior.lost) ** (lag + 1 - sum(way))
    total = sum(weights.values())
    expected = [sum(w for way, w in weights.items() if way[k]) / total for k in range(lag + 1)]
    found = Decision(prior, lag).probabilities(root[None], right[None], np.array([level]))
    np.testing.assert_allclose(found[0], expected, rtol=1e-9)


def test_a_record_in_blocks_is_the_same_record(case, monkeypatch):
    plant, _, whole, tables, theta, omega, valid, edges = case
    monkeypatch.setattr(segments, "AT_ONCE", 3)
    parts = segments.cut_record(theta[0], omega[0], valid, edges, PIECES, plant, tables, 0.1)
    assert parts.samples.tolist() == whole.samples.tolist()
    for one, other in ((parts.move, whole.move), (parts.add, whole.add)):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    products = [rows.swapaxes(-1, -2) @ rows for rows in (parts.rows, whole.rows)]
    np.testing.assert_allclose(*products, rtol=1e-6, atol=1e-6 * np.abs(products[0]).max())
