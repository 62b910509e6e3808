"""Records of engines with hidden effects, many at once: `simulate_hidden`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from .batch import Batch, Load, rule_for
from .engine import Engine, burn_factors
from .geometry import CYCLE
from .hidden import Hidden, place
from .pressure import Cylinders, unequal_cylinders
from .run import Plant, Start, warm_up
from .shaft import Shaft, crankshaft_shaft, two_mass_shaft
from .simulate import LOAD_TORQUE, SAMPLE_RATE, Record, add_noise, observe, sample_count
from .switches import Torque, torques_of
from .torque_table import make_table

SHAFTS = {"two_mass": two_mass_shaft, "crankshaft": crankshaft_shaft}


@dataclass(frozen=True)
class Case:
    """One run: its hidden effects, the seeds of scatter and noise, and misfire that the pressures show."""

    effects: tuple[Hidden, ...] = ()
    scatter_seed: int = 0
    noise_seed: int = 0
    misfire: Mapping[int, str | Sequence[int]] = field(default_factory=dict)


def simulate_hidden(
    kind: str,
    cases: Sequence[Case],
    *,
    speed_rpm: float = 1200.0,
    load: float | Load = LOAD_TORQUE,
    cycles: int = 10,
    duration: float | None = None,
    scatter: float = 0.02,
    sigma: float = 0.1,
    shaft: Shaft | None = None,
    cylinders: Cylinders | None = None,
    rate: float = SAMPLE_RATE,
    steps: int = 1,
    starts: Sequence[Start] | None = None,
) -> list[Record]:
    """Integrate all cases together and sample them as `simulate_shaft` does; one record for each.

    kind       "two_mass" or "crankshaft"; `shaft` gives other parameters
    load       braking torque [N m], a number or a function of an array of times [s]
    duration   length of the records [s], instead of so many complete cycles
    steps      steps of the integrator in each sample; 1 leaves errors below 1e-9 rad/s (see the tests)
    starts     of each case: what a warm-up came to before, instead of one
    Every run starts on the warmed-up orbit of the engine without hidden effects, which act from time 0 on: a
    fit that knows them and has the initial state free describes the record exactly.
    A record holds what `simulate_shaft` gives; its pressures are those of the burn strengths without misfire
    and imbalance that are hidden, at the true crank angles, and `factors` the true ones.
    """
    order = sorted(range(len(cases)), key=lambda run: [(e.name, e.at) for e in cases[run].effects])
    cases = [cases[run] for run in order]  # runs with the same effects side by side
    made = SHAFTS[kind]() if shaft is None else shaft
    people = unequal_cylinders() if cylinders is None else cylinders
    brake = load if callable(load) else _constant(float(load))
    for case in cases:
        for effect in case.effects:
            place(effect, made)
    told = [
        burn_factors(people, cycles=cycles, scatter=scatter, seed=c.scatter_seed, misfire=c.misfire)
        for c in cases
    ]
    true = [_burned(factors, case) for factors, case in zip(told, cases, strict=True)]
    if starts is None:
        engines, begun = _starts(made, people, told, cases, brake, speed_rpm)
    else:
        engines = [
            Engine(people, factors, starts[run].strength) for factors, run in zip(told, order, strict=True)
        ]
        begun = [np.array(starts[run].state) for run in order]
    table = make_table(made, people)
    factors = np.stack([e.strength * f for e, f in zip(engines, true, strict=True)], axis=1)
    strength = factors[table.cylinders.T]  # (S, H, runs, events)
    torques = torques_of(made, [c.effects for c in cases])
    batch = Batch(made, table, brake, strength, torques, len(cases), rule_for(made, 1.0 / (rate * steps)))
    least = sample_count(speed_rpm, cycles) * rate / SAMPLE_RATE
    count = round(1.01 * least) if duration is None else round(duration * rate)
    states, modes = _integrate(batch, np.array(begun).T, count, rate, steps)
    records: list[Record] = [{}] * len(cases)
    for run, case in enumerate(cases):
        own, length = states[:, :, run], count
        if duration is None:
            complete = int(np.searchsorted(own[:, 0], cycles * CYCLE)) + 1
            length = max(round(least), complete)
        times = np.arange(min(length, count)) / rate
        engine = Engine(people, told[run], engines[run].strength)
        record = observe(made, engine, _no_load, times, own[: len(times)].T.copy())
        record |= {"T_load": brake(times), "factors": true[run]}
        record |= _sensed(record, batch, modes, run, case, 1.0 / rate)
        records[order[run]] = add_noise(record, sigma=sigma, seed=case.noise_seed)
    return records


def _no_load(_time: float) -> float:
    return 0.0


def _constant(torque: float) -> Load:
    return lambda time: np.full(np.shape(time), torque)


def _burned(factors: np.ndarray, case: Case) -> np.ndarray:
    """The true burn factors (4, events): those told, less hidden misfire, times hidden imbalance."""
    true = factors.copy()
    for effect in case.effects:
        cylinder = int(effect.at[-1]) - 1 if effect.at.startswith("cylinder_") else -1
        if effect.name == "cylinder_imbalance":
            true[cylinder] *= 1.0 + effect.size
        if effect.name == "misfire":
            for cycle in effect.details["cycles"]:  # type: ignore[union-attr]
                if not 1 <= cycle < factors.shape[1]:
                    raise ValueError(
                        f"misfire in cycle {cycle}: the record has cycles 1..{factors.shape[1] - 2}"
                    )
                true[cylinder, cycle] *= 1.0 - effect.size
    return true


def _starts(
    shaft: Shaft,
    people: Cylinders,
    told: Sequence[np.ndarray],
    cases: Sequence[Case],
    brake: Load,
    speed_rpm: float,
) -> tuple[list[Engine], list[np.ndarray]]:
    """Warmed-up engines and states: one warm-up for all runs whose mean cycle is the same."""
    known: dict[bytes, tuple[Engine, np.ndarray]] = {}
    engines, starts = [], []
    for factors, _case in zip(told, cases, strict=True):
        key = factors[:, 0].tobytes()
        if key not in known:
            known[key] = _warm(_Frozen(shaft, people, factors), float(brake(np.array(0.0))), speed_rpm)
        engines.append(known[key][0])
        starts.append(known[key][1])
    return engines, starts


class _Frozen:
    """Shaft, cylinders and mean burn factors, equal where their numbers are."""

    def __init__(self, shaft: Shaft, people: Cylinders, factors: np.ndarray):
        self.shaft, self.people, self.factors = shaft, people, factors
        arrays = [shaft.inertia, shaft.stiffness, shaft.coupling_damping, shaft.absolute_damping]
        arrays += [people.strength, people.intake, people.delay, factors[:, 0]]
        self._key = (shaft.throws, b"".join(a.tobytes() for a in arrays))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Frozen) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@cache
def _warm(what: _Frozen, load: float, speed_rpm: float) -> tuple[Engine, np.ndarray]:
    plant = Plant(what.shaft, Engine(what.people, what.factors), lambda _time: load)
    return warm_up(plant, speed_rpm * np.pi / 30.0)


def _integrate(
    batch: Batch, start: np.ndarray, count: int, rate: float, steps: int
) -> tuple[np.ndarray, list[np.ndarray]]:
    """States (count, 2n, runs) at the samples, and for each torque its modes (count, runs) there."""
    width = batch.width
    states = np.empty((count, *start.shape))
    states[0] = state = start.copy()
    h, time = np.full(width, 1.0 / (rate * steps)), np.zeros(width)
    slope = batch.start(time, state)
    modes = [np.empty((count, len(torque.runs))) for torque in batch.torques]
    for kept, torque in zip(modes, batch.torques, strict=True):
        kept[0] = torque.mode
    for k in range(1, count):
        for part in range(steps):
            time = np.full(width, ((k - 1) * steps + part) / (rate * steps))
            state, slope = batch.advance(time, state, slope, h)
        states[k] = state
        for kept, torque in zip(modes, batch.torques, strict=True):
            kept[k] = torque.mode
    return states, modes


def _sensed(
    record: Record, batch: Batch, modes: list[np.ndarray], run: int, case: Case, step: float
) -> Record:
    """What sensors with hidden effects show, before noise: omega_true and omega_load_true as they see them."""
    rows = {"sensor_omega": 1, "sensor_omega_load": batch.shaft.size}
    names = {"sensor_omega": "omega_true", "sensor_omega_load": "omega_load_true"}
    shown: Record = {}
    for effect in sorted(case.effects, key=lambda e: e.name):  # the delay before the offset
        if effect.at not in rows:
            continue
        name = names[effect.at]
        if effect.name == "sensor_delay":
            late = _shifted(record["states"], batch, modes, run, -effect.size, step)
            shown[name] = late[rows[effect.at]]
    for effect in case.effects:
        if effect.name == "sensor_offset":
            name = names[effect.at]
            shown[name] = shown.get(name, record[name]) + effect.size
    return shown


def _shifted(
    states: np.ndarray, batch: Batch, modes: list[np.ndarray], run: int, shift: float, step: float
) -> np.ndarray:
    """States (2n, N) at all samples plus `shift` [s]: every one is integrated on from the sample before."""
    count = states.shape[1]
    whole = int(np.floor(shift / step))
    rest = shift - whole * step
    place = np.arange(count) + whole
    inside = (place >= 0) & (place < count)
    origin = np.clip(place, 0, count - 1)
    torques: list[Torque] = []
    for term, kept in zip(batch.torques, modes, strict=True):
        if run in term.runs:
            at = int(np.searchsorted(term.runs, run))
            torques.append(
                Torque(
                    term.kind,
                    np.arange(count),
                    term.signal,
                    term.lean,
                    np.full(count, term.size[at]),
                    np.full(count, term.more[at]),
                    kept[origin, at].copy(),
                )
            )
    strength = np.repeat(batch.strength[:, :, run : run + 1], count, axis=2)
    wide = Batch(batch.shaft, batch.table, batch.load, strength, torques, count, batch.rule)
    time, state = origin * step, states[:, origin].copy()
    wide.burn(state)
    first = wide.rate(time, state)
    part = np.where(inside, rest, (place - origin) * step + rest)
    ahead = part >= 0
    # before the record's first sample there is nothing to integrate on from: those go back from it
    moved, _ = wide.step(time, state, first, part)
    if ahead.any():
        some = wide.take(np.flatnonzero(ahead))
        moved[:, ahead], _ = some.advance(time[ahead], state[:, ahead], first[:, ahead], part[ahead])
    return moved
