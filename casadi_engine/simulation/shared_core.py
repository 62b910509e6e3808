"""Discrete matrices that records have in common: made once, and worked out once an iterate.

Records of one engine, sampled alike, differ in their drives and measurements only: their linear core, its
discretisation and the block matrices with first and second derivatives are the same. For many parameters these cost
more than the records' own sums.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Model
from casadi_engine.simulation.blocks import Blocks, block_matrices, second_powers, second_products
from casadi_engine.simulation.discretisation import DiscreteCore, Discretisation, Method
from casadi_engine.simulation.jets import Array

# Steps that differ by the rounding of time stamps alone are one: to this share, over 1e5 samples a share of 1e-5 of
# one sample, which is less than the stamps themselves are off.
_SAME_STEP = 1e-10


class SharedCore:
    """A discrete core that remembers what it gave last, for the records that ask the same after one another."""

    def __init__(self, core: DiscreteCore) -> None:
        self.core = core
        self._z: Array | None = None
        self._made: dict[tuple[Any, ...], Any] = {}

    def at(self, z: Array, order: int) -> Discretisation:
        """See ``DiscreteCore.at``."""
        found: Discretisation = self._remembered(z, (order,), lambda: self.core.at(z, order))
        return found

    def blocks(
        self, z: Array, order: int, length: int, samples: NDArray[np.intp], *, lasting: bool = True
    ) -> Blocks:
        """The block matrices at z : (nz,); see ``block_matrices``."""

        def make() -> Blocks:
            return block_matrices(self.at(z, order), length, samples, lasting=lasting)

        found: Blocks = self._remembered(z, (order, length, samples.tobytes(), lasting), make)
        return found

    def second_products(self, z: Array, length: int, samples: NDArray[np.intp], outer: Array) -> Array | None:
        """What the second derivatives of the block matrix at z : (nz,) add to a Hessian; see ``second_products``. None
        where they have to be made."""
        discrete = self.at(z, 2)
        powers = self._remembered(z, ("second", length), lambda: second_powers(discrete, length))
        return None if powers is None else second_products(discrete, powers, samples, outer)

    def _remembered(self, z: Array, key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
        if self._z is None or not np.array_equal(self._z, z):
            self._z, self._made = np.array(z), {}
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


class Cores:
    """The cores of a set of records: one for all whose model, parameters, step and holds are the same."""

    def __init__(self) -> None:
        self._made: dict[tuple[Any, ...], list[SharedCore]] = {}
        self._kept: list[Any] = []

    def of(
        self,
        model: Model,
        z: ca.SX,
        physical: ca.SX,
        *,
        step: float,
        hold: tuple[str, ...],
        scale: Array,
        method: Method,
    ) -> SharedCore:
        """The core for these arguments of ``DiscreteCore``; models and parameters are told apart by identity."""
        symbols = tuple(z[k].element_hash() for k in range(z.numel()))
        alike = self._made.setdefault((id(model), id(physical), symbols, hold, scale.tobytes(), method), [])
        for found in alike:
            if abs(found.core.step - step) <= _SAME_STEP * step:
                return found
        core = DiscreteCore(model, z, physical, step=step, hold=hold, scale=scale, method=method)
        # what is told apart by identity has to live as long as the entry
        self._kept.append((model, physical, z))
        alike.append(SharedCore(core))
        return alike[-1]
