"""Sensitivities of candidates against finite differences of the sharp, independent simulator."""

from functools import cache

import casadi as ca
import numpy as np
import pytest

from casadi_engine import effects, simulate
from casadi_engine.model import crankshaft, two_mass

TWO = two_mass(outputs=("omega", "omega_load"))
SEVEN = crankshaft(outputs=("omega", "omega_load"))


def sweep(candidate, record, values):
    """∂y/∂ψ (ny, N): ṡ = f_x s + g, y_s = h_x s + m along the record's true states, by Runge-Kutta steps over two
    samples each (the states in the middle are known)."""
    m = candidate.model
    x = state_rows(m, record)
    u = np.array([record[v.name] for v in m.inputs])
    g = ca.Function(
        "g",
        [m.x, m.u, m.t, m.p],
        [ca.jacobian(m.closed_ode, m.x), candidate.ode, ca.jacobian(m.closed_outputs, m.x), candidate.output],
    )
    count, n, ny = x.shape[1], m.x.numel(), len(m.outputs)
    p = np.repeat(m.parameter_vector(values)[:, None], count, axis=1)
    a, b, c, d = (np.array(part) for part in g.map(count)(x, u, record["time"][None], p))
    a, b = a.reshape(n, count, n).swapaxes(0, 1), b.T
    c, d = c.reshape(ny, count, n).swapaxes(0, 1), d.T
    h, s, out = 2 * float(record["time"][1]), np.zeros(n), []
    for k in range(0, count - 2, 2):
        out.append(c[k] @ s + d[k])
        k1 = a[k] @ s + b[k]
        k2 = a[k + 1] @ (s + h / 2 * k1) + b[k + 1]
        k3 = a[k + 1] @ (s + h / 2 * k2) + b[k + 1]
        k4 = a[k + 2] @ (s + h * k3) + b[k + 2]
        s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(out).T


def state_rows(model, record):
    """The simulator's states in the model's order."""
    states, n = record["states"], len(record["states"]) // 2
    rows = [states[1]]
    for i in range(1, n):
        rows += [states[1 + i], states[n + i]]
    return np.array(rows)


def gap(model, record, experiment):
    """What the record shows and the model without the effect, driven by the same channels, does not: (ny, N)."""
    start = dict(zip((s.name for s in model.states), state_rows(model, record)[:, 0], strict=True))
    run = simulate(model, experiment, initial=start)
    shown = [record["omega_true"], record["omega_load_true"]]
    return np.array([y - run[v.name].values for y, v in zip(shown, model.outputs, strict=True)])


# name, port, hidden size, nuisance of the model, details of the simulator, allowed error of the largest value
TWO_MASS = [
    ("coulomb_friction", "coupling", 1e-2, {}, {}, 0.015),
    ("coulomb_friction", "load", 1e-2, {}, {}, 1e-4),
    ("viscous_friction", "coupling", 1e-3, {}, {}, 1e-3),
    ("viscous_friction", "load", 1e-4, {}, {}, 1e-3),
    ("quadratic_drag", "load", 1e-6, {}, {}, 1e-3),
    ("stribeck_friction", "load", 1e-2, {"fading": 140.0}, {"fading": 140.0}, 1e-3),
    ("constant_torque", "engine", 1e-2, {}, {}, 1e-4),
    ("cubic_stiffness", "coupling", 1e2, {}, {}, 1e-3),
    ("backlash", "coupling", 1e-5, {}, {}, 1e-3),
    ("misfire", "cylinder_3", 1e-3, {"first": 1, "last": 1}, {"cycles": (1,)}, 0.015),
    ("cylinder_imbalance", "cylinder_3", 1e-3, {}, {}, 0.015),
    ("load_step", "load", 1e-2, {"time": 0.0201}, {"time": 0.0201}, 2e-3),
    ("sensor_offset", "sensor_omega", 1e-2, {}, {}, 1e-9),
    ("sensor_delay", "sensor_omega_load", 1e-6, {}, {}, 1e-3),
]
SEVEN_MASS = [
    ("coulomb_friction", "coupling_76", 1e-2, {}, {}, 0.02),
    ("viscous_friction", "inertia_3", 1e-3, {}, {}, 1e-3),
    ("cubic_stiffness", "coupling_76", 1e2, {}, {}, 1e-3),
    ("cylinder_imbalance", "cylinder_3", 1e-3, {}, {}, 0.015),
    ("backlash", "coupling_76", 1e-5, {}, {}, 1e-3),
    ("constant_torque", "inertia_4", 1e-2, {}, {}, 1e-3),
    ("sensor_delay", "sensor_omega", 1e-6, {}, {}, 1e-3),
]


ROWS = {"two_mass": TWO_MASS, "crankshaft": SEVEN_MASS}
MODELS = {"two_mass": TWO, "crankshaft": SEVEN}


@pytest.fixture(scope="module")
def runs():
    """kind -> the run without a hidden effect and those of the rows, all at once."""
    from simulator.hidden import hidden
    from simulator.hidden_runs import Case, simulate_hidden

    @cache
    def made(kind):
        cases = [Case(scatter_seed=3)]
        cases += [
            Case(effects=(hidden(name, at, size, **details),), scatter_seed=3)
            for name, at, size, _, details, _ in ROWS[kind]
        ]
        return simulate_hidden(kind, cases, cycles=1, duration=0.05, sigma=0.0)

    return made


# On the crankshaft the quick run has the closed forms of test_candidate.py.
PAIRS = [
    pytest.param(kind, number, marks=pytest.mark.slow if kind == "crankshaft" else ())
    for kind, rows in ROWS.items()
    for number in range(len(rows))
]


@pytest.mark.parametrize(("kind", "number"), PAIRS, ids=lambda v: v if isinstance(v, str) else str(v))
def test_a_candidate_is_the_slope_of_the_sharp_simulator(kind, number, runs, experiment_of):
    name, at, size, values, _, allowed = ROWS[kind][number]
    model, null, record = MODELS[kind], runs(kind)[0], runs(kind)[number + 1]
    count = min(len(record["time"]), len(null["time"]))
    residual = gap(model, record, experiment_of(record))[:, :count]
    found = (residual - gap(model, null, experiment_of(null))[:, :count]) / size
    numbers = dict(zip(model.parameter_names, model.parameter_vector(), strict=True))
    effect = effects.library(name)[0].fitted(effects.port_view(model, at), experiment_of(null), numbers)
    predicted = sweep(effects.candidate(model, effect, at, values, sharp=True), null, None)
    found = found[:, : 2 * predicted.shape[1] : 2]
    assert np.abs(found).max() > 0
    assert np.abs(predicted - found).max() < allowed * np.abs(found).max(), f"{name} at {at}"
