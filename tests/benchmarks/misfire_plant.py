"""Long records of a misfiring engine, many at once, for the large numbers of the misfire study.

The simulator's shaft, pressures and unequal cylinders, in fixed steps: the shaft is solved exactly with torques that
are linear over a step. `test_misfire_study.py` holds it against the simulator. In addition a governor keeps the speed,
the road shakes the load, and loads are switched at the engine.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import expm

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "data"))

from simulator import simulate
from simulator.engine import TDC, Engine
from simulator.geometry import CYCLE, cylinder_torque
from simulator.pressure import Cylinders, event_number, pressure, unequal_cylinders
from simulator.run import Plant, warm_up
from simulator.shaft import Shaft, two_mass_shaft

CELLS = 7200
FILTER = 0.1  # s, in which the governor sees speed and loads at the engine


@dataclass(frozen=True)
class Shaking:
    """Torques that are not combustion [N m]: rough road (rms, corner [Hz]) and jolts on the load, steps at the engine.

    impulse, impulse_rate : largest height of half sines of 30 ms, and how many come in a second
    step, step_rate : a load of this size at the engine, and how often in a second it is switched on or off
    """

    road: float = 0.0
    road_hz: float = 10.0
    impulse: float = 0.0
    impulse_rate: float = 1.0
    step: float = 0.0
    step_rate: float = 1.0

    def torques(self, count: int, h: float, records: int, random: np.random.Generator):
        """Braking torques (count, 2, records) on the engine and on the load; first sample zero."""
        made = np.zeros((count, 2, records))
        decay = np.exp(-2 * np.pi * self.road_hz * h)
        if self.road:
            made[:, 1] = random.standard_normal((count, records)) * self.road * np.sqrt(1 - decay**2)
            for k in range(1, count):
                made[k, 1] += decay * made[k - 1, 1]
        shape = np.sin(np.pi * np.arange(1, round(0.03 / h)) * h / 0.03)
        for run in range(records):
            if self.impulse:
                for at in random.integers(0, count, random.poisson(count * h * self.impulse_rate)):
                    long = min(len(shape), count - at)
                    made[at : at + long, 1, run] += random.uniform(-1, 1) * self.impulse * shape[:long]
            if self.step:
                switches = random.uniform(size=count) < h * self.step_rate
                made[:, 0, run] += self.step * (np.cumsum(switches) % 2)
        return made


def simulate_long(
    rpm: float,
    load: float,
    lost: np.ndarray,
    *,
    seed: int,
    shaft: Shaft | None = None,
    rate: float = simulate.SAMPLE_RATE,
    sigma: float = 0.1,
    scatter: float = 0.02,
    shaking: Shaking | None = None,
    governor: float | None = 2.0,
    cylinders: Cylinders | None = None,
    sweep: Callable[[float], float] | None = None,
    seconds: float | None = None,
):
    """theta and omega (records, N) of an engine whose combustions `lost` (records, 4, cycles + 2) do not burn.

    governor : seconds in which it brings back the speed, None for none
    sweep : the governed speed as a function of time [RPM]; seconds : length of the records, left out that of the cycles
    """
    shaft, people = (
        two_mass_shaft() if shaft is None else shaft,
        unequal_cylinders() if cylinders is None else cylinders,
    )
    shaking = Shaking() if shaking is None else shaking
    random = np.random.default_rng(seed)
    records, _, events = lost.shape
    factors = people.strength[:, None] * (1 + scatter * random.standard_normal(lost.shape)) * ~lost
    one = Engine(people, np.ones((4, 3)) * people.strength[:, None])
    engine, state = warm_up(Plant(shaft, one, lambda _t: load), rpm * np.pi / 30)
    strength = engine.strength / (1 - lost.mean(axis=(1, 2)) if governor else 1.0)
    h, n = 1 / rate, shaft.size
    count = round(rate * ((events - 2) * 120 / rpm if seconds is None else seconds))
    outside = shaking.torques(count, h, records, random)
    outside[:, 1] += load
    enter = np.column_stack([shaft.torque_columns(), np.zeros((2 * n, 2))])
    enter[1, 4], enter[n, 5] = -1 / shaft.inertia[0], -1 / shaft.inertia[-1]
    move, held, ramp = _first_order_hold(shaft.matrix(), enter, h)
    table = _table(people)
    throws = list(shaft.throws)
    angles, spins = shaft.angle_rows()[throws], 1 + np.array(throws)
    x = np.tile(state[:, None], (1, records))
    theta, omega = np.empty((records, count)), np.empty((records, count))
    slow, asked = np.full(records, state[1]), np.zeros(records)
    usual = load + shaft.absolute_damping.sum() * state[1]
    motored = engine.mean_torque(0.0)
    before = None
    event = np.zeros((4, records), dtype=int)
    burn = strength * factors[:, :, 0].T
    every = np.arange(records)
    for k in range(count):
        at, turning = angles @ x, x[spins]
        number = np.clip(event_number(at - TDC[:, None]).astype(int), 0, events - 1) if k % 8 == 0 else event
        fresh = number != event
        if fresh.any():
            target, later = (
                (state[1], state[1])
                if sweep is None
                else np.pi / 30 * np.array([sweep(k * h), sweep(k * h + 1)])
            )
            back = (target - slow) / governor if governor else 0.0
            more = (asked + shaft.inertia.sum() * (back + later - target)) * bool(governor)
            more += shaft.absolute_damping.sum() * (target - state[1])
            now = strength * np.clip(1 + more / (usual - motored), 0.1, 3.0)
            drawn = factors[every, np.arange(4)[:, None], number]
            burn, event = np.where(fresh, now * drawn, burn), number
        slow += h / FILTER * (turning[0] - slow)
        asked += h / FILTER * (outside[k, 0] - asked)
        inputs = np.concatenate([_torques(table, at, turning, burn), outside[k]])
        if before is not None:
            x = x + ramp @ (inputs - before)  # the end of the step before, of which only the start was known
        theta[:, k], omega[:, k] = x[0], x[1]
        before = inputs
        x = move @ x + (held + ramp) @ inputs
    return theta, omega + sigma * random.standard_normal(omega.shape)


def _first_order_hold(matrix: np.ndarray, enter: np.ndarray, h: float):
    """x+ = move x + held u + ramp u+, exactly for inputs that are linear over the step."""
    n, m = enter.shape
    whole = np.zeros((n + 2 * m, n + 2 * m))
    whole[:n, :n], whole[:n, n : n + m] = matrix * h, enter * h
    whole[n : n + m, n + m :] = np.eye(m)
    made = expm(whole)
    ramp = made[:n, n + m :]
    return made[:n, :n], made[:n, n : n + m] - ramp, ramp


def _table(people: Cylinders) -> np.ndarray:
    """(4, CELLS, 3): torque of the motored cylinder, of its mass per speed squared, and of 1 Pa burned."""
    angle = np.arange(CELLS) * CYCLE / CELLS
    rows = []
    for c in range(4):
        local, shape = angle - TDC[c], (people.intake[c], people.delay[c])
        motored = cylinder_torque(local, 0 * angle, pressure(local, 0.0, *shape))
        squared = cylinder_torque(local, 0 * angle + 1, pressure(local, 0.0, *shape)) - motored
        burned = (cylinder_torque(local, 0 * angle, pressure(local, 1e6, *shape)) - motored) / 1e6
        rows.append(np.stack([motored, squared, burned], axis=-1))
    return np.array(rows)


def _torques(table: np.ndarray, at: np.ndarray, turning: np.ndarray, burn: np.ndarray) -> np.ndarray:
    place = at * (CELLS / CYCLE)
    cell = np.floor(place)
    share = (place - cell)[..., None]
    cell = cell.astype(int) % CELLS
    which = np.arange(4)[:, None]
    value = table[which, cell] * (1 - share) + table[which, (cell + 1) % CELLS] * share
    return value[..., 0] + value[..., 1] * turning**2 + value[..., 2] * burn
