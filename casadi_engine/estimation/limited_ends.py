"""Where an interval ends because another parameter, or a constrained quantity, comes to its limit on the way.

Where that limit is r standard errors away and both correlate by rho, a quantity that is followed until chi-squared has
risen by z^2 ends at rho r + ((1 - rho^2)(z^2 - r^2))^(1/2) of its standard errors: the other stays at its limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.search import Search
from casadi_engine.estimation.standard_errors import Uncertainty

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What has limits and is at none.

    names : of each; rooms : (c, 2) down and up to its limits, in its standard errors; rho : (c, nv) its correlations
    with the parameters; own : (c,) the number of the parameter that it is, -1 for a constrained quantity
    """

    names: tuple[str, ...]
    rooms: Array
    rho: Array
    own: NDArray[np.intp]

    @staticmethod
    def of(search: Search, errors: Uncertainty) -> Limits:
        """Those of a fit's bounds and inequalities."""
        nv, user, v = search.problem.nv, search.constraints, errors.v
        rows, here, own = np.eye(nv), v, np.arange(nv)
        low, high, names = search.lower[:nv], search.upper[:nv], list(search.pmap.free)
        free = np.array([side is False for side in errors.bound[:nv]], dtype=bool)
        if user.count:
            value, slopes = user.evaluate(v)
            rows, here, names = (
                np.vstack([rows, slopes]),
                np.concatenate([here, value]),
                [*names, *user.labels],
            )
            low, high = np.concatenate([low, user.lower]), np.concatenate([high, user.upper])
            free, own = np.concatenate([free, user.lower < user.upper]), np.append(own, [-1] * len(value))
        matrix = errors.covariance.matrix[:nv, :nv]
        size = np.sqrt(np.maximum(np.einsum("ca,ab,cb->c", rows, matrix, rows), 0.0))
        rooms = np.stack([here - low, high - here], axis=1)
        kept = free & (size > 0) & (rooms >= 0).all(axis=1)
        size, sizes = (
            size[kept],
            np.where(np.diag(matrix) > 0, np.sqrt(np.maximum(np.diag(matrix), 0.0)), np.inf),
        )
        rho = np.clip((rows[kept] @ matrix) / np.outer(size, sizes), -1.0, 1.0)
        found = tuple(name for name, one in zip(names, kept, strict=True) if one)
        return Limits(found, rooms[kept] / size[:, None], rho, own[kept].astype(np.intp))

    def end(self, k: int, sign: float, far: float) -> tuple[float, str | None]:
        """Standard errors that parameter k goes to one side until chi-squared has risen by far^2, its own bound apart;
        and which limit ends it there, in words, if any does."""
        least, words = far, None
        for name, (down, up), rho, own in zip(self.names, self.rooms, self.rho[:, k], self.own, strict=True):
            upper = sign * rho > 0
            room = float(up if upper else down)
            if own == k or room >= far * abs(rho):
                continue
            end = float(abs(rho) * room + np.sqrt((1 - rho**2) * (far**2 - room**2)))
            if end < least:
                kind = "limit" if own < 0 else "bound"
                least, words = end, f"{name}, which reaches its {'upper' if upper else 'lower'} {kind}"
        return least, words
