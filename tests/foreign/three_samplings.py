"""One rotor at three samplings: a driven rotor on a spring with a damper, 20 Hz, its speed measured three ways.

equal : 150 Hz. jittered : the same number of samples, each off by up to 40 % of a step. teeth : at each tooth of a
shaft whose speed varies by half (instants that never meet the torque's samples).
The torque is recorded at 200 Hz and joined by lines. Truth: SciPy, started anew at each sample of the torque.
Noise-free, so that what differs between the fits is the arithmetic; standard errors from a stated noise.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from small_truth import Pieces, solve

import casadi_engine as ce

Array = NDArray[np.float64]
TRUE = {"J": 0.01, "c": 0.1, "k": 0.01 * (40 * np.pi) ** 2}
SIGMA = 5e-3  # rad/s, a thousandth of the speeds
COUNT, LAST = 150, 0.998
TORQUE_TIME = np.arange(201) * 5e-3
TORQUE = 3 * np.sin(115 * TORQUE_TIME) + 2 * np.sin(31 * TORQUE_TIME + 1) + 1.5 * np.sin(190 * TORQUE_TIME)


def model(*, hardening: float = 0.0) -> ce.Model:
    """The rotor; with a spring that hardens it is nonlinear."""
    b = ce.Blueprint("rotor")
    inertia = b.parameter("J", TRUE["J"], unit="kg m2", min=1e-4)
    c = b.parameter("c", TRUE["c"], unit="N m s/rad", min=0)
    k = b.parameter("k", TRUE["k"], unit="N m/rad", min=0)
    torque = b.input("T", unit="N m")
    a, w = b.state("a", unit="rad", scale=0.1), b.state("w", unit="rad/s", scale=5.0)
    b.ode("a", w)
    b.ode("w", (torque - k * (a + hardening * a**3) - c * w) / inertia)
    b.output("speed", w, unit="rad/s", scale=5.0)
    return b.model()


def _rates(hardening: float) -> Any:
    return lambda t, x, p, u: [
        x[1], (u["T"] - p["k"] * x[0] * (1 + hardening * x[0] ** 2) - p["c"] * x[1]) / p["J"]
    ]  # fmt: skip


def samplings() -> dict[str, Array]:
    """Name -> (150,) times [s], from the first to the last of the same span."""
    rng = np.random.default_rng(6)
    equal = np.linspace(0, LAST, COUNT)
    jittered = equal.copy()
    jittered[1:-1] += rng.uniform(-0.4, 0.4, COUNT - 2) * equal[1]
    # The angle of a shaft at a mean of 150 teeth a second, its speed half up and down at 3 Hz.
    fine = np.linspace(0, LAST, 200_001)
    angle = fine + 0.5 / (6 * np.pi) * (1 - np.cos(6 * np.pi * fine))
    teeth = np.interp(np.linspace(0, angle[-1], COUNT), angle, fine)
    return {"equal": equal, "jittered": jittered, "teeth": teeth}


@functools.cache
def fits(hardening: float) -> dict[str, Any]:
    """Name -> Fit from starts 30 % off."""
    made = {}
    pieces = Pieces({"T": (TORQUE_TIME, TORQUE)}, "first")
    for name, time in samplings().items():
        speed = solve(_rates(hardening), TRUE, np.zeros(2), 0.0, time, pieces)[1]
        record = ce.Experiment.from_arrays(
            name, units={"T": "N m", "speed": "rad/s"}, T=(TORQUE_TIME, TORQUE), speed=(time, speed)
        )
        pars = model().parameters()
        for key, factor in (("J", 1.1), ("c", 1.3), ("k", 1.1)):
            pars[key].set(factor * TRUE[key])
        made[name] = ce.estimate(
            model(hardening=hardening), record, parameters=pars, noise=ce.Noise(speed=SIGMA), progress=False
        )
    return made
