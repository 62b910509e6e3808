"""Exact discretisation of a model's linear core, as functions of the estimated vector z.

dx/dt = A x + B d + e,  y = C x + D d + c  becomes  x[k+1] = F x[k] + G0 v[k] + G1 v[k+1],  y[k] = C x[k] + D v[k],
with v the merged drives and the constant 1. With the first-order hold (drives interpolated linearly)
G1 = h phi_2(A h) B, G0 = h phi_1(A h) B - G1; with the zero-order hold G0 = h phi_1(A h) B, G1 = 0.
States are scaled inside: x stands for state / scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import SimulationError
from casadi_engine.model import Model
from casadi_engine.simulation import jets
from casadi_engine.simulation.exponential import phi_functions, transition
from casadi_engine.simulation.jets import Array

# "exact" or "euler"; checked where a propagator is made.
Method = str


@dataclass(frozen=True)
class Discretisation:
    """Jets of the discrete matrices at one point z: F (k,n,n), G0 and G1 (k,n,m), C (k,ny,n), D (k,ny,m)."""

    f: Array
    g0: Array
    g1: Array
    c: Array
    d: Array
    parameters: int
    order: int
    generator: Array  # A h of the scaled states, for transitions over many steps; (n, n)


class _Arrays:
    """A function of one vector whose dense outputs come as arrays, column-major, without CasADi's matrices between."""

    def __init__(self, name: str, z: ca.SX, outputs: list[ca.SX]) -> None:
        self._function = ca.Function(name, [z], [ca.densify(out) for out in outputs])
        self._sizes = [int(out.numel()) for out in outputs]
        self._buffer: tuple[Any, Any] | None = None

    def __call__(self, z: NDArray[np.float64]) -> list[Array]:
        if self._buffer is None:
            self._buffer = self._function.buffer()
        buffer, run = self._buffer
        at, found = np.array(z, dtype=float), [np.empty(size) for size in self._sizes]
        if at.size:
            buffer.set_arg(0, memoryview(at))  # type: ignore[call-arg, arg-type]
        for k, out in enumerate(found):
            if out.size:
                buffer.set_res(k, memoryview(out))  # type: ignore[call-arg, arg-type]
        run()
        return found


class DiscreteCore:
    """The linear core of a model with the step ``h``, to be evaluated at any z.

    Parameters
    ----------
    model : a model with a linear core
    z : (nz,) SX, the estimated vector
    physical : (np,) SX, the model's parameters as expressions of z
    step : sampling interval h [s]
    hold : "first" or "zero" for each drive of the model
    scale : (n,) magnitudes by which the states are divided inside
    method : "exact", or "euler" for x[k+1] = x[k] + h dx/dt
    """

    def __init__(
        self,
        model: Model,
        z: ca.SX,
        physical: ca.SX,
        *,
        step: float,
        hold: tuple[str, ...],
        scale: NDArray[np.float64],
        method: Method = "exact",
    ) -> None:
        core = model.linear
        if core is None:
            raise SimulationError(
                "the model has no linear core",
                seen=model.name,
                cure="use the general integrator for this model",
            )
        self.step, self.method, self.parameters = step, method, int(z.numel())
        self.states, self.outputs = int(core.A.shape[0]), int(core.C.shape[0])
        self.groups, b, d = merge(core.B, core.D, core.e, core.c, hold)
        self.drives = int(b.shape[1])
        self.first = np.zeros(self.drives, dtype=bool)
        self.first[: len(self.groups)] = [hold[group[0]] == "first" for group in self.groups]
        s = ca.DM(scale)
        scaled = (ca.diag(1 / s) @ core.A @ ca.diag(s), ca.diag(1 / s) @ b, core.C @ ca.diag(s), d)
        flat = ca.vertcat(*[ca.vec(ca.densify(part)) for part in scaled])
        flat = ca.substitute(flat, model.p, physical) if model.p.numel() else flat
        first = ca.jacobian(flat, z)
        self._value = _Arrays("core", z, [flat])
        self._first = _Arrays("core_first", z, [flat, first])
        self._pairs = jets.pairs(self.parameters)
        self._z, self._first_expression = z, first
        self._second: _Arrays | None = None

    def _second_function(self) -> _Arrays:
        if self._second is None:
            rows = ca.vec(self._first_expression)
            self._second = _Arrays("core_second", self._z, [ca.jacobian(rows, self._z)])
        return self._second

    def _flat(self, z: NDArray[np.float64], order: int) -> Array:
        d = self.parameters
        if order == 0 or d == 0:
            return self._value(z)[0].reshape(1, -1)
        value, first = self._first(z)
        rows = [value.reshape(1, -1), first.reshape(d, -1)]
        if order == 2:
            second = self._second_function()(z)[0].reshape(d, d, -1)
            i, j = self._pairs
            rows.append(second[i, j])
        return np.concatenate(rows)

    def matrices(self, z: NDArray[np.float64], order: int) -> tuple[Array, Array, Array, Array]:
        """Jets of the continuous A (k,n,n), B (k,n,m), C (k,ny,n), D (k,ny,m) of the scaled states."""
        n, m, ny = self.states, self.drives, self.outputs
        flat = self._flat(z, order)
        shapes = ((n, n), (n, m), (ny, n), (ny, m))
        parts, at = [], 0
        for rows, columns in shapes:
            block = flat[:, at : at + rows * columns]
            parts.append(np.ascontiguousarray(block.reshape(len(flat), columns, rows).transpose(0, 2, 1)))
            at += rows * columns
        return parts[0], parts[1], parts[2], parts[3]

    def finite(self, z: NDArray[np.float64], order: int) -> tuple[Array, Array, Array, Array]:
        """The same; raises FloatingPointError where A or B are not finite."""
        a, b, c, d = self.matrices(z, order)
        if not (np.isfinite(a).all() and np.isfinite(b).all() and np.isfinite(jets.norm(a))):
            raise FloatingPointError("the linear core is not finite here")
        return a, b, c, d

    def at(self, z: NDArray[np.float64], order: int) -> Discretisation:
        """The discrete matrices and their derivatives up to ``order`` at z : (nz,)."""
        a, b, c, d = self.finite(z, order)
        nz, h = self.parameters, self.step
        ah = a * h
        if self.method == "euler":
            f = ah.copy()
            f[0] += np.eye(self.states)
            return Discretisation(f, b * h, np.zeros_like(b), c, d, nz, order, np.zeros((0, 0)))
        phi0, phi1, phi2 = phi_functions(ah, nz)
        both = jets.product(np.concatenate([phi1, phi2], axis=1), b, nz) * h
        held, ramp = both[:, : self.states], both[:, self.states :]
        ramp[:, :, ~self.first] = 0.0
        return Discretisation(phi0, held - ramp, ramp, c, d, nz, order, ah[0])


def merge(
    b: ca.SX, d: ca.SX, e: ca.SX, c: ca.SX, hold: tuple[str, ...]
) -> tuple[tuple[tuple[int, ...], ...], ca.SX, ca.SX]:
    """Join drives that act alike and append the constant terms as a last drive of value 1.

    Returns the groups of drive numbers (the constant is not among them) and the joined B and D. The four cylinders of
    a rigid engine are one column: the sum of their torques is what the model sees.
    """
    columns = [ca.vertcat(b[:, j], d[:, j]) for j in range(b.shape[1])]
    groups: list[list[int]] = []
    for j, column in enumerate(columns):
        for group in groups:
            same_hold = hold[group[0]] == hold[j]
            if same_hold and ca.is_equal(ca.densify(columns[group[0]]), ca.densify(column), 10):
                group.append(j)
                break
        else:
            groups.append([j])
    keep = [g[0] for g in groups]
    joined_b = ca.horzcat(*[b[:, j] for j in keep]) if keep else ca.SX(b.shape[0], 0)
    joined_d = ca.horzcat(*[d[:, j] for j in keep]) if keep else ca.SX(d.shape[0], 0)
    if ca.densify(e).is_zero() and ca.densify(c).is_zero():
        return tuple(tuple(g) for g in groups), joined_b, joined_d
    return tuple(tuple(g) for g in groups), ca.horzcat(joined_b, e), ca.horzcat(joined_d, c)


def long_transition(discrete: Discretisation, steps: int) -> Array | None:
    """The value of F**steps to the last digit, or None where F is not an exponential."""
    return transition(discrete.generator, steps) if discrete.generator.size else None
