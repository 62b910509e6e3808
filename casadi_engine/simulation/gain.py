"""The correction gain L of a one-step predictor as a function of the estimated vector: stated, or of Riccati.

x+ = x + L (y - y_hat) before each step, so that the innovations form (2.10) has K = A_D L. States are scaled inside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from casadi_engine.simulation import jets
from casadi_engine.simulation.discretisation import DiscreteCore, Discretisation
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.riccati import Kalman, kalman, over_steps, step_noise

Seen = tuple[bool, ...]


class SymbolicJet:
    """Jets of a matrix that is a CasADi expression of z : (nz,)."""

    def __init__(self, expression: ca.SX, z: ca.SX) -> None:
        self._shape, self._z, self.parameters = expression.shape, z, int(z.numel())
        flat = ca.vec(ca.densify(expression))
        self._first_expression = ca.densify(ca.jacobian(flat, z))
        self._value = ca.Function("value", [z], [flat])
        self._first = ca.Function("first", [z], [self._first_expression])
        self._second: ca.Function | None = None

    def at(self, z: Array, order: int) -> Array:
        """The jet (k, rows, columns) of this order."""
        d, rows = self.parameters, [np.asarray(self._value(z)).reshape(1, -1)]
        if order and d:
            rows.append(np.asarray(self._first(z)).T)
        if order == 2 and d:
            if self._second is None:
                twice = ca.densify(ca.jacobian(ca.vec(self._first_expression), self._z))
                self._second = ca.Function("second", [self._z], [twice])
            i, j = jets.pairs(d)
            rows.append(np.asarray(self._second(z)).reshape(d, -1, d)[i, :, j])
        flat = np.concatenate(rows)
        return np.ascontiguousarray(flat.reshape(-1, *self._shape[::-1]).transpose(0, 2, 1))


@dataclass(frozen=True)
class Correction:
    """Jets at one z for one set of outputs that were measured: lift (k, n, ny), zero columns for those that were not;
    whitener (k, ny, ny), which makes innovations of the reference levels out of y - y_hat, or None."""

    lift: Array
    whitener: Array | None = None


class Gain(Protocol):
    """What a predictor asks for."""

    def at(self, z: Array, core: DiscreteCore, discrete: Discretisation, seen: Seen) -> Correction:
        """The correction at z : (nz,) where the outputs ``seen`` were measured, of the order of ``discrete``."""
        ...


class StatedGain:
    """A gain whose entries are numbers or estimated parameters.

    expression : (n, ny) SX of z, state's unit per output's unit; scale : (n,) of the states
    """

    def __init__(self, expression: ca.SX, z: ca.SX, scale: Array) -> None:
        self._jet = SymbolicJet(ca.SX(expression) / ca.repmat(ca.DM(scale), 1, expression.shape[1]), z)

    def at(self, z: Array, core: DiscreteCore, discrete: Discretisation, seen: Seen) -> Correction:  # noqa: ARG002
        """See ``Gain``."""
        return Correction(self._jet.at(z, discrete.order) * np.array(seen, dtype=float))


class RiccatiGain:
    """The stationary Kalman gain of noise covariances that may hang on z.

    density : (n, n) SX of z, covariance that white process noise adds to the state in a second, units of the states;
    measurement : (ny, 1) SX of z, standard deviations of the outputs' noise; every : grid steps between samples of the
    outputs; level : (ny,) reference levels to which the whitener scales the innovations, None for no whitener
    """

    def __init__(
        self,
        density: ca.SX,
        measurement: ca.SX,
        z: ca.SX,
        *,
        scale: Array,
        every: int = 1,
        level: Array | None = None,
    ) -> None:
        s = ca.diag(1 / ca.DM(scale))
        self._density = SymbolicJet(s @ density @ s, z)
        self._variance = SymbolicJet(ca.diag(measurement**2), z)
        self._every, self._level = every, level
        self._last: tuple[Array, int, Kalman] | None = None

    def stationary(self, z: Array, core: DiscreteCore, discrete: Discretisation) -> Kalman:
        """Gain, innovations' covariance and error covariance where every output is measured."""
        if self._last is not None and self._last[1] == discrete.order and np.array_equal(self._last[0], z):
            return self._last[2]
        d, order = discrete.parameters, discrete.order
        a = core.matrices(z, order)[0]
        noise = step_noise(a, self._density.at(z, order), core.step, d)
        f = discrete.f
        if self._every > 1:
            f, noise = over_steps(f, noise, self._every, d)
        found = kalman(f, discrete.c, noise, self._variance.at(z, order), d)
        self._last = (np.array(z), order, found)
        return found

    def at(self, z: Array, core: DiscreteCore, discrete: Discretisation, seen: Seen) -> Correction:
        """See ``Gain``; where an output is missing the gain is the best one for those that are there."""
        found, d = self.stationary(z, core, discrete), discrete.parameters
        some = np.flatnonzero(seen)
        lift, whitener = np.zeros_like(found.lift), None
        if self._level is not None:
            whitener = jets.constant(np.eye(len(seen)), d, discrete.order)
        if len(some):
            shown = discrete.c[:, some]
            innovation = found.innovation[:, some[:, None], some]
            cross = jets.product(found.error, jets.transpose(shown), d)
            lift[:, :, some] = jets.product(cross, jets.inverse(innovation, d), d)
            if whitener is not None:
                back = jets.inverse(jets.cholesky(innovation, d), d)
                whitener[:, some[:, None], some] = back * self._level[some, None]  # type: ignore[index]
        return Correction(lift, whitener)

    def log_determinant(
        self, z: Array, core: DiscreteCore, discrete: Discretisation, seen: Seen
    ) -> tuple[Array, Array]:
        """Jet (k,) of log det S, S the covariance of one sample's innovations; and the part (nz, nz) of the information
        on z in their size that the whitened innovations do not show by their slopes.

        The information is tr(S^-1 dS S^-1 dS) / 2; the squared slopes of the whitened innovations hold all of it but
        for a quarter of the squares on the diagonal of B dS B', B the whitener.
        """
        found, d = self.stationary(z, core, discrete), discrete.parameters
        some = np.flatnonzero(seen)
        s = found.innovation[:, some[:, None], some]
        back = np.linalg.inv(np.linalg.cholesky(s[0]))
        relative = back @ s @ back.T
        value = np.zeros(len(s))
        value[0] = np.linalg.slogdet(s[0])[1]
        value[1:] = np.trace(relative[1:], axis1=1, axis2=2)
        first = relative[1 : 1 + d]
        if len(s) > 1 + d:
            value[1 + d :] -= np.einsum("iab,jba->ij", first, first)[jets.pairs(d)]
        diagonal = np.einsum("iaa->ia", first)
        return value, diagonal @ diagonal.T / 4


@dataclass(frozen=True)
class GainPlan:
    """A gain that hangs on the estimated vector, before it is known which entries a record needs.

    expression : (k, 1) SX of the whole vector, what the gain is made of; build : from it and the record's own entries
    z to the Gain; used : (ny,) outputs that correct the state
    """

    expression: ca.SX
    build: Callable[[ca.SX, ca.SX], Gain]
    used: Seen


def corrected(discrete: Discretisation, correction: Correction | Array) -> Discretisation:
    """The one-step predictor as a model of its own: x+ = x + L (y - y_hat) before each step.

    The measured outputs (ny,) join the drives. With a whitener W the outputs are y + W (y_hat - y).
    correction : or L alone, (n, ny) in scaled states per output
    """
    if isinstance(correction, np.ndarray):
        correction = Correction(jets.constant(correction, discrete.parameters, discrete.order))
    d, nz, lift = discrete, discrete.parameters, correction.lift
    push = jets.product(d.f, lift, nz)
    f = d.f - jets.product(push, d.c, nz)
    g0 = np.concatenate([d.g0 - jets.product(push, d.d, nz), push], axis=2)
    g1 = np.concatenate([d.g1, np.zeros_like(push)], axis=2)
    ny, white = d.c.shape[1], correction.whitener
    c, through, rest = d.c, d.d, np.zeros((len(d.c), ny, ny))
    if white is not None:
        c, through = jets.product(white, c, nz), jets.product(white, through, nz)
        rest = jets.constant(np.eye(ny), nz, d.order) - white
    out = np.concatenate([through, rest], axis=2)
    return Discretisation(f, g0, g1, c, out, nz, d.order, np.zeros((0, 0)))
