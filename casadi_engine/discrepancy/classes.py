"""Which effects the data can tell apart: clusters, ranking probabilities, classes, and what would split them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.score import Scores
from casadi_engine.distributions import normal_sf

# Rows that correlate more are one row with several names.
SAME_ROW = 0.9999
# A candidate stays in the class unless the winner beats it by this many standard deviations, squared: at most 1 % of
# the times that it is the truth.
_KEEP = 2.326
_SEPARATED = 3.3


def ranking_probability(mu: Array | float, rho: Array | float) -> Array:
    """P(|z_j| > |z_k|) when z_j ~ N(mu, 1), z_k ~ N(rho mu, 1) and they correlate by rho: j is true and ranks first.

    Phi(a) Phi(b) + Phi(-a) Phi(-b) with a, b = |mu| sqrt((1 -+ |rho|)/2).
    """
    size, share = np.abs(mu), np.abs(rho)
    a, b = size * np.sqrt((1 - share) / 2), size * np.sqrt((1 + share) / 2)
    return np.asarray(normal_sf(-a) * normal_sf(-b) + normal_sf(a) * normal_sf(b), dtype=np.float64)


def separation(mu: Array | float, rho: Array | float) -> Array:
    """d = |mu| sqrt(1 - rho^2): the winner is right with probability about Phi(d/2)."""
    return np.asarray(np.abs(mu) * np.sqrt(np.maximum(1 - np.square(rho), 0.0)), dtype=np.float64)


def clusters(scores: Scores, *, same: float = SAME_ROW) -> list[list[int]]:
    """Groups of testable candidates that are one row with several names, the highest statistic first in each."""
    size = np.abs(scores.correlation)
    order = sorted(np.flatnonzero(scores.testable), key=lambda k: -scores.statistic[k])
    found: list[list[int]] = []
    for k in order:
        home = next((c for c in found if size[c[0], k] > same), None)
        if home is None:
            found.append([int(k)])
        else:
            home.append(int(k))
    return found


@dataclass(frozen=True)
class Member:
    """One effect that may be the missing one: its candidate, its correlation with the lead, and how probable it is
    among the members with equal chances before the data; ``names`` are the candidates of the same row."""

    candidate: int
    rho: float
    probability: float
    names: tuple[int, ...]


def confusable(
    scores: Scores,
    *,
    gain: Mapping[int, float] | None = None,
    keep: float = _KEEP,
    same: float = SAME_ROW,
) -> list[Member]:
    """The class of the best candidate: itself and all that the data do not exclude beside it, best first.

    gain : candidate -> drop of chi-squared of a refit, in place of the predicted drop z^2. keep : the truth is left
    out with probability at most Phi(-keep). An effect with several points of a nuisance grid enters by its best point.
    """
    drop = scores.drop.copy()
    for k, value in (gain or {}).items():
        drop[k] = value
    rows = clusters(scores, same=same)
    best: dict[tuple[str, str], tuple[float, list[int]]] = {}
    for row in rows:
        head = max(row, key=lambda k: drop[k])
        key = scores.candidates[head].key
        if key not in best or drop[head] > best[key][0]:
            best[key] = (float(drop[head]), [head, *[k for k in row if k != head]])
    if not best:
        return []
    ranked = sorted(best.values(), key=lambda pair: -pair[0])
    top, lead = ranked[0][0], ranked[0][1][0]
    members = [(value, row) for value, row in ranked if top - value <= keep**2]
    weight = np.exp(0.5 * (np.array([value for value, _ in members]) - top))
    rho = scores.correlation[lead]
    seen: set[tuple[str, str]] = set()
    found = []
    for (_, row), share in zip(members, weight / weight.sum(), strict=True):
        names = _distinct(scores, row, seen)
        if names:
            found.append(Member(names[0], float(rho[names[0]]), float(share), tuple(names)))
    return found


def _distinct(scores: Scores, row: Sequence[int], seen: set[tuple[str, str]]) -> list[int]:
    """The candidates of a row with keys not seen before, which they then are."""
    out = []
    for k in row:
        key = scores.candidates[k].key
        if key not in seen:
            seen.add(key)
            out.append(k)
    return out


def theoretical_class(scores: Scores, truth: int, size: float, *, separated: float = _SEPARATED) -> list[int]:
    """One candidate of every effect that data of this kind cannot tell from a true one of the given size.

    Those with d < ``separated`` (3.3: wrong in 5 % of records), the truth first.
    """
    mu = size * np.sqrt(scores.information[truth])
    d = separation(mu, scores.correlation[truth])
    found, seen = [truth], {scores.candidates[truth].key}
    for k in np.argsort(d, kind="stable"):
        key = scores.candidates[k].key
        if scores.testable[k] and key not in seen and d[k] < separated:
            seen.add(key)
            found.append(int(k))
    return found


@dataclass(frozen=True)
class Split:
    """What one more experiment would do for a class: the least separation d among its pairs, before and with it."""

    experiment: str
    before: float
    after: float


def best_split(
    members: Sequence[int],
    sizes: Sequence[float],
    now: Scores,
    proposed: Mapping[str, Scores],
) -> list[Split]:
    """Experiments by how well they would split a class, best first.

    members : candidates; sizes : their estimated amplitudes; proposed : experiment -> Scores of the data so far and the
    experiment together (only its R and q count, which a simulation gives)
    """

    def least(scores: Scores) -> float:
        pairs = [
            float(separation(size * np.sqrt(scores.information[j]), scores.correlation[j, k]))
            for j, size in zip(members, sizes, strict=True)
            for k in members
            if k != j
        ]
        return min(pairs, default=0.0)

    before = least(now)
    found = [Split(name, before, least(scores)) for name, scores in proposed.items()]
    return sorted(found, key=lambda split: -split.after)
