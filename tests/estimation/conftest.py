"""What the tests of estimation share: small records, their closed-form answers, and a check of messages."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

import casadi_engine as ce
from casadi_engine.errors import CasadiEngineError

DATA = Path(__file__).parents[2] / "data"
Refused = Callable[..., AbstractContextManager[pytest.ExceptionInfo[CasadiEngineError]]]


@pytest.fixture
def refused() -> Refused:
    """A context that wants exactly this class of error, with these texts in its four parts."""

    @contextmanager
    def context(kind, problem, *, seen="", allowed="", cure="") -> Iterator:
        with pytest.raises(CasadiEngineError) as caught:
            yield caught
        error = caught.value
        assert type(error) is kind, repr(error)
        assert problem in error.problem
        assert seen in (error.seen if isinstance(error.seen, str) else repr(error.seen))
        assert allowed in (error.allowed or "")
        assert cure in (error.cure or "")
        assert "do: " in str(error)

    return context


def run_up(
    name="run_up", *, n=400, step=0.02, seed=0, J=0.4, C=0.5, sigma=0.05, start=20.0, missing=0.0,
    outliers=0.0, euler=False,
):  # fmt: skip
    """One inertia under a switching torque, zero-order hold, by its exact (or Euler) recursion."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * step
    torque = 10 + 5 * np.sign(np.sin(2 * np.pi * 0.7 * time + seed)) + rng.standard_normal(n)
    a = 1 - step * C / J if euler else np.exp(-step * C / J)
    b = step / J if euler or C == 0 else (1 - a) / C
    speed = np.empty(n)
    speed[0] = start
    for k in range(n - 1):
        speed[k + 1] = a * speed[k] + b * torque[k]
    noise = sigma * rng.standard_normal(n)
    hit = rng.random(n) < outliers
    noise[hit] += 30 * sigma * rng.standard_normal(int(hit.sum()))
    measured = speed + noise
    measured[rng.random(n) < missing] = np.nan
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(name, time=time, units=units, hold="zero", T=torque, omega=measured)


@pytest.fixture(name="run_up")
def run_up_fixture():
    return run_up


def shaft(name="shaft", *, n=1200, step=2e-3, seed=0, sigma=(0.05, 0.1), two=True):
    """Two inertias on a damped shaft under torques of many frequencies, exact for the first-order hold."""
    p = {"J_eng": 0.4, "J_load": 0.18, "K_el": 120.0, "C_el": 0.2, "C_eng": 0.15}
    rng = np.random.default_rng(seed)
    time = np.arange(n) * step
    tones = 2 * np.pi * np.array([0.5, 1.3, 2.9, 4.1, 6.7, 9.3])
    phase = rng.uniform(0, 6, (2, len(tones), 1))
    torque = 20 + 8 * np.sin(tones[:, None] * time + phase[0]).sum(axis=0)
    load = 15 + 4 * np.sin(tones[:, None] * time + phase[1]).sum(axis=0)
    je, jl, k, c, ce_ = p.values()
    a = np.array([[-(c + ce_) / je, c / je, k / je], [c / jl, -c / jl, -k / jl], [-1.0, 1.0, 0.0]])
    b = np.array([[1 / je, 0], [0, -1 / jl], [0, 0]])
    big = np.zeros((7, 7))
    big[:3, :3], big[:3, 3:5], big[3:5, 5:] = a * step, b * step, np.eye(2)
    big = expm(big)
    f, held, ramp = big[:3, :3], big[:3, 3:5], big[:3, 5:]
    u = np.array([torque, load])
    x = np.empty((n, 3))
    x[0] = [100.0, 100.0, -0.1]
    for i in range(n - 1):
        x[i + 1] = f @ x[i] + held @ u[:, i] + ramp @ (u[:, i + 1] - u[:, i])
    y = x[:, :2] + rng.standard_normal((n, 2)) * sigma
    outputs = {"omega": y[:, 0], "omega_load": y[:, 1]} if two else {"omega": y[:, 0]}
    units = {"T": "N m", "T_load": "N m", **dict.fromkeys(outputs, "rad/s")}
    made = ce.Experiment.from_arrays(name, time=time, units=units, T=torque, T_load=load, **outputs)
    return SimpleNamespace(data=made, truth=p, start=x[0], states=x)


@pytest.fixture(name="shaft")
def shaft_fixture():
    return shaft


@pytest.fixture
def shaft_model():
    """The model of ``shaft`` with torque channels; ``two=False`` leaves the load's speed unmeasured."""

    def make(two=True):
        b = ce.Blueprint("shaft")
        je = b.parameter("J_eng", 0.5, unit="kg m2", min=1e-3, max=10)
        jl = b.parameter("J_load", 0.2, unit="kg m2", min=1e-3, max=10)
        k = b.parameter("K_el", 100.0, unit="N m/rad", min=1, max=1e4)
        c = b.parameter("C_el", 0.3, unit="N m s/rad", min=0, max=10)
        d = b.parameter("C_eng", 0.2, unit="N m s/rad", min=0, max=10)
        we = b.state("omega_eng", unit="rad/s", scale=100)
        wl = b.state("omega_load", unit="rad/s", scale=100)
        twist = b.state("twist", unit="rad", scale=0.1)
        torque, load = b.input("T", unit="N m", scale=20), b.input("T_load", unit="N m", scale=20)
        spring = k * twist + c * (wl - we)
        b.ode("omega_eng", (torque + spring - d * we) / je)
        b.ode("omega_load", (-spring - load) / jl)
        b.ode("twist", wl - we)
        b.output("omega", we, unit="rad/s", scale=100)
        if two:
            b.output("omega_load", wl, unit="rad/s", scale=100)
        return b.model()

    return make


def line(b_model=None, *, product=False):
    """A model whose output is linear in its parameters: dx/dt = p1 u1 + p2 u2, x(0) known."""
    b = ce.Blueprint("line")
    p1, p2 = b.parameter("p1", 1.0), b.parameter("p2", 1.0)
    x = b.state("x")
    u1, u2 = b.input("u1"), b.input("u2")
    b.ode("x", p1 * p2 * u1 if product else p1 * u1 + p2 * u2)
    b.output("y", x)
    return b.model()


@pytest.fixture(name="line")
def line_fixture():
    return line


def line_data(name="ramp", *, n=200, step=0.05, seed=0, p=(1.5, -0.7), sigma=0.1, start=0.0):
    """A record of ``line`` with its regressors: y = phi p + start + noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) * step
    u = np.array([np.sin(1.1 * time), np.cos(0.7 * time) + 0.3])
    phi = np.zeros((n, 2))
    phi[1:] = np.cumsum(u[:, :-1].T * step, axis=0)
    y = phi @ p + start + sigma * rng.standard_normal(n)
    units = dict.fromkeys(("u1", "u2", "y"), "1")
    data = ce.Experiment.from_arrays(name, time=time, units=units, hold="zero", u1=u[0], u2=u[1], y=y)
    return SimpleNamespace(data=data, phi=phi, y=y, sigma=sigma)


@pytest.fixture(name="line_data")
def line_data_fixture():
    return line_data


@pytest.fixture(scope="session")
def misfire():
    """Cycles of the kept misfire record: misfire(1, 2) are the first two."""
    whole = ce.read_experiment(DATA / "misfire_1200rpm.csv.gz", optional=("omega_load",))
    return lambda first, last: whole.cycles(first, last)
