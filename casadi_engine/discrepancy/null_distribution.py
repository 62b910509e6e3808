"""How large the best score of a whole library is when nothing is missing.

Under the null the scores are z = U'y with y standard normal, U the candidates' unit vectors. Each test is a row: one
vector, two- or one-sided, or a subspace for a group. All are put on the scale of their own p-value, and the smallest
p-value of the library is calibrated by draws: P(min p <= p0) = p0 K E[1/N], where one of the K tests is drawn, y is
drawn given that it is significant at p0, and N counts the tests that then are (Adler, Blanchet & Liu 2012). Its
relative error does not grow for small p0, and it needs a few thousand draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.score import Scores, upper_tail
from casadi_engine.distributions import chi2_isf, chi2_sf, f_sf, normal_isf

_DRAWS = 4000
_SMALLEST = 1e-300
# Draws looked at side by side: their scores stay near the cache.
_PART = 500
_LIBRARY_SHARE = 0.8


@dataclass(frozen=True, eq=False)
class Row:
    """One test of the library: a subspace (m, r) of the scores' frame, and a side for r = 1 (0 is two-sided).

    freedom : degrees of freedom of the noise's variance; the p-values of data are then those of Student's t and
    Fisher's F, while the law of the smallest of many is that of normal scores with the same p-values
    """

    name: str
    frame: Array
    side: int = 0
    freedom: float = np.inf

    def p_value(self, y: Array) -> Array:
        """p-values (n,) at y (m, n)."""
        inner = self.frame.T @ y
        rank = self.frame.shape[1]
        if rank == 1:
            beyond = self.side * inner[0] if self.side else np.abs(inner[0])
            return (1 if self.side else 2) * upper_tail(beyond, self.freedom)
        value = (inner**2).sum(axis=0)
        if np.isfinite(self.freedom):
            return np.asarray(f_sf(value / rank, rank, self.freedom))
        return np.asarray(chi2_sf(value, rank))

    def limit(self, p: float) -> float:
        """The value of the statistic (one-sided z, |z| or chi) that has this p-value."""
        if self.frame.shape[1] == 1:
            return float(normal_isf(p if self.side else p / 2))
        return float(np.sqrt(np.asarray(chi2_isf(p, self.frame.shape[1]))))


def library_rows(scores: Scores, groups: dict[str, Sequence[int]] | None = None) -> list[Row]:
    """One test for each testable candidate, and one for each group of them."""
    tests = [
        Row(
            candidate.label,
            scores.directions[:, [k]],
            candidate.side,
            np.inf if scores.freedom is None else float(scores.freedom[k]),
        )
        for k, candidate in enumerate(scores.candidates)
        if scores.testable[k]
    ]
    for name, members in (groups or {}).items():
        members = [k for k in members if scores.testable[k]]
        frame = scores.subspace(members)
        if frame.shape[1] > 1:
            freedom = np.inf if scores.freedom is None else float(scores.freedom[members].min())
            tests.append(Row(name, frame, 0, freedom))
    return tests


class NullDistribution:
    """The smallest p-value of a library under the null.

    tests : the rows; draws, seed : of the Monte Carlo sample, which is the same for every question asked
    """

    def __init__(self, tests: Sequence[Row], *, draws: int = _DRAWS, seed: int = 0) -> None:
        self.tests = tuple(tests)
        # those of one vector, the two-sided ones first
        single = [k for k, t in enumerate(self.tests) if t.frame.shape[1] == 1]
        self._single = sorted(single, key=lambda k: self.tests[k].side != 0)
        self._both = sum(self.tests[k].side == 0 for k in single)
        self._wide = [k for k, t in enumerate(self.tests) if t.frame.shape[1] > 1]
        m = self.tests[0].frame.shape[0] if self.tests else 0
        rng = np.random.default_rng(seed)
        self._picked = rng.permutation(np.arange(draws) % max(len(self.tests), 1))
        self._y = rng.standard_normal((m, draws))
        self._level, self._sign = rng.random(draws), np.where(rng.random(draws) < 0.5, -1.0, 1.0)

    @cached_property
    def _vectors(self) -> Array:
        """(m, singles) the vectors of the tests of one, each towards its side."""
        return np.concatenate([self.tests[k].frame * (self.tests[k].side or 1) for k in self._single], axis=1)

    @cached_property
    def _scores(self) -> Array:
        """(draws, singles) the scores of the draws."""
        return np.asarray(self._y.T @ self._vectors)

    @cached_property
    def _inner(self) -> Array:
        """(singles, singles) inner products of the vectors."""
        return np.asarray(self._vectors.T @ self._vectors)

    @cached_property
    def _columns(self) -> NDArray[np.intp]:
        """(draws,) the number of the picked test among those of one vector; -1 for a wide one."""
        column = np.full(len(self.tests), -1)
        column[self._single] = np.arange(len(self._single))
        return np.asarray(column[self._picked], dtype=np.intp)

    def pooled(self, p: float) -> float:
        """P(the smallest p-value of the library <= p) when nothing is missing."""
        if not self.tests or p <= 0:
            return 0.0
        if p >= 1:
            return 1.0
        inside = self._significant(p)
        share = float((1 / np.maximum(inside, 1)).mean())
        return min(1.0, p * len(self.tests) * share)

    def threshold(self, alpha: float) -> float:
        """The p-value of a single test below which the library's smallest one falls with probability ``alpha``."""
        from scipy import optimize

        if not self.tests:
            return alpha
        low = alpha / len(self.tests)
        if len(self.tests) == 1 or self.pooled(low) >= alpha:
            return low

        def excess(log_p: float) -> float:
            return float(np.log(self.pooled(float(np.exp(log_p)))) - np.log(alpha))

        found = optimize.brentq(excess, np.log(low), np.log(alpha), xtol=1e-4)
        return float(np.exp(float(np.asarray(found))))

    def critical(self, alpha: float) -> float:
        """c_alpha: the |z| of a two-sided test at the threshold."""
        return float(normal_isf(self.threshold(alpha) / 2))

    def _significant(self, p: float) -> Array:
        """(n,) number of tests that are significant at p in each draw, given that its picked test is; that one counts
        whatever its last digit says."""
        tail = np.maximum(self._level * p, _SMALLEST)
        count = np.zeros(len(tail))
        # what is added to the draws of tests of one vector: so much of it
        column = self._columns if self._single else np.full(len(tail), -1)
        moved = np.zeros(len(tail))
        mine = np.flatnonzero(column >= 0)
        own = column[mine]
        if len(mine):
            two_sided = own < self._both
            z = normal_isf(np.where(two_sided, tail[mine] / 2, tail[mine]))
            moved[mine] = np.where(two_sided, self._sign[mine] * z, z) - self._scores[mine, own]
        wide = self._wide_draws(tail)
        if self._single:
            two, one = normal_isf(p / 2), normal_isf(p)
            for first in range(0, len(tail), _PART):
                part = slice(first, first + _PART)
                z = self._inner[np.maximum(column[part], 0)] * moved[part, None]
                z += self._scores[part]
                for at, y in wide:
                    inside = np.flatnonzero((at >= first) & (at < first + _PART))
                    z[at[inside] - first] = y[:, inside].T @ self._vectors
                both, rest = z[:, : self._both], z[:, self._both :]
                count[part] += (np.abs(both, out=both) >= two * (1 - 1e-12)).sum(axis=1)
                count[part] += (rest >= one - 1e-12 * abs(one)).sum(axis=1)
        if self._wide:
            y = self._y.copy()
            if len(mine):
                y[:, mine] += self._vectors[:, own] * moved[mine]
            for at, given in wide:
                y[:, at] = given
            for k in self._wide:
                test = self.tests[k]
                count += ((test.frame.T @ y) ** 2).sum(axis=0) >= test.limit(p) ** 2 * (1 - 1e-12)
        return count

    def _wide_draws(self, tail: Array) -> list[tuple[NDArray[np.intp], Array]]:
        """For each wide test the draws at which it was picked, and these (m, n), given that it is significant."""
        found = []
        for number in self._wide:
            mine = np.flatnonzero(self._picked == number)
            frame, y = self.tests[number].frame, self._y[:, mine]
            inner = frame.T @ y
            radius = np.sqrt(chi2_isf(tail[mine], frame.shape[1]))
            found.append((mine, y + frame @ (inner / np.linalg.norm(inner, axis=0) * radius - inner)))
        return found


def split_alpha(alpha: float, *, library: float = _LIBRARY_SHARE) -> tuple[float, float]:
    """Shares of the false-alarm rate for the library and the whiteness test; independent or not, at most alpha."""
    return alpha * library, alpha * (1 - library)
