"""The records that are kept in data/: their operating points and seeds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .simulate import Record, simulate_crankshaft, simulate_two_mass

CONTRACT = {
    "time": "s",
    "theta": "rad",
    "p1": "Pa",
    "p2": "Pa",
    "p3": "Pa",
    "p4": "Pa",
    "T_load": "N m",
    "omega": "rad/s",
    "omega_load": "rad/s",
}


@dataclass(frozen=True)
class Plan:
    """One file: path below data/, its model, mean speed [RPM], misfiring cylinder (or None) and seeds."""

    path: str
    model: Callable[..., Record]
    speed_rpm: float
    misfire: int | None
    scatter_seed: int
    noise_seed: int
    assumed: bool = False  # p3 and p4 are cylinders 1 and 2 shifted in crank angle, not what drove the engine

    def record(self) -> dict[str, np.ndarray]:
        """The columns of the file, in the order of the contract."""
        misfire = {} if self.misfire is None else {self.misfire: "all"}
        made = self.model(
            self.speed_rpm, misfire=misfire, scatter_seed=self.scatter_seed, noise_seed=self.noise_seed
        )
        if self.assumed:
            made |= {"p3": made["p3_assumed"], "p4": made["p4_assumed"]}
        return {name: made[name] for name in CONTRACT}


PLANS = (
    Plan("normal_1200rpm.csv.gz", simulate_two_mass, 1200.0, None, 105, 201),
    Plan("misfire_1200rpm.csv.gz", simulate_two_mass, 1200.0, 2, 102, 202),
    Plan("normal_1400rpm.csv.gz", simulate_two_mass, 1400.0, None, 103, 203),
    # one run written twice: what a rig with two pressure sensors would record, and all four true pressures
    Plan("assumed_pressure_1200rpm.csv.gz", simulate_two_mass, 1200.0, None, 106, 204, assumed=True),
    Plan("assumed_pressure_1200rpm_truth.csv.gz", simulate_two_mass, 1200.0, None, 106, 204),
    Plan("crankshaft/normal_1000rpm.csv.gz", simulate_crankshaft, 1000.0, None, 111, 211),
    Plan("crankshaft/misfire_1000rpm.csv.gz", simulate_crankshaft, 1000.0, 2, 112, 212),
    Plan("crankshaft/normal_1200rpm.csv.gz", simulate_crankshaft, 1200.0, None, 113, 213),
    Plan("crankshaft/misfire_1200rpm.csv.gz", simulate_crankshaft, 1200.0, 2, 114, 214),
    Plan("crankshaft/normal_1400rpm.csv.gz", simulate_crankshaft, 1400.0, None, 115, 215),
    Plan("crankshaft/misfire_1400rpm.csv.gz", simulate_crankshaft, 1400.0, 2, 116, 216),
    Plan("crankshaft/normal_1800rpm.csv.gz", simulate_crankshaft, 1800.0, None, 117, 217),
    Plan("crankshaft/misfire_1800rpm.csv.gz", simulate_crankshaft, 1800.0, 2, 118, 218),
)
