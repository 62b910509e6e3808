"""The records that are kept in data/: their operating points and seeds."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .hidden import Hidden, hidden
from .hidden_runs import Case, simulate_hidden
from .run import Start
from .simulate import SAMPLE_RATE, Record, simulate_crankshaft, simulate_two_mass

SECRET = Path(__file__).resolve().parent.parent / "hidden_effect" / "truth.json"

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


def hidden_truth() -> tuple[Hidden, ...]:
    """The effects that the records of hidden_effect/ hide, from the file that nothing else reads."""
    told = json.loads(SECRET.read_text(encoding="utf-8"))
    return tuple(hidden(one["name"], one["at"], one["size"]) for one in told["effects"])


def simulate_two_mass_hidden(
    speed_rpm: float,
    *,
    misfire: Mapping[int, str],
    scatter_seed: int,
    noise_seed: int,
    duration: float | None = None,
    start: Start | None = None,
) -> Record:
    """One record of the two-mass engine that has what `hidden_truth` says."""
    case = Case(hidden_truth(), scatter_seed, noise_seed, misfire)
    starts = None if start is None else [start]
    return simulate_hidden("two_mass", [case], speed_rpm=speed_rpm, duration=duration, starts=starts)[0]


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

    def simulated(self, **options: Any) -> Record:
        """All that the simulator tells."""
        misfire = {} if self.misfire is None else {self.misfire: "all"}
        seeds = {"scatter_seed": self.scatter_seed, "noise_seed": self.noise_seed}
        return self.model(self.speed_rpm, misfire=misfire, **seeds, **options)

    def warmed_up(self) -> Start:
        """What its warm-up comes to."""
        return start_of(self.simulated(duration=2 / SAMPLE_RATE))

    def columns(self, made: Record) -> dict[str, np.ndarray]:
        """The columns of the file, in the order of the contract."""
        if self.assumed:
            made = made | {"p3": made["p3_assumed"], "p4": made["p4_assumed"]}
        return {name: made[name] for name in CONTRACT}

    def record(self, start: Start | None = None) -> dict[str, np.ndarray]:
        """The columns of the file; start : None for a warm-up."""
        return self.columns(self.simulated(**({} if start is None else {"start": start})))


def start_of(made: Record) -> Start:
    """From what a record began."""
    return Start(float(made["strength"]), tuple(made["states"][:, 0].tolist()))


PLANS = (
    Plan("normal_1200rpm.csv.gz", simulate_two_mass, 1200.0, None, 105, 201),
    Plan("misfire_1200rpm.csv.gz", simulate_two_mass, 1200.0, 2, 102, 202),
    Plan("normal_1400rpm.csv.gz", simulate_two_mass, 1400.0, None, 103, 203),
    # one run written twice: what a rig with two pressure sensors would record, and all four true pressures
    Plan("assumed_pressure_1200rpm.csv.gz", simulate_two_mass, 1200.0, None, 106, 204, assumed=True),
    Plan("assumed_pressure_1200rpm_truth.csv.gz", simulate_two_mass, 1200.0, None, 106, 204),
    Plan("hidden_effect/normal_1200rpm.csv.gz", simulate_two_mass_hidden, 1200.0, None, 123, 221),
    Plan("hidden_effect/misfire_1200rpm.csv.gz", simulate_two_mass_hidden, 1200.0, 2, 122, 222),
    Plan("hidden_effect/normal_1400rpm.csv.gz", simulate_two_mass_hidden, 1400.0, None, 121, 223),
    Plan("crankshaft/normal_1000rpm.csv.gz", simulate_crankshaft, 1000.0, None, 111, 211),
    Plan("crankshaft/misfire_1000rpm.csv.gz", simulate_crankshaft, 1000.0, 2, 112, 212),
    Plan("crankshaft/normal_1200rpm.csv.gz", simulate_crankshaft, 1200.0, None, 113, 213),
    Plan("crankshaft/misfire_1200rpm.csv.gz", simulate_crankshaft, 1200.0, 2, 114, 214),
    Plan("crankshaft/normal_1400rpm.csv.gz", simulate_crankshaft, 1400.0, None, 115, 215),
    Plan("crankshaft/misfire_1400rpm.csv.gz", simulate_crankshaft, 1400.0, 2, 116, 216),
    Plan("crankshaft/normal_1800rpm.csv.gz", simulate_crankshaft, 1800.0, None, 117, 217),
    Plan("crankshaft/misfire_1800rpm.csv.gz", simulate_crankshaft, 1800.0, 2, 118, 218),
)
