"""Integrate many runs at once with fixed steps of order 5 or 8, and switch torques exactly where they switch.

A step is taken by all runs together. Where it passed a switch, it is taken again up to there by those runs alone,
the mode changes, and the rest follows; so the order of the method holds throughout.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import DOP853, RK45

from .shaft import Shaft
from .switches import Torque, signal_rows
from .torque_table import TorqueTable

# Runge-Kutta rules of Dormand and Prince. The short one is exact to 1e-11 rad/s where the shaft is slow against
# the step, |eigenvalue| h < SLOW; stiff shafts take the long one.
SHORT, LONG, SLOW = RK45, DOP853, 0.05
MOST_SWITCHES = 60  # of one run within one step
STICK_ITERATIONS = 6

Load = Callable[[np.ndarray], np.ndarray]


@dataclass
class Batch:
    """`width` runs of one shaft: the burn strengths (S, H, width, events) [Pa] and the torques of their effects."""

    shaft: Shaft
    table: TorqueTable
    load: Load
    strength: np.ndarray
    torques: list[Torque]
    width: int
    rule: type  # Runge-Kutta rule, see `rule_for`

    def __post_init__(self) -> None:
        shaft, throws = self.shaft, self.table.throws
        size = 2 * shaft.size
        self.signals = signal_rows(shaft)
        parts = [shaft.matrix(), shaft.angle_rows()[throws], np.eye(size)[1:][throws]]
        self._linear = np.vstack([*parts, self.signals] if self.torques else parts)
        self._give = 1.0 / shaft.inertia
        self._throws_give = self._give[throws][:, None]
        self._burning = self.strength[..., 0]
        self._stuck = [np.zeros(len(torque.runs)) for torque in self.torques]

    # ---- equation

    def burn(self, state: np.ndarray) -> None:
        """Look up the burn strengths of the combustions that the runs (2n, width) are in."""
        heads = len(self.table.throws)
        angle = (self._linear @ state)[2 * self.shaft.size :][:heads]
        event = np.clip(self.table.events(angle), 0, self.strength.shape[-1] - 1)
        self._burning = np.take_along_axis(self.strength, event[..., None], axis=-1)[..., 0]

    def rate(self, time: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Derivative (2n, width) of the states at `time` (width,)."""
        n, heads = self.shaft.size, len(self.table.throws)
        product = self._linear @ state
        rate, seen = product[: 2 * n], product[2 * n :]
        torque = self.table.torques(seen[:heads], seen[heads : 2 * heads], self._burning)
        rate[1 + self.table.throws] += torque * self._throws_give
        rate[n] -= self.load(time) * self._give[-1]
        signals = seen[2 * heads :]
        sticking = []
        for number, term in enumerate(self.torques):
            columns = term.columns
            self._act(rate, term, term.value(signals[term.signal, columns]))
            if term.rubs and not term.mode.all():
                sticking.append(number)
        for number in sticking:
            self._hold(rate, number)
        return rate

    def _act(self, rate: np.ndarray, term: Torque, value: np.ndarray) -> None:
        for inertia, lean in term.places:
            rate[1 + inertia, term.columns] += value * (lean * self._give[inertia])

    def _ease(self, term: Torque) -> float:
        """What a unit of the torque adds to the rate of what it sees."""
        return float(self.signals[term.signal, 1 : 1 + self.shaft.size] @ (term.lean * self._give))

    def _hold(self, rate: np.ndarray, number: int) -> None:
        """Dry friction that sticks takes the torque that keeps its speed at zero."""
        term = self.torques[number]
        needed = -(self.signals[term.signal] @ rate[:, term.runs]) / self._ease(term)
        needed = np.where(term.mode == 0.0, needed, 0.0)
        self._stuck[number] = needed
        self._act(rate, term, needed)

    # ---- steps

    def step(
        self, time: np.ndarray, state: np.ndarray, first: np.ndarray, h: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """State after a step h (width,) in the present modes, and the derivative there."""
        self.burn(state)
        rule: Any = self.rule
        slopes = np.empty((rule.n_stages, *state.shape))
        slopes[0] = first
        flat = slopes.reshape(len(slopes), -1)
        for s in range(1, len(slopes)):
            moved = state + h * (rule.A[s, :s] @ flat[:s]).reshape(state.shape)
            slopes[s] = self.rate(time + rule.C[s] * h, moved)
        new = state + h * (rule.B @ flat).reshape(state.shape)
        return new, self.rate(time + h, new)

    def advance(
        self, time: np.ndarray, state: np.ndarray, first: np.ndarray, h: np.ndarray, depth: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """State after a step h >= 0 with all switches on the way, and the derivative there."""
        if depth > MOST_SWITCHES:
            raise RuntimeError(f"more than {MOST_SWITCHES} switches within one step at {time.min():.6f} s")
        new, last = self.step(time, state, first, h)
        share, which = self._first_switch(time, state, first, new, last, h)
        late = np.flatnonzero(np.isfinite(share))
        if not len(late):
            return new, last
        some = self.take(late)
        begun, part = time[late], share[late] * h[late]
        there, slope = some.step(begun, state[:, late], first[:, late], part)
        there, slope, part = some.land(begun, state[:, late], first[:, late], there, slope, part, which[late])
        some.switch(begun + part, there, which[late])
        again = some.rate(begun + part, there)
        end, end_slope = some.advance(begun + part, there, again, h[late] - part, depth + 1)
        new[:, late], last[:, late] = end, end_slope
        self.give_back(some, late)
        return new, last

    def land(
        self,
        time: np.ndarray,
        state: np.ndarray,
        first: np.ndarray,
        there: np.ndarray,
        slope: np.ndarray,
        part: np.ndarray,
        which: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Move from near the switch onto it, by Newton's rule; `which` (width,) are numbers in the batch before."""
        for _ in range(STICK_ITERATIONS):
            gap, speed = np.zeros(self.width), np.ones(self.width)
            loose = np.zeros(self.width, dtype=bool)
            for term in self.torques:
                mine = which[term.runs] == term.origin
                runs = term.runs[mine]
                if not len(runs):
                    continue
                row = self.signals[term.signal]
                seen, turning = row @ there[:, term.runs], row @ slope[:, term.runs]
                gap[runs] = term.gap(time[term.runs] + part[term.runs], seen)[mine]
                speed[runs] = _gap_rate(term, seen, turning)[mine]
                loose[runs] = (term.mode[mine] == 0.0) & term.rubs
            move = np.where((speed != 0.0) & ~loose, -gap / np.where(speed == 0.0, 1.0, speed), 0.0)
            if np.abs(move).max() < 1e-15:
                break
            part = np.maximum(part + move, 0.0)
            there, slope = self.step(time, state, first, part)
        return there, slope, part

    def _first_switch(
        self,
        time: np.ndarray,
        state: np.ndarray,
        first: np.ndarray,
        new: np.ndarray,
        last: np.ndarray,
        h: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """For each run the share of the step at which its first switch comes (nan: none), and whose it is."""
        share, which = np.full(self.width, np.nan), np.full(self.width, -1)
        if not any(term.switches for term in self.torques):
            return share, which
        before, after, leaving, arriving = (self.signals @ part for part in (state, new, first, last))
        for number, term in enumerate(self.torques):
            if not term.switches:
                continue
            runs, steps, columns = term.runs, h[term.columns], (term.signal, term.columns)
            seen0, seen1 = before[columns], after[columns]
            gap0, gap1 = term.gap(time[runs], seen0), term.gap(time[runs] + steps, seen1)
            turn0 = _gap_rate(term, seen0, leaving[columns]) * steps
            turn1 = _gap_rate(term, seen1, arriving[columns]) * steps
            found = np.full(len(runs), np.nan)
            look = (gap1 < 0.0) | ((turn0 < 0.0) & (turn1 > 0.0) & (gap0 > 0.0))
            for place in np.flatnonzero(look & (steps > 0.0)):
                found[place] = _root(gap0[place], gap1[place], turn0[place], turn1[place])
            if term.rubs and not term.mode.all():
                broken = (term.mode == 0.0) & (np.abs(self._stuck[number]) > term.limit(np.zeros(len(runs))))
                for place in np.flatnonzero(broken & (steps > 0.0)):
                    found[place] = self._breaking(number, place, time, state, first, h)
            earlier = np.isfinite(found) & ~(share[runs] <= found)
            share[runs[earlier]], which[runs[earlier]] = found[earlier], number
        return share, which

    def _breaking(
        self, number: int, place: int, time: np.ndarray, state: np.ndarray, first: np.ndarray, h: np.ndarray
    ) -> float:
        """The share of a step at which dry friction that sticks gives way: the secant rule within a bracket."""
        run = self.torques[number].runs[place : place + 1]
        some = self.take(run)
        which = next(k for k, t in enumerate(some.torques) if t.origin == number)

        def excess(share: float) -> float:
            some.step(time[run], state[:, run], first[:, run], share * h[run])
            term = some.torques[which]
            return float(np.abs(some._stuck[which][0]) - term.limit(np.zeros(1))[0])

        low, high, below, above = 0.0, 1.0, excess(0.0), excess(1.0)
        if below >= 0.0:
            return 0.0
        for _ in range(60):
            guess = high - above * (high - low) / (above - below)
            value = excess(guess)
            if abs(value) < 1e-12 or high - low < 1e-14:
                return guess
            if value > 0.0:
                high, above, below = guess, value, 0.5 * below
            else:
                low, below, above = guess, value, 0.5 * above
        return high

    def switch(self, time: np.ndarray, state: np.ndarray, which: np.ndarray) -> None:
        """Change modes where the state is on a switch; friction sticks if it can, and then its speed is 0.

        `which` (width,) are numbers of torques in the batch that this part was taken from.
        """
        for number, term in enumerate(self.torques):
            mine = which[term.runs] == term.origin
            if not mine.any():
                continue
            if not term.rubs:
                term.turn(mine, self.signals[term.signal] @ state[:, term.runs])
                continue
            stuck = mine & (term.mode == 0.0)
            term.mode[mine] = 0.0
            rest = self.signals[term.signal] @ state[:, term.runs] / self._ease(term)
            rest = np.where(mine & ~stuck, rest, 0.0)
            for inertia, lean in term.places:
                state[1 + inertia, term.runs] -= rest * (lean * self._give[inertia])
            self.rate(time, state)
            needed, limit = self._stuck[number], term.limit(np.zeros(len(term.runs)))
            slips = mine & (stuck | (np.abs(needed) > limit))
            term.mode[slips] = -np.sign(needed[slips])

    # ---- parts of a batch

    def take(self, runs: np.ndarray) -> "Batch":
        """The runs of these numbers as a batch of its own; its modes are copies."""
        where = np.full(self.width, -1)
        where[runs] = np.arange(len(runs))
        torques = []
        for number, term in enumerate(self.torques):
            mine = where[term.runs] >= 0
            if mine.any():
                made = replace(
                    term,
                    runs=where[term.runs[mine]],
                    size=term.size[mine],
                    more=term.more[mine],
                    mode=term.mode[mine],
                    origin=number,
                )
                torques.append(made)
        return replace(self, strength=self.strength[:, :, runs], torques=torques, width=len(runs))

    def give_back(self, some: "Batch", runs: np.ndarray) -> None:
        """Take over the modes of a part."""
        for number, term in enumerate(some.torques):
            mine = self.torques[term.origin]
            place = np.searchsorted(mine.runs, runs[term.runs])
            mine.mode[place] = term.mode
            self._stuck[term.origin][place] = some._stuck[number]

    def start(self, time: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Set all modes and return the first derivative."""
        for term in self.torques:
            term.start(time[term.runs], self.signals[term.signal] @ state[:, term.runs])
        self.burn(state)
        return self.rate(time, state)


def rule_for(shaft: Shaft, step: float) -> type:
    """The Runge-Kutta rule that a shaft needs at this step [s]."""
    fastest = float(np.abs(np.linalg.eigvals(shaft.matrix())).max())
    return SHORT if fastest * step < SLOW else LONG


def _gap_rate(term: Torque, seen: np.ndarray, turning: np.ndarray) -> np.ndarray:
    """Derivative by time of the event function of a torque."""
    if term.kind == "load_step":
        return np.where(term.mode == 0.0, -1.0, 0.0)
    if term.kind == "backlash":
        return np.where(term.mode == 0.0, -np.sign(seen), term.mode) * turning
    return term.mode * turning


def _root(gap0: float, gap1: float, turn0: float, turn1: float) -> float:
    """First zero in (0, 1] of the cubic with these values and slopes at 0 and 1; nan if it has none."""
    cubic = np.array(
        [2 * gap0 - 2 * gap1 + turn0 + turn1, 3 * (gap1 - gap0) - 2 * turn0 - turn1, turn0, gap0]
    )
    roots = np.roots(cubic)
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-9) & (roots.real <= 1.0 + 1e-9)]
    falling = [r for r in real if 3 * cubic[0] * r * r + 2 * cubic[1] * r + cubic[2] <= 0.0]
    if falling:
        return float(min(min(falling), 1.0))
    return 0.0 if gap1 < 0.0 else float("nan")
