"""Posterior: draws of a fit's parameters and what they say, as numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import PosteriorError
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.options import check_level
from casadi_engine.parameters import near_matches
from casadi_engine.posterior.drawn import Drawn
from casadi_engine.posterior.mixture import Mixture
from casadi_engine.posterior.modes import Modes
from casadi_engine.posterior.prior import Prior
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]

# Share of an interval from a bound within which draws are counted beside its ends; standard deviations of such a count
# beyond which one end is denser by no chance.
_BESIDE, _CHANCE = 0.05, 3.0


@dataclass(frozen=True)
class Mode:
    """One mode: the parameters' values at its highest point, its share of the draws, and the optima that it joins.

    below : how much lower its log density is than that of the highest one
    """

    values: Mapping[str, float]
    mass: float
    below: float
    optima: int


@dataclass(frozen=True, eq=False)
class Posterior:
    """The answer of ``posterior``.

    Attributes
    ----------
    fit : what it started from
    names, units : of the free parameters and unknown noise levels, d of them; a noise level is ``sigma(output)``
    values : (n, d) draws in these units, all of which weigh alike
    log_density : (n,) of prior and likelihood; log_likelihood : (n,) of white noise, before its root is taken
    root : of the likelihood of white noise, by which coloured noise counts; 1 where the residual is white
    method : "importance" or "ensemble"; why : what decided
    modes : the highest one first; searches : that looked for optima
    log_evidence, log_evidence_error : log of the probability density of the records given model and prior, and its
        standard error
    rhat : name -> rank-normalised split R-hat; empty where the draws are independent
    bulk, tail : name -> effective sample size in the middle and in the tails
    shape : Pareto k-hat of the weights, None for an ensemble
    priors : name -> the prior in words
    evaluations : of the likelihood; bins : frequency bins in use and of all, None where samples were used
    seconds : processor time; seed : of the random numbers
    untold_states : of the directions of a linear record's initial states, those that the prior tells rather than the
    record, and all
    """

    fit: Fit
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    log_density: Array
    log_likelihood: Array
    method: str
    why: str
    modes: tuple[Mode, ...]
    searches: int
    log_evidence: float
    log_evidence_error: float
    rhat: Mapping[str, float]
    bulk: Mapping[str, float]
    tail: Mapping[str, float]
    shape: float | None
    priors: Mapping[str, str]
    prior: Prior
    evaluations: int
    bins: tuple[int, int] | None
    seconds: float
    seed: int
    chains: Array | None = field(default=None, repr=False)
    untold_states: tuple[int, int] = (0, 0)
    root: float = 1.0

    @property
    def draws(self) -> dict[str, Array]:
        """Name -> (n,) draws in the parameter's unit; those of one number belong together."""
        return {name: self.values[:, k] for k, name in enumerate(self.names)}

    def __getitem__(self, name: str) -> Array:
        if name not in self.names:
            raise PosteriorError(
                "the posterior has no such parameter",
                seen=repr(name),
                allowed=near_matches(str(name), self.names),
                cure="name a free parameter of the fit, or sigma(output) of a noise level that it estimated",
            )
        return self.values[:, self.names.index(name)]

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """The interval that holds the parameter with this probability, in its unit: as much is left out on either side,
        or, where the density does not fall towards a bound, all of it on the other one."""
        check_level(level, PosteriorError)
        own, k = self[name], self.names.index(name)
        if k < len(self.prior.low):
            for side in (0, 1):
                bound = self.prior.bounds(k)[side]
                end = float(np.quantile(own, level if side == 0 else 1 - level))
                if np.isfinite(bound) and self._is_denser(k, bound, end):
                    return (bound, end) if side == 0 else (end, bound)
        low, high = np.quantile(own, [(1 - level) / 2, (1 + level) / 2])
        return float(low), float(high)

    def _is_denser(self, k: int, bound: float, end: float) -> bool:
        """True if draws of the coordinate of a parameter are denser beside its bound than beside the other end of an
        interval that begins there, by more than chance makes them."""
        along, name = self.prior.along, self.names[k]
        at, first, last = along(k, self.values[:, k]), *along(k, np.array([bound, end]))
        near = _BESIDE * abs(last - first)
        weight = min(self.bulk[name] / len(at), 1.0)
        beside, other = (weight * np.count_nonzero(np.abs(at - place) <= near) for place in (first, last))
        other /= 2  # to both sides of it
        return bool(beside - other > _CHANCE * math.sqrt(beside + other))

    def evidence_at(self, root: float) -> float:
        """The log evidence of another root of the likelihood than that of the draws.

        Its derivative in the power 1/root is the mean of the log likelihood, which lies below the highest by half of a
        number of dimensions over that power: that number is taken from the draws, and taken to stay.
        """
        if root == self.root:
            return self.log_evidence
        top, here, there = float(self.log_likelihood.max()), 1.0 / self.root, 1.0 / root
        dimensions = 2.0 * here * (top - float(self.log_likelihood.mean()))
        return self.log_evidence + (there - here) * top - 0.5 * dimensions * math.log(there / here)

    @property
    def median(self) -> dict[str, float]:
        """Name -> median."""
        return {name: float(np.median(own)) for name, own in self.draws.items()}

    def __str__(self) -> str:
        from casadi_engine.posterior.summary import summary

        return summary(self)

    def table(self) -> str:
        """Median and intervals of every parameter, as text."""
        from casadi_engine.posterior.summary import table

        return table(self)

    def predictive(self, data: Any = None, *, draws: int = 60, seed: int = 0, initial: Any = None) -> Any:
        """What the posterior foretells of a record's outputs; see ``predictive``."""
        from casadi_engine.posterior.predictive import predictive

        return predictive(self, data, draws=draws, seed=seed, initial=initial)

    def save(self, path: Any) -> Path:
        """Write the draws, what they say and their fit as result.json, all or nothing, and return its path.

        path : a file NAME.json, or a folder, which is made and gets a result.json. ``ce.load_result`` reads it back:
        it prints as this does and has the draws, ``load_result(path).draws["J_eng"]``; records are not in it.
        OutputError where it cannot be written.
        """
        # The room above this one knows the file, and is not there before it is needed.
        save = import_module("casadi_engine.report.result_file").save_result
        found: Path = save(self, path, "posterior", self.seconds, self.seed)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, ready for JSON; the draws among them."""
        return {
            "names": list(self.names),
            "units": list(self.units),
            "draws": {name: own.tolist() for name, own in self.draws.items()},
            "log_density": self.log_density.tolist(),
            "intervals": {
                name: {str(level): list(self.interval(name, level / 100)) for level in (50, 80, 95)}
                for name in self.names
            },
            "median": self.median,
            "modes": [
                {"values": dict(one.values), "mass": one.mass, "below": one.below, "optima": one.optima}
                for one in self.modes
            ],
            "log_evidence": self.log_evidence,
            "log_evidence_error": self.log_evidence_error,
            "method": self.method,
            "why": self.why,
            "rhat": dict(self.rhat),
            "bulk": dict(self.bulk),
            "tail": dict(self.tail),
            "pareto_k": None if self.shape is None or not np.isfinite(self.shape) else self.shape,
            "priors": dict(self.priors),
            "searches": self.searches,
            "evaluations": self.evaluations,
            "likelihood_root": self.root,
            "frequency_bins": None if self.bins is None else list(self.bins),
            "seconds": self.seconds,
            "seed": self.seed,
        }

    def to_inference_data(self) -> dict[str, Any]:
        """What ``arviz.from_dict(**...)`` takes: posterior and sample statistics, (chain, draw) each; no dependency."""
        chains = self.values.T[:, None] if self.chains is None else self.chains
        found: dict[str, Any] = {"posterior": dict(zip(self.names, chains, strict=True))}
        if self.chains is None:
            found["sample_stats"] = {"lp": self.log_density[None]}
        return found


def made(
    fit: Fit, target: Target, modes: Modes, groups: list[list[int]], drawn: Drawn, seed: int, seconds: float
) -> Posterior:
    """The result from draws."""
    values = target.values(drawn.u)
    names = target.names
    tops = modes.at[[group[0] for group in groups]]
    height = target.full(tops)
    of_each = zip(target.values(tops), _masses(modes, groups, drawn.u), height, groups, strict=True)
    found = [
        Mode(dict(zip(names, top.tolist(), strict=True)), float(share), float(height.max() - own), len(group))
        for top, share, own, group in of_each
    ]
    found.sort(key=lambda mode: mode.below)

    def by_name(part: Array | None) -> dict[str, float]:
        return {} if part is None else dict(zip(names, part.tolist(), strict=True))

    levels = dict.fromkeys(names[target.nv :], "flat in the logarithm, a factor 1000 about the fit's")
    chains = None
    if drawn.chains is not None:
        m, t, d = drawn.chains.shape
        chains = target.values(drawn.chains.reshape(m * t, d)).reshape(m, t, d).transpose(2, 0, 1)
    return Posterior(
        fit=fit,
        names=names,
        units=target.units,
        values=values,
        log_density=drawn.density,
        log_likelihood=target.root * (drawn.density - target.before(drawn.u[:, : target.nv])),
        root=target.root,
        method=drawn.method,
        why=drawn.why,
        modes=tuple(found),
        searches=modes.searches,
        log_evidence=drawn.log_evidence,
        log_evidence_error=drawn.error,
        rhat=by_name(drawn.rhat),
        bulk=by_name(drawn.bulk),
        tail=by_name(drawn.tail),
        shape=drawn.shape,
        priors=target.prior.words | levels,
        prior=target.prior,
        evaluations=target.evaluations,
        bins=target.likelihood.bins,
        seconds=seconds,
        seed=seed,
        chains=chains,
        untold_states=target.likelihood.untold(
            target.start[: target.nv], target.sigma(target.start[None])[0]
        ),
    )


def _masses(modes: Modes, groups: list[list[int]], u: Array) -> Array:
    """Shares of the draws that belong to each group of optima, by the quadratics at these."""
    scale = np.asarray(np.linalg.inv(modes.information), dtype=np.float64)
    parts = Mixture.of(np.ones(len(modes.at)), modes.at, scale).parts(u)
    owner = np.argmax(parts, axis=0)
    return np.array([np.isin(owner, group).mean() for group in groups])
