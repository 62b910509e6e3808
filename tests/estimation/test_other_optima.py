"""A resonance that is buried in noise has many optima, and the search goes on from one to a lower one."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import butter, lfilter

import casadi_engine as ce
from casadi_engine.estimation.spectral_start import SpectralStarts

NOISE = 0.03


@pytest.fixture(scope="module")
def record():
    """One speed of two inertias under a torque that has little at their resonance of 40 Hz; exact for its samples."""
    random, samples, step = np.random.default_rng(3), 2400, 2e-3
    torque = 50 * lfilter(*butter(2, 0.02), random.standard_normal(samples))
    engine, load, spring, damper = 0.4, 0.18, 8000.0, 0.3
    a = np.array(
        [
            [-(damper + 0.5) / engine, damper / engine, spring / engine],
            [damper / load, -damper / load, -spring / load],
            [-1, 1, 0],
        ]
    )
    whole = np.zeros((5, 5))
    whole[:3, :3], whole[:3, 3], whole[3, 4] = a * step, np.array([step / engine, 0, 0]), 1
    whole = expm(whole)
    x = np.zeros((samples, 3))
    x[0] = [10, 10, 0]
    for k in range(samples - 1):
        x[k + 1] = (
            whole[:3, :3] @ x[k] + whole[:3, 3] * torque[k] + whole[:3, 4] * (torque[k + 1] - torque[k])
        )
    seen = x[:, 0] + NOISE * random.standard_normal(samples)
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays("r", time=np.arange(samples) * step, units=units, T=torque, omega=seen)


def fitted(record, load, spring, sigma=NOISE, **options):
    b = ce.Blueprint("shaft")
    je = b.parameter("J_eng", 0.4, unit="kg m2", min=0.04, max=4)
    jl = b.parameter("J_load", load, unit="kg m2", min=1e-3, max=10)
    k = b.parameter("K", spring, unit="N m/rad", min=100, max=1e5)
    c = b.parameter("C", 0.3, unit="N m s/rad", min=0.02, max=10)
    we, wl = (b.state(name, unit="rad/s", scale=10) for name in ("omega_eng", "omega_load"))
    twist, torque = b.state("twist", unit="rad", scale=0.01), b.input("T", unit="N m", scale=20)
    shaft = k * twist + c * (wl - we)
    b.ode("omega_eng", (torque + shaft - 0.5 * we) / je)
    b.ode("omega_load", -shaft / jl)
    b.ode("twist", wl - we)
    b.output("omega", we, unit="rad/s", scale=10)
    return ce.estimate(b.model(), record, noise=ce.Noise(omega=sigma), progress=False, **options)


def test_a_search_that_ends_at_a_line_of_the_noise_goes_on_to_the_resonance(record):
    """From 20 kN m/rad it had ended at 29, with chi-squared 360 above what 7.9 has, and said that it had converged."""
    near, far = fitted(record, 0.2, 7000.0), fitted(record, 0.3, 20000.0)
    assert near.values["K"] == pytest.approx(8000, rel=0.03)
    assert far.cost == pytest.approx(near.cost, abs=0.01)
    assert far.values["K"] == pytest.approx(near.values["K"], rel=1e-4)


def test_optima_that_were_left_are_told_of(record):
    far = fitted(record, 0.3, 20000.0)
    assert far.optima[0].cost == pytest.approx(far.cost, abs=0.01)
    left = [one for one in far.optima[1:] if one.cost > far.cost + 300]
    assert left
    assert all(one.values["K"] > 1.5 * far.values["K"] for one in left)


def test_several_processes_find_what_one_finds(record):
    """That a search has strayed had been known to the process alone in which it did."""
    one, two = (fitted(record, 0.3, 20000.0, starts=2, jobs=jobs) for jobs in (1, 2))
    assert two.cost == pytest.approx(one.cost, abs=1e-6)
    assert len(two.optima) == len(one.optima)


def test_what_is_left_open_is_looked_at_by_the_levels_of_the_optimum(record, monkeypatch):
    """An estimated level scales the optimum; the frequencies beside it had kept the level of the start."""
    seen, plain = [], SpectralStarts.others

    def others(self, begun):
        self._spectral.weigh(np.full(1, 7.0))
        found = plain(self, begun)
        seen.append((self._spectral.records[0].sigma[0], begun.sigma[0]))
        return found

    monkeypatch.setattr(SpectralStarts, "others", others)
    fitted(record, 0.2, 7000.0, "estimate")
    assert seen
    assert all(used == wanted == pytest.approx(NOISE, rel=0.2) for used, wanted in seen)
