"""What is known of a record's initial states before it is looked at: they are like any others along the record.

A flat prior does not do, nor one that is far too wide. An engine's record begins in the middle of its running, and each
of its torsional modes may start with any amplitude then: a rival model, in which some modes are hardly seen, has more
room for amplitudes that fit noise, and wins against the truth far more often than its probability says.

What a fit finds for the first states holds such noise itself, and so does the trajectory from there until it has died
out. The prior is therefore one of three, taken for as probable as one another, and integrated over. A linear record of
a machine that runs starts near the state that it has where its drives go on as they do at the beginning (``alike``). Or
it starts anywhere in the motion of the later half of the trajectory, with the trend of that half led back to the
beginning. Or else, as a record may begin with a run-up or a free motion that dies, it has a prior as wide as the states
are large. The width is integrated over as well, flat in its logarithm from that to ten times as much.

The motion alone made intervals of a crankshaft too narrow: where all records begin at a moment at which its modes are
quiet, amplitudes that they have at others are no measure for what noise tells of them.

The states that drives lead to depend on the parameters, and so does the prior. One that stays where the fit has it
tells the posterior again what the fit made of the noise: a single record of the crankshaft had 95 % intervals that held
the truth in 90 % (``tests/benchmarks/POSTERIOR.md``).

In the frequency domain the initial states enter by the sum of the first and the last one (``last_state``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.options import interval_length
from casadi_engine.estimation.record import RecordTerm
from casadi_engine.estimation.starts import chained_nodes
from casadi_engine.posterior.alike import Alike

Array = NDArray[np.float64]

# Widths of the prior over which is integrated, in those of the states' motion along the record.
WIDTHS = 10.0 ** np.linspace(0, 1, 5)
# Share of a state's own standard deviation, and of its size, that it may differ by itself: no more than keeps the
# covariance off singular, as what is not seen along the record would be free to fit noise.
_ALONE, _STILL = 1e-3, 1e-6
# With fewer states along the record they say nothing of the motion.
_FEWEST = 10


@dataclass(frozen=True)
class StatePrior:
    """Normal densities of scaled states, as probable as one another: means (a, n), and factors (a, n, n) of the
    covariances at width 1.

    chosen, width : the one that searches use
    follows : how far (n,) the states that the drives lead to lie at other parameters v (nv,) beside these; None for
        states that do not tell
    """

    means: Array
    factors: Array
    chosen: int = 0
    width: float = 1.0
    follows: Callable[[Array], Array] | None = None

    @property
    def mean(self) -> Array:
        """(n,) that searches use."""
        return np.asarray(self.means[self.chosen])

    @property
    def factor(self) -> Array:
        """(n, n) that searches use, with the width."""
        return self.width * self.factors[self.chosen]

    def of_sum(self, ahead: Array, forced: Array) -> StatePrior:
        """That of the sum x_0 + x_N of first and last state, x_N = ahead @ x_0 + forced."""
        turn = np.eye(len(ahead)) + ahead
        return replace(self, means=self.means @ turn.T + forced, factors=turn @ self.factors)

    def part(self, index: NDArray[np.intp]) -> StatePrior:
        """That of some of the states."""
        covariances = (self.factors @ self.factors.swapaxes(1, 2))[:, index][:, :, index]
        factors = np.asarray(np.linalg.cholesky(covariances), dtype=np.float64)
        return replace(self, means=self.means[:, index], factors=factors, follows=None)

    def settled(self, rows: Array, rest: Array) -> StatePrior:
        """The same, searches with what is most probable for rows (n, L) and a residual (L,); see ``integral``."""
        logs = self._logs(rows[None], rest[None], None)[0][:, :, 0]
        chosen, width = np.unravel_index(np.argmax(logs), logs.shape)
        return replace(self, chosen=int(chosen), width=float(WIDTHS[width]))

    def at(self, v: Array) -> StatePrior:
        """That at other parameters v (nv,)."""
        return self if self.follows is None else self.moved(self.follows(v))

    def moved(self, by: Array) -> StatePrior:
        """That of states that lie ``by`` (n,) beside these."""
        return replace(self, means=self.means + by)

    def integral(
        self, rows: Array, rest: Array, turn: Array | None = None, moved: Array | None = None
    ) -> tuple[Array, Array]:
        """Log likelihood (P,) with states, width and which density integrated out, and the mean states (P, n) given the
        data, at P points; NaN where a number is not finite.

        rows : (P, n, L) what a state does to the residual, which is ``rest`` (P, L) with states of zero
        turn : (P, n, n) of the coordinates in which the rows are; without any, those of the prior
        moved : (P, n) how far the prior lies beside this one at each point
        """
        if moved is not None:
            by = moved if turn is None else (turn @ moved[..., None])[..., 0]
            rest = rest + (by[:, None] @ rows)[:, 0]
        logs, states = self._logs(rows, rest, turn)
        top = logs.max(axis=(0, 1))
        share = np.exp(logs - top)
        total = top + np.log(share.mean(axis=(0, 1)))
        return total, (share[..., None] * states).sum(axis=(0, 1)) / share.sum(axis=(0, 1))[:, None]

    def _logs(self, rows: Array, rest: Array, turn: Array | None) -> tuple[Array, Array]:
        """Log likelihood (a, w, P) and mean states (a, w, P, n) for each density and width."""
        gram, logs, states = rows @ rows.swapaxes(-1, -2), [], []
        for mean, factor in zip(self.means, self.factors, strict=True):
            if turn is not None:
                mean, factor = turn @ mean, turn @ factor
            left = rest + (np.broadcast_to(mean, rows.shape[:2])[:, None] @ rows)[:, 0]
            back = factor.swapaxes(-1, -2)
            known = back @ gram @ factor
            fine = np.isfinite(known).all(axis=(-1, -2))
            sizes, axes = np.linalg.eigh(np.where(fine[:, None, None], known, 0.0))
            pull = (axes.swapaxes(-1, -2) @ (back @ (rows @ left[..., None])))[..., 0]
            square = np.square(WIDTHS)[:, None, None]
            grown = 1.0 + square * np.maximum(sizes, 0.0)
            own = 0.5 * (square * pull**2 / grown - np.log(grown)).sum(axis=-1)
            logs.append(np.where(fine, own - 0.5 * np.square(left).sum(axis=-1), np.nan))
            states.append(mean - (factor @ (axes @ (square * pull / grown)[..., None]))[..., 0])
        return np.array(logs), np.array(states)

    def best(self, rows: Array, left: Array) -> Array:
        """The states (n,) of the least chi-squared for searches, the prior included; ``left`` (L,) with its mean."""
        axes, sizes, ways = _axes(self.factor.T @ rows)
        moved = axes @ (_shrunk(sizes) * (ways @ left))
        return np.asarray(self.mean - self.factor @ moved)

    def without(self, rows: Array, flat: Array) -> Array:
        """What the states take in searches from the products flat @ flat.T of rows (m, L)."""
        _, sizes, ways = _axes(self.factor.T @ rows)
        seen = flat @ ways.T
        return np.asarray((seen * (sizes * _shrunk(sizes))) @ seen.T)


def _axes(seen: Array) -> tuple[Array, Array, Array]:
    """Singular vectors and values of what states do to a residual, in units of their prior (n, L). The sum of the prior
    and of their squares would lose the prior beside states that are seen 1e8 times better; numbers that are not finite
    stay so."""
    if np.isfinite(seen).all():
        return np.linalg.svd(seen, full_matrices=False)
    count = min(seen.shape)
    return (
        np.full((len(seen), count), np.nan),
        np.full(count, np.nan),
        np.full((count, seen.shape[1]), np.nan),
    )


def _shrunk(sizes: Array) -> Array:
    """s / (1 + s^2) of singular values, of any size."""
    return np.asarray(1.0 / (1.0 / np.maximum(sizes, 1e-150) + sizes))


def state_prior(record: RecordTerm, v: Array, first: Array) -> StatePrior:
    """From the states along a record, simulated at v (nv,) from ``first`` (n,), scaled."""
    if record.linear and record.plan.m > _FEWEST:  # a fit may have cut it into few intervals
        record = record.again(gain=record.gain, length=interval_length("auto", record.grid))
    size = np.maximum(np.abs(first), 1.0)
    wide = np.zeros(len(first)), np.diag(size)
    nodes = chained_nodes(record, v, first)
    later = nodes[len(nodes) // 2 :]
    known = len(later) >= _FEWEST and np.isfinite(nodes).all()
    shapes = [(later.mean(axis=0), _factor(later)), wide] if known else [wide]
    again, follows = Alike.of(record, v, first) if record.linear and known else None, None
    if again is not None:
        state = again.state(v)
        apart = again.apart(v, state)
        if np.isfinite(apart).all():
            shapes.append((state, _root(apart.T @ apart / len(apart), later)))
            follows = partial(_beside, again, state)
    means, factors = (np.array(own) for own in zip(*shapes, strict=True))
    return StatePrior(means, factors, follows=follows)


def _beside(again: Alike, state: Array, v: Array) -> Array:
    """How far the state that the drives lead to at v lies beside another one."""
    return again.state(v) - state


def _factor(nodes: Array) -> Array:
    """Lower factor (n, n) of the covariance of states (M, n) about their mean, and of what a line through them makes of
    it as far before them as they are long."""
    count = len(nodes)
    away, at = nodes - nodes.mean(axis=0), np.arange(count) - (count - 1) / 2
    trend = 1.5 * count * (at @ away) / (at @ at)
    return _root(away.T @ away / count + np.outer(trend, trend), nodes)


def _root(covariance: Array, nodes: Array) -> Array:
    """Lower factor (n, n) of a covariance and of what each state may differ by itself, those along a record being
    ``nodes`` (M, n)."""
    own = (_ALONE * nodes.std(axis=0)) ** 2 + (_STILL * np.abs(nodes.mean(axis=0))) ** 2 + 1e-18
    return np.asarray(np.linalg.cholesky(covariance + np.diag(own)), dtype=np.float64)
