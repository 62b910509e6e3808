"""The matrices of one exponential Runge-Kutta step, with their first and second parameter derivatives.

For dx/dt = A x + B v + G w(s), s = Q x, Krogstad's scheme (J. Comput. Phys. 203, 2005, 72-88) has four stages at
0, h/2, h/2 and h. Everything in it but the laws w is linear, so that one step is

    [x_end; s_1; ..; s_4] = P [x; v_0; v_1; w_1; ..; w_4],

with zeros where stage i would need w_i or later ones. The drives v are held as in the linear propagator, so that
without laws the step is the exact one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Model
from casadi_engine.model.linear import LinearCore
from casadi_engine.simulation import jets
from casadi_engine.simulation.discretisation import DiscreteCore
from casadi_engine.simulation.exponential import balance
from casadi_engine.simulation.jets import Array

STAGES = 4
# Number of each stage's place among the nodes 0, h/2, h.
STAGE_NODES = (0, 1, 1, 2)

_RADIUS = 0.5
_TERMS = 14
# The hold of the columns that laws act through: it keeps them from being joined with drives.
_LAW = "law"


@dataclass(frozen=True)
class StepMatrices:
    """Jets of one step: p (k, n + 4 ns, n + 2 m + 4 nw); outputs y = c x + d v, c (k, ny, n), d (k, ny, m)."""

    p: Array
    c: Array
    d: Array
    n: int
    m: int
    order: int


class StepCore:
    """A split model's linear core with the step ``h``: the matrices of a step at any z.

    groups : slots of each law column; drives : drives of each drive column, the constant last if there is one
    """

    def __init__(
        self,
        core: LinearCore,
        model: Model,
        z: ca.SX,
        physical: ca.SX,
        *,
        hold: tuple[str, ...],
        scale: Array,
    ) -> None:
        m, nw = len(hold), int(core.G.shape[1])
        wide = replace(core, B=ca.horzcat(core.B, core.G), D=ca.horzcat(core.D, ca.SX(core.D.shape[0], nw)))
        stand_in = cast(Model, _CoreModel(wide, model.p, model.name))
        self._core = DiscreteCore(stand_in, z, physical, step=1.0, hold=(*hold, *[_LAW] * nw), scale=scale)
        kinds = [group[0] >= m for group in self._core.groups]
        self.drives = [g for g, law in zip(self._core.groups, kinds, strict=True) if not law]
        self.groups = [
            tuple(i - m for i in g) for g, law in zip(self._core.groups, kinds, strict=True) if law
        ]
        extra = self._core.drives - len(kinds)
        self.constant = bool(extra)
        self._drive_columns = np.array(
            [j for j, law in enumerate(kinds) if not law] + [len(kinds)] * extra, dtype=np.intp
        )
        self._law_columns = np.array([j for j, law in enumerate(kinds) if law], dtype=np.intp)
        self.m = len(self._drive_columns)
        self.first = self._core.first[self._drive_columns]
        self._nz = int(z.numel())

    def at(self, z: NDArray[np.float64], order: int, step: float, q: Array) -> StepMatrices:
        """The matrices of a step [s] at z : (nz,), for signals q : (ns, n)."""
        a, b, c, d = self._core.matrices(z, order)
        if not (np.isfinite(a).all() and np.isfinite(b).all() and np.isfinite(jets.norm(a))):
            raise FloatingPointError("the linear core is not finite here")
        if self._nz == 0:
            order = 0
        drive, law = b[:, :, self._drive_columns], b[:, :, self._law_columns]
        p = _krogstad(a * step, drive * step, law * step, q, self.first, self._nz if order else 0)
        return StepMatrices(
            p, c, np.ascontiguousarray(d[:, :, self._drive_columns]), a.shape[1], self.m, order
        )


@dataclass(frozen=True)
class _CoreModel:
    """What a discrete core reads of a model."""

    linear: LinearCore
    p: ca.SX
    name: str


def _krogstad(z: Array, b: Array, g: Array, q: Array, first: NDArray[np.bool_], d: int) -> Array:
    """The jet of P; z, b, g : jets of h A, h B, h G; q : (ns, n)."""
    k, n, m = b.shape
    ns, nw = len(q), g.shape[2]
    half, whole = phi_pair(z, d)
    both = np.concatenate([b, g], axis=2)
    # phi_1 .. phi_3 of the step, then phi_1 and phi_2 of its half, all on [B, G]
    stack = np.concatenate([*whole[1:], *half[1:]], axis=1)
    phi1, phi2, phi3, half1, half2 = np.split(jets.product(stack, both, d), 5, axis=1)
    ramp, half_ramp = phi2[:, :, :m].copy(), 0.25 * half2[:, :, :m]
    ramp[:, :, ~first], half_ramp[:, :, ~first] = 0.0, 0.0
    p = np.zeros((k, n + STAGES * ns, n + 2 * m + STAGES * nw))

    def fill(rows: slice, left: Array | None, free: Array, held: Array, rise: Array) -> None:
        for at, part in ((0, free), (n, held - rise), (n + m, rise)):
            p[:, rows, at : at + part.shape[2]] = part if left is None else left @ part

    def law(rows: slice, stage: int, left: Array | None, part: Array) -> None:
        at = n + 2 * m + stage * nw
        p[:, rows, at : at + nw] = part if left is None else left @ part

    w1, w2, w3 = (part[:, :, m:] for part in (phi1, phi2, phi3))
    v1, v2 = half1[:, :, m:], half2[:, :, m:]
    end = slice(0, n)
    fill(end, None, whole[0], phi1[:, :, :m], ramp)
    law(end, 0, None, w1 - 3 * w2 + 4 * w3)
    law(end, 1, None, 2 * w2 - 4 * w3)
    law(end, 2, None, 2 * w2 - 4 * w3)
    law(end, 3, None, 4 * w3 - w2)
    stages = [slice(n + i * ns, n + (i + 1) * ns) for i in range(STAGES)]
    p[0, stages[0], :n] = q
    for middle in stages[1:3]:
        fill(middle, q, half[0], 0.5 * half1[:, :, :m], half_ramp)
    fill(stages[3], q, whole[0], phi1[:, :, :m], ramp)
    law(stages[1], 0, q, 0.5 * v1)
    law(stages[2], 0, q, 0.5 * v1 - v2)
    law(stages[2], 1, q, v2)
    law(stages[3], 0, q, w1 - 2 * w2)
    law(stages[3], 2, q, 2 * w2)
    return p


def phi_pair(z: Array, d: int) -> tuple[list[Array], list[Array]]:
    """phi_0 .. phi_2 of z/2 and phi_0 .. phi_3 of z, jets in d parameters.

    By the Taylor series of phi_3 and doubling of the argument: phi_k(2 z) = (phi_0(z) phi_k(z) + sum over j = 1 .. k
    of phi_j(z) / (k - j)!) / 2**k. The half step comes along the way.
    """
    scale = balance(z[0])
    if scale is None:
        return _phi_pair(z, d)
    turn = scale[:, None] / scale
    half, whole = _phi_pair(z / turn, d)
    return [phi * turn for phi in half], [phi * turn for phi in whole]


def _phi_pair(z: Array, d: int) -> tuple[list[Array], list[Array]]:
    """The same of a balanced jet."""
    size = jets.norm(z)
    doublings = max(1, math.ceil(math.log2(size / _RADIUS))) if size > 0 else 1
    small = z / 2.0**doublings
    identity = np.eye(z.shape[1])
    phi = [np.zeros_like(z)]
    # Horner's rule for phi_3, then phi_k = z phi_{k+1} + 1/k!
    phi[0][0] = identity / math.factorial(_TERMS + 3)
    for power in range(_TERMS - 1, -1, -1):
        phi[0] = jets.product(small, phi[0], d)
        phi[0][0] += identity / math.factorial(power + 3)
    for k in (2, 1, 0):
        lower = jets.product(small, phi[0], d)
        lower[0] += identity / math.factorial(k)
        phi.insert(0, lower)
    half = phi
    for _ in range(doublings):
        half = phi
        stacked = jets.product(half[0], np.concatenate(half, axis=2), d)
        products = np.split(stacked, 4, axis=2)
        phi = []
        for k in range(4):
            total = products[k]
            for j in range(1, k + 1):
                total = total + half[j] / math.factorial(k - j)
            phi.append(total / 2.0**k)
    return half[:3], phi
