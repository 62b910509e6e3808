"""Runs of the simulator: energy, tolerance, another integrator, speed, misfire, noise."""

import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp
from simulator import (
    Engine,
    add_noise,
    crankshaft_shaft,
    identical_cylinders,
    simulate_two_mass,
    two_mass_shaft,
    unequal_cylinders,
)
from simulator.run import Plant, integrate


def energy_gap(shaft, record, samples):
    """Energy that came in, less what was stored, dissipated or given to the load, over the throughput [1]."""
    states, time, n = record["states"][:, :samples], record["time"][:samples], shaft.size
    speeds = states[1 : 1 + n]
    torques = np.array([record[f"T_{c}"][:samples] for c in (1, 2, 3, 4)])
    supplied = simpson((torques * speeds[list(shaft.throws)]).sum(axis=0), x=time)
    braked = simpson(record["T_load"][:samples] * speeds[-1], x=time)
    rubbed = simpson(shaft.absolute_damping @ speeds**2, x=time)
    damped = simpson(shaft.coupling_damping @ np.diff(speeds, axis=0) ** 2, x=time)
    stored = shaft.energy(states)
    return (supplied - braked - rubbed - damped - (stored[-1] - stored[0])) / supplied


def test_energy_is_conserved_on_two_masses(clean_normal):
    assert abs(energy_gap(two_mass_shaft(), clean_normal, 2001)) < 1e-8


def test_energy_is_conserved_on_the_crankshaft(clean_crankshaft):
    assert abs(energy_gap(crankshaft_shaft(), clean_crankshaft, 901)) < 1e-7


def test_another_integrator_and_equation_4_1_written_out_give_the_same_run(clean_misfire):
    record = clean_misfire
    engine = Engine(unequal_cylinders(), record["factors"], float(record["strength"]))
    offsets = np.array([0.0, 3.0, 1.0, 2.0]) * np.pi
    r, rod, area, mass = 0.043, 0.145, 0.0058, 0.7

    def equation_4_1(_time, x):
        star = x[3] - offsets
        root = np.sqrt(1 - (r / rod) ** 2 * np.sin(star) ** 2)
        f = np.sin(star) + (r / rod) * np.sin(star) * np.cos(star) / root
        slope = np.cos(star) + (r / rod) * np.cos(2 * star) / root
        slope += (r / rod) ** 3 * (np.sin(star) * np.cos(star)) ** 2 / root**3
        indicated = (engine.pressures(np.full((4, 1), x[3]))[:, 0] - 1e5) * area * r * f
        shape = -mass * r**2 * f * slope
        spring = 1992.0 * x[2] + 2.5 * (x[1] - x[0])
        return [
            2.557 * (-0.1541 * x[0] + spring + indicated.sum() + x[0] ** 2 * shape.sum()),
            5.646 * (-spring - 57.0),
            x[1] - x[0],
            x[0],
        ]

    start = record["states"][[1, 2, 3, 0], 0]
    times = record["time"][:1440:60]
    again = solve_ivp(equation_4_1, (0, times[-1]), start, "LSODA", times, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.y[0], record["omega_true"][:1440:60], atol=2e-6)
    np.testing.assert_allclose(again.y[3], record["theta"][:1440:60], atol=2e-7)


@pytest.mark.parametrize("shaft", [two_mass_shaft(), crankshaft_shaft()], ids=["two_mass", "crankshaft"])
def test_tolerance_has_converged(shaft, clean_normal, clean_crankshaft):
    record = clean_normal if shaft.size == 2 else clean_crankshaft
    engine = Engine(unequal_cylinders(), record["factors"], float(record["strength"]))
    plant, times = Plant(shaft, engine, lambda _time: 57.0), record["time"][:500]
    rough, fine = (integrate(plant, record["states"][:, 0], times, rtol=rtol) for rtol in (1e-10, 1e-12))
    np.testing.assert_allclose(rough[1], fine[1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(rough[0], fine[0], rtol=0, atol=1e-8)
    # the twists of a crankshaft are 1e-5 to 1e-2 rad
    np.testing.assert_allclose(rough[1 + shaft.size :], fine[1 + shaft.size :], rtol=0, atol=1e-9)


def test_record_starts_on_the_orbit_at_the_wanted_speed():
    record = simulate_two_mass(
        1200.0, cycles=2, scatter=0.0, cylinders=identical_cylinders(), sigma=0.0, rtol=1e-9
    )
    whole = record["theta"] < 8 * np.pi
    duration = np.interp(8 * np.pi, record["theta"], record["time"])
    assert whole.sum() >= 2879
    assert 8 * np.pi / duration * 30 / np.pi == pytest.approx(1200.0, abs=0.01)
    at_starts = [np.interp(k * 4 * np.pi, record["theta"], record["omega_true"]) for k in (0, 1, 2)]
    np.testing.assert_allclose(at_starts, at_starts[0], atol=1e-3)


def test_angle_starts_at_zero_and_all_cycles_are_complete(clean_normal):
    assert clean_normal["theta"][0] == 0.0
    assert clean_normal["theta"][-1] >= 2 * 4 * np.pi
    assert len(clean_normal["time"]) >= 2880
    np.testing.assert_allclose(np.gradient(clean_normal["theta"], clean_normal["time"])[1:-1],
                               clean_normal["omega_true"][1:-1], atol=5e-3)  # fmt: skip


def test_misfiring_cylinder_is_motored_and_the_others_carry_the_load(clean_normal, clean_misfire):
    motored = clean_misfire["p2"].max()
    assert motored == pytest.approx(10.5e5, rel=0.02)
    after = np.interp(3 * np.pi + np.pi / 6, clean_misfire["theta"], clean_misfire["p2"])
    before = np.interp(3 * np.pi - np.pi / 6, clean_misfire["theta"], clean_misfire["p2"])
    assert after == pytest.approx(before, rel=1e-3)
    assert clean_normal["p2"].max() > 2.0 * motored
    assert clean_misfire["p1"].max() > 1.15 * clean_normal["p1"].max()
    torque = [sum(run[f"T_{c}"].mean() for c in (1, 2, 3, 4)) for run in (clean_normal, clean_misfire)]
    assert torque == pytest.approx([57.0 + 0.1541 * 125.66] * 2, rel=0.03)


def test_assumed_pressures_are_the_measured_ones_shifted(clean_normal):
    record, theta = clean_normal, clean_normal["theta"]
    later = (theta > np.pi) & (theta < 7 * np.pi)
    shifted = np.interp(theta[later] - np.pi, theta, record["p1"])
    np.testing.assert_allclose(record["p3_assumed"][later], shifted, rtol=2e-3)
    shifted = np.interp(theta[later] + np.pi, theta, record["p2"])
    np.testing.assert_allclose(record["p4_assumed"][later], shifted, rtol=2e-3)
    for cylinder in ("p3", "p4"):
        gap = np.abs(record[cylinder] - record[f"{cylinder}_assumed"]).max()
        assert 0.005 < gap / record[cylinder].max() < 0.15


def test_noise_has_the_wanted_size_and_follows_its_seed(clean_normal):
    first, again, other = (add_noise(clean_normal, sigma=0.1, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first["omega"], again["omega"])
    noise = np.array(
        [r[name] - r[f"{name}_true"] for r in (first, other) for name in ("omega", "omega_load")]
    )
    np.testing.assert_allclose(noise.std(axis=1), 0.1, rtol=0.05)
    assert np.abs(np.corrcoef(noise) - np.eye(4)).max() < 0.08
    np.testing.assert_array_equal(clean_normal["omega"], clean_normal["omega_true"])


def test_an_extra_torque_on_the_load_is_a_different_load():
    options = {"cycles": 1, "scatter_seed": 3, "sigma": 0.0, "rtol": 1e-9}
    heavy = simulate_two_mass(1200.0, load=62.0, **options)
    braked = simulate_two_mass(1200.0, load=57.0, extra=lambda _t, _x: np.array([0.0, -5.0]), **options)
    np.testing.assert_allclose(braked["omega_true"], heavy["omega_true"], atol=1e-3)


def test_a_lighter_load_lets_the_engine_run_up():
    record = simulate_two_mass(
        1200.0, load=lambda time: 57.0 - 200.0 * time, duration=0.1, cycles=2, sigma=0.0, rtol=1e-8
    )
    assert len(record["time"]) == 1440
    assert record["T_load"][-1] == pytest.approx(57.0 - 200.0 * record["time"][-1])
    gained = record["states"][1:3, -1] - record["states"][1:3, 0]
    momentum = two_mass_shaft().inertia @ gained
    assert momentum == pytest.approx(200.0 * 0.1**2 / 2, rel=0.35)
