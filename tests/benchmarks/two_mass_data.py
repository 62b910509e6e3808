"""The record of benchmark A, made with NumPy and SciPy alone so that it owes nothing to the code under test.

Two masses with the nonlinear engine torque (4.1) are integrated by `solve_ivp` to a tight tolerance; the fit
then sees what a test bench gives: crank angle, four cylinder pressures, the load torque and a noisy speed.
`record` makes such a record for any seed; `read_record` takes one of the kept records instead.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]

MISFIRE_FILE = Path(__file__).parents[2] / "data" / "misfire_1200rpm.csv.gz"
SAMPLES = 14_400
RATE = 14_402.0
NOISE = 0.1
NAMES = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}

CRANK, ROD, PISTON_AREA, RECIPROCATING_MASS = 0.043, 0.145, 0.0058, 0.7
CRANKCASE_PRESSURE = 1.0e5
FIRING_ANGLE = np.pi * np.array([0.0, 3.0, 1.0, 2.0])  # combustion TDC of cylinders 1..4, order 1-3-4-2
COMPRESSION_RATIO, POLYTROPIC = 10.0, 1.32
MEAN_SPEED, MEAN_LOAD = 1200 * np.pi / 30, 57.0


@dataclass(frozen=True)
class Record:
    """One bench record and what made it.

    t : (N,) s; theta : (N,) rad; pressures : (4, N) Pa; torque_eng, torque_load : (N,) N m; y : (N,) rad/s
    """

    t: Array
    theta: Array
    pressures: Array
    torque_eng: Array
    torque_load: Array
    y: Array
    truth: dict[str, float]

    @property
    def step(self) -> float:
        """Sampling interval [s]."""
        return float((self.t[-1] - self.t[0]) / (self.t.size - 1))


def crank_factor(angle: Array) -> tuple[Array, Array]:
    """Crank-slider factor f (3.2) and df/dθ at `angle` [rad]."""
    ratio = CRANK / ROD
    sine, cosine = np.sin(angle), np.cos(angle)
    root = np.sqrt(1 - (ratio * sine) ** 2)
    slope = cosine + ratio * (cosine**2 - sine**2) / root + ratio**3 * (sine * cosine) ** 2 / root**3
    return sine + ratio * sine * cosine / root, slope


def engine_torque(theta: Array, pressures: Array, speed: Array) -> Array:
    """Summed torque of the cylinders (3.1), (3.5), (3.6) [N m]; pressures : (4, ...) Pa."""
    angle = theta - FIRING_ANGLE.reshape((4,) + (1,) * np.ndim(theta))
    factor, slope = crank_factor(angle)
    gas = (pressures - CRANKCASE_PRESSURE) * PISTON_AREA * CRANK * factor
    return (gas - RECIPROCATING_MASS * CRANK**2 * factor * slope * speed**2).sum(axis=0)


def _smooth_step(x: Array) -> Array:
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def cylinder_pressures(theta: Array, strength: Array) -> Array:
    """Absolute pressures (4, ...) [Pa] at crank angle `theta`; strength : (4, cycles) Pa, of combustion."""
    angle = theta - FIRING_ANGLE.reshape((4,) + (1,) * np.ndim(theta))
    cycle = np.floor(angle / (4 * np.pi) + 0.5)
    angle = angle - 4 * np.pi * cycle  # in [-2 pi, 2 pi), zero at the combustion TDC
    stroke = CRANK * (1 - np.cos(angle)) + ROD - np.sqrt(ROD**2 - (CRANK * np.sin(angle)) ** 2)
    clearance = 2 * CRANK / (COMPRESSION_RATIO - 1)
    volume = (stroke + clearance) / clearance
    closed = np.abs(angle) < np.pi  # at both ends volume is stationary, so pressure stays smooth there
    motored = CRANKCASE_PRESSURE * np.where(closed, (COMPRESSION_RATIO / volume) ** POLYTROPIC, 1.0)
    degrees = np.rad2deg(angle)
    burnt = -np.expm1(-5.0 * np.clip((degrees + 15.0) / 55.0, 0.0, None) ** 3)
    blow_down = 1 - _smooth_step((degrees - 120.0) / 60.0)
    rows = np.arange(4).reshape((4,) + (1,) * np.ndim(theta))
    height = strength[rows, cycle.astype(int) % strength.shape[1]]
    return motored + height * burnt * blow_down * volume**-POLYTROPIC


def load_torque(t: Array) -> Array:
    """Braking torque of the dynamometer [N m]: nearly constant, as after the bench's moving average."""
    return MEAN_LOAD * (1 + 0.010 * np.sin(2 * np.pi * 1.3 * t) + 0.005 * np.sin(2 * np.pi * 3.1 * t + 1.0))


def _combustion(rng: np.random.Generator, misfire: bool) -> Array:
    """Strengths (4, cycles) [Pa]: 3 % between cylinders, 2 % between cycles; cylinder 2 none on misfire."""
    relative = (1 + 0.03 * rng.standard_normal((4, 1))) * (1 + 0.02 * rng.standard_normal((4, 12)))
    if misfire:
        relative[1] = 0.0
    # The level holds the mean speed: mean torque equals load plus engine friction.
    theta = np.linspace(0.0, 40 * np.pi, 40_000, endpoint=False)
    motored, fired = (
        engine_torque(theta, cylinder_pressures(theta, k * relative), np.full_like(theta, MEAN_SPEED)).mean()
        for k in (0.0, 1e6)
    )
    level = (MEAN_LOAD + TRUTH["C_eng"] * MEAN_SPEED - motored) / (fired - motored)
    return 1e6 * level * relative


def record(seed: int = 0, misfire: bool = True) -> Record:
    """Ten engine cycles at 1200 RPM: 14 400 samples at 14 402 Hz with speed noise of 0.1 rad/s."""
    rng = np.random.default_rng(seed)
    strength = _combustion(rng, misfire)
    p = TRUTH

    def slope(t: float, x: Array) -> list[float]:
        theta = np.asarray(x[3])
        drive = engine_torque(theta, cylinder_pressures(theta, strength), x[0])
        shaft = p["K_el"] * x[2] + p["C_el"] * (x[1] - x[0])
        load = load_torque(np.asarray(t))
        return [
            (drive + shaft - p["C_eng"] * x[0]) / p["J_eng"],
            (-shaft - load) / p["J_load"],
            x[1] - x[0],
            x[0],
        ]

    t = np.arange(SAMPLES) / RATE
    start = [MEAN_SPEED, MEAN_SPEED, -MEAN_LOAD / p["K_el"], 0.3]
    # The cap on the step keeps every combustion event in sight of the error control.
    solution = solve_ivp(slope, (0.0, t[-1]), start, "DOP853", t, rtol=1e-10, atol=1e-12, max_step=1e-3)
    theta = solution.y[3]
    pressures = cylinder_pressures(theta, strength)
    y = solution.y[0] + NOISE * rng.standard_normal(SAMPLES)
    return Record(t, theta, pressures, engine_torque(theta, pressures, y), load_torque(t), y, dict(TRUTH))


def read_record(path: Path | str = MISFIRE_FILE) -> Record:
    """A kept record (columns time, theta, p1..p4, T_load, omega); torques from the measured speed."""
    frame = pd.read_csv(path)
    frame.columns = [str(name).split("[")[0].strip() for name in frame.columns]
    column = {name: frame[name].to_numpy(float) for name in frame.columns}
    pressures = np.array([column[f"p{c}"] for c in range(1, 5)])
    drive = engine_torque(column["theta"], pressures, column["omega"])
    time, theta, load, speed = (column[name] for name in ("time", "theta", "T_load", "omega"))
    return Record(time, theta, pressures, drive, load, speed, dict(TRUTH))
