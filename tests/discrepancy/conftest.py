"""A small shaft with ports and a pendulum, their records, and null models, for the tests of the discrepancy room."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import casadi_engine as ce
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.null_model import null_at
from casadi_engine.discrepancy.refit import Refitter
from casadi_engine.simulation.candidate_sensitivities import Direction, torque_direction

TRUTH = {"J_eng": 0.4, "J_load": 0.18, "K_el": 120.0, "C_el": 0.2, "C_eng": 0.15}
START = np.array([100.0, 100.0, -0.1])
SIGMA = {"omega": 0.05, "omega_load": 0.1}


def shaft_model(two=True):
    b = ce.Blueprint("shaft")
    je = b.parameter("J_eng", 0.4, unit="kg m2", min=1e-3, max=10)
    jl = b.parameter("J_load", 0.18, unit="kg m2", min=1e-3, max=10)
    k = b.parameter("K_el", 120.0, unit="N m/rad", min=1, max=1e4)
    c = b.parameter("C_el", 0.2, unit="N m s/rad", min=0, max=10)
    d = b.parameter("C_eng", 0.15, unit="N m s/rad", min=0, max=10)
    we = b.state("omega_eng", unit="rad/s", scale=100)
    wl = b.state("omega_load", unit="rad/s", scale=100)
    twist = b.state("twist", unit="rad", scale=0.1)
    torque, load = b.input("T", unit="N m", scale=20), b.input("T_load", unit="N m", scale=20)
    on_engine = b.port("engine", "inertia", {"speed": we})
    on_load = b.port("load", "inertia", {"speed": wl})
    inside = b.port("coupling", "coupling", {"twist": twist, "twist_rate": wl - we, "stiffness": k})
    spring = k * twist + c * (wl - we) + inside
    b.ode("omega_eng", (torque + spring - d * we + on_engine) / je)
    b.ode("omega_load", (-spring - load + on_load) / jl)
    b.ode("twist", wl - we)
    b.output("omega", we, unit="rad/s", scale=100)
    if two:
        b.output("omega_load", wl, unit="rad/s", scale=100)
    return b.model()


def shaft_data(name="shaft", *, n=400, step=4e-3, seed=0, noise=True, two=True, hidden=None, inputs=7):
    """An exact record (first-order hold); hidden(t, x) -> torques on engine and load, held over a tenth of a step."""
    rng = np.random.default_rng(seed)
    drawn = np.random.default_rng(inputs)
    time = np.arange(n) * step
    tones = 2 * np.pi * np.array([0.5, 1.3, 2.9, 4.1, 6.7, 9.3])
    phase = drawn.uniform(0, 6, (2, len(tones), 1))
    torque = 20 + 8 * np.sin(tones[:, None] * time + phase[0]).sum(axis=0)
    load = 15 + 4 * np.sin(tones[:, None] * time + phase[1]).sum(axis=0)
    je, jl, k, c, d = TRUTH.values()
    a = np.array([[-(c + d) / je, c / je, k / je], [c / jl, -c / jl, -k / jl], [-1.0, 1.0, 0.0]])
    b = np.array([[1 / je, 0], [0, -1 / jl], [0, 0]])
    parts = 1 if hidden is None else 10
    h = step / parts
    big = np.zeros((7, 7))
    big[:3, :3], big[:3, 3:5], big[3:5, 5:] = a * h, b * h, np.eye(2)
    big = expm(big)
    f, held, ramp = big[:3, :3], big[:3, 3:5], big[:3, 5:]
    x = np.empty((n, 3))
    x[0] = START
    for i in range(n - 1):
        state = x[i]
        for j in range(parts):
            u0, u1 = (
                np.array([torque[i], load[i]]) * (1 - s) + np.array([torque[i + 1], load[i + 1]]) * s
                for s in (j / parts, (j + 1) / parts)
            )
            if hidden is not None:
                extra = np.asarray(hidden(time[i] + (j + 0.5) * h, state)) * [1, -1]
                u0, u1 = u0 + extra, u1 + extra
            state = f @ state + held @ u0 + ramp @ (u1 - u0)
        x[i + 1] = state
    y = x[:, :2] + (rng.standard_normal((n, 2)) * [SIGMA["omega"], SIGMA["omega_load"]] if noise else 0.0)
    outputs = {"omega": y[:, 0], "omega_load": y[:, 1]} if two else {"omega": y[:, 0]}
    units = {"T": "N m", "T_load": "N m", **dict.fromkeys(outputs, "rad/s")}
    return ce.Experiment.from_arrays(name, time=time, units=units, T=torque, T_load=load, **outputs)


def shaft_candidates(model):
    """Named terms of several kinds; the last is a combination of parameters and cannot be tested."""
    coupling = model.ports["coupling"].signals
    engine, load = model.ports["engine"].signals["speed"], model.ports["load"].signals["speed"]
    rate, twist = coupling["twist_rate"], coupling["twist"]

    def torque(name, port, value, *, side=0, group=None, **nuisance):
        direction = torque_direction(model, port, value, name=name)
        return Candidate(name, port, direction, nuisance=nuisance, side=side, unit="N m", group=group)

    zero, one = ca.SX.zeros(3, 1), ca.SX.zeros(len(model.outputs), 1)
    one[0] = 1
    return [
        torque("coulomb_friction", "coupling", ca.tanh(rate / 0.5), side=1),
        torque("cubic_stiffness", "coupling", twist**3 * 1e2),
        torque("constant_torque", "load", 0 * load - 1),
        torque("viscous_friction", "load", -load / 100, side=1),
        torque("quadratic_drag", "load", -load * ca.fabs(load) / 1e4, side=1),
        torque("load_step", "load", -ca.if_else(model.t > 0.5, 1.0, 0.0), time=0.5),
        torque("load_step", "load", -ca.if_else(model.t > 1.1, 1.0, 0.0), time=1.1),
        torque("ripple", "engine", ca.sin(40 * model.t), group="ripple"),
        torque("ripple", "load", ca.sin(40 * model.t), group="ripple"),
        Candidate("sensor_offset", "sensor_omega", Direction("offset", zero, one)),
        torque("viscous_friction", "coupling", -rate),
        torque("engine_drag", "engine", engine / 100),
    ]


@pytest.fixture(scope="session")
def shaft():
    """model, truth, start, sigma; data(...), candidates(model), null(data): the null model at the truth."""
    model = shaft_model()

    def null(*data, prior=None, parameters=None, model=model):
        pars = model.parameters() if parameters is None else parameters
        for name, spread in (prior or {}).items():
            pars[name].set(prior=(TRUTH[name], spread))
        z = np.array(list(TRUTH.values()))
        return null_at(model, data, pars, z, {d.name: START for d in data})

    return SimpleNamespace(
        model=model, truth=TRUTH, start=START, sigma=SIGMA, data=shaft_data, candidates=shaft_candidates,
        null=null, make=shaft_model,
    )  # fmt: skip


LEVEL = 0.002


def pendulum_model():
    b = ce.Blueprint("pendulum")
    stiff = b.parameter("w2", 40.0, unit="rad2/s2", min=1, max=200)
    damping = b.parameter("c", 0.05, unit="1/s", min=0, max=5)
    angle, rate = b.state("angle", unit="rad"), b.state("rate", unit="rad/s", scale=5)
    pivot = b.port("pivot", "inertia", {"speed": rate, "angle": angle})
    b.ode("angle", rate)
    b.ode("rate", pivot - damping * rate - stiff * ca.sin(angle))
    b.output("y", angle, unit="rad")
    return b.model()


def decay(hidden=None, *, name="decay", seed=0, samples=500, begun=1.5, w2=41.3, c=0.05):
    """A free decay of a pendulum by SciPy, sampled at 100 Hz; hidden(t, angle, rate) -> torque over inertia."""
    time = np.arange(samples) * 0.01

    def rates(t, x):
        extra = 0.0 if hidden is None else hidden(t, *x)
        return [x[1], extra - c * x[1] - w2 * np.sin(x[0])]

    run = solve_ivp(rates, (0, time[-1]), [begun, 0.0], t_eval=time, rtol=1e-8, atol=1e-10, max_step=0.01)
    y = run.y[0] + LEVEL * np.random.default_rng(seed).standard_normal(samples)
    return ce.Experiment.from_arrays(name, time=time, units={"y": "rad"}, y=y)


@pytest.fixture(scope="session")
def pendulum():
    """model, level; decay(hidden, ...): a record; refitter(*data): of records whose level is known."""
    model = pendulum_model()

    def refitter(*data, parameters=None):
        pars = model.parameters() if parameters is None else parameters
        return Refitter(model, pars, data, ce.Noise(y=LEVEL), {"max_iterations": 100})

    return SimpleNamespace(model=model, level=LEVEL, decay=decay, refitter=refitter)


@pytest.fixture(scope="session")
def with_residual():
    """A null model whose residuals are replaced: record -> output -> (N,), or drawn from the noise levels."""

    def change(null, residuals):
        records = tuple(
            replace(record, residual={k: residuals[record.name][k] for k in record.residual})
            for record in null.records
        )
        return replace(null, records=records)

    return change
