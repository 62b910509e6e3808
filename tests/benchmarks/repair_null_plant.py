"""The two-mass plant without effects, in NumPy, and its refit to records that have effects: nothing of the package.

Records of the independent simulator drive it by their own crank angle, pressures and load. The refit is iterated
(Levenberg and Marquardt, slopes by central differences, parameters as logarithms within the bounds that
problems/two_mass.py gives a user), from several starts, for many records at once.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import lsq_linear

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "data"))

from simulator.engine import TDC
from simulator.geometry import cylinder_torque

NAMES = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
TRUTH = np.array([1 / 2.557, 1 / 5.646, 1992.0, 2.5, 0.1541])
LOW = np.array([0.05, 0.02, 200.0, 0.05, 0.005])
HIGH = np.array([4.0, 2.0, 20_000.0, 50.0, 5.0])
# Starts beside the truth, as factors: far more damping in the coupling; heavier and stiffer; lighter and softer; and
# a coupling so soft that it hides the load, light and damped or heavy.
STARTS = np.array(
    [
        [1, 1, 1, 1, 1],
        [1, 1, 1, 8, 1],
        [1, 3, 3, 1, 2],
        [1, 0.4, 0.4, 1, 0.5],
        [1, 0.3, 0.11, 18, 1],
        [1, 10, 0.11, 4, 1],
    ]
)
SIGMA = 0.1
_AROUND = np.array([1e-4] * 5 + [1e-3, 1e-3, 1e-5])
_UNIT = np.array([1.0] * 5 + [1.0, 1.0, 1e-2])
_ITERATIONS, _TOLERANCE = 60, 1e-3


@dataclass(frozen=True)
class Drives:
    """What drives the plant in R records: torques (K, R) at speed 0 and per speed squared, load (K, R), step [s]."""

    still: np.ndarray
    squared: np.ndarray
    load: np.ndarray
    step: float


def drives_of(records):
    """The drives of records of equal length and rate."""
    still, squared, load = [], [], []
    for record in records:
        angle = record["theta"][None] - TDC[:, None]
        pressures = np.stack([record[f"p{n}"] for n in (1, 2, 3, 4)])
        zero = np.zeros_like(angle)
        rest = cylinder_torque(angle, zero, pressures).sum(axis=0)
        still.append(rest)
        squared.append(cylinder_torque(angle, zero + 1.0, pressures).sum(axis=0) - rest)
        load.append(record["T_load"])
    time = records[0]["time"]
    return Drives(np.array(still).T, np.array(squared).T, np.array(load).T, float(2 * (time[1] - time[0])))


def driven(drives, which, parameters, first):
    """Speeds (2, B, K) of the plant at every second sample.

    which : (B,) records; parameters : (5, B); first : (3, B) speeds of engine and load, and twist
    """
    je, jl, k, c, d = parameters
    h, count = drives.step, (len(drives.load) + 1) // 2

    def torques(at):
        return drives.still[at][which], drives.squared[at][which], drives.load[at][which]

    def rate(x, torque):
        still, squared, load = torque
        spring = k * x[2] + c * (x[1] - x[0])
        engine = still + squared * x[0] ** 2 + spring - d * x[0]
        return np.stack([engine / je, -(spring + load) / jl, x[1] - x[0]])

    x = np.array(first, dtype=float)
    out = np.empty((2, x.shape[1], count))
    out[..., 0] = x[:2]
    end = torques(0)
    for step in range(1, count):
        begin, middle, end = end, torques(2 * step - 1), torques(2 * step)
        k1 = rate(x, begin)
        k2 = rate(x + h / 2 * k1, middle)
        k3 = rate(x + h / 2 * k2, middle)
        k4 = rate(x + h * k3, end)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        out[..., step] = x[:2]
    return out


@dataclass(frozen=True)
class Left:
    """What a refit leaves: mu, its norm in units of the noise; that of one linear refit from the truth; where."""

    mu: float
    linear: float
    values: dict
    at_bound: tuple
    converged: bool


def refitted(records, sensors, warm=None):
    """One `Left` for each record, the best of all starts.

    sensors : (R,) of how many sensors each record has, 1 or 2; warm : record -> parameters (5,), one more start
    """
    drives = drives_of(records)
    count = (len(drives.load) + 1) // 2
    keys = ("omega_true", "omega_load_true")
    measured = np.array([[r[key][::2][:count] for key in keys] for r in records])
    first = np.array([[r["states"][1, 0], r["states"][2, 0], r["states"][3, 0]] for r in records])
    problems = [(r, TRUTH * start) for r in range(len(records)) for start in STARTS]
    problems += [(r, start) for r, start in (warm or {}).items()]
    which = np.array([r for r, _ in problems])
    q = np.array([np.append(np.log(np.clip(p, LOW, HIGH)), first[r] / _UNIT[5:]) for r, p in problems])
    marquardt = _Marquardt(drives, measured, np.array(sensors), which, q)
    marquardt.run()
    return [marquardt.left(r) for r in range(len(records))]


class _Marquardt:
    """All refits side by side: those that are done are left out."""

    def __init__(self, drives, measured, sensors, which, q):
        self.drives, self.measured, self.sensors, self.which, self.q = drives, measured, sensors, which, q
        size = len(q)
        self.cost, self.damping = np.full(size, np.inf), np.full(size, 1e-4)
        self.done, self.linear = np.zeros(size, dtype=bool), np.full(size, np.nan)
        self.system = [None] * size  # R of the QR decomposition of [J | e]

    def run(self):
        """Iterate until no refit promises a further fall of chi-squared."""
        self._look(np.arange(len(self.q)), self.q.copy())
        for _ in range(_ITERATIONS):
            active = np.flatnonzero(~self.done)
            trial = self.q[active].copy()
            for row, problem in enumerate(active):
                move, promised = self._step(problem)
                trial[row] += move
                if promised < _TOLERANCE:
                    self.done[problem] = True
            go = ~self.done[active]
            if not go.any():
                return
            self._look(active[go], trial[go])

    def left(self, record):
        """The best refit of a record."""
        own = np.flatnonzero(self.which == record)
        best = own[np.argmin(self.cost[own])]
        values = np.exp(self.q[best, :5])
        near = (values < LOW * 1.001) | (values > HIGH * 0.999)
        return Left(
            float(np.sqrt(self.cost[best])),
            float(self.linear[own[0]]),
            dict(zip(NAMES, values.tolist(), strict=True)),
            tuple(name for name, at in zip(NAMES, near, strict=True) if at),
            bool(self.done[best]),
        )

    def _look(self, problems, q):
        """Chi-squared and slopes at q (B, 8); points that are better are taken."""
        columns = np.repeat(q[:, None], 17, axis=1)
        for j in range(8):
            columns[:, 1 + 2 * j, j] += _AROUND[j] / _UNIT[j]
            columns[:, 2 + 2 * j, j] -= _AROUND[j] / _UNIT[j]
        flat = columns.reshape(-1, 8)
        with np.errstate(all="ignore"):
            made = driven(
                self.drives,
                np.repeat(self.which[problems], 17),
                np.exp(flat[:, :5]).T,
                (flat[:, 5:] * _UNIT[5:]).T,
            )
        made = made.reshape(2, len(q), 17, -1)
        for row, problem in enumerate(problems):
            record = self.which[problem]
            sensors = self.sensors[record]
            own = made[:sensors, row]
            e = (self.measured[record, :sensors] - own[:, 0]).ravel() / SIGMA
            cost = float(e @ e) if np.isfinite(own).all() else np.inf
            if not cost < self.cost[problem]:
                self.damping[problem] *= 8
                self.done[problem] |= self.damping[problem] > 1e10 or not np.isfinite(self.cost[problem])
                continue
            slopes = (own[:, 1::2] - own[:, 2::2]) / 2 / SIGMA
            slopes = slopes.transpose(0, 2, 1).reshape(len(e), 8) / (_AROUND / _UNIT)
            self.system[problem] = np.linalg.qr(np.column_stack([slopes, e]), mode="r")
            if not np.isfinite(self.cost[problem]):
                self.linear[problem] = abs(self.system[problem][8, 8])
            self.cost[problem], self.q[problem] = cost, q[row]
            self.damping[problem] = max(self.damping[problem] / 8, 1e-9)

    def _step(self, problem):
        """The step within the bounds, and the fall of chi-squared that an undamped one promises."""
        slopes, right = self.system[problem][:8, :8], self.system[problem][:8, 8]
        size = np.linalg.norm(slopes, axis=0)
        low = np.append(np.log(LOW) - self.q[problem, :5], [-np.inf] * 3)
        high = np.append(np.log(HIGH) - self.q[problem, :5], [np.inf] * 3)
        low, high = np.minimum(low, -1e-12) * size, np.maximum(high, 1e-12) * size
        slopes = slopes / size

        def within(damping):
            rows = np.concatenate([slopes, np.sqrt(damping) * np.eye(8)])
            step = lsq_linear(rows, np.append(right, np.zeros(8)), (low, high), method="bvls").x
            return step, float(right @ right - np.sum((right - slopes @ step) ** 2))

        _, promised = within(1e-9)
        step, _ = within(self.damping[problem])
        return step / size, promised
