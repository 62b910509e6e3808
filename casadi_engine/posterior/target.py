"""What is drawn from: the log density of free parameters and unknown noise levels, given the records of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.coordinates import Coordinates
from casadi_engine.estimation.exchanged import mirrored_starts
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.levenberg_marquardt import Squares
from casadi_engine.estimation.search import Search
from casadi_engine.estimation.single_shots import SingleShots, evaluator
from casadi_engine.estimation.spectral_start import no_spectrum
from casadi_engine.posterior.laplace_likelihood import LaplaceLikelihood
from casadi_engine.posterior.open_ends import with_ends
from casadi_engine.posterior.prior import Prior
from casadi_engine.posterior.spectral_likelihood import SpectralLikelihood
from casadi_engine.posterior.states import StatePrior, state_prior
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

# By what factor errors are larger by the residual's own noise from which the likelihood counts with it.
NARROW = 1.1
# A noise level that is not known is flat in its logarithm, this factor to either side of what the fit found.
LEVELS = 1000.0
# Chi-squared above the best within which first states that lead there are looked from too.
_FAR = 30.0


class Likelihood(Protocol):
    """Of records at v (nv,) and noise levels (ny,), the initial states integrated out; see ``SpectralLikelihood``."""

    @property
    def bins(self) -> tuple[int, int] | None:
        """Number of frequency bins in use and of all, None where samples are used."""
        ...

    def untold(self, v: Array, sigma: Array) -> tuple[int, int]:
        """Of the directions of a record's initial states, those that the prior tells, and all; 0, 0 if not counted."""
        ...

    def choose(self, points: list[Array], sigma: Array, left_out: float = ...) -> None:
        """Leave out what says little at these points."""
        ...

    def value(self, v: Array, sigma: Array) -> Array:
        """(k,) log likelihood, but for what does not depend on v and sigma."""
        ...

    def full(self, v: Array, sigma: Array) -> Array:
        """The same with nothing left out."""
        ...

    def integrate_finely(self, v: Array, sigma: Array) -> bool:
        """Integrate as finely as points v (k, nv) ask for; True if that is finer than before."""
        ...

    def squares(self, v: Array, sigma: Array) -> Squares | None:
        """Half the sum of squares with slopes, at one point v (nv,), sigma (ny,)."""
        ...


# Half chi-squared by which a constraint's value beyond its limit, in its size at the start, counts times its square.
_STEEP = 1e9
# How often steps of the integration are made shorter at the fit's own point.
_SHORTENED = 6


def root_of(fit: Fit) -> float:
    """Which root of the likelihood of white noise is taken, 1 where the residual is white.

    Neighbours that are alike, and noise that is larger than stated, tell less than that likelihood counts: errors of
    the fit are larger by ``fit.own_noise``. Its root of that squared makes them so, of the parameter whose error grows
    most; all others' are larger than they have to be (Miller & Dunson 2019; Pauli, Racugno & Ventura 2011).
    """
    most = max((fit.own_noise.get(name, 1.0) for name in fit.free), default=1.0)
    return float(most**2) if most >= NARROW else 1.0


class Target:
    """Log density over u (d,): the coordinates v of the parameters, then logarithms of noise levels over the fit's.

    names, units : of the d numbers as they are printed; low, high : (d,) bounds of u; start : (d,) of the fit
    within : parameters without bounds of their own, and how far from the fit's value their draws may lie
    evaluations : of the likelihood so far; root : see ``root_of``
    """

    def __init__(self, fit: Fit) -> None:
        levels: dict[str, Any] = {name: sigma for name, (sigma, _) in fit.noise.items()}
        method = str(fit.options.get("method", "exact"))
        parameters, self.within = with_ends(fit)
        self.search = evaluator(fit.model, fit.data, parameters, Noise(**levels), method=method)
        self.coordinates: Coordinates = self.search.coordinates
        pmap = self.search.pmap
        self.prior = Prior(pmap, self.coordinates)
        self._outputs = self.search.records[0].outputs
        self._sigma = np.array([levels[name] for name in self._outputs])
        unknown = [k for k, name in enumerate(self._outputs) if fit.noise[name][1]]
        self._unknown, self.nv = np.array(unknown, dtype=np.intp), len(pmap.free)
        self.free = pmap.free
        self.names = (*pmap.free, *(f"sigma({self._outputs[k]})" for k in unknown))
        units = {out.name: out.unit for out in fit.model.outputs}
        self.units = tuple(
            [fit.parameters[name.split("@")[0]].unit for name in pmap.free]
            + [units[self._outputs[k]] for k in unknown]
        )
        reach = np.full(len(unknown), np.log(LEVELS))
        self.low, self.high = (
            np.concatenate([self.prior.low, -reach]),
            np.concatenate([self.prior.high, reach]),
        )
        z = np.array([fit.values[name] for name in pmap.free])
        self.start = np.clip(
            np.concatenate([self.coordinates.of(z), np.zeros(len(unknown))]), self.low, self.high
        )
        self.samples = sum(record.count for record in self.search.records)
        self._constant = -0.5 * self.samples * float(np.log(2 * np.pi))
        self._levels = -len(unknown) * float(np.log(2 * np.log(LEVELS)))
        self.root = root_of(fit)
        self.likelihood = _likelihood(fit, self.search, self.start[: self.nv])
        self.evaluations = 0

    # ---- densities

    def log_density(self, u: Array) -> Array:
        """(k,) at u (k, d): of prior and likelihood, in what is left of the data."""
        return self._log(u, whole=False)

    def full(self, u: Array) -> Array:
        """(k,) of all data."""
        return self._log(u, whole=True)

    def _log(self, u: Array, *, whole: bool) -> Array:
        v = u[:, : self.nv]
        found = self.before(v)
        found[(np.abs(u[:, self.nv :]) > np.log(LEVELS)).any(axis=1)] = -np.inf
        if self.search.problem.user.count:
            found[[bool(self.search.constraints.violated(own)) for own in v]] = -np.inf
        inside = np.isfinite(found)
        if inside.any():
            self.evaluations += int(inside.sum())
            evaluate = self.likelihood.full if whole else self.likelihood.value
            found[inside] += (evaluate(v[inside], self.sigma(u[inside])) + self._constant) / self.root
        return found

    def before(self, v: Array) -> Array:
        """(k,) the prior's log density at v (k, nv), that of noise levels with it."""
        return self.prior.log_density(v) + self._levels

    def sigma(self, u: Array) -> Array:
        """(k, ny) noise levels at u (k, d)."""
        found = np.tile(self._sigma, (len(u), 1))
        found[:, self._unknown] *= np.exp(u[:, self.nv :])
        return found

    def squares(self, v: Array) -> Squares | None:
        """Half of chi-squared and normal priors at the fit's noise levels, with slopes in v."""
        return self._with_priors(v, self.likelihood.squares(v, self._sigma))

    def squares_of(self, v: Array, *, roughly: bool = False) -> list[Squares | None]:
        """The same at points v (k, nv) that lie far apart, where that can be done at once; roughly : with initial
        states that are nearly at their best."""
        own = getattr(self.likelihood, "squares_of", None)
        found = (
            [self.likelihood.squares(one, self._sigma) for one in v]
            if own is None
            else own(v, self._sigma, roughly=roughly)
        )
        return [self._with_priors(*one) for one in zip(v, found, strict=True)]

    def _with_priors(self, v: Array, found: Squares | None) -> Squares | None:
        if found is None:
            return None
        cost, gradient, _, matrix = self.search.problem.priors.evaluate(v)
        root = self.root
        return Squares(
            found.cost / root + cost, found.gradient / root + gradient, found.matrix / root + matrix
        )

    def steep(self, v: Array) -> Squares | None:
        """The same, but that it rises steeply where constraints are not met: a search of it ends at their limits."""
        return self._steep(v, self.squares(v))

    def steep_of(self, v: list[Array]) -> list[Squares | None]:
        """The same at points v (nv,) that lie far apart, where that can be done at once."""
        return [self._steep(*one) for one in zip(v, self.squares_of(np.array(v)), strict=True)]

    def _steep(self, v: Array, found: Squares | None) -> Squares | None:
        beyond, slopes = self._beyond(v)
        if found is None or not len(beyond):
            return found
        cost = found.cost + 0.5 * _STEEP * float(beyond @ beyond)
        gradient = found.gradient + _STEEP * beyond @ slopes
        return Squares(cost, gradient, found.matrix + _STEEP * slopes.T @ slopes)

    def met(self, v: Array) -> tuple[Array, Array]:
        """Where such a search ended, moved to the limits that it went over, and (nv, nv) what to add to the information
        there: towards a limit the density rises as an exponential, whose slope is as wide as a normal density of its
        square."""
        beyond, slopes = self._beyond(v)
        if not len(beyond):
            return v, np.zeros((len(v), len(v)))
        pressed = (_STEEP * np.abs(beyond))[:, None] * slopes
        return v - np.linalg.pinv(slopes) @ beyond, pressed.T @ pressed

    def _beyond(self, v: Array) -> tuple[Array, Array]:
        """By how much constraints are not met at v, and the slopes (c, nv) of these."""
        user = self.search.constraints
        if not user.count:
            return np.zeros(0), np.zeros((0, len(v)))
        value, slopes = user.evaluate(v)
        beyond = np.maximum(value - user.upper, 0.0) - np.maximum(user.lower - value, 0.0)
        return beyond[beyond != 0], slopes[beyond != 0]

    def integrate_finely(self, v: Array) -> bool:
        """Integrate as finely as points v (k, nv) ask for; True if that is finer than before."""
        return self.likelihood.integrate_finely(v, self._sigma)

    def choose(self, points: list[Array], left_out: float) -> None:
        """Leave out data that hold less than this share of the information at any of the points v."""
        self.likelihood.choose(points, self._sigma, left_out)

    def information(self, matrix: Array) -> Array:
        """(d, d) of u from that of v (nv, nv): a noise level is known by the number of its samples."""
        found = np.zeros((len(self.names),) * 2)
        found[: self.nv, : self.nv] = matrix
        counts = self.search.levels.counts[self._unknown]
        found[range(self.nv, len(found)), range(self.nv, len(found))] = 2.0 * counts / self.root
        return found

    # ---- numbers as they are printed

    def values(self, u: Array) -> Array:
        """(k, d) in the parameters' units, at u (k, d)."""
        z = self.coordinates.values(u[:, : self.nv])
        levels = np.exp(u[:, self.nv :]) * self._sigma[self._unknown]
        return np.concatenate([z, levels], axis=1)


def first_states(search: Search, fit: Fit) -> list[Array]:
    """First states (n,) of each record as a fit has them, scaled."""
    return [
        np.array([one.value for one in fit.initial[record.experiment.name].values()]) / record.scale
        for record in search.records
    ]


def _likelihood(fit: Fit, search: Search, v: Array) -> Likelihood:
    names = [record.experiment.name for record in search.records]
    first = dict(zip(names, first_states(search, fit), strict=True))
    if no_spectrum(search) is None and not _held(fit).any():
        return SpectralLikelihood(search.records, v, _priors(search, v, first))
    held = {name: np.array([one.fixed for one in fit.initial[name].values()]) for name in first}
    shots = SingleShots.over(search)
    shots.weigh({name: fit.noise[name][0] for name in search.records[0].outputs})
    _finely(shots, np.concatenate([v, *first.values()]))
    found = LaplaceLikelihood(shots, first, v, held, _priors(search, v, first))
    if not all(record.linear for record in search.records):
        _add_branches(found, fit, search, v, first)
    return found


def _finely(shots: SingleShots, x: Array) -> None:
    """Steps that can follow the records from the fit's own point, which began with those of a search."""
    with suppress(FloatingPointError, np.linalg.LinAlgError):
        for _ in range(_SHORTENED):
            if not shots.integrate_finely(x, float(np.square(shots.residuals(x)).sum())):
                break


def _priors(search: Search, v: Array, first: Mapping[str, Array]) -> list[StatePrior]:
    """The prior of each record's first states (n,), scaled, by its motion at v (nv,)."""
    return [state_prior(record, v, first[record.experiment.name]) for record in search.records]


def _add_branches(
    likelihood: LaplaceLikelihood, fit: Fit, search: Search, v: Array, first: Mapping[str, Array]
) -> None:
    """Other first states that explain the records as well: those of the fit's other optima, and of the other sign."""
    sigma = np.array([fit.noise[name][0] for name in search.records[0].outputs])
    places = []
    for one in fit.optima:
        known = one.status == "converged" and all(name in one.values for name in search.pmap.free)
        if known and set(one.initial) == set(first) and one.cost < fit.cost + _FAR:
            begun = {
                r.experiment.name: np.array(list(one.initial[r.experiment.name].values())) / r.scale
                for r in search.records
            }
            z = np.array([one.values[name] for name in search.pmap.free])
            places.append((search.coordinates.of(z), begun))
    for twin in mirrored_starts(search, v, list(first.values()), _FAR):
        places.append((twin.v, dict(zip(first, twin.starts, strict=True))))
    for at, begun in places:
        if not likelihood.leads_to(begun, at, sigma):
            with suppress(FloatingPointError, np.linalg.LinAlgError):
                likelihood.add(begun, at, _priors(search, at, begun))


def _held(fit: Fit) -> NDArray[np.bool_]:
    """Initial states that are known."""
    return np.array([one.fixed for states in fit.initial.values() for one in states.values()], dtype=bool)
