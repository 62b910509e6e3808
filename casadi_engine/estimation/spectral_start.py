"""Where the search of a linear model starts on all samples: the optimum in the frequency domain, and its nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.other_optima import OtherOptima
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.scales import felt_sizes, size_factors
from casadi_engine.estimation.spectral_search import Found, Priors, SpectralSearch
from casadi_engine.estimation.starts import nodes_by_first
from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.linear import LinearPropagator

if TYPE_CHECKING:
    from casadi_engine.estimation.laid_problem import LaidProblem
    from casadi_engine.estimation.search import Search

Array = NDArray[np.float64]

# Rounds of estimated noise levels that are settled in the frequency domain, and the change that ends them.
_ROUNDS, _LEVEL = 4, 1e-3
# Longest step of a scaled parameter, in multiples of itself or of its scale; of a logarithm it is 1.
_LONGEST = 10.0
# A cost per sample on all samples that is larger by this is another one.
_UNLIKE = 1e-2


@dataclass(frozen=True)
class Begun:
    """Where a search in the frequency domain ended.

    found : its last optimum, at the levels sigma (ny,); steps : of all rounds; stopped : by the user;
    converged : at an optimum
    """

    found: Found
    steps: int
    stopped: bool
    converged: bool
    sigma: Array

    @property
    def v(self) -> Array:
        """(nv,) coordinates of the parameters."""
        return self.found.minimum.x


# Why a search is on all samples where an optimum in the frequency domain is beyond a constraint.
HELD = "constraints hold the parameters"


def in_full(search: LaidProblem) -> str | None:
    """Why a search has to be on all samples from its start; None if it can begin in the frequency domain."""
    user = search.problem.user
    if search.problem.nv and user.count and (user.lower == user.upper).any():
        return HELD
    return no_spectrum(search)


def no_spectrum(search: LaidProblem) -> str | None:
    """Why chi-squared is not to be had in the frequency domain; None if it is."""
    return asked_in_full(search) or next((why for why in map(_record_in_full, search.records) if why), None)


def asked_in_full(search: LaidProblem) -> str | None:
    """Why chi-squared is not to be had in the frequency domain, whatever the records are."""
    if search.loss.robust:
        return "the loss is robust"
    if not search.pmap.free:
        return "no parameter is free"
    if search.predictor.kind != "none":
        return "a predictor corrects the states"
    if any(np.isfinite(low).any() or np.isfinite(high).any() for low, high, _ in search._initial):
        return "initial states are given, or have bounds"
    return None


def _record_in_full(record: RecordTerm) -> str | None:
    """Why one record has to be searched on all its samples."""
    if not isinstance(record.propagator, LinearPropagator):
        return f"{record.experiment.name} is not linear, or not sampled at equal steps"
    return (
        None
        if complete(record.grid, record.outputs)
        else f"{record.experiment.name} lacks samples of an output"
    )


def complete(grid: Grid, outputs: tuple[str, ...]) -> bool:
    """True if every output was measured at every sample."""
    return all(
        name in grid.measured and len(grid.measured[name].position) == grid.samples for name in outputs
    )


def spectral_search(search: LaidProblem, priors: Priors) -> SpectralSearch:
    """The search of a problem's records in the frequency domain, with these priors on its coordinates."""
    nv = search.problem.nv
    return SpectralSearch(
        search.records,
        priors,
        search.lower[:nv],
        search.upper[:nv],
        lambda v: np.where(search.coordinates.log, 1.0, _LONGEST * np.maximum(np.abs(v), 1.0)),
    )


class SpectralStarts:
    """The starts of one search, set up once for all of them."""

    def __init__(self, search: Search) -> None:
        """Transforms the records."""
        self._search, self._seen, self._stopped = search, 0, False
        self._spectral = spectral_search(search, search.problem.priors.evaluate)
        self._beside: OtherOptima | None = None

    def sizes(self, z: Array) -> tuple[Array | None, Array | None]:
        """The scales of parameters whose start at z (nz,) says nothing, and factors on those of the states.

        See ``felt_scale`` and ``state_factors``.
        """
        search, v = self._search, self._search.coordinates.of(z)
        nodes = [
            best_nodes(record, v) for record in search.records
        ]  # before spectra take memory beside the drives
        self._spectral.weigh(search.sigma)
        gram = self._spectral.whole(v)
        if gram is None:
            return None, None
        felt = felt_sizes(float(gram[0, 0]), np.diag(gram)[1:].copy(), search.coordinates, z)
        return felt, size_factors([one for one in nodes if one is not None])

    def from_below(self, z: Array, begun: Begun) -> Array:
        """Where the low frequencies lead from z (nz,), beside an optimum that was found from there: (nv,)."""
        v = self._search.coordinates.of(z)
        self._spectral.weigh(begun.sigma)
        with np.errstate(all="ignore"):
            return self._spectral.from_below(v, begun.found.hertz, self._search.solver.most)

    def others(self, begun: Begun) -> OtherOptima:
        """What looks for others than an optimum; kept for the next time."""
        self._spectral.weigh(begun.sigma)
        if self._beside is None or self._beside.known is not begun.found:
            self._beside = OtherOptima(self._spectral, begun.found)
        return self._beside

    def search(self, z: Array, *, steps: int, beside: Begun | None = None) -> Begun | None:
        """Search from z : (nz,), in at most so many steps; None where the model has no value or no slope.

        beside : a lower optimum is looked for than this one

        Noise levels that have to be settled are on the way: the problem is left with the last for weights.
        """
        search = self._search
        v, done = search.coordinates.of(z), 0
        self._seen, self._stopped, begun = 0, False, None
        for _ in range(_ROUNDS):
            self._spectral.weigh(search.sigma)
            run = self._spectral.run if beside is None else self.others(beside).run
            found = run(v, steps=max(steps - done, 1), stop=self._stop)
            if found is None:
                return None
            v, done = found.minimum.x, done + found.minimum.steps
            begun = Begun(found, done, self._stopped, found.minimum.converged, search.sigma.copy())
            x = self.variables(begun) if begun.converged and search.settles else None
            if x is None or self._settled(x):
                break
            self._seen -= 1  # the next begins where this one ended
        self._spectral.release()
        return begun if begun is None or search.settles else self._at_own_level(begun)

    def _at_own_level(self, begun: Begun) -> Begun:
        """The same at the noise level that its residual has, where one level is estimated and moves no optimum."""
        search = self._search
        if not (begun.converged and any(search.levels.estimated)):
            return begun
        before, left = begun.sigma, search.levels.counts.sum() - search.free_count
        search._weigh(search.levels.weights(before * np.sqrt(2 * begun.found.minimum.squares.cost / left)))
        share = float((before / search.sigma)[0] ** 2)
        return replace(begun, found=begun.found.scaled(share), sigma=search.sigma.copy())

    def _settled(self, x: Array) -> bool:
        """Weigh by the noise levels at a point; True if they are what they were."""
        search = self._search
        weights = search.levels.weights(search.levels_at(x))
        change = float(np.abs(weights / search.sigma - 1).max())
        search._weigh(weights)
        return change < _LEVEL

    def _stop(self, cost: float) -> bool:
        """Show a point of the search; True if the user ends it."""
        self._stopped = self._search.watch(self._seen, cost / self._search.problem.samples) or self._stopped
        self._seen += 1
        return self._stopped

    def variables(self, begun: Begun) -> Array | None:
        """The variables (size,) of the search on all samples, every record's nodes on the trajectory that explains it
        best; None where that is no number, or the samples say another thing than the bins (states without bounds)."""
        search = self._search
        x = np.zeros(search.problem.size)
        x[: search.problem.nv] = begun.v
        for record, lay in zip(search.records, search.problem.layouts, strict=True):
            nodes = best_nodes(record, begun.v)
            if nodes is None:
                return None
            x[lay.at : lay.at + nodes.size] = nodes.ravel()
        if not begun.converged:  # then its cost is that of the band alone
            return x
        try:
            cost = search.problem.at(x).objective * search.problem.samples
        except (FloatingPointError, np.linalg.LinAlgError):
            return None
        return x if cost <= begun.found.minimum.squares.cost + _UNLIKE * search.problem.samples else None


@np.errstate(over="ignore", invalid="ignore")
def best_nodes(record: RecordTerm, v: Array) -> Array | None:
    """Starts (M, n) of the intervals along the trajectory of a linear model that explains a record best, scaled.

    None where that is no number.
    """
    m, n = record.plan.m, record.n
    try:
        point = record.evaluate(v, np.zeros((m, n)), order=0)
        free = nodes_by_first(point)
        rows = [_compressed(record, point, slice(0, m - 1)), _compressed(record, point, slice(m - 1, m))]
        seen = np.concatenate([(slope @ free[at]).reshape(-1, n + 1) for slope, _, at in rows])
        left = np.concatenate([rest.ravel() for _, rest, _ in rows])
        scale = np.linalg.norm(seen[:, :n], axis=0)
        scale[scale == 0] = 1.0
        first = -np.linalg.lstsq(seen[:, :n] / scale, left + seen[:, n], rcond=None)[0] / scale
        nodes = free @ np.append(first, 1.0)
    except (FloatingPointError, np.linalg.LinAlgError):
        return None
    return nodes if np.isfinite(nodes).all() else None


def _compressed(record: RecordTerm, point: object, part: slice) -> tuple[Array, Array, slice]:
    """Triangular factor (1, r, n) of the slopes in the starts of intervals whose samples are weighted alike, and the
    residual's share (m, r) in it."""
    r, js = point.r[:, part], point.js  # type: ignore[attr-defined]
    if not r.shape[1]:
        return np.zeros((1, 0, js.shape[1])), np.zeros((0, 0)), part
    q, slope = np.linalg.qr(js * record.weight[:, part][:, :1])
    return slope[None], np.ascontiguousarray((q.T @ r).T), part
