"""The smoother against one dense least-squares problem of the same record, and Bayes' rule against enumeration."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from casadi_engine.detection.plant import Disturbances, make_plant
from casadi_engine.detection.segments import _pushes, cut_segments, window_edges
from casadi_engine.detection.smoother import LEVEL_DOUBT, WIDE, Decision, Prior, Smoother
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
    pushes = _pushes(theta, omega, tables)
    known, gas, burning = ([row[0] for row in kind] for kind in pushes)
    nz, segments = plant.size, WINDOWS * PIECES
    # unknowns: strengths, start (nz + gas), noises (4 for each segment)
    count = WINDOWS + nz + 1 + 4 * segments
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


def test_the_strengths_are_those_of_one_dense_least_squares_problem(case):
    plant, unknown, parts, *_ = case
    smoother = Smoother(plant, unknown, parts, lag=WINDOWS - 1, speed=case[5][:, case[7][0]])
    flat = np.ones(1), np.full(1, WIDE**2)
    for k in range(WINDOWS):
        smoother.window(k, flat)
    root, right = (one[0] for one in smoother.strengths())
    exact, other = dense(case)
    np.testing.assert_allclose(root.T @ root, exact.T @ exact, rtol=1e-6)
    np.testing.assert_allclose(root.T @ right, exact.T @ other, rtol=1e-6)


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


def test_motored_cylinders_and_combustions_have_the_simulators_torque(fit):
    from simulator.geometry import cylinder_torque
    from simulator.pressure import pressure, unequal_cylinders

    tables = learn_torques(fit)
    assert tables.order.tolist() == [1, 3, 4, 2]
    assert tables.spans == 1
    inertia = fit.values["J_eng"]
    angle = np.arange(tables.known.shape[1]) * 4 * np.pi / tables.known.shape[1]
    one = unequal_cylinders()
    still = np.zeros_like(angle)
    turned = [angle - at for at in (0, 3 * np.pi, np.pi, 2 * np.pi)]
    known = sum(
        cylinder_torque(a, still, pressure(a, 0.0, i)) for a, i in zip(turned, one.intake, strict=True)
    )
    assert np.abs(inertia * tables.known[0] - known).max() < 0.04 * np.abs(known).max()
    motored, burning = (pressure(angle, size, one.intake[0], one.delay[0]) for size in (0.0, 1e6))
    true = cylinder_torque(angle, 0 * angle, burning) - cylinder_torque(angle, 0 * angle, motored)
    near = (angle > 0.1) & (angle < 2.6)
    shape = inertia * tables.combustion[0, 0, near]
    scale = shape @ true[near] / (true[near] @ true[near])
    assert np.abs(shape - scale * true[near]).max() < 0.03 * shape.max()
