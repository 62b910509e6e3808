"""Residuals of records and their slopes in free parameters and initial states, each record simulated in one piece."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.chained import chained_slopes
from casadi_engine.estimation.final_check import residual
from casadi_engine.estimation.integration import shift_of, shorten_steps, signed_errors
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.spectral_search import Priors, SpectralSearch
from casadi_engine.estimation.spectral_start import best_nodes, in_full, spectral_search
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise
from casadi_engine.simulation.exponential_runge_kutta import TooStiff
from casadi_engine.simulation.side_by_side import runs_side_by_side, side_by_side

Array = NDArray[np.float64]
Place = tuple[str, str]

# Steps of a search in the frequency domain; times that steps of the integration are made shorter.
_STEPS, _SHORTENED = 100, 4
# Standard errors from an optimum beyond which nothing counts.
_COUNTS = 6.0


def evaluator(
    model: Model, data: Sequence[Experiment], parameters: Parameters, noise: Noise, *, method: str = "exact"
) -> Search:
    """A search's problem that is evaluated alone; raises what ``estimate`` raises for such arguments."""
    return Search(
        model, tuple(data), parameters, noise, interval="auto", initial=None, loss=read_loss("square"),
        ties="substitute", method=method, max_iterations=1, tolerance=1e-9, warm=None, progress=None,
    )  # fmt: skip


class SingleShots:
    """Simulated (predicted, with a gain) residuals of records at x = [coordinates of z (nv,); first states, scaled].

    free : names of z; lower, upper : (nx,) of x; places : the rows (record, output) -> slice; index : the samples'
    numbers in their channels
    Raises what ``estimate`` raises for such arguments.
    """

    def __init__(
        self,
        model: Model,
        data: Sequence[Experiment],
        parameters: Parameters,
        noise: Noise,
        *,
        method: str = "exact",
    ) -> None:
        self._lay(evaluator(model, data, parameters, noise, method=method))

    @classmethod
    def over(cls, search: Search) -> SingleShots:
        """Those of a search that is set up."""
        found = cls.__new__(cls)
        found._lay(search)
        return found

    def _lay(self, search: Search) -> None:
        self._search = search
        self._spectral: SpectralSearch | None = None  # set up once it is wanted
        # the records in one interval as the fit integrates them, and the same in Runge-Kutta steps
        self._abreast: tuple[list[RecordTerm], list[RecordTerm]] | None = None
        self.free = self._search.pmap.free
        own = np.concatenate(
            [
                np.arange(self._search.problem.nv),
                *(np.arange(lay.at, lay.at + lay.n) for lay in self._search.problem.layouts),
            ]
        )
        self.lower, self.upper = self._search.lower[own], self._search.upper[own]
        self.states = tuple(state.name for state in search.model.states)
        self._sigma = dict.fromkeys(self._search.records[0].outputs, 1.0)
        self.places: dict[Place, slice] = {}
        self.index: dict[Place, NDArray[np.intp]] = {}
        at = 0
        for record in self._search.records:
            valid = record.observation.valid.ravel()
            for output, where in record.observation.where.items():
                place = (record.experiment.name, output)
                counts = valid[where]
                self.index[place] = record.grid.measured[output].index[counts]
                self.places[place] = slice(at, at + int(counts.sum()))
                at += int(counts.sum())
        self.count = at

    def weigh(self, sigma: Mapping[str, float]) -> None:
        """Divide residuals and slopes by the standard deviations of the outputs."""
        self._sigma = dict(sigma)

    def start(self, z: Mapping[str, float], first: Mapping[str, Array]) -> Array:
        """x (nx,) of parameters name -> value and of first states record -> (n,), moved into the bounds."""
        v = self._search.coordinates.of(np.array([z[name] for name in self.free], dtype=float))
        states = [first[r.experiment.name] / r.scale for r in self._search.records]
        return np.clip(np.concatenate([v, *states]), self.lower, self.upper)

    def nearer(self, x: Array, priors: Priors) -> Array:
        """The optimum x (nx,) that the frequency domain leads to from x; x itself for records that are not to be
        searched there.

        priors : on the coordinates (nv,), as those of a ``SpectralSearch``, the same in every call
        """
        search, nv = self._search, len(self.free)
        if in_full(search):
            return x
        sigma = np.array([self._sigma[name] for name in search.records[0].outputs])
        if self._spectral is None:
            self._spectral = spectral_search(search, priors)
        self._spectral.weigh(sigma)
        search._weigh(sigma)  # nodes are at their best at the levels of the records
        found = self._spectral.run(x[:nv], steps=_STEPS, stop=lambda _: False)
        self._spectral.release()
        if found is None:
            return x
        nodes = [best_nodes(record, found.minimum.x) for record in search.records]
        first = [one[0] for one in nodes if one is not None]
        if len(first) < len(nodes):
            return x
        return np.clip(np.concatenate([found.minimum.x, *first]), self.lower, self.upper)

    def values(self, x: Array) -> Array:
        """z (nz,) in the parameters' units."""
        return self._search.coordinates.values(x[: len(self.free)])

    def units(self, x: Array) -> Array:
        """dz/dx (nz,), diagonal."""
        return self._search.coordinates.slope(x[: len(self.free)])

    def limits(self, x: Array) -> list[tuple[str, float, Array]]:
        """Bounds of parameters and inequalities between them: name, distance inside (negative: violated) and its slope
        (nx,), in coordinates of x and in the constraints' own units."""
        found = []
        for k, name in enumerate(self.free):
            for limit, side in ((self.lower[k], 1.0), (self.upper[k], -1.0)):
                if np.isfinite(limit):
                    found.append(
                        (f"the bound of {name}", side * float(x[k] - limit), side * np.eye(len(x))[k])
                    )
        user = self._search.constraints
        if user.count:
            value, jacobian = user.evaluate(x[: len(self.free)])
            for k in np.flatnonzero(user.lower < user.upper).tolist():
                slope = np.concatenate([jacobian[k], np.zeros(len(x) - len(self.free))])
                for limit, side in ((user.lower[k], 1.0), (user.upper[k], -1.0)):
                    if np.isfinite(limit):
                        found.append((user.labels[k], side * float(value[k] - limit), side * slope))
        return found

    def columns(self, record: str) -> NDArray[np.intp]:
        """Entries of x that act in a record: all of z, and its own first states."""
        names = [one.experiment.name for one in self._search.records]
        n = len(self.states)
        begin = len(self.free) + n * names.index(record)
        return np.concatenate([np.arange(len(self.free)), np.arange(begin, begin + n)])

    def residuals(self, x: Array) -> Array:
        """Residuals (K,), model less measured, in standard deviations; raises as ``evaluate``."""
        found, at = np.zeros(self.count), len(self.free)
        for record in self._search.records:
            nodes = _chained(record, x[: len(self.free)], x[at : at + record.n])
            self._place(found, record, residual(record, record.outputs_at(x[: len(self.free)], nodes)[0]))
            at += record.n
        return found

    def runs_side_by_side(self, x: Array) -> bool:
        """Whether many points can be simulated at once, by Runge-Kutta steps that are as fine as those of the fit at
        x (nx,)."""
        steps = [record.single() for record in self._search.records]
        known = [] if self._abreast is None else self._abreast[0]
        if self._abreast is None or any(a is not b for a, b in zip(known, steps, strict=True)):
            at, made = len(self.free), list[RecordTerm]()
            for record in self._search.records:
                whole = _in_steps(record, x[: len(self.free)], x[at : at + record.n])
                made += [] if whole is None else [whole]
                at += record.n
            self._abreast = steps, made
        return len(self._abreast[1]) == len(steps)

    def side_by_side(
        self, x: Array, sigma: Mapping[str, Array], moved: NDArray[np.intp] | None = None
    ) -> Array:
        """Residuals (P, K) at points x (P, nx), where ``runs_side_by_side``, in the outputs' standard deviations (P,)
        at each; NaN in those that have none.

        moved : (Q,) entries of x that differ in each of Q parts of the points from the first part, -1 for itself: a
        record in which an entry does not act is not simulated again for it
        """
        found, at, nv = np.zeros((len(x), self.count)), len(self.free), len(self.free)
        for record, whole in zip(
            self._search.records, [] if self._abreast is None else self._abreast[1], strict=True
        ):
            own: Any = whole.propagator
            acts = [*record.active, *range(at, at + record.n)]
            which = self._acting(len(x), acts, moved)
            some = x[which]
            y = side_by_side(own, some[:, :nv][:, record.active].T, some[:, at : at + record.n].T)
            shown = whole.observation.observe(y).reshape(len(some), -1)
            if len(some) < len(x) and moved is not None:
                alike = np.tile(np.arange(len(x) // len(moved)), len(moved))  # as the first part has them
                alike[which] = np.arange(len(some))
                shown = shown[alike]
            at += record.n
            for output, where in whole.observation.where.items():
                here = where[whole.observation.valid.ravel()[where]]
                rows = self.places[(record.experiment.name, output)]
                measured = whole.observation.measured.ravel()[here]
                found[:, rows] = (shown[:, here] - measured) / sigma[output][:, None]
        return found

    @staticmethod
    def _acting(count: int, acts: Sequence[int], moved: NDArray[np.intp] | None) -> NDArray[np.intp]:
        """The numbers of the points at which a record differs from the first part of them, and of that part."""
        if moved is None:
            return np.arange(count)
        own = (moved < 0) | np.isin(moved, acts)
        return np.flatnonzero(np.repeat(own, count // len(moved)))

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Residuals (K,), model less measured, and their slopes (K, nx), both in standard deviations.

        Raises FloatingPointError where the model is not finite.
        """
        v = x[: len(self.free)]
        residuals, slopes = np.zeros(self.count), np.zeros((self.count, len(x)))
        at = len(self.free)
        for record in self._search.records:
            found = record.evaluate(v, _chained(record, v, x[at : at + record.n]))
            whole = chained_slopes(record, found).reshape(-1, record.weight.size)
            nz = len(record.active)
            for rows, here, level in self._place(residuals, record, found.r):
                own = (whole[:, here] / level).T
                slopes[rows, record.active] = own[:, :nz]
                slopes[rows, at : at + record.n] = own[:, nz:]
            at += record.n
        if not np.isfinite(slopes).all():
            raise FloatingPointError("the sensitivities are not finite here")
        return residuals, slopes

    def integrate_finely(self, x: Array, lowest: float) -> bool:
        """Shorter steps for records whose integration is felt at x (nx,), where that may be within ``_COUNTS`` standard
        errors of the lowest chi-squared; True if any has them now."""
        v, at, changed = x[: len(self.free)], len(self.free), False
        higher = float(np.square(self.residuals(x)).sum()) - lowest
        misfit = lowest / max(self.count, 1)
        for record in self._search.records:
            nodes = _chained(record, v, x[at : at + record.n])
            at += record.n
            (error,) = signed_errors([record], v, [nodes])
            if error is not None and np.sqrt(max(higher, 0.0)) - shift_of(record, error) < _COUNTS:
                changed |= shorten_steps([record], v, [nodes], misfit)
        return changed

    def _place(
        self, residuals: Array, record: RecordTerm, own: Array
    ) -> list[tuple[slice, NDArray[np.intp], Array]]:
        """Write a record's weighted residual (K, M) to its rows; of each output the rows, its samples and levels."""
        valid, weight, found = record.observation.valid.ravel(), record.weight.ravel(), []
        for output, where in record.observation.where.items():
            here = where[valid[where]]
            rows = self.places[(record.experiment.name, output)]
            level = weight[here] * self._sigma[output]  # the terms come weighted by levels of their own
            residuals[rows] = own.ravel()[here] / level
            found.append((rows, here, level))
        if not np.isfinite(residuals).all():
            raise FloatingPointError("the sensitivities are not finite here")
        return found


def _in_steps(record: RecordTerm, v: Array, first: Array) -> RecordTerm | None:
    """A record in one interval, in Runge-Kutta steps as fine as it asks for at v (nv,) from a first state (n,); None
    where it has none."""
    whole = record.single()
    if record.gain is not None or record.linear or runs_side_by_side(whole.propagator):
        return whole if record.gain is None and runs_side_by_side(whole.propagator) else None
    whole = record.again(gain=None)
    if not whole.step_in_places(anyway=True):
        return None
    whole.weight = record.single().weight
    try:
        for _ in range(_SHORTENED):
            whole.outputs_at(v, first[None])
            if not shorten_steps([whole], v, [first[None]]):
                break
        whole.outputs_at(v, first[None])
    except (FloatingPointError, np.linalg.LinAlgError):
        return None
    return whole if runs_side_by_side(whole.propagator) else None


def _chained(record: RecordTerm, v: Array, first: Array) -> Array:
    """The intervals' starts (M, n) of one run from a first state, by steps that can follow its laws."""
    try:
        return chained_nodes(record, v, first)
    except TooStiff:
        if not record.step_in_places():
            raise
    for _ in range(_SHORTENED):
        nodes = chained_nodes(record, v, first)
        if not shorten_steps([record], v, [nodes]):
            break
    return chained_nodes(record, v, first)
