"""The linear core of a fit with what is unknown at the crank and at the load, in steps of a sample."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from casadi_engine.estimation import Fit

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbances:
    """What is not known beforehand, as it is assumed.

    step : standard deviation of a step of the torque on the engine and on the load, at every combustion [N m]
    road, road_hz : standard deviation of the road's torque on the load [N m] and its corner frequency [Hz]
    gas : standard deviation of the motored gas torque, of that of the fit [1]
    """

    step: float = 20.0
    road: float = 30.0
    road_hz: float = 10.0
    gas: float = 0.1


@dataclass(frozen=True, eq=False)
class Plant:
    """z = states, torque on the first inertia, on the last, and the road's on the last [N m]; y = c z.

    step : (nz, nz) from a sample to the next; push : (nz, columns) of rates that last for a sample of h seconds
    start : (nz,) standard deviations at first; turning : (nz,) 1 where the state is a speed
    road_decay : of the road's torque [1/s]
    """

    step: Array
    push: Array
    c: Array
    h: float
    start: Array
    turning: Array
    road_decay: float

    @property
    def size(self) -> int:
        return len(self.step)

    def powers(self, count: int) -> Array:
        """step**k for k = 0 .. count, (count + 1, nz, nz)."""
        made = np.empty((count + 1, *self.step.shape))
        made[0] = np.eye(self.size)
        for k in range(count):
            made[k + 1] = self.step @ made[k]
        return made


def vector_of(fit: Fit) -> Array:
    """The model's parameters (np,), the mean over the records of those that vary by experiment."""
    values = fit.values_for("")
    return fit.model.parameter_vector({name: values[name] for name in fit.model.parameter_names})


def make_plant(fit: Fit, output: str, enter: Array, h: float, disturbances: Disturbances) -> Plant:
    """The plant of a fit, sampled every h seconds."""
    model, core = fit.model, fit.model.linear
    assert core is not None
    vector = ca.DM(vector_of(fit))
    a, g, c = (
        np.array(ca.Function("f", [model.p], [ca.densify(part)])(vector).full())
        for part in (core.A, core.G, core.C)
    )
    n, slots = len(a), model.ports.with_slot
    bodies = [k for k, port in enumerate(slots) if port.kind == "inertia"]
    rate = 2 * np.pi * disturbances.road_hz
    whole = np.zeros((n + 3, n + 3))
    whole[:n, :n] = a
    whole[:n, n] = g[:, bodies[0]]
    whole[:n, n + 1] = whole[:n, n + 2] = g[:, bodies[-1]]
    whole[n + 2, n + 2] = -rate
    columns = enter.shape[1]
    both = np.zeros((n + 3 + columns, n + 3 + columns))
    both[: n + 3, : n + 3] = whole
    both[:n, n + 3 :] = enter
    both = expm(both * h)
    row = [one.name for one in model.outputs].index(output)
    start = [10.0 if one.unit == "rad/s" else 0.1 for one in model.states]
    return Plant(
        both[: n + 3, : n + 3], both[: n + 3, n + 3 :], np.append(c[row], np.zeros(3)), h,
        np.array([*start, 100.0, 300.0, disturbances.road]),
        np.array([*[float(one.unit == "rad/s") for one in model.states], 0.0, 0.0, 0.0]), rate,
    )  # fmt: skip
