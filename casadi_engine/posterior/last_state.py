"""The last state of a linear record, which drives and parameters lead to from the first one.

In the frequency domain initial states enter by t = x_0 + x_N. The last state is no further unknown. Taken for as
unknown as the first, it made the log likelihood of six records of the crankshaft lower by 28 at the truth; taken for
what it is at the fit, whatever the parameters are, it told a posterior for a second time what the fit had made of the
noise, and made intervals a fifth too narrow (`tests/benchmarks/POSTERIOR.md`).

A simulation of the record for each point of the parameters is exact, and takes longer than all the rest of a likelihood
in few bins. About the fit a quadratic foretells it; the last draws, at which all data are looked at, are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.posterior.states import StatePrior
from casadi_engine.simulation.linear import LinearPropagator

Array = NDArray[np.float64]

# Where a quadratic is laid through: so many standard errors from its middle along each direction of the information,
# as far as most draws lie, but no farther than this in the coordinates of the parameters, where one is a factor e.
_REACH, _FARTHEST = 1.5, 0.2


@dataclass(frozen=True)
class LastStates:
    """How far first and last state of one record go together with the parameters, their sum x_0 + x_N at v about v =
    ``at``: a quadratic.

    at : (nv,); slopes : (n, nv); bends : (n, nv, nv), how the slopes change
    """

    at: Array
    slopes: Array
    bends: Array

    @classmethod
    def still(cls, at: Array, states: int) -> LastStates:
        """One that does not move."""
        return cls(at, np.zeros((states, len(at))), np.zeros((states, len(at), len(at))))

    @classmethod
    def about(cls, record: RecordTerm, first: StatePrior, at: Array, information: Array) -> LastStates:
        """Of a record that begins as its prior says, in the neighbourhood that ``information`` (nv, nv) leaves about
        v = ``at`` (nv,)."""
        sizes, axes = np.linalg.eigh(information)
        width = np.minimum(_REACH / np.sqrt(np.maximum(sizes, (_REACH / _FARTHEST) ** 2)), _FARTHEST)

        def there(*steps: Array) -> Array:
            v = at + np.sum(steps, axis=0)
            (ahead, forced), state = last_state(record, v), first.at(v).mean
            return np.asarray(state + ahead @ state + forced)

        d, sides = len(at), (axes * width).T
        here = there(0 * at)
        ahead, back = (np.array([there(sign * side) for side in sides]) for sign in (1, -1))
        bends = np.zeros((d, d, len(here)))
        for i in range(d):
            bends[i, i] = ahead[i] + back[i] - 2 * here
            for j in range(i):
                both = there(sides[i], sides[j]) - ahead[i] - ahead[j] + here
                bends[i, j] = bends[j, i] = both
        turn = axes / width
        slopes = turn @ (ahead - back) / 2
        return cls(at, slopes.T, np.einsum("ai,bj,ijn->nab", turn, turn, bends))

    def moved(self, v: Array) -> Array:
        """(P, n) how far the sum lies from that at ``at``, at v (P, nv)."""
        by = v - self.at
        bent = np.einsum("pa,nab,pb->pn", by, self.bends, by)
        return np.asarray(by @ self.slopes.T + 0.5 * bent)

    def slopes_at(self, v: Array) -> Array:
        """(n, nv) at v (nv,)."""
        return np.asarray(self.slopes + self.bends @ (v - self.at))


def last_state(record: RecordTerm, v: Array) -> tuple[Array, Array]:
    """What leads from the first state of a linear record without a predictor to the one that follows its last sample,
    scaled: a matrix (n, n) and the state (n,) that the drives make of zero, which come back there with the other sign.
    """
    propagator, count = cast(LinearPropagator, record.propagator), record.grid.samples
    z = v[record.active]
    discrete, drives = propagator.discretisation(z, 0), propagator.merged_drives(z).value
    f, g0, g1 = discrete.f[0], discrete.g0[0], discrete.g1[0]
    nodes = chained_nodes(record, v, np.zeros(record.n))
    begin = (len(nodes) - 1) * record.plan.length
    last = np.concatenate([drives[:, begin:], -drives[:, :1]], axis=1)
    forced = nodes[-1]
    for push in (g0 @ last[:, :-1] + g1 @ last[:, 1:]).T:
        forced = f @ forced + push
    with np.errstate(all="ignore"):
        return np.linalg.matrix_power(f, count), forced
