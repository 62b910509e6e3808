"""The response of a discrete linear model at many frequencies from its poles, and what its transients do.

``estimation.spectral`` works for every matrix, and gives slopes; this gives values alone, several times as fast, where
the eigenvectors are a good basis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.spectral import Bins, Response
from casadi_engine.simulation.discretisation import Discretisation
from casadi_engine.simulation.exponential import balance

Array = NDArray[np.float64]

# Condition of the eigenvectors beyond which they are no basis to work with.
_SOUND = 1e7


class Transients:
    """A model at K bins: its residual without transients, and what these do.

    rest : (ny, K, 2) real and imaginary parts; rows : (n, ny, K, 2) in a basis of their own; turn : (n, n) with
    turn.T @ rows the same in the states; poles : (n,)
    """

    def __init__(self, discrete: Discretisation, bins: Bins, sigma: Array) -> None:
        f = discrete.f[0]
        scale = balance(f)
        scale = np.ones(len(f)) if scale is None else scale
        self.poles, vectors = np.linalg.eig(f * scale / scale[:, None])
        if not np.linalg.cond(vectors) < _SOUND:
            self._plainly(discrete, bins, sigma)
            return
        half = np.flatnonzero(self.poles.imag >= 0)
        pair = half[self.poles[half].imag > 0]
        real = half[self.poles[half].imag == 0]
        inverse = np.linalg.inv(vectors) / scale  # its rows make the states modes
        seen = (discrete.c[0] / sigma[:, None] * scale) @ vectors
        self.turn = turn = np.concatenate([inverse[real].real, inverse[pair].real, inverse[pair].imag])
        rows = self._rows(bins.z, seen, real, pair)
        # the drive at the end of a step acts by z / (z - pole) = 1 + pole / (z - pole)
        late = self.poles[:, None] * (inverse @ discrete.g1[0])
        drive = turn @ discrete.g0[0] + np.concatenate([late[real].real, late[pair].real, late[pair].imag])
        count = len(bins.z)
        direct = (discrete.c[0] @ discrete.g1[0] + discrete.d[0]) / sigma[:, None]
        rest = np.empty(bins.measured.shape, complex)
        for y in range(len(sigma)):
            gain = (drive.T @ rows[:, y].view(np.float64)).view(np.complex128) + direct[y][:, None]
            gain *= bins.drives
            gain.sum(axis=0, out=rest[y])
            rest[y] -= bins.measured[y] / sigma[y]
        rows *= bins.z * bins.share
        self.rows = rows.view(np.float64).reshape(len(f), len(sigma), count, 2)
        self.rest = rest.view(np.float64).reshape(len(sigma), count, 2)

    def _plainly(self, discrete: Discretisation, bins: Bins, sigma: Array) -> None:
        response = Response(discrete, bins, sigma)
        n, ny, count = len(discrete.f[0]), len(sigma), len(bins.z)
        self.rows = response.seen.reshape(n, ny, count, 2)
        self.turn = np.eye(n)
        self.rest = np.ascontiguousarray(response.forced(bins)[0]).view(np.float64).reshape(ny, count, 2)

    def _rows(
        self,
        z: NDArray[np.complex128],
        seen: NDArray[np.complex128],
        real: NDArray[np.intp],
        pair: NDArray[np.intp],
    ) -> NDArray[np.complex128]:
        """(n, ny, K) responses to real coordinates of the modes: of pairs the real parts, then the imaginary ones."""
        first, last = len(real), len(real) + len(pair)
        rows = np.empty((len(self.poles), len(seen), len(z)), complex)
        alone = 1.0 / (z - self.poles[real, None])
        np.multiply(alone[:, None], seen.T[real, :, None], out=rows[:first])
        up, down = z - self.poles[pair, None], z - self.poles[pair, None].conj()
        np.reciprocal(up, out=up)
        np.reciprocal(down, out=down)
        own = seen.T[pair, :, None]
        left, right = up[:, None] * own, down[:, None] * own.conj()
        np.add(left, right, out=rows[first:last])
        np.subtract(right, left, out=rows[last:])
        rows[last:] *= -1j
        return rows
