"""An independent simulator: SciPy's DOP853 between the knots of the inputs, dry friction by events.

It shares nothing with the package. Inputs are straight lines between samples. Dry friction is met as it is: a sliding
body slides until its speed is zero, and one at rest stays there as long as friction can hold it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

RELATIVE, ABSOLUTE = 1e-9, 1e-11
# A change of slope of an input that is rounding and no knot, as a share of its largest value.
_STRAIGHT = 1e-9
_SWITCHES = 20_000


@dataclass(frozen=True)
class Dry:
    """Dry friction: it opposes the speed ``row @ x`` with ``level(x)``, and holds it at zero up to that.

    `weight` : what a friction of 1 adds to the rates of all states, (n,)
    """

    row: Sequence[float]
    weight: Sequence[float]
    level: Callable[[np.ndarray], float]


class Inputs:
    """Inputs by name as straight lines between samples; ``at(t)`` gives a dict."""

    def __init__(self, time: np.ndarray, values: Mapping[str, np.ndarray]):
        self.time, self.values = time, {name: np.asarray(one, float) for name, one in values.items()}

    def at(self, t: float) -> dict[str, float]:
        k = min(max(int(np.searchsorted(self.time, t, side="right")) - 1, 0), len(self.time) - 2)
        share = (t - self.time[k]) / (self.time[k + 1] - self.time[k])
        return {name: one[k] + share * (one[k + 1] - one[k]) for name, one in self.values.items()}

    def knots(self) -> np.ndarray:
        """Indices of samples at which an input changes its slope."""
        bent = np.zeros(len(self.time), bool)
        for one in self.values.values():
            slope = np.diff(one) / np.diff(self.time)
            bent[1:-1] |= np.abs(np.diff(slope)) > _STRAIGHT * max(np.abs(slope).max(), 1e-300)
        return np.flatnonzero(bent)


class Mode:
    """What every dry friction does now: −1 or 1 for sliding that way, 0 for sticking."""

    def __init__(self, rate: Callable, inputs: Inputs, dry: Sequence[Dry]):
        self.rate, self.inputs, self.dry = rate, inputs, dry
        self.rows = np.array([one.row for one in dry], float)
        self.weights = np.array([one.weight for one in dry], float)
        self.state = np.zeros(len(dry), int)

    def forces(self, free: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Every friction's force; those that stick take what holds their speeds, whatever it needs."""
        found = np.array([-s * one.level(x) for s, one in zip(self.state, self.dry, strict=True)])
        stuck = np.flatnonzero(self.state == 0)
        if len(stuck):
            rows = self.rows[stuck]
            pushed = free + found @ self.weights
            found[stuck] = -np.linalg.solve(rows @ self.weights[stuck].T, rows @ pushed)
        return found

    def slope(self, t: float, x: np.ndarray) -> np.ndarray:
        free = np.asarray(self.rate(t, x, self.inputs.at(t)), float)
        return free if not self.dry else free + self.forces(free, x) @ self.weights

    def events(self) -> list[Callable]:
        """One a friction: its speed crosses zero, or what it has to hold exceeds what it can."""
        made = []
        for k, one in enumerate(self.dry):
            if self.state[k]:

                def crossing(t: float, x: np.ndarray, k: int = k) -> float:
                    return float(self.rows[k] @ x)

                crossing.direction = -float(self.state[k])  # type: ignore[attr-defined]
            else:

                def crossing(t: float, x: np.ndarray, k: int = k, one: Dry = one) -> float:
                    free = np.asarray(self.rate(t, x, self.inputs.at(t)), float)
                    return abs(self.forces(free, x)[k]) - one.level(x)

                crossing.direction = 1.0  # type: ignore[attr-defined]
            crossing.terminal = True  # type: ignore[attr-defined]
            made.append(crossing)
        return made

    def settle(self, t: float, x: np.ndarray, which: Sequence[int]) -> None:
        """What the frictions `which` do next, at zero speed: stick if they can hold, else slide as pushed."""
        for k in which:
            self.state[k] = 0
        free = np.asarray(self.rate(t, x, self.inputs.at(t)), float)
        for k in which:
            need = self.forces(free, x)[k]
            if abs(need) >= self.dry[k].level(x) * (1 - 1e-12):
                self.state[k] = -int(np.sign(need))


def simulate(
    rate: Callable[[float, np.ndarray, Mapping[str, float]], Sequence[float]],
    start: Sequence[float],
    time: np.ndarray,
    inputs: Mapping[str, np.ndarray],
    *,
    dry: Sequence[Dry] = (),
    breaks: Sequence[float] = (),
) -> np.ndarray:
    """States (N, n) at `time` of ẋ = rate(t, x, inputs by name), with dry friction added.

    breaks : instants at which `rate` jumps
    """
    time = np.asarray(time, float)
    given = Inputs(time, inputs)
    ends = np.unique([*time[given.knots()], time[-1], *(b for b in breaks if time[0] < b < time[-1])])
    mode, x, t = Mode(rate, given, dry), np.array(start, float), float(time[0])
    mode.state[:] = [int(np.sign(value)) for value in mode.rows @ x] if dry else []
    if dry:
        mode.settle(t, x, [k for k in range(len(dry)) if mode.state[k] == 0])
    found = np.empty((len(time), len(x)))
    found[0], switches = x, 0
    for end in ends:
        while t < end:
            inside = time[(time > t) & (time <= end)]
            points = inside if len(inside) and inside[-1] == end else np.append(inside, end)
            done = solve_ivp(
                mode.slope, (t, end), x, method="DOP853", t_eval=points, events=mode.events() or None,
                rtol=RELATIVE, atol=ABSOLUTE,
            )  # fmt: skip
            if done.status < 0:
                raise ArithmeticError(f"the simulator stops at {t:g} s: {done.message}")
            reached = np.isin(done.t, inside)
            if reached.any():
                found[np.searchsorted(time, np.asarray(done.t)[reached])] = done.y.T[reached]
            if done.status == 0:
                t, x = float(end), done.y[:, -1]
                continue
            hit = next(k for k, one in enumerate(done.t_events) if len(one))
            t, x = float(done.t_events[hit][0]), done.y_events[hit][0]
            switches += 1
            if switches > _SWITCHES:
                raise ArithmeticError(f"the simulator switches without end at {t:g} s")
            if mode.state[hit]:
                x = _at_zero(x, mode.rows[hit])
                mode.settle(t, x, [hit])
            else:
                free = np.asarray(rate(t, x, given.at(t)), float)
                mode.state[hit] = -int(np.sign(mode.forces(free, x)[hit]))
    return found


def _at_zero(x: np.ndarray, row: np.ndarray) -> np.ndarray:
    """The state with this speed exactly zero: what is left of it is rounding."""
    return x - row * (row @ x) / (row @ row)
