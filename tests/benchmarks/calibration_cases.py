"""The variants of the calibration study: simulated records with drawn noise, and what is fitted to them.

Nothing here uses the package but `fit_of`: the linear form of the engine is simulated by its modes (`simulate`), which
is checked against the sample-by-sample recursion of `chain.py`, and the Cramér-Rao bound is that of `yardstick.py`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
from cases import (
    CRANKSHAFT,
    CRANKSHAFT_TRUTH,
    SIX,
    STARTS_FILE,
    STEP,
    TWO_MASS,
    TWO_MASS_TRUTH,
    Case,
    Record,
    kept_channels,
)
from chain import Array, Channels, Shape, discretise
from ours import TWO_MASS_NAMES, UNITS, model_of, parameters_of
from scipy.signal import lfilter
from yardstick import covariance_bound

import casadi_engine as ce

NAMES = TWO_MASS.names  # J1, J2, K21, C21, C1
RATIO = float(TWO_MASS_TRUTH[1] / TWO_MASS_TRUTH[0])
# Deviations of the priors, shares of the truth: about what the record itself tells of these dampers.
PRIOR_SHARES = {"C21": 3e-3, "C1": 1e-4}
MISSING = 0.1
_SETTLED, _ROUNDS = 1e-11, 60


@dataclass(frozen=True)
class Variant:
    """One line of the study.

    words : what it is; count : fits of the full study; coverage, ratio : the limits that its numbers have to keep
    sigma : of the noise [rad/s]; reported : parameters whose intervals are counted, by the benchmark's names
    neighbours : of `estimate`; one_sided : the parameter whose truth lies on its lower bound
    """

    words: str
    count: int
    coverage: tuple[float, float]
    ratio: tuple[float, float]
    reported: tuple[str, ...]
    sigma: float = 0.1
    neighbours: int = 0
    one_sided: str = ""


_TWO = {"count": 2000, "coverage": (0.93, 0.97), "ratio": (0.95, 1.08), "reported": NAMES}
_SIX = {"count": 500, "coverage": (0.91, 0.99), "ratio": (0.9, 1.12), "reported": tuple(SIX)}
VARIANTS: dict[str, Variant] = {
    "known": Variant("two masses, noise level known", **_TWO),  # type: ignore[arg-type]
    "estimated": Variant("two masses, noise level estimated", **_TWO),  # type: ignore[arg-type]
    "tied": Variant("two masses, J2 tied to J1", **_TWO),  # type: ignore[arg-type]
    "prior": Variant("two masses, priors on both dampers, truth drawn from them", **_TWO),  # type: ignore[arg-type]
    # On a bound the other estimates are better than the bound, which knows nothing of it.
    "bound": Variant(
        "two masses, C1 = 0 on its bound", **_TWO | {"ratio": (0.0, 1.08)}, one_sided="C1"  # type: ignore[arg-type]
    ),
    "missing": Variant("two masses, 10 % of the samples missing", **_TWO),  # type: ignore[arg-type]
    "crankshaft": Variant("crankshaft, six records", **_SIX, neighbours=1),  # type: ignore[arg-type]
    "crankshaft_quiet": Variant(
        "crankshaft, six records, a tenth of the noise", **_SIX, sigma=0.01  # type: ignore[arg-type]
    ),
    "crankshaft_still": Variant(
        "crankshaft, six records, a thirtieth of the noise", **_SIX, sigma=1 / 300  # type: ignore[arg-type]
    ),
    "quiet": Variant("two masses, a tenth of the noise", **_TWO, sigma=0.01),  # type: ignore[arg-type]
    "loud": Variant("two masses, thirty times the noise", **_TWO, sigma=3.0),  # type: ignore[arg-type]
    "louder": Variant("two masses, eighty times the noise", **_TWO, sigma=8.0),  # type: ignore[arg-type]
    "crankshaft_plain": Variant("crankshaft, six records, no neighbours", **_SIX),  # type: ignore[arg-type]
}  # fmt: skip


# ---- records


def simulate(
    shape: Shape, full: Array, start: Array, source: Channels, noise: Array, step: float = STEP
) -> tuple[Array, Array]:
    """What `chain.simulate` gives, by the modes of the whole record at once.

    The reciprocating torque is made of the measured speed: the record is simulated again until it is made of itself.
    """
    f, g, h = discretise(shape, full, step)
    rates, modes = np.linalg.eig(f)
    inverse = np.linalg.inv(modes)
    half = np.flatnonzero(rates.imag >= 0)
    share = np.where(rates[half].imag > 0, 2.0, 1.0) * modes[0, half]
    first = inverse[half] @ start
    speed = noise + start[0]
    for _ in range(_ROUNDS):
        drives = source.torques(speed)
        push = inverse[half] @ (g @ drives[:, :-1] + h @ drives[:, 1:])
        found = np.full(source.samples, share @ first)
        total = np.zeros(source.samples - 1, dtype=complex)
        for k, rate in enumerate(rates[half]):
            total += share[k] * lfilter([1.0], [1.0, -rate], push[k], zi=[rate * first[k]])[0]
        found[1:] = total
        new = found.real + noise
        change = float(np.abs(new - speed).max())
        speed = new
        if change < _SETTLED * np.abs(speed).max():
            return speed, source.torques(speed)
    message = f"the measured speed does not settle: {change}"
    raise RuntimeError(message)


@cache
def _two_mass_source() -> tuple[Channels, Array]:
    """Channels of the kept misfire record, and the first state that suits it best at the truth."""
    from cases import ROOT
    from simulator.files import read_columns
    from yardstick import _responses

    path = "misfire_1200rpm.csv.gz"
    source = kept_channels(path)
    source = Channels(
        source.constant.sum(axis=0)[None], source.quadratic.sum(axis=0)[None], source.load, source.channels
    )
    speed = read_columns((ROOT / "data" / path).read_bytes())["omega"]
    record = Record("kept", source.torques(speed), speed, {})
    case = Case("A", TWO_MASS, TWO_MASS_TRUTH, NAMES, (record,))
    forced, _ = _responses(case, TWO_MASS_TRUTH, record)
    f, _, _ = discretise(TWO_MASS, TWO_MASS_TRUTH, STEP)
    row_, rows = np.eye(1, 3)[0], []
    for _ in range(record.samples):
        rows.append(row_)
        row_ = row_ @ f
    return source, np.linalg.lstsq(np.array(rows), speed - forced, rcond=None)[0]


def _two_mass(name: str, seed: int) -> tuple[Case, list[Array]]:
    rng = np.random.default_rng([11, list(VARIANTS).index(name), seed])
    source, start = _two_mass_source()
    truth, priors = TWO_MASS_TRUTH.copy(), {}
    if name == "prior":
        at = {key: NAMES.index(key) for key in PRIOR_SHARES}
        priors = {key: (float(truth[k]), float(PRIOR_SHARES[key] * truth[k])) for key, k in at.items()}
        for key, k in at.items():
            truth[k] = priors[key][0] + priors[key][1] * rng.standard_normal()
    if name == "bound":
        truth[NAMES.index("C1")] = 0.0
    noise = VARIANTS[name].sigma * rng.standard_normal(source.samples)
    speed, drives = simulate(TWO_MASS, truth, start, source, noise)
    record = Record("misfire_1200rpm", drives, speed, source.channels | {"omega": speed})
    sigma = VARIANTS[name].sigma
    return Case(name, TWO_MASS, truth, NAMES, (record,), {}, priors, spread=0.4, sigma=sigma), [noise]


def _crankshaft(name: str, seed: int) -> tuple[Case, list[Array]]:
    """Normal and misfire at 1000, 1200 and 1400 RPM."""
    sigma, starts = VARIANTS[name].sigma, json.loads(STARTS_FILE.read_text())
    rng, records, noises = np.random.default_rng([12, list(VARIANTS).index(name), seed]), [], []
    for rpm in (1000, 1200, 1400):
        for kind in ("normal", "misfire"):
            key = f"{kind}_{rpm}rpm"
            source = kept_channels(f"crankshaft/{key}.csv.gz")
            noise = sigma * rng.standard_normal(source.samples)
            speed, drives = simulate(CRANKSHAFT, CRANKSHAFT_TRUTH, np.array(starts[key]), source, noise)
            records.append(Record(key, drives, speed, source.channels | {"omega": speed}))
            noises.append(noise)
    return Case(name, CRANKSHAFT, CRANKSHAFT_TRUTH, tuple(SIX), tuple(records), SIX, sigma=sigma), noises


def drawn(name: str, seed: int) -> tuple[Case, list[Array]]:
    """The case of a variant, its truth and noise drawn by this seed, and the noise (N,) of its records."""
    return (_crankshaft if name.startswith("crankshaft") else _two_mass)(name, seed)


def case_of(name: str, seed: int) -> Case:
    """The case alone."""
    return drawn(name, seed)[0]


# ---- fits


def _torque_model() -> ce.Model:
    """Two masses whose torques are channels: their speed is an output alone, and may have gaps."""
    from innovations_study import two_masses

    return two_masses()


def _experiments(case: Case, rng: np.random.Generator) -> list[ce.Experiment]:
    found = []
    for record in case.records:
        time_, channels, units = np.arange(record.samples) * case.step, dict(record.channels), UNITS
        if case.name == "missing":
            units = {"T": "N m", "T_load": "N m", "omega": "rad/s"}
            speed = np.where(rng.random(record.samples) < MISSING, np.nan, record.speed)
            channels = {"T": record.drives[0], "T_load": record.drives[1], "omega": speed}
        units = {key: units[key] for key in channels}
        found.append(ce.Experiment.from_arrays(record.name, time=time_, units=units, **channels))
    return found


def fit_of(case: Case, seed: int, *, neighbours: int | None = None) -> ce.Fit:
    """The package's fit from a start within the case's spread."""
    rng = np.random.default_rng([13, seed])
    model, names = model_of(case)
    if case.name == "missing":
        model = _torque_model()
    at_truth = case if case.true_values.all() else replace(case, truth=TWO_MASS_TRUTH)
    parameters = parameters_of(at_truth, model, names, at_truth.start(seed))
    if case.name == "tied":
        parameters[names["J2"]].set(min=-np.inf, max=np.inf)
        parameters.tie(names["J2"], f"{RATIO!r}*{names['J1']}")
    if case.name == "bound":
        parameters[names["C1"]].set(min=0.0)
    noise = ce.Noise(omega="estimate" if case.name == "estimated" else case.sigma)
    return ce.estimate(
        model,
        _experiments(case, rng),
        parameters=parameters,
        noise=noise,
        neighbours=VARIANTS[case.name].neighbours if neighbours is None else neighbours,
        progress=False,
    )


def row(piece: dict[str, Any]) -> dict[str, Any]:
    """One fit of the study as plain numbers: piece = {"variant": name, "seed": number}.

    stderr : of the quadratic, printed or not; printed : what the fit prints, "stderr", an interval or nothing
    region : -2 log of the likelihood (posterior) at the truth against that of the fit, the initial states at their best
    behind : how much lower the cost of a search from the truth ends, where neighbours are searched
    """
    name, seed = piece["variant"], piece["seed"]
    case, noises = drawn(name, seed)
    begun = time.process_time()
    fit = fit_of(case, seed)
    spent = time.process_time() - begun
    names = TWO_MASS_NAMES if case.shape.size == 2 else {key: key for key in case.shape.names}
    found = {key: fit.estimates[names[key]] for key in case.free}
    answer = {
        "status": fit.status,
        "seconds": round(spent, 3),
        "error": {
            key: one.value - float(case.truth[case.shape.names.index(key)]) for key, one in found.items()
        },
        "stderr": {key: one.quadratic or one.stderr for key, one in found.items()},
        "printed": {key: _printed(one) for key, one in found.items()},
        "at_bound": [key for key, one in found.items() if one.at_bound],
        "chi2": fit.cost / fit.n,
        "optima": len(fit.optima),
    }
    if name not in ("estimated", "missing"):
        answer["region"] = _cost_of_truth(case, noises) - fit.cost
    if VARIANTS[name].neighbours:
        answer["behind"] = fit.cost - fit_of(replace(case, spread=0.0), seed, neighbours=0).cost
    return answer


def _printed(one: Any) -> str | list[float] | None:
    """What stands beside an estimate: "stderr", the ends of its interval less its value, or nothing."""
    if one.interval is not None:
        return [end - one.value for end in one.interval]
    return None if one.stderr is None else "stderr"


def _cost_of_truth(case: Case, noises: list[Array]) -> float:
    """Chi-squared of the noise less what the initial states can imitate of it, and the priors at the truth."""
    total = float((case.prior_residual(case.true_values) ** 2).sum()) if case.priors else 0.0
    for noise in noises:
        free = _free_responses(case.shape, tuple(case.truth.tolist()), noise.size)
        total += float(noise @ noise - np.square(free.T @ noise).sum()) / case.sigma**2
    return total


@lru_cache(maxsize=8)
def _free_responses(shape: Shape, truth: tuple[float, ...], samples: int) -> Array:
    """(samples, states) orthonormal."""
    f, _, _ = discretise(shape, np.array(truth), STEP)
    rows, row_ = np.empty((samples, shape.states)), np.eye(1, shape.states)[0]
    for k in range(samples):
        rows[k] = row_
        row_ = row_ @ f
    return np.linalg.qr(rows / np.linalg.norm(rows, axis=0))[0]


# ---- the bound


@cache
def bound_of(name: str) -> dict[str, float]:
    """The Cramér-Rao bound (standard deviation) of every reported parameter; with priors that of the posterior."""
    # The noise drives the engine too, by the measured speed in the reciprocating torque: a mean over records.
    draws = range(100_000, 100_008 if name == "prior" else 100_003)
    total = np.mean([_covariance(name, seed) for seed in draws], axis=0)
    return dict(zip(VARIANTS[name].reported, np.sqrt(np.diag(total)).tolist(), strict=True))


def _covariance(name: str, seed: int) -> Array:
    case = case_of(name, seed)
    if name == "bound":  # differences of a parameter that is zero need a size: that of the thesis
        return _bound_at_zero(case)
    covariance = covariance_bound(case)
    if name == "tied":
        turn = np.eye(5)[:, [0, 2, 3, 4]]
        turn[1, 0] = RATIO
        return turn @ np.linalg.inv(turn.T @ np.linalg.inv(covariance) @ turn) @ turn.T
    return covariance / (1 - MISSING) if name == "missing" else covariance


def _bound_at_zero(case: Case) -> Array:
    """The bound at C1 = 0, by central differences of one step in it that owe nothing to its size."""
    from yardstick import _responses

    (record,) = case.records
    forced, free = _responses(case, case.truth, record)
    rest = record.speed - forced
    start, columns = free @ (free.T @ rest), []
    for i, size in enumerate(TWO_MASS_TRUTH):
        moved = []
        for sign in (1.0, -1.0):
            there, basis = _responses(case, case.truth + sign * 1e-4 * size * np.eye(5)[i], record)
            moved.append(there + basis @ (basis.T @ start))
        columns.append((moved[0] - moved[1]) / (2e-4 * size))
    rows = np.array(columns).T
    rows = rows - free @ (free.T @ rows)
    return np.asarray(np.linalg.inv(rows.T @ rows / case.sigma**2))
