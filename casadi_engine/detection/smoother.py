"""Fixed-lag smoother of the strength of every combustion, in square-root information form.

The last combustions are unknowns of the filter, without a prior. What is known of their size is used where their
probabilities are worked out, for all ways in which the last ones may have been lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.detection.plant import Disturbances, Plant
from casadi_engine.detection.segments import Segments

Array = NDArray[np.float64]

LEVEL_GAIN = 0.15  # with which the usual strength follows
LEVEL_DOUBT = 0.1  # of the usual strength, common to the combustions within the lag
LEAST_LEVEL = 0.02  # of the strength in the fit
EXCESS_GAIN = 0.1  # with which the variance of what the model does not foretell follows
EXCESS_STEP = 4.0  # most that one window's innovations count: a single jolt is not the model's error
# Mean square of a window's innovations, over that of the noise, from which its samples count for less: outliers.
OUTLYING = 9.0
WIDE = 3.0  # standard deviation of a strength of which nothing is known [1]
NOISES = 4  # torque on the engine, torque on the load, the road's part, motored gas torque


@dataclass(frozen=True)
class Prior:
    """What is assumed of a combustion: probability to be lost, scatter of its strength (of the usual one) [1]."""

    lost: float = 0.01
    scatter: float = 0.05


class Smoother:
    """Filter of B records at once, window by window.

    ``root`` is (B, size, size + 1), upper triangular: [state, motored gas torque, strengths of the last lag + 1
    combustions, oldest first | right side], rows in standard deviations. ``excess`` (B,) is the variance of what the
    model does not foretell, 1 for that of the noise: innovations that are larger make all that follows less certain.
    """

    def __init__(
        self, plant: Plant, disturbances: Disturbances, segments: Segments, *, lag: int, speed: Array
    ) -> None:
        self.plant, self.disturbances, self.segments, self.lag = plant, disturbances, segments, lag
        self.spans = segments.add.shape[-1] - 2
        self.nz = plant.size + 1
        size = self.nz + lag + 1
        spread = np.concatenate([plant.start, [disturbances.gas], np.full(lag + 1, WIDE)])
        mean = np.zeros((len(speed), size))
        mean[:, : plant.size] = speed[:, None] * plant.turning
        mean[:, self.nz :] = 1.0
        self.root = np.zeros((len(speed), size, size + 1))
        self.root[:, :, :size] = np.diag(1 / spread)
        self.root[:, :, -1] = mean / spread
        pieces = segments.rows.shape[2]
        d = disturbances
        self.noise = np.array([d.step, d.step, 0.0, 0.1 * d.gas]) / np.sqrt(pieces)
        self.excess = np.ones(len(speed))

    def window(self, k: int, oldest: tuple[Array, Array]) -> Array:
        """Take up the samples of window k; mean square of its innovations over that of the noise, (B,).

        oldest : mean and variance (B,) of the strength that leaves the lag
        """
        before, usual = self.root, self.excess
        ratio = self._taken(k, oldest)
        found = usual * ratio
        if (ratio > OUTLYING).any():
            self.root, self.excess = before, np.where(ratio > OUTLYING, found, usual)
            self._taken(k, oldest)
        self.excess = np.maximum(usual * (1 + EXCESS_GAIN * (np.minimum(ratio, EXCESS_STEP) - 1)), 1.0)
        return found

    def _taken(self, k: int, oldest: tuple[Array, Array]) -> Array:
        """Mean square of the innovations of window k over the variance that they are taken up with, (B,)."""
        squares = self._segment(k, 0, oldest)
        for m in range(1, self.segments.rows.shape[2]):
            squares = squares + self._segment(k, m, None)
        samples = self.segments.samples[:, k].sum(axis=-1)
        return np.where(samples > 0, squares / np.maximum(samples, 1), 1.0)

    def strengths(self) -> tuple[Array, Array]:
        """What the samples tell of the last strengths s: |R s - r|² of R (B, lag + 1, lag + 1) and r (B, lag + 1)."""
        return self.root[:, self.nz :, self.nz : -1], self.root[:, self.nz :, -1]

    def _segment(self, k: int, m: int, oldest: tuple[Array, Array] | None) -> Array:
        """One QR: columns [strength that leaves, noises, state, strengths | right side]; squared remainder (B,)."""
        nz, size, gone = self.nz, self.root.shape[1], int(oldest is not None)
        rows, add = self.segments.rows[:, k, m], self.segments.add[:, k, m]
        r, left = rows.shape[1], gone + NOISES
        total = size + gone + r
        stack = np.zeros((len(self.root), total + NOISES, left + size + 1))
        state, newest = slice(left, left + nz), left + size - 1
        if oldest is None:
            stack[:, :size, left:] = self.root
        else:
            mean, variance = oldest
            stack[:, :size, 0] = self.root[:, :, nz]
            stack[:, :size, state] = self.root[:, :, :nz]
            stack[:, :size, left + nz : newest] = self.root[:, :, nz + 1 : -1]
            stack[:, :size, -1] = self.root[:, :, -1]
            stack[:, size, 0] = 1 / np.sqrt(variance)
            stack[:, size, -1] = mean / np.sqrt(variance)
        taken = stack[:, size + gone : total]
        taken[:, :, state] = rows[:, :, :nz]
        for span in range(self.spans):
            taken[:, :, newest - span] = rows[:, :, nz + span]
        taken[:, :, -1] = rows[:, :, -1]
        taken /= np.sqrt(self.excess)[:, None, None]
        # new state = move (old) + add (known, gas, strengths) + noise, solved for the old one
        whole = np.zeros((len(rows), nz, nz))
        whole[:, :-1, :-1] = self.segments.move[:, k, m]
        whole[:, :-1, -1] = add[:, :, 1]
        whole[:, -1, -1] = 1.0
        back = stack[:, :total, state] @ np.linalg.inv(whole)
        stack[:, :total, state] = back
        stack[:, :total, gone:left] = -back[:, :, -NOISES:]
        given = back[:, :, :-1] @ add
        stack[:, :total, -1] += given[:, :, 0]
        for span in range(self.spans):
            stack[:, :total, newest - span] -= given[:, :, 2 + span]
        noise = np.tile(self.noise, (len(rows), 1))
        seconds = self.segments.seconds[:, k, m]
        noise[:, 2] = self.disturbances.road * np.sqrt(-np.expm1(-2 * self.plant.road_decay * seconds))
        each = np.arange(NOISES)
        stack[:, total + each, gone + each] = 1 / noise
        triangle: Array = np.asarray(np.linalg.qr(stack, mode="r"))
        self.root = triangle[:, left : left + size, left:]
        return triangle[:, left + size, -1] ** 2


class Decision:
    """Probabilities of the last combustions from their strengths, by Bayes, for all ways in which some are lost."""

    def __init__(self, prior: Prior, lag: int) -> None:
        self.prior, self.lag = prior, lag
        ways = np.arange(2 ** (lag + 1))
        self.burns = 1.0 - ((ways[:, None] >> np.arange(lag, -1, -1)) & 1)  # (H, lag + 1), oldest first
        lost = (1 - self.burns).sum(axis=1)
        self.weight = lost * np.log(prior.lost) + (lag + 1 - lost) * np.log1p(-prior.lost)

    def probabilities(self, root: Array, right: Array, level: Array) -> Array:
        """(B, lag + 1) that each of the last combustions was lost, oldest first; level (B,) the usual strength."""
        size = self.lag + 1
        spread = (
            self.prior.scatter**2 * np.eye(size)
            + LEVEL_DOUBT**2 * self.burns[:, :, None] * self.burns[:, None]
        )
        scaled = root * level[:, None, None]
        seen = scaled[:, None]  # (B, 1, L, L)
        covariance = np.eye(size) + seen @ spread @ seen.swapaxes(-1, -2)
        off = right[:, None] - self.burns @ scaled.swapaxes(-1, -2)
        lower = np.linalg.cholesky(covariance)
        white = np.linalg.solve(lower, off[..., None])[..., 0]
        likely = self.weight - 0.5 * np.sum(white**2, axis=-1)
        likely -= np.sum(np.log(np.diagonal(lower, axis1=-2, axis2=-1)), axis=-1)
        share = np.exp(likely - likely.max(axis=1, keepdims=True))
        share /= share.sum(axis=1, keepdims=True)
        return share @ (1 - self.burns)

    def oldest(self, root: Array, right: Array, level: Array, lost: Array) -> tuple[Array, Array]:
        """Strength of the oldest combustion and its standard error, (B,), by the samples and the others' sizes."""
        mean, variance = self.expected(level[:, None], lost)
        known = 1 / variance
        known[:, 0] = 0.0
        information = root.swapaxes(-1, -2) @ root
        each = np.arange(self.lag + 1)
        information[:, each, each] += known + 1e-9
        covariance = np.linalg.inv(information)
        pull = (root.swapaxes(-1, -2) @ right[..., None])[..., 0] + known * mean
        return np.einsum("bi,bi->b", covariance[:, 0], pull), np.sqrt(covariance[:, 0, 0])

    def alone(self, root: Array, right: Array) -> Array:
        """Strength of the oldest combustion (B,) by the samples alone."""
        information = root.swapaxes(-1, -2) @ root + 1e-6 * np.eye(self.lag + 1)  # where samples are missing
        found = np.linalg.solve(information, root.swapaxes(-1, -2) @ right[..., None])
        return np.asarray(found[:, 0, 0], dtype=np.float64)

    def expected(self, level: Array, lost: Array) -> tuple[Array, Array]:
        """Mean and variance of a strength that is lost with this probability."""
        spread = self.prior.scatter**2 + (1 - lost) * LEVEL_DOUBT**2 + lost * (1 - lost)
        return (1 - lost) * level, spread * level**2


@dataclass(frozen=True, eq=False)
class Found:
    """For every window, (B, K): probability to be lost, strength with standard error, usual strength [1].

    misfit : mean square of the innovations over that of the noise, 1 where the model and its noise are right
    """

    lost: Array
    strength: Array
    stderr: Array
    level: Array
    misfit: Array


def smooth(plant: Plant, disturbances: Disturbances, prior: Prior, segments: Segments, speed: Array, *, lag: int,
           first_look: int) -> Found:  # fmt: skip
    """Decide every combustion of B records that begin at these speeds (B,)."""
    decision = Decision(prior, lag)
    windows = segments.rows.shape[1]
    records = len(speed)
    flat = np.ones(records), np.full(records, WIDE**2)
    excess = np.ones(records)
    for _ in range(2):  # again with the noise that the first look found
        smoother = Smoother(plant, disturbances, segments, lag=lag, speed=speed)
        smoother.excess, seen, squares = excess, [], []
        for k in range(min(first_look + lag, windows)):
            squares.append(smoother.window(k, flat))
            if k >= lag:
                seen.append(decision.alone(*smoother.strengths()))
        excess = np.maximum(np.median(squares, axis=0), 1.0)
    # The usual strength at first: what most of the strong half of the first combustions make.
    level = np.maximum(np.quantile(np.array(seen), 0.75, axis=0), LEAST_LEVEL)
    smoother = Smoother(plant, disturbances, segments, lag=lag, speed=speed)
    smoother.excess = excess
    out = Found(np.zeros((records, windows)), *[np.full((records, windows), np.nan) for _ in range(4)])
    oldest = flat
    for k in range(windows):
        out.misfit[:, k] = smoother.window(k, oldest)
        root, right = smoother.strengths()
        lost = decision.probabilities(root, right, level)
        strength, stderr = decision.oldest(root, right, level, lost)
        oldest = decision.expected(level, lost[:, 0]) if k >= lag else flat
        if k >= lag:
            at = k - lag
            out.lost[:, at], out.strength[:, at] = lost[:, 0], strength
            out.stderr[:, at], out.level[:, at] = stderr, level
            trust = (1 - lost[:, 0]) * LEVEL_GAIN / (1 + (stderr / (LEVEL_DOUBT * level)) ** 2)
            level = np.maximum(level + trust * (strength - level), LEAST_LEVEL)
    # The last ones are decided with what there is.
    for place in range(1, min(lag, windows - 1) + 1):
        out.lost[:, windows - 1 - lag + place] = lost[:, place]
        out.level[:, windows - 1 - lag + place] = level
    return out
