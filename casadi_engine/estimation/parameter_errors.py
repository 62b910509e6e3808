"""What a fit knows of the errors of its parameters, as a prior for other data: which directions, and how well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Directions with less than this share of the others' variance, or of a direction that the data do not determine, are
# rounding.
_ROUNDING = 1e-12
_PART = 1e-6
# Rows that repeat one another to this share count once.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class ParameterErrors:
    """Errors of the free vector z of a fit, of which ``names`` are the entries.

    rows : (r, nz) with rows @ (z_true - z - shift) ~ N(0, I), one for each direction that the data determine
    held : (h, nz) directions in which equalities hold z, one typical size of the entries long
    shift : (nz,) from the estimate to where it were without the bounds that act: its error is normal about there, and
    one-sided at the bound
    What neither rows nor held spans, the data do not determine.
    """

    names: tuple[str, ...]
    rows: Array
    held: Array
    shift: Array

    @staticmethod
    def of(
        names: Sequence[str], covariance: Array, unknown: Array, scale: Array, shift: Array
    ) -> ParameterErrors:
        """From the covariance (nz, nz) of the directions determined, those that are not (nz, k), and the size (nz,) of
        the entries, all in the units of z."""
        from scipy.linalg import null_space

        if not len(scale):
            return ParameterErrors((), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0))
        blind = unknown / scale[:, None]
        blind = blind[:, np.linalg.norm(blind, axis=0) > _PART]
        known = null_space(blind.T, rcond=_PART) if blind.size else np.eye(len(scale))
        known = known.T / scale
        inner = known @ covariance @ known.T
        spread = np.sqrt(np.maximum(np.diag(inner), 0.0))
        still = spread <= _ROUNDING * spread.max(initial=0.0)
        size = np.where(still, 1.0, spread)
        values, vectors = np.linalg.eigh(inner / np.outer(size, size))
        moves = values > _ROUNDING * max(1.0, float(values.max(initial=0.0)))
        scaled = known / size[:, None]
        rows = (vectors[:, moves] / np.sqrt(values[moves])).T @ scaled
        held = vectors[:, ~moves].T @ known
        return ParameterErrors(tuple(names), rows, held, shift)

    def over(self, names: Sequence[str]) -> tuple[Array, Array]:
        """(r', len(names)) rows over some of the entries alone, whatever the other ones are, zero columns for names
        that are no entries; and (r',) where they see the shift."""
        return self._over(self.rows, names)

    def held_over(self, names: Sequence[str]) -> Array:
        """(h', len(names)) of the directions held, in the same way."""
        return self._over(self.held, names)[0]

    def _over(self, rows: Array, names: Sequence[str]) -> tuple[Array, Array]:
        from scipy.linalg import null_space

        here = [k for k, name in enumerate(names) if name in self.names]
        mine = [self.names.index(names[k]) for k in here]
        others = [k for k, name in enumerate(self.names) if name not in names]
        if others and len(rows):
            gone = rows[:, others] / np.maximum(np.linalg.norm(rows[:, others], axis=0), 1e-300)
            rows = null_space(gone.T, rcond=_SAME).T @ rows
        found = np.zeros((len(rows), len(names)))
        found[:, here] = rows[:, mine]
        return found, rows @ self.shift
