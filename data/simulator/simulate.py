"""The two functions that make a record: `simulate_two_mass` and `simulate_crankshaft`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .engine import Engine, burn_factors
from .geometry import CYCLE
from .pressure import Cylinders, unequal_cylinders
from .run import Extra, Plant, Start, integrate, warm_up
from .shaft import Shaft, crankshaft_shaft, two_mass_shaft

SAMPLE_RATE = 14402.0  # Hz
SAMPLES_PER_SECOND_OF_CYCLES = 14400  # ten cycles at 1200 RPM, one second, are 14 400 samples
LOAD_TORQUE = 57.0  # N m
SIGMA = 0.1  # rad/s

Record = dict[str, np.ndarray]


def sample_count(speed_rpm: float, cycles: float) -> int:
    """Least number of samples for `cycles` engine cycles (two turns each): 14 400 for ten at 1200 RPM."""
    return round(cycles * 120.0 / speed_rpm * SAMPLES_PER_SECOND_OF_CYCLES)


def simulate_two_mass(speed_rpm: float = 1200.0, **options: Any) -> Record:
    """One record of the two-mass engine-load model (4.1), truth of Table 4.1; options as `simulate_shaft`."""
    return simulate_shaft(options.pop("shaft", two_mass_shaft()), speed_rpm, **options)


def simulate_crankshaft(speed_rpm: float = 1200.0, **options: Any) -> Record:
    """One record of the seven-inertia crankshaft, truth of Table 4.12; options as `simulate_shaft`."""
    return simulate_shaft(options.pop("shaft", crankshaft_shaft()), speed_rpm, **options)


def simulate_shaft(
    shaft: Shaft,
    speed_rpm: float,
    *,
    load: float | Callable[[float], float] = LOAD_TORQUE,
    cycles: int = 10,
    duration: float | None = None,
    misfire: Mapping[int, str | Sequence[int]] | None = None,
    cylinders: Cylinders | None = None,
    scatter: float = 0.02,
    scatter_seed: int = 0,
    sigma: float = SIGMA,
    noise_seed: int = 0,
    extra: Extra | None = None,
    rate: float = SAMPLE_RATE,
    rtol: float = 1e-11,
    start: Start | None = None,
) -> Record:
    """Warm up, integrate and sample one record.

    load          braking torque [N m], a number or a function of time [s]
    cycles        engine cycles to record, all complete; combustion is drawn for as many
    duration      length of the record [s] instead, for loads that change the speed
    misfire       {cylinder: "all" or the cycles (1, 2, ...) that do not burn}; the other cylinders make up
                  for "all", so that the speed holds, and for a list they do not
    scatter       cycle-to-cycle standard deviation of the burn strength [1]
    sigma         standard deviation of the white noise on the speeds [rad/s]; 0 gives the clean record
    extra         torque on every inertia, extra(time, state) -> (n,) N m: an effect that a model may lack;
                  the warm-up has it too, with time counted from the start of each of its cycles
    start         what a warm-up came to before, instead of one
    Returns arrays (N,) by the names of the data contract, and the truth behind them: omega_true and
    omega_load_true [rad/s], T_1..T_4 [N m], p3_assumed and p4_assumed [Pa], states (2n, N),
    factors (4, cycles + 2) and strength [Pa].
    """
    cylinders = unequal_cylinders() if cylinders is None else cylinders
    factors = burn_factors(cylinders, cycles=cycles, scatter=scatter, seed=scatter_seed, misfire=misfire)
    load_at = load if callable(load) else lambda _time: float(load)
    plant = Plant(shaft, Engine(cylinders, factors), load_at, extra)
    if start is None:
        engine, state = warm_up(plant, speed_rpm * np.pi / 30.0)
    else:
        engine, state = plant.engine.with_strength(start.strength), np.array(start.state)
    least = round(sample_count(speed_rpm, cycles) * rate / SAMPLE_RATE) if duration is None else 0
    longest = 1.01 * least if duration is None else duration * rate
    times = np.arange(round(longest)) / rate
    states = integrate(Plant(shaft, engine, load_at, extra), state, times, rtol=rtol)
    if duration is None:
        # scatter leaves the mean speed a little free: keep what completes the last cycle
        complete = int(np.searchsorted(states[0], cycles * CYCLE)) + 1
        times, states = times[: max(least, complete)], states[:, : max(least, complete)]
    return add_noise(observe(shaft, engine, load_at, times, states), sigma=sigma, seed=noise_seed)


def observe(
    shaft: Shaft, engine: Engine, load: Callable[[float], float], times: np.ndarray, states: np.ndarray
) -> Record:
    """What happened, without noise, from the sampled states."""
    throws = list(shaft.throws)
    angles = shaft.angle_rows()[throws] @ states
    pressures = engine.pressures(angles)
    torques = engine.torques(angles, states[np.asarray(throws) + 1])
    record = {"time": times, "theta": states[0]}
    record |= {f"p{c + 1}": pressures[c] for c in range(4)}
    record["T_load"] = np.array([load(time) for time in times])
    record |= {"omega_true": states[1], "omega_load_true": states[shaft.size]}
    record |= {f"T_{c + 1}": torques[c] for c in range(4)}
    assumed = engine.pressures(angles, law_of=(1, 2, 1, 2))
    record |= {"p3_assumed": assumed[2], "p4_assumed": assumed[3]}
    record |= {"states": states, "factors": engine.factors, "strength": np.array(engine.strength)}
    return record


def add_noise(record: Record, *, sigma: float = SIGMA, seed: int = 0) -> Record:
    """The record with fresh white noise on `omega` and `omega_load`; other arrays are shared, not copied."""
    generator = np.random.default_rng(seed)
    noise = sigma * generator.standard_normal((2, len(record["time"])))
    return record | {
        "omega": record["omega_true"] + noise[0],
        "omega_load": record["omega_load_true"] + noise[1],
    }
