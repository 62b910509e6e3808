"""A mixture of Student-t densities: what draws are proposed from, and fitted to draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

Array = NDArray[np.float64]

# Degrees of freedom: tails heavier than those of a posterior with many data.
FREEDOM = 5.0
# Components with a smaller share of the mass are dropped; a covariance is kept off singular by this share of the whole.
_LEAST, _SPRING = 1e-4, 1e-6
# Share and scale of the copies that keep weights bounded; growth of a component of which few draws weigh anything.
_GUARD, _WIDER, _UNSURE = 0.15, 4.0, 1.5


@dataclass(frozen=True)
class Mixture:
    """share (k,), centre (k, d), factor (k, d, d) lower Cholesky factors of the scale matrices."""

    share: Array
    centre: Array
    factor: Array

    @classmethod
    def of(cls, share: Array, centre: Array, scale: Array) -> Mixture:
        """From scale matrices (k, d, d); shares need not sum to one."""
        share = np.asarray(share, dtype=float)
        return cls(
            share / share.sum(), np.asarray(centre), np.asarray(np.linalg.cholesky(scale), dtype=np.float64)
        )

    def draw(self, count: int, random: np.random.Generator) -> Array:
        """(count, d) independent draws."""
        d = self.centre.shape[1]
        which = random.choice(len(self.share), count, p=self.share)
        normal = random.standard_normal((count, d))
        stretch = np.sqrt(FREEDOM / random.chisquare(FREEDOM, count))
        moved = np.einsum("nij,nj->ni", self.factor[which], normal) * stretch[:, None]
        return np.asarray(self.centre[which] + moved)

    def parts(self, x: Array) -> Array:
        """(k, n) log densities of the components at x (n, d), times their shares."""
        d, found = self.centre.shape[1], np.empty((len(self.share), len(x)))
        constant = gammaln((FREEDOM + d) / 2) - gammaln(FREEDOM / 2) - 0.5 * d * np.log(FREEDOM * np.pi)
        for k, (share, centre, factor) in enumerate(zip(self.share, self.centre, self.factor, strict=True)):
            away = np.linalg.solve(factor, (x - centre).T)
            square = np.square(away).sum(axis=0)
            bent = -0.5 * (FREEDOM + d) * np.log1p(square / FREEDOM)
            found[k] = np.log(share) + constant - np.log(np.diag(factor)).sum() + bent
        return found

    def log_density(self, x: Array) -> Array:
        """(n,) at x (n, d)."""
        return np.asarray(logsumexp(self.parts(x), axis=0))

    def guarded(self) -> Mixture:
        """The same with wide copies of its components, for a part of the draws."""
        return Mixture(
            np.concatenate([(1 - _GUARD) * self.share, _GUARD * self.share]),
            np.concatenate([self.centre, self.centre]),
            np.concatenate([self.factor, np.sqrt(_WIDER) * self.factor]),
        )

    def beside(self, other: Mixture, share: float = 0.5) -> Mixture:
        """This one, and a share of the draws from another."""
        return Mixture(
            np.concatenate([(1 - share) * self.share, share * other.share]),
            np.concatenate([self.centre, other.centre]),
            np.concatenate([self.factor, other.factor]),
        )

    def fitted(self, x: Array, weight: Array, rounds: int = 1) -> Mixture:
        """The mixture moved towards weighted draws x (n, d) by expectation maximisation (Cappe et al. 2008)."""
        found = self
        for _ in range(rounds):
            found = found._step(x, weight / weight.sum())
        return found

    def _step(self, x: Array, weight: Array) -> Mixture:
        d = x.shape[1]
        parts = self.parts(x)
        owned = np.exp(parts - logsumexp(parts, axis=0)) * weight
        mass = owned.sum(axis=1)
        effective = mass**2 / np.maximum(np.square(owned).sum(axis=1), 1e-300)
        mean = weight @ x
        spring = _SPRING * np.diag(np.maximum(weight @ np.square(x - mean), 1e-300))
        share, centre, scale = [], [], []
        for k in np.flatnonzero(mass > _LEAST):
            if (
                effective[k] < 4 * d
            ):  # too few draws to say its shape: it goes to them with the one it has, wider
                share.append(mass[k])
                centre.append(owned[k] @ x / mass[k])
                scale.append(_UNSURE * self.factor[k] @ self.factor[k].T)
                continue
            away = np.linalg.solve(self.factor[k], (x - self.centre[k]).T)
            pull = owned[k] * (FREEDOM + d) / (FREEDOM + np.square(away).sum(axis=0))
            middle = pull @ x / pull.sum()
            apart = x - middle
            share.append(mass[k])
            centre.append(middle)
            scale.append((apart.T * pull) @ apart / mass[k] + spring)
        if not share:
            return self
        return Mixture.of(np.array(share), np.array(centre), np.array(scale))


def around(x: Array, count: int, random: np.random.Generator, rounds: int = 15) -> Mixture:
    """A mixture of ``count`` components at most, fitted to draws x (n, d) that weigh alike."""
    d = x.shape[1]
    count = max(1, min(count, len(x) // (10 * d)))
    spread = np.cov(x.T).reshape(d, d) + 1e-12 * np.diag(x.var(axis=0) + 1e-300)
    white = np.linalg.solve(np.linalg.cholesky(spread), (x - x.mean(axis=0)).T).T
    seeds = [int(random.integers(len(x)))]  # far from one another (k-means++)
    for _ in range(count - 1):
        far = np.min([np.square(white - white[s]).sum(axis=1) for s in seeds], axis=0)
        seeds.append(int(random.choice(len(x), p=far / far.sum())))
    start = Mixture.of(
        np.ones(count), x[seeds], np.repeat(spread[None] / max(count, 1) ** (2 / d), count, axis=0)
    )
    return start.fitted(x, np.ones(len(x)), rounds)
