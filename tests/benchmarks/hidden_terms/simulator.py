"""An independent simulator: SciPy's DOP853 between the knots of the inputs, dry friction by events.

It shares nothing with the package. Inputs are straight lines between samples. Dry friction is met as it is: a sliding
body slides until its speed is zero, and one at rest stays there as long as friction can hold it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

RELATIVE, ABSOLUTE = 1e-9, 1e-11
# A change of slope of an input that is rounding and no knot, as a share of its largest value.
_STRAIGHT = 1e-9
_SWITCHES = 20_000
# Share of a sample after a switch in which none is looked for: a speed that starts at zero would count as crossing it.
_BLIND = 1e-4
# What is at rest is held a little longer than its friction can, so that it breaks away in the right direction.
_HELD = 1e-9


@dataclass(frozen=True)
class Dry:
    """Dry friction: it opposes the speed ``row @ x`` with ``level(x)``, and holds it at zero up to that.

    weight : what a friction of 1 adds to the rates of all states, (n,), or a function of the states
    """

    row: Sequence[float]
    weight: Sequence[float] | Callable[[np.ndarray], Sequence[float]]
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
        self.state = np.zeros(len(dry), int)

    def weights(self, x: np.ndarray) -> np.ndarray:
        """What a friction of 1 adds to the rates, one a row."""
        return np.array([one.weight(x) if callable(one.weight) else one.weight for one in self.dry], float)

    def forces(self, free: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Every friction's force; those that stick take what holds their speeds, whatever it needs."""
        found = np.array([-s * one.level(x) for s, one in zip(self.state, self.dry, strict=True)])
        stuck = np.flatnonzero(self.state == 0)
        if len(stuck):
            rows, weights = self.rows[stuck], self.weights(x)
            pushed = free + found @ weights
            found[stuck] = -np.linalg.solve(rows @ weights[stuck].T, rows @ pushed)
        return found

    def free(self, t: float, x: np.ndarray) -> np.ndarray:
        """The rates without dry friction."""
        return np.asarray(self.rate(t, x, self.inputs.at(t)), float)

    def slope(self, t: float, x: np.ndarray) -> np.ndarray:
        free = self.free(t, x)
        return free if not self.dry else free + self.forces(free, x) @ self.weights(x)

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
                    return abs(self.forces(self.free(t, x), x)[k]) - (1 + _HELD) * one.level(x)

                crossing.direction = 1.0  # type: ignore[attr-defined]
            crossing.terminal = True  # type: ignore[attr-defined]
            made.append(crossing)
        return made

    def late(self, t: float, x: np.ndarray) -> list[int]:
        """The frictions that should have switched: sliding the other way by now, or holding more than they can."""
        if not self.dry:
            return []
        speeds, found = self.rows @ x, self.forces(self.free(t, x), x)
        return [
            k
            for k, one in enumerate(self.dry)
            if (
                self.state[k] * speeds[k] < 0 if self.state[k] else abs(found[k]) > (1 + _HELD) * one.level(x)
            )
        ]

    def settle(self, t: float, x: np.ndarray, which: Sequence[int]) -> None:
        """What the frictions `which` do next, at zero speed: stick if they can hold, else slide as pushed."""
        for k in which:
            self.state[k] = 0
        for k in which:
            need = self.forces(self.free(t, x), x)[k]
            if abs(need) > (1 + _HELD) * self.dry[k].level(x):
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
    mode.state[:] = np.sign(mode.rows @ x) if dry else []
    mode.settle(t, x, np.flatnonzero(mode.state == 0))
    blind = t + _BLIND * float(np.diff(time).min())
    found, switches = np.empty((len(time), len(x))), 0
    found[0] = x
    for end in map(float, ends):
        while t < end:
            goal, events = (min(end, blind), []) if dry and t < blind else (end, mode.events())
            inside = time[(time > t) & (time <= goal)]
            points = inside if len(inside) and inside[-1] == goal else np.append(inside, goal)
            done = solve_ivp(
                mode.slope, (t, goal), x, method="DOP853", t_eval=points, events=events or None, rtol=RELATIVE,
                atol=ABSOLUTE,
            )  # fmt: skip
            if done.status < 0:
                raise ArithmeticError(f"the simulator stops at {t:g} s: {done.message}")
            reached = np.isin(done.t, inside)
            if reached.any():
                found[np.searchsorted(time, np.asarray(done.t)[reached])] = done.y.T[reached]
            if done.status == 0:
                t, x = goal, done.y[:, -1]
                turned = [] if events else mode.late(t, x)
            else:
                turned = [k for k, one in enumerate(done.t_events) if len(one)][:1]
                t, x = float(done.t_events[turned[0]][0]), done.y_events[turned[0]][0]
            if turned:
                for k in turned:
                    x = _at_zero(x, mode.rows[k])
                mode.settle(t, x, turned)
                blind = t + _BLIND * float(np.diff(time).min())
                switches += 1
            if switches > _SWITCHES:
                raise ArithmeticError(f"the simulator switches without end at {t:g} s")
    return found


def _at_zero(x: np.ndarray, row: np.ndarray) -> np.ndarray:
    """The state with this speed exactly zero: what is left of it is rounding."""
    return x - row * (row @ x) / (row @ row)


def delayed(time: np.ndarray, values: np.ndarray, delay: float) -> np.ndarray:
    """What a sensor that is late shows: the curve through the samples, `delay` earlier."""
    return values if delay == 0 else CubicSpline(time, values)(time - delay)
