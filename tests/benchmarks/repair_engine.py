"""Two masses for the studies of repair: records of the independent simulator, their null fits and their scores.

`data/simulator` makes the records (it shares nothing with the package); everything else is the package's own parts.
Set OPENBLAS_NUM_THREADS=1: threads only wait for one another on matrices of this size.
"""

import json
import sys
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "data"))

from simulator.hidden_runs import simulate_hidden
from single_shooting import settle

import casadi_engine as ce
from casadi_engine.discrepancy.assumed_pressure import SCATTER, carry, settle_scatter, with_priors
from casadi_engine.discrepancy.compression import candidate_columns, compress
from casadi_engine.discrepancy.library_candidates import library_candidates
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_distribution import NullDistribution, library_rows
from casadi_engine.discrepancy.null_model import null_model

TRUTH = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
SIGMA, RATE = 0.1, 2880.4
PRESSURES = ("p1", "p2", "p3", "p4")
UNITS = {"theta": "rad", **dict.fromkeys(PRESSURES, "Pa"), "T_load": "N m"}
SENSORS = {1: ("omega",), 2: ("omega", "omega_load")}
NAME = "record"


@cache
def model(sensors=1):
    """The two-mass model (4.1) with one or two speed sensors."""
    return ce.two_mass(outputs=SENSORS[sensors], reciprocating_speed="model")


def simulated(cases, *, rate=RATE, sigma=SIGMA, **options):
    """Records of the simulator: ten cycles, one second."""
    return simulate_hidden("two_mass", cases, rate=rate, duration=1.0, sigma=sigma, **options)


def experiment(record, *, sensors=1, assumed=False, clean=False, name=NAME):
    """A record as the package reads it; assumed : p3 and p4 are p1 and p2 shifted; clean : speeds without noise."""
    columns = {key: record[key] for key in UNITS}
    if assumed:
        columns |= {"p3": record["p3_assumed"], "p4": record["p4_assumed"]}
    columns |= {key: record[f"{key}_true" if clean else key] for key in SENSORS[sensors]}
    units = {**UNITS, **dict.fromkeys(SENSORS[sensors], "rad/s")}
    origin = {key: "assumed" if assumed and key in ("p3", "p4") else "measured" for key in units}
    return ce.Experiment.from_arrays(name, time=record["time"], units=units, origin=origin, **columns)


def first_state(record):
    """omega_eng, omega_load and twist at the first sample."""
    return np.array([record["omega_true"][0], record["omega_load_true"][0], record["states"][3, 0]])


@dataclass(frozen=True, eq=False)
class Fitted:
    """A null fit: the null model, its record, chi-squared, the first states; and the scatter of assumed pressures."""

    null: object
    data: object
    cost: float
    first: dict = field(default_factory=dict)
    columns: dict = field(default_factory=dict)
    scatter: float = 0.0

    def parameters(self, model):
        """A model's parameters, those of assumed pressures with their priors and scatter."""
        pars = with_priors(model.parameters())
        if SCATTER in pars:
            pars[SCATTER].set(self.scatter)
        return pars


def null_fit(data, start, *, sensors=1, noise=None, scatter=(), z=None):
    """The null fit of one record from the truth (or z) and its true first state, all of them free."""
    made = model(sensors)
    null, first, cost = settle(
        made,
        [data],
        made.parameters(),
        np.array(list(TRUTH.values())) if z is None else z,
        {data.name: start},
        noise=white(sensors) if noise is None else noise,
        scatter=scatter,
        iterations=25,
        tolerance=0.03,  # of chi-squared; what is left of the step is projected out of the score
    )
    return Fitted(null, data, cost, first)


_CARRIED = {}


def assumed_fit(data, *, sensors=1, start=None):
    """The null fit as `ce.repair` makes it where p3 and p4 are assumed: from the truth, its scatter estimated."""
    made = carry(model(sensors), model(sensors).parameters(), [data])
    # one model for all records of as many cycles: the library's terms are in its symbols
    own = _CARRIED.setdefault((sensors, made.model.parameter_names), made.model)
    noise = ce.Noise(**dict.fromkeys(SENSORS[sensors], SIGMA))
    pars = made.parameters
    for name, value in (start or TRUTH).items():
        pars[name].set(value)
    fit = ce.estimate(own, made.data, parameters=pars, noise=noise, progress=False)
    fit, _ = settle_scatter(fit, pars, noise=noise)
    first = {NAME: np.array([e.value for e in fit.initial[NAME].values()])}
    return Fitted(null_model(fit), made.data[0], fit.cost, first, scatter=fit.values[SCATTER]), fit


def columns_of(fitted, candidates):
    """record -> output -> sensitivities of the candidates, worked out once for a fit."""
    if not fitted.columns:
        fitted.columns[NAME] = candidate_columns(fitted.null.records[0], candidates)
    return fitted.columns


def refitted_drop(fitted, scores, noise, scatter):
    """The best candidate put into the model and refitted: how far chi-squared falls, against what the score said."""
    k = int(np.argmin(scores.p_value))
    candidate = scores.candidates[k]
    extended = candidate.source.extended(psi=0.0)
    pars = fitted.parameters(extended)
    for name in pars:
        if name.startswith(f"{candidate.port}.") and not name.endswith(f".{candidate.source.amplitude.name}"):
            pars.fix(name)
    z = np.append(fitted.null.values + scores.shift[:, k], scores.amplitude[k])
    _, _, cost = settle(
        extended, [fitted.data], pars, z, dict(fitted.first), noise=noise, scatter=scatter, iterations=25
    )
    before = null_cost(fitted, noise, scatter)
    drop = before - cost
    p = float(stats.chi2.sf(max(drop, 0.0), 1)) / (1 if candidate.side == 0 else 2)
    limit = NullDistribution(library_rows(scores, groups_of(scores.candidates))).threshold(0.01)
    return {
        "label": candidate.label,
        "promised": float(scores.drop[k]),
        "drop": drop,
        "p": p,
        "significant": bool(p <= limit),
    }


def null_cost(fitted, noise, scatter):
    """chi-squared of a null fit under another noise model."""
    one = fitted.null
    _, _, cost = settle(
        one.model, [fitted.data], fitted.parameters(one.model), one.values, dict(fitted.first),
        noise=noise, scatter=scatter, iterations=0,
    )  # fmt: skip
    return cost


_LIBRARIES = {}


def candidates_of(fitted, *, sensors=1):
    """The whole library at all ports, made once for all records of equal length: its terms are symbolic."""
    key = (sensors, len(fitted.data["theta"].time), fitted.null.model.parameter_names)
    if key not in _LIBRARIES:
        _LIBRARIES[key] = library_candidates(fitted.null, [fitted.data], ce.effects.library())
    return _LIBRARIES[key]


def groups_of(candidates):
    """group -> numbers of its candidates."""
    found = {}
    for k, candidate in enumerate(candidates):
        if candidate.group:
            found.setdefault(candidate.group, []).append(k)
    return found


def white(sensors=1):
    """The noise as it is known to be."""
    return NoiseModel(dict.fromkeys(SENSORS[sensors], SIGMA))


def compressed(fitted, candidates, noise, *, scatter=()):
    """A null fit compressed for the score tests."""
    return compress(fitted.null, candidates, noise, scatter=scatter, columns=columns_of(fitted, candidates))


def library_test(scores, *, least=1.0, level=1.0):
    """The smallest p-value of all rows (candidates and groups), its name, and its pooled p-value.

    least : above this smallest p-value the pooled one, which is larger, is not worked out: it is nan
    level : the noise level in units of that which the scores were made with
    """
    rows = library_rows(scores, groups_of(scores.candidates))
    y = scores.y[:, None] / level
    p = np.array([float(row.p_value(y)[0]) for row in rows])
    k = int(np.argmin(p))
    pooled = NullDistribution(rows).pooled(float(p[k])) if p[k] <= least else float("nan")
    return float(p[k]), rows[k].name, pooled


class Store:
    """Finished pieces of a study, one JSON line each, so that it can be stopped and taken up again."""

    def __init__(self, folder, name):
        self.path = Path(folder) / f"{name}.jsonl"
        self.path.parent.mkdir(parents=True, exist_ok=True)

    def done(self):
        """piece -> its result; a last line that was cut off does not count."""
        found = {}
        if self.path.exists():
            for line in self.path.read_text(encoding="utf-8").splitlines():
                try:
                    entry = json.loads(line)
                except json.JSONDecodeError:
                    continue
                found[entry["piece"]] = entry["result"]
        return found

    def add(self, piece, result):
        """Append one piece."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"piece": piece, "result": result}) + "\n")


def run_pieces(store, pieces, work, *, jobs=1):
    """Do what is not done yet; pieces : name -> arguments of ``work``."""
    missing = {name: args for name, args in pieces.items() if name not in store.done()}
    if jobs == 1:
        for name, args in missing.items():
            store.add(name, work(*args))
        return
    from joblib import Parallel, delayed

    made = Parallel(n_jobs=jobs, return_as="generator")(delayed(work)(*args) for args in missing.values())
    for name, result in zip(missing, made, strict=True):
        store.add(name, result)
