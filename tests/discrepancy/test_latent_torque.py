"""Latent torques against dense Gaussian-process formulas, and torques that are known."""

import numpy as np
import pytest

from casadi_engine.discrepancy.latent_torque import KERNELS, latent_torques
from casadi_engine.discrepancy.noise_model import Colour, NoiseModel
from casadi_engine.errors import EstimationError
from casadi_engine.simulation.candidate_sensitivities import torque_direction
from casadi_engine.simulation.knot_sensitivities import knot_sensitivities


def wander(t, x):
    return np.array([0.0, 1.5 * np.sin(4 * t) + 0.8 * (t > 0.9)])


def test_the_course_and_gain_are_those_of_the_dense_formulas(shaft):
    """Knots at few times, every sample used: the marginal likelihood and posterior written out."""
    import casadi as ca

    data = shaft.data(hidden=wander, seed=2)
    null = shaft.null(data)
    colour = Colour()  # white, but it keeps the samples from being averaged
    noise = NoiseModel(shaft.sigma, {("shaft", "omega"): colour})
    found = latent_torques(null, noise, ports=["load"], knots=20)[0]
    record = null.records[0]
    knots = found.courses["shaft"].time
    unit = torque_direction(shaft.model, "load", ca.SX(1), name="load")
    hats = knot_sensitivities(record.path, unit, knots)
    h = np.concatenate([hats[:, 0].T / 0.05, hats[:, 1].T / 0.1])
    s = np.concatenate([record.slopes[o] / shaft.sigma[o] for o in record.outputs])
    e = np.concatenate([record.residual[o] / shaft.sigma[o] for o in record.outputs])
    q = np.linalg.qr(s / np.linalg.norm(s, axis=0))[0]
    h, e = h - q @ (q.T @ h), e - q @ (q.T @ e)
    prior = found.level**2 * np.exp(-np.abs(knots[:, None] - knots) / found.length)
    precision = np.linalg.inv(prior) + h.T @ h
    mean = np.linalg.solve(precision, h.T @ e)
    assert found.courses["shaft"].mean == pytest.approx(mean, abs=1e-4 * np.abs(mean).max())
    band = np.sqrt(np.diag(np.linalg.inv(precision)))
    assert found.courses["shaft"].band == pytest.approx(band, rel=1e-3)
    v = np.eye(len(e)) + h @ prior @ h.T
    gain = e @ e - e @ np.linalg.solve(v, e) - np.linalg.slogdet(v)[1]
    assert found.gain == pytest.approx(gain, rel=1e-4)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_known_torque_lies_in_its_band_but_for_what_parameters_take(shaft, kernel):
    data = shaft.data(hidden=wander, seed=2, n=800)
    null, noise = shaft.null(data), NoiseModel(shaft.sigma)
    found = latent_torques(null, noise, kernel=kernel, knots=80)
    best = found[0]
    assert best.port == "load"
    assert best.gain > 100
    course = best.courses["shaft"]
    truth = np.array([wander(t, None)[1] for t in course.time])
    inside = np.abs(course.mean - truth) < 2.5 * course.band
    assert inside.mean() > 0.85
    assert np.corrcoef(course.mean, truth)[0, 1] > 0.9
    assert course.signals["speed"].shape == course.time.shape


def test_no_torque_is_made_of_noise(shaft):
    noise = NoiseModel(shaft.sigma)
    gains = [
        one.gain
        for seed in range(4)
        for one in latent_torques(shaft.null(shaft.data(seed=20 + seed)), noise, knots=30)
    ]
    assert max(gains) < 12
    assert min(gains) >= 0


def test_averaging_loses_little(shaft):
    data = shaft.data(hidden=wander, seed=2, n=1200, step=2e-3)
    null = shaft.null(data)
    plain = latent_torques(null, NoiseModel(shaft.sigma), ports=["load"], knots=25)[0]
    white = NoiseModel(shaft.sigma, {("shaft", "omega"): Colour()})
    every = latent_torques(null, white, ports=["load"], knots=25)[0]
    assert plain.gain == pytest.approx(every.gain, rel=0.02)


def test_bad_names_are_refused(shaft):
    null = shaft.null(shaft.data())
    noise = NoiseModel(shaft.sigma)
    with pytest.raises(
        EstimationError, match=r"the kernel of the latent torque is not known; seen: 'cubic'; allowed: exp"
    ):
        latent_torques(null, noise, kernel="cubic")
    with pytest.raises(
        EstimationError, match=r"no torque can act at this port; seen: sensor_omega; allowed: engine, load"
    ):
        latent_torques(null, noise, ports=["sensor_omega"])
