"""Draws from a posterior whose optima are known, by the first method whose draws can be trusted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import UntrustedPosteriorError
from casadi_engine.posterior import ensemble, importance
from casadi_engine.posterior.box import Box
from casadi_engine.posterior.bridge import bridge
from casadi_engine.posterior.drawn import Drawn, thinned, weighed
from casadi_engine.posterior.left_out import SCATTER
from casadi_engine.posterior.mixture import Mixture, around
from casadi_engine.posterior.modes import Modes
from casadi_engine.posterior.target import Target

Array = NDArray[np.float64]
LogDensity = Callable[[Array], Array]

# How far a draw has to lie above the highest optimum for optima to be looked for again, from so many draws. A wrong
# model has many optima, and those that the fit's starts met may be poor ones.
HIGHER, OPTIMA = 3.0, 6
# Draws that a proposal has to be worth for walkers to start in its coordinates rather than in those without bounds.
FEW = 20.0
# Components of a mixture that is fitted to so many draws of walkers that do not agree.
COMPONENTS, FITTED = 8, 8000


@dataclass(frozen=True)
class Met:
    """What was met in place of draws that can be trusted: points v that lie ``higher`` than all optima; if there are
    none, the data that were left out say too much."""

    higher: list[Array] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Drawing:
    """The draws of one posterior.

    method : as in ``posterior``; count : draws that are wanted; most : evaluations by an ensemble; tell : is told what
    is done
    """

    target: Target
    method: str
    random: np.random.Generator
    count: int
    most: int
    tell: Callable[[str], Any]

    def draws(self, modes: Modes, *, last: bool) -> Drawn | Met:
        """Draws by the method that is asked for, or by the first that can be trusted, or what has to be done before.

        last : whatever is met there are draws
        Raises UntrustedPosteriorError.
        """
        box, known, why = Box.none(self.target.low), None, "asked for"
        if self.method != "ensemble":
            found = self._at_optima(modes, last=last)
            if not isinstance(found, tuple):
                return found
            box, known, why = found
        ensemble.emcee()
        self.tell("ensemble")
        density = box.density(self.target.log_density)
        starts = [dispersed(density, modes, box, self.random) for _ in range(2)]
        explored = ensemble.explore(density, starts, self.random, known)
        been = box.back(np.concatenate(explored.states))
        height = self.target.log_density(been)
        higher = self._higher(modes, been, height)
        if higher and not last:
            return Met(higher)
        if self._left_out(been, height) > SCATTER:
            return Met()
        if self.method == "auto":
            weighted = self._where_walkers_were(density, explored.proposal)
            if isinstance(weighted, Drawn):
                return box.drawn(weighted)
            explored = replace(explored, proposal=weighted)
            self.tell("ensemble")
        return box.drawn(self._by_walking(density, explored, modes, why))

    def _where_walkers_were(self, density: LogDensity, proposal: Mixture) -> Drawn | Mixture:
        """Importance sampling from a mixture that was fitted to walkers; what it learnt where it cannot be trusted."""
        self.tell("importance sampling where the walkers have been")
        weighted = importance.sample(density, proposal, self.random, self.count)
        if not weighted.trusted:
            return weighted.proposal
        return weighed(weighted, "from where an ensemble of walkers has been", self.count, self.random)

    def _at_optima(self, modes: Modes, *, last: bool) -> Drawn | Met | tuple[Box, Mixture, str]:
        """Importance sampling from the optima; where it cannot be trusted the coordinates and the proposal from which
        an ensemble starts, and why."""
        self.tell("importance sampling")
        target, plain = self.target, Box.none(self.target.low)
        near = Box.about(modes.at[0], np.linalg.inv(modes.information[0]), target.low, target.high)
        tried = []
        for box in (plain, near) if near.closed.any() else (plain,):
            found = importance.sample(
                box.density(target.log_density), modes.mixture(box), self.random, self.count
            )
            if found.trusted:
                return box.drawn(weighed(found, "few smooth optima", self.count, self.random))
            higher = self._higher(modes, box.back(found.x), found.density - box.log_slope(found.x))
            if higher and not last:
                return Met(higher)
            tried.append((box, found))
        box, found = tried[0] if tried[0][1].size > FEW else tried[-1]
        if self.method == "importance":
            raise UntrustedPosteriorError(
                "importance sampling does not describe this posterior",
                seen=found.words,
                allowed=f"k-hat up to {importance.LARGEST_SHAPE:g}, and {importance.FEWEST:.0f} draws",
                cure='take method="ensemble", which crosses many optima and curved valleys',
            )
        return box, found.proposal, found.words

    def _higher(self, modes: Modes, u: Array, height: Array) -> list[Array]:
        """The highest of some points u (n, d), as v, if they lie well above the best optimum."""
        above = np.flatnonzero(height > modes.height[0] + HIGHER)
        return [u[k, : self.target.nv] for k in above[np.argsort(-height[above])][:OPTIMA]]

    def _left_out(self, u: Array, height: Array) -> float:
        """Scatter of what all data say beyond those in use, at some points."""
        if self.target.likelihood.bins is None:
            return 0.0
        return float(np.std(self.target.full(u) - height))

    def _limit(self, modes: Modes) -> str:
        """What the evidence cannot exceed, in words: the highest likelihood, at the fit's noise levels."""
        if self.target.nv < len(self.target.names):
            return ""
        at = modes.at[:OPTIMA]
        likelihood = self.target.full(at) - self.target.prior.log_density(at)
        return f"; the log evidence is {likelihood.max():.2f} at most, the likelihood of the best optimum"

    def _by_walking(self, density: LogDensity, explored: ensemble.Explored, modes: Modes, why: str) -> Drawn:
        """Draws of an ensemble; raises UntrustedPosteriorError where its walkers do not agree."""
        chains = ensemble.walk(density, explored, self.random, most=self.most)
        if not chains.trusted and self.method == "auto":  # the weights judge by themselves
            later = chains.x[:, chains.x.shape[1] // 2 :].reshape(-1, chains.x.shape[2])
            thin = self.random.choice(len(later), min(len(later), FITTED), replace=False)
            drawn = self._where_walkers_were(density, around(later[thin], COMPONENTS, self.random))
            if isinstance(drawn, Drawn):
                return drawn
        if not chains.trusted:
            worst = int(np.argmax(chains.rhat))
            raise UntrustedPosteriorError(
                "the walkers of the ensemble do not agree yet",
                seen=f"R-hat {chains.rhat[worst]:.3f} of {self.target.names[worst]}, worth {chains.size:.0f} "
                f"independent draws after {chains.evaluations} evaluations{self._limit(modes)}",
                allowed=f"R-hat up to {ensemble.LARGEST:g}, and {ensemble.FEWEST:.0f} draws",
                cure=f"give more, evaluations={4 * self.most}, or narrower bounds or priors for what the data tell "
                "little of",
            )
        evidence = bridge(density, chains.x, chains.density, chains.size, self.random)
        return thinned(chains, evidence, self.count, why)


def dispersed(density: LogDensity, modes: Modes, box: Box, random: np.random.Generator) -> Array:
    """Where the walkers of an ensemble (w, d) start: half about the optima, half far along the weakest directions."""
    d = modes.at.shape[1]
    walkers = 2 * (d + 1)
    about = box.mixture(np.ones(len(modes.at)), modes.at, np.asarray(np.linalg.inv(modes.information)))
    values, vectors = np.linalg.eigh(about.factor[0] @ about.factor[0].T)
    found: list[Array] = []
    for tried in range(100 * walkers):
        k = int(random.integers(len(modes.at)))
        at = about.centre[k] + about.factor[k] @ random.standard_normal(d)
        if len(found) % 2:
            weak = np.argsort(values)[::-1][: min(2, d)]
            far = random.uniform(-8, 8, len(weak)) * np.sqrt(values[weak]) / (1 + tried // (10 * walkers))
            at = at + vectors[:, weak] @ far
        if np.isfinite(density(at[None])[0]):
            found.append(at)
        if len(found) == walkers:
            return np.array(found)
    raise UntrustedPosteriorError(
        "the model cannot be evaluated around the optimum, or constraints leave no room there",
        seen=f"{len(found)} of {100 * walkers} draws about the optima have a density",
        allowed=f"{walkers} of them, for the walkers of an ensemble",
        cure="widen the constraints that the fit rests on, or fix these parameters, and fit again",
    )
