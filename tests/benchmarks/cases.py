"""The problems of the benchmarks: records, free parameters, starts, bounds and priors, the same for everybody.

A    two masses, five parameters, the kept misfire record (its model is the linear form but for noise)
B    seven inertias, six tied parameters, one normal record of 14 400 samples
B6   the same six, normal and misfire at 1000, 1200, 1400 RPM jointly
B21  the 21 parameters of the chain but J7 and K76, C2 = … = C5 tied, those six records, a prior on C32..C65

The records of B, B6 and B21 are *like against like*: crank angles, pressures and load of the kept nonlinear
records (`data/crankshaft`, noise-free columns), but the speed of an independent simulation of the *linear* form, whose
reciprocating torque is made of the measured speed. The kept speeds come from the nonlinear form: a linear model
misses them by 0.85 % of chi-squared, and what it estimates from them is biased.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from chain import Array, Channels, Shape, simulate

ROOT = Path(__file__).resolve().parents[2]
STARTS_FILE = Path(__file__).with_name("crankshaft_starts.json")
if str(ROOT / "data") not in sys.path:
    sys.path.insert(0, str(ROOT / "data"))

STEP, SIGMA = 1 / 14402.0, 0.1
LIMIT_TWO_MASS, LIMIT_CRANKSHAFT = 1e-5, 3e-4  # of chi-squared per sample, above the best

TWO_MASS = Shape(2, (0,), (0,))
CRANKSHAFT = Shape(7, (1, 2, 3, 4), (1, 2, 3, 4))
TWO_MASS_TRUTH = np.array([1 / 2.557, 1 / 5.646, 1992.0, 2.5, 0.1541])
CRANKSHAFT_TRUTH = np.concatenate(
    [
        1 / np.array([33.39, 22.3, 22.3, 22.3, 22.3, 5.968, 5.646]),
        [241.8e3, 1270e3, 1270e3, 1270e3, 1427e3, 1992.0],
        [15.0, 2.5, 2.5, 2.5, 2.5, 2.5],
        np.full(4, 0.1541 / 4),
    ]
)
SIX = {"J1": (), "J2": ("J3", "J4", "J5"), "J6": (), "K21": (), "K32": ("K43", "K54"), "K65": ()}
PRIOR_SHARE = 0.5  # N(2.5, 1.25) N m s/rad on each damper between cylinders: the thesis's value within 50 %
DAMPERS_WITH_PRIOR = ("C32", "C43", "C54", "C65")


@dataclass(frozen=True)
class Record:
    """One experiment: drives (inputs, N) N m at the samples, first-order hold; speed (N,) rad/s."""

    name: str
    drives: Array
    speed: Array
    channels: dict[str, Array]

    @property
    def samples(self) -> int:
        return int(self.speed.size)


@dataclass(frozen=True)
class Case:
    """One estimation problem.

    free : names of the free parameters; ties : leader -> followers that equal it; truth : full vector
    width : free parameter -> (low, high), bounds as factors of the truth
    priors : free parameter -> (mean, standard deviation); limit : what counts as converged
    spread : starts are uniform within this share of the truth; offsets : firing offsets [rad], None for 1-3-4-2
    """

    name: str
    shape: Shape
    truth: Array
    free: tuple[str, ...]
    records: tuple[Record, ...]
    ties: dict[str, tuple[str, ...]] = field(default_factory=dict)
    priors: dict[str, tuple[float, float]] = field(default_factory=dict)
    limit: float = LIMIT_CRANKSHAFT
    spread: float = 0.2
    offsets: tuple[float, ...] | None = None
    step: float = STEP
    sigma: float = SIGMA

    @property
    def samples(self) -> int:
        return sum(record.samples for record in self.records)

    @property
    def spreading(self) -> Array:
        """(full, free): how the free values enter the full vector; its other entries are the truth."""
        names = self.shape.names
        matrix = np.zeros((len(names), len(self.free)))
        for column, name in enumerate(self.free):
            for each in (name, *self.ties.get(name, ())):
                matrix[names.index(each), column] = 1.0
        return matrix

    @property
    def fixed(self) -> Array:
        """The full vector with zeros where free values enter."""
        return np.where(self.spreading.any(axis=1), 0.0, self.truth)

    def full(self, values: Array) -> Array:
        """Full parameter vector of free values."""
        return self.fixed + self.spreading @ values

    @property
    def true_values(self) -> Array:
        """Free parameters that made the records."""
        names = self.shape.names
        return np.array([self.truth[names.index(name)] for name in self.free])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """A factor 5 either side of the thesis's values; 50 for dampers."""
        wide = np.array([50.0 if name.startswith("C") else 5.0 for name in self.free])
        return self.true_values / wide, self.true_values * wide

    def start(self, number: int) -> Array:
        """Start `number`: every free parameter uniform within ±`spread` of the truth."""
        share = np.random.default_rng(100 + number).random(len(self.free))
        return self.true_values * (1 + self.spread * (2 * share - 1))

    def prior_residual(self, values: Array) -> Array:
        """(value − mean)/deviation of the priors."""
        index = [self.free.index(name) for name in self.priors]
        mean, deviation = np.array(list(self.priors.values())).reshape(-1, 2).T
        return np.asarray((values[index] - mean) / deviation)

    def prior_jacobian(self) -> Array:
        """Its derivative (priors, free)."""
        rows = np.zeros((len(self.priors), len(self.free)))
        for row, (name, (_, deviation)) in enumerate(self.priors.items()):
            rows[row, self.free.index(name)] = 1 / deviation
        return rows


def _cylinder_parts(theta: Array, pressures: Array, offsets: Array) -> tuple[Array, Array]:
    """Gas torque and coefficient of −speed² of every cylinder, (c, N), (3.1)-(3.6)."""
    from simulator.geometry import CRANKCASE, MASS, PISTON_AREA, RADIUS, slider

    factor, slope = slider(theta - offsets[:, None])
    return (pressures - CRANKCASE) * PISTON_AREA * RADIUS * factor, MASS * RADIUS**2 * factor * slope


@cache
def kept_channels(path: str) -> Channels:
    """The noise-free columns of a kept record."""
    from simulator.files import read_columns
    from simulator.geometry import tdc_angles

    columns = read_columns((ROOT / "data" / path).read_bytes())
    pressures = np.array([columns[f"p{c}"] for c in range(1, 5)])
    constant, quadratic = _cylinder_parts(columns["theta"], pressures, tdc_angles())
    kept = {name: columns[name] for name in ("theta", "p1", "p2", "p3", "p4", "T_load")}
    return Channels(constant, quadratic, columns["T_load"], kept)


def crankshaft_start(speed_rpm: int, misfire: bool) -> Array:
    """State (13,) in which the kept records start: the independent simulator's warmed-up engine at angle 0."""
    from simulator import Engine, burn_factors, crankshaft_shaft, unequal_cylinders
    from simulator.run import Plant, warm_up

    cylinders = unequal_cylinders()
    factors = burn_factors(cylinders, cycles=1, misfire={2: "all"} if misfire else {})
    plant = Plant(crankshaft_shaft(), Engine(cylinders, factors), lambda _time: 57.0)
    _, state = warm_up(plant, speed_rpm * np.pi / 30)
    return np.asarray(state[1:])


def crankshaft_record(kind: str, speed_rpm: int, seed: int | None) -> Record:
    """A record of the linear form; `seed` None: without noise (then the drives see the true speed)."""
    name = f"{kind}_{speed_rpm}rpm"
    source = kept_channels(f"crankshaft/{name}.csv.gz")
    start = np.array(json.loads(STARTS_FILE.read_text())[name])
    noise = np.zeros(source.samples)
    if seed is not None:
        noise = SIGMA * np.random.default_rng(seed).standard_normal(source.samples)
    speed, drives = simulate(CRANKSHAFT, CRANKSHAFT_TRUTH, start, source, noise, STEP)
    return Record(name, drives, speed, source.channels | {"omega": speed})


def six_records(seed: int) -> tuple[Record, ...]:
    """Normal and misfire at 1000, 1200 and 1400 RPM."""
    kinds = [(kind, rpm) for rpm in (1000, 1200, 1400) for kind in ("normal", "misfire")]
    return tuple(crankshaft_record(kind, rpm, 10 * seed + i) for i, (kind, rpm) in enumerate(kinds))


def case_a() -> Case:
    """Two masses: parameters from starts ±40 %."""
    source = kept_channels("misfire_1200rpm.csv.gz")
    from simulator.files import read_columns

    speed = read_columns((ROOT / "data" / "misfire_1200rpm.csv.gz").read_bytes())["omega"]
    torques = source.torques(speed)
    drives = np.array([torques[:-1].sum(axis=0), torques[-1]])
    record = Record("misfire_1200rpm", drives, speed, source.channels | {"omega": speed})
    free = TWO_MASS.names
    return Case("A", TWO_MASS, TWO_MASS_TRUTH, free, (record,), limit=LIMIT_TWO_MASS, spread=0.4)


def case_b(seed: int = 1) -> Case:
    """Seven inertias, six tied parameters, one normal record of 14 400 samples."""
    record = crankshaft_record("normal", 1200, seed)
    cut = Record(
        record.name,
        record.drives[:, :14_400],
        record.speed[:14_400],
        {key: value[:14_400] for key, value in record.channels.items()},
    )
    return Case("B", CRANKSHAFT, CRANKSHAFT_TRUTH, tuple(SIX), (cut,), SIX)


def case_b6(seed: int = 1) -> Case:
    """The same six from six records."""
    return Case("B6", CRANKSHAFT, CRANKSHAFT_TRUTH, tuple(SIX), six_records(seed), SIX)


def every_parameter() -> Case:
    """All but J7 and K76, the absolute dampers equal, a prior on the dampers between cylinders; no records."""
    followers = ("C3", "C4", "C5")
    free = tuple(name for name in CRANKSHAFT.names if name not in ("J7", "K76", *followers))
    priors = dict.fromkeys(DAMPERS_WITH_PRIOR, (2.5, 2.5 * PRIOR_SHARE))
    return Case("B21", CRANKSHAFT, CRANKSHAFT_TRUTH, free, (), {"C2": followers}, priors)


def case_b21(seed: int = 1) -> Case:
    """All of these parameters from the six records of B6."""
    return replace(every_parameter(), records=six_records(seed))


def scaling_case(cylinders: int, samples: int, seed: int = 1) -> Case:
    """A crankshaft with 1 to 12 cylinders at 1200 RPM for any number of samples; six tied parameters (five of one).

    Even firing in the order of the cylinders, 3 % between them, a load that holds the speed; crank angle of a
    constant speed (it is an input here, so any will do).
    """
    from simulator.pressure import pressure

    count = cylinders + 3
    shape = Shape(count, tuple(range(1, cylinders + 1)), tuple(range(1, cylinders + 1)))
    fly = cylinders + 2
    truth = np.concatenate(
        [
            [1 / 33.39, *[1 / 22.3] * cylinders, 1 / 5.968, 1 / 5.646],
            [241.8e3, *[1270e3] * (cylinders - 1), 1427e3, 1992.0],
            [15.0, *[2.5] * (cylinders + 1)],
            np.full(cylinders, 0.1541 / 4),
        ]
    )
    speed = 40 * np.pi
    theta = speed * STEP * np.arange(samples)
    offsets = 4 * np.pi / cylinders * np.arange(cylinders)
    strength = 1.1e6 * (1 + 0.03 * np.cos(2.0 * np.arange(cylinders)))
    pressures = np.array([pressure(theta - o, s) for o, s in zip(offsets, strength, strict=True)])
    constant, quadratic = _cylinder_parts(theta, pressures, offsets)
    cycle = round(0.1 / STEP)
    mean = float((constant - quadratic * speed**2).sum(axis=0)[:cycle].mean())
    load = np.full(samples, mean - 0.1541 / 4 * cylinders * speed)
    channels = {"theta": theta, "T_load": load} | {f"p{c + 1}": pressures[c] for c in range(cylinders)}
    start = np.r_[np.full(count, speed), np.full(count - 2, -mean / 1427e3), -load[0] / 1992.0]
    noise = SIGMA * np.random.default_rng(seed).standard_normal(samples)
    source = Channels(constant, quadratic, load, channels)
    measured, drives = simulate(shape, truth, start, source, noise, STEP)
    followers = tuple(range(3, cylinders + 2))
    ties: dict[str, tuple[str, ...]] = {"J2": tuple(f"J{i}" for i in followers)}
    free = ["J1", "J2", f"J{fly}", "K21", f"K{fly}{fly - 1}"]
    if cylinders > 1:
        free.insert(4, "K32")
        ties["K32"] = tuple(f"K{i}{i - 1}" for i in followers[1:])
    record = Record("scaling", drives, measured, channels | {"omega": measured})
    return Case(
        f"{cylinders}x{samples}",
        shape,
        truth,
        tuple(free),
        (record,),
        ties,
        spread=0.1,
        offsets=tuple(offsets),
    )


CASES = {"A": case_a, "B": case_b, "B6": case_b6, "B21": case_b21}


def main() -> None:
    """Work the start states out again and write them."""
    kinds = [(kind, rpm) for rpm in (1000, 1200, 1400) for kind in ("normal", "misfire")]
    states = {f"{kind}_{rpm}rpm": crankshaft_start(rpm, kind == "misfire").tolist() for kind, rpm in kinds}
    STARTS_FILE.write_text(json.dumps(states, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
