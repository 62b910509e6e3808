"""How small a hidden effect can be found, without the package: finite differences of the independent simulator.

A record of the simulator with an effect of some size is compared with the null plant, driven by that record's own
crank angle, pressures and load (integrated here by NumPy with Runge-Kutta steps). What is left after a least-squares
refit of the five parameters and three initial states, by finite differences of the same equations, has the norm mu in
units of the noise; the detectable size is where mu = c_alpha + 1.645, found with a power of 95 %.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "data"))

from simulator import hidden
from simulator.engine import TDC
from simulator.geometry import cylinder_torque
from simulator.hidden_runs import Case, simulate_hidden

TRUTH = np.array([1 / 2.557, 1 / 5.646, 1992.0, 2.5, 0.1541])
SIGMA, RATE, SAMPLED = 0.1, 5760.8, 2880.4
THRESHOLD, POWER = 3.75, 1.645
WANTED = THRESHOLD + POWER


@dataclass(frozen=True)
class Place:
    """An effect at a port: its details, a size to begin with, the largest that makes sense, the sensors needed."""

    effect: str
    at: str
    start: float
    most: float
    details: dict = field(default_factory=dict)
    sensors: int = 1
    load: float = 57.0

    @property
    def name(self):
        """``effect at port``."""
        return f"{self.effect} at {self.at}"

    def hidden(self, size):
        """The simulator's effect."""
        return hidden(self.effect, self.at, size, **self.details)


# Viscous friction at the engine and in the coupling is what the parameters C_eng and C_el are: nothing to be found.
PLACES = (
    Place("coulomb_friction", "engine", 1.0, 40),
    Place("coulomb_friction", "load", 1.0, 40),
    Place("coulomb_friction", "coupling", 0.5, 40),
    Place("viscous_friction", "load", 0.01, 0.4),
    Place("quadratic_drag", "engine", 1e-4, 3e-3),
    Place("quadratic_drag", "load", 1e-4, 3e-3),
    Place("stribeck_friction", "engine", 1.0, 60, {"fading": 140.0}),
    Place("stribeck_friction", "load", 1.0, 60, {"fading": 140.0}),
    Place("constant_torque", "engine", 1.0, 40),
    Place("constant_torque", "load", 1.0, 40),
    Place("cubic_stiffness", "coupling", 2e4, 2e6),
    Place("backlash", "coupling", 3e-4, 0.03, load=5.0),  # at 57 N m the coupling never unloads
    Place("misfire", "cylinder_2", 0.1, 1.0, {"cycles": (4,)}),
    Place("misfire", "cylinder_3", 0.1, 1.0, {"cycles": (7,)}),
    Place("cylinder_imbalance", "cylinder_1", 0.01, 0.5),
    Place("cylinder_imbalance", "cylinder_4", 0.01, 0.5),
    Place("load_step", "engine", 1.0, 40, {"time": 0.437}),
    Place("load_step", "load", 1.0, 40, {"time": 0.437}),
    Place("sensor_offset", "sensor_omega", 0.1, 20),
    Place("sensor_delay", "sensor_omega", 1e-5, 2e-3),
    Place("sensor_offset", "sensor_omega_load", 0.1, 20, sensors=2),
    Place("sensor_delay", "sensor_omega_load", 1e-5, 2e-3, sensors=2),
)


def driven(record, parameters, first):
    """Speeds (2, B, K) of the null plant at every second sample, driven by a record's channels.

    parameters : (5, B); first : (3, B) speeds of engine and load, and twist
    """
    je, jl, k, c, d = parameters
    angle = record["theta"][None] - TDC[:, None]
    pressures = np.stack([record[f"p{n}"] for n in (1, 2, 3, 4)])
    zero = np.zeros_like(angle)
    still = cylinder_torque(angle, zero, pressures).sum(axis=0)
    squared = (cylinder_torque(angle, zero + 1.0, pressures)).sum(axis=0) - still
    load = record["T_load"]
    h = 2 * (record["time"][1] - record["time"][0])

    def rate(x, at):
        torque = still[at] + squared[at] * x[0] ** 2
        spring = k * x[2] + c * (x[1] - x[0])
        return np.stack([(torque + spring - d * x[0]) / je, (-spring - load[at]) / jl, x[1] - x[0]])

    x = np.array(first, dtype=float)
    out = np.empty((2, x.shape[1], (len(load) + 1) // 2))
    out[..., 0] = x[:2]
    for step in range(1, out.shape[2]):
        at = 2 * (step - 1)
        k1 = rate(x, at)
        k2 = rate(x + h / 2 * k1, at + 1)
        k3 = rate(x + h / 2 * k2, at + 1)
        k4 = rate(x + h * k3, at + 2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        out[..., step] = x[:2]
    return out


def start_of(record):
    """omega_eng, omega_load, twist."""
    return np.array([record["states"][1, 0], record["states"][2, 0], record["states"][3, 0]])


def slopes_of(base):
    """(2, 8, K) finite differences of the speeds in parameters (relative) and first states."""
    around = np.concatenate([TRUTH * 1e-4, [1e-3, 1e-3, 1e-5]])
    parameters, first = np.tile(TRUTH[:, None], 16), np.tile(start_of(base)[:, None], 16)
    for j in range(8):
        for sign, column in ((1, 2 * j), (-1, 2 * j + 1)):
            if j < 5:
                parameters[j, column] += sign * around[j]
            else:
                first[j - 5, column] += sign * around[j]
    made = driven(base, parameters, first)
    return np.stack([(made[:, 2 * j] - made[:, 2 * j + 1]) / 2 for j in range(8)], axis=1)


def clean_records(effects, load, *, seed=0):
    """Records without noise, with and without effects: one engine, ten cycles."""
    cases = [Case(tuple(e), seed, 0) for e in effects]
    return simulate_hidden("two_mass", cases, rate=RATE, duration=1.0, sigma=0.0, load=load)


def left_over(record, frame, sensors, every=1):
    """What remains of (measured - null plant) after the refit, in units of the noise; every : as below."""
    keys = ("omega_true", "omega_load_true")[:sensors]
    made = driven(record, TRUTH[:, None], start_of(record)[:, None])[:sensors, 0]
    gap = [record[key][::2][: made.shape[1]][::every] for key in keys]
    gap = np.concatenate(gap) - made[:, ::every].ravel()
    gap = gap - frame @ (frame.T @ gap)
    return (gap - frame @ (frame.T @ gap)) / SIGMA


def detectable_sizes(sensors, *, rounds=4, places=PLACES, every=1):
    """place name -> the size at which mu is ``WANTED``, at most the place's ``most``; and the error of the method.

    every : of the samples at ``SAMPLED`` so many are one measured value
    """
    sizes, errors = {}, []
    for load in sorted({p.load for p in places}):
        chosen = [p for p in places if p.sensors <= sensors and p.load == load]
        base = clean_records([()], load)[0]
        slopes = slopes_of(base)[:sensors, :, ::every].transpose(0, 2, 1).reshape(-1, 8)
        frame, _ = np.linalg.qr(slopes / np.linalg.norm(slopes, axis=0))
        error = left_over(base, frame, sensors, every)
        errors.append(float(np.linalg.norm(error)))
        sizes |= {p.name: p.start for p in chosen}
        for _ in range(rounds):
            made = clean_records([(p.hidden(sizes[p.name]),) for p in chosen], load)
            for p, record in zip(chosen, made, strict=True):
                mu = float(np.linalg.norm(left_over(record, frame, sensors, every) - error))
                sizes[p.name] = min(sizes[p.name] * float(np.clip(WANTED / max(mu, 1e-9), 0.1, 10)), p.most)
    return sizes, max(errors)


if __name__ == "__main__":
    for sensors in (1, 2):
        sizes, error = detectable_sizes(sensors)
        print(f"{sensors} sensors; left of a record without effect: {error:.2g} of the noise's sigma")
        for p in PLACES:
            if p.sensors <= sensors:
                print(f"  {p.name:40s} {sizes[p.name]:.4g} (at most {p.most})")
