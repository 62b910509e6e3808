"""The engine of one record: unequal cylinders, cycle-to-cycle scatter, misfire, and the torques they make."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .geometry import CYCLE, cylinder_torque, tdc_angles
from .pressure import Cylinders, event_number, pressure

ALL_CYCLES = "all"
TDC = tdc_angles()


@dataclass(frozen=True)
class Engine:
    """`factors` (4, events): burn strength of cylinder c in event k is `strength * factors[c - 1, k]`.

    Event k >= 1 is the k-th combustion of a cylinder in the record; event 0 is the one before the record, and
    stands for every event of the warm-up as well.
    """

    cylinders: Cylinders
    factors: np.ndarray
    strength: float = 1.0e6

    def pressures(self, angle: np.ndarray, law_of: Sequence[int] = (1, 2, 3, 4)) -> np.ndarray:
        """Absolute pressures [Pa] at the crank angles (4, N) of the throws.

        Place c burns with the law and the events of cylinder `law_of[c - 1]`: its own, unless one asks what a
        shifted pressure would be.
        """
        rows = np.asarray(law_of)[:, None] - 1
        local = angle - TDC[:, None]
        event = np.clip(event_number(local).astype(int), 0, self.factors.shape[1] - 1)
        strength = self.strength * self.factors[rows, event]
        return pressure(local, strength, self.cylinders.intake[rows], self.cylinders.delay[rows])

    def torques(self, angle: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Total torque of each cylinder (4, N) [N m] at its throw's own angle and speed."""
        return cylinder_torque(angle - TDC[:, None], speed, self.pressures(angle))

    def torque_law(self) -> Callable[[Sequence[float], Sequence[float]], list[float]]:
        """The same torques at one instant, as a fast function of four angles and four speeds."""
        strength = (self.strength * self.factors).tolist()
        tdc, intake, delay = TDC.tolist(), self.cylinders.intake.tolist(), self.cylinders.delay.tolist()
        last = self.factors.shape[1] - 1

        def law(angles: Sequence[float], speeds: Sequence[float]) -> list[float]:
            torques = []
            for c in range(4):
                local = angles[c] - tdc[c]
                event = min(max(int(event_number(local)), 0), last)
                inside = pressure(local, strength[c][event], intake[c], delay[c], math)
                torques.append(cylinder_torque(local, speeds[c], inside, math))
            return torques

        return law

    def with_strength(self, strength: float) -> "Engine":
        return replace(self, strength=strength)

    def before_record(self) -> "Engine":
        """The same engine repeating its event 0 for ever: the mean cycle, used to warm up."""
        return replace(self, factors=self.factors[:, :1])

    def mean_torque(self, strength: float) -> float:
        """Mean torque of the mean cycle at constant speed [N m], by the periodic trapezoidal rule."""
        angle = np.tile(np.arange(7200) * CYCLE / 7200, (4, 1))
        engine = self.before_record().with_strength(strength)
        return float(engine.torques(angle, np.zeros_like(angle)).sum(axis=0).mean())

    def strength_for(self, torque: float) -> float:
        """Burn strength [Pa] that makes the mean cycle deliver `torque` [N m] on average (it is linear)."""
        motored, unit = self.mean_torque(0.0), 1.0e6
        return unit * (torque - motored) / (self.mean_torque(unit) - motored)


def burn_factors(
    cylinders: Cylinders,
    *,
    cycles: int,
    scatter: float = 0.02,
    seed: int = 0,
    misfire: Mapping[int, str | Sequence[int]] | None = None,
) -> np.ndarray:
    """Strength factors (4, cycles + 2): imbalance times scatter, 0 where a cylinder misfires.

    `misfire` maps a cylinder (1..4) to "all" or to the cycles (1, 2, ...) that do not burn.  The scatter's
    mean over the burning events is taken out, so that a record ends about as fast as it began.
    """
    drawn = np.random.default_rng(seed).standard_normal((4, cycles + 1))
    burns = np.ones((4, cycles + 2))
    for cylinder, which in (misfire or {}).items():
        burns[cylinder - 1, _silent_events(cylinder, which, cycles)] = 0.0
    inside = burns[:, 1:-1] > 0.0
    drawn -= drawn[:, :-1][inside].mean() if inside.any() else 0.0
    factors = np.ones((4, cycles + 2))
    factors[:, 1:] += scatter * drawn
    return cylinders.strength[:, None] * factors * burns


def _silent_events(cylinder: int, which: str | Sequence[int], cycles: int) -> list[int]:
    if cylinder not in (1, 2, 3, 4):
        raise ValueError(f"misfire of cylinder {cylinder!r}: there are cylinders 1..4")
    if which == ALL_CYCLES:
        return list(range(cycles + 2))
    if isinstance(which, str) or not all(1 <= cycle <= cycles for cycle in which):
        raise ValueError(f"misfire of cylinder {cylinder} in {which!r}: give 'all' or a list of 1..{cycles}")
    return list(which)
