"""Is the posterior calibrated? Simulation-based: parameters drawn from the prior, records, fit, posterior, rank.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/posterior_study.py [NAME ...] [--count N] [--write]

NAME : A, A_quiet, B, B6, B6_quiet, B21, B6_fixed, described in VARIANTS; all of them if none is given. The parameters
are drawn from their prior, flat in their logarithms between bounds, or the normal one that they have; the rank of the
truth among the draws is then uniform, and an interval of 80 % holds the truth in 80 % (Talts et al. 2018). So is the
rank of the truth's log density among those of the draws, one number for each row, while the parameters of a row go
together.

Every finished simulation goes into a checkpoint beside this file (`posterior-*.jsonl`, --folder for another place), and
from there, at the beginning and the end of a command, into the small files of `posterior_rows/`, which the repository
keeps: a study goes on with the same command wherever it was stopped, and the table is written from them. `--write` puts
the dated table into POSTERIOR.md, and what posterior_referee.py found.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import truncnorm

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

import posterior_referee  # noqa: E402
from calibration_cases import _two_mass_source, simulate  # noqa: E402
from cases import (  # noqa: E402
    CRANKSHAFT,
    CRANKSHAFT_TRUTH,
    SIX,
    STARTS_FILE,
    STEP,
    TWO_MASS,
    TWO_MASS_TRUTH,
    Case,
    Record,
    every_parameter,
    kept_channels,
)
from chain import Channels, Shape, discretise  # noqa: E402
from ours import TWO_MASS_NAMES, experiments, model_of, parameters_of  # noqa: E402
from posterior_rows import FEW, Kept  # noqa: E402

import casadi_engine as ce  # noqa: E402
from casadi_engine.errors import CasadiEngineError  # noqa: E402
from casadi_engine.estimation.checkpoint import key_of  # noqa: E402
from casadi_engine.estimation.study import study  # noqa: E402
from casadi_engine.posterior.result import Posterior  # noqa: E402
from casadi_engine.posterior.target import Target  # noqa: E402

Rows = list[dict[str, Any]]
SETTING = {"version": 7, "draws": 999}
LEVELS = (50, 80, 95)
# Draws whose log densities the truth's is compared with.
COMPARED = 99


@dataclass(frozen=True)
class Variant:
    """words : what it is; count : simulations of the full study; sigma : of the noise [rad/s]; width : factor of the
    bounds to either side of the thesis's values; records : of the crankshaft, none for two masses; first : seed, after
    those that were looked at while the priors were made; every : True for all parameters of the crankshaft, as in the
    problem B21 of cases.py; fixed : True for records that begin with the thesis's states, whatever the parameters are;
    the others begin as an engine runs that has been running with these parameters"""

    words: str
    count: int
    sigma: float
    width: float
    records: tuple[str, ...] = ()
    first: int = 0
    every: bool = False
    fixed: bool = False

    def nominal(self, name: str) -> Case:
        """The case without records, with the thesis's values."""
        if self.every:
            return replace(every_parameter(), name=name, sigma=self.sigma)
        if self.records:
            return Case(name, CRANKSHAFT, CRANKSHAFT_TRUTH, tuple(SIX), (), SIX, sigma=self.sigma)
        return Case(name, TWO_MASS, TWO_MASS_TRUTH, TWO_MASS.names, (), sigma=self.sigma)

    def bounds(self, case: Case) -> tuple[np.ndarray, np.ndarray]:
        """Of the free parameters (n,): so wide, or the benchmark's wide ones for those with a normal prior."""
        normal = np.array([name in case.priors for name in case.free])
        near = case.true_values / self.width, case.true_values * self.width
        low, high = (np.where(normal, far, own) for far, own in zip(case.bounds, near, strict=True))
        return low, high


_SIX = tuple(f"{kind}_{rpm}rpm" for rpm in (1000, 1200, 1400) for kind in ("normal", "misfire"))
VARIANTS = {
    "A": Variant("A: two masses, noise 0.1 rad/s", 1000, 0.1, 1.2),
    "A_quiet": Variant("A: two masses, noise 0.01 rad/s", 1000, 0.01, 1.2),
    "B": Variant("B: crankshaft, one record, noise 0.1 rad/s", 500, 0.1, 1.3, ("normal_1200rpm",)),
    "B6": Variant("B6: crankshaft, six records, noise 0.1 rad/s", 200, 0.1, 1.3, _SIX, first=100),
    "B6_quiet": Variant("B6: crankshaft, six records, noise 0.01 rad/s", 200, 0.01, 1.3, _SIX, first=100),
    "B21": Variant(
        "B21: crankshaft, all parameters, six records, noise 0.1 rad/s", 50, 0.1, 1.3, _SIX, every=True
    ),
    "B6_fixed": Variant("B6: the same from the thesis's states", 200, 0.1, 1.3, _SIX, first=100, fixed=True),
}


def drawn(name: str, seed: int) -> tuple[Case, np.ndarray]:
    """The case with its thesis's values, records of other ones, and these values."""
    variant = VARIANTS[name]
    random = np.random.default_rng([SETTING["version"], list(VARIANTS).index(name), seed])
    plain = variant.nominal(name)
    low, high = variant.bounds(plain)
    values = plain.true_values * variant.width ** random.uniform(-1, 1, len(plain.free))
    for key, (mean, deviation) in plain.priors.items():
        k = plain.free.index(key)
        ends = (low[k] - mean) / deviation, (high[k] - mean) / deviation
        values[k] = truncnorm.ppf(random.random(), *ends, loc=mean, scale=deviation)
    records = []
    for key in variant.records or ("misfire_1200rpm",):
        if variant.records:
            source, start = (
                kept_channels(f"crankshaft/{key}.csv.gz"),
                np.array(json.loads(STARTS_FILE.read_text())[key]),
            )
        else:
            source, start = _two_mass_source()
        if not variant.fixed:
            start = running(plain.shape, plain.full(values), start, source, random)
        noise = variant.sigma * random.standard_normal(source.samples)
        speed, drives = simulate(plain.shape, plain.full(values), start, source, noise)
        records.append(Record(key, drives, speed, source.channels | {"omega": speed}))
    return replace(plain, records=tuple(records)), values


def running(
    shape: Shape, full: np.ndarray, start: np.ndarray, source: Channels, random: np.random.Generator
) -> np.ndarray:
    """The state of an engine that has been running with these parameters, at the crank angle of the record's beginning:
    that of one of the cycles in the later half of a record without noise."""
    _, drives = simulate(shape, full, start, source, np.zeros(source.samples))
    cycles = (source.channels["theta"] - source.channels["theta"][0]) / (4 * np.pi)
    moments = np.searchsorted(cycles, np.arange(1, int(cycles[-1]) + 1))
    stop = int(random.choice(moments[moments >= source.samples // 2]))
    f, g, h = discretise(shape, full, STEP)
    push = g @ drives[:, :-1] + h @ drives[:, 1:]
    state = start
    for k in range(stop):
        state = f @ state + push[:, k]
    return state


def fit_of(case: Case, seed: int) -> ce.Fit:
    """The fit from a start within 10 % of the thesis's values, between the bounds that the truth was drawn from."""
    model, names = model_of(case)
    low, high = VARIANTS[case.name].bounds(case)
    start = case.true_values * (1 + 0.1 * np.random.default_rng([16, seed]).uniform(-1, 1, len(case.free)))
    parameters = parameters_of(case, model, names, start)
    for name, least, most in zip(case.free, low.tolist(), high.tolist(), strict=True):
        parameters[names[name]].set(min=least, max=most)
    return ce.estimate(
        model, experiments(case), parameters=parameters, noise=ce.Noise(omega=case.sigma), progress=False
    )


def row(piece: dict[str, Any]) -> dict[str, Any]:
    """One simulation as plain numbers: piece = {"variant": name, "seed": number}."""
    case, truth = drawn(piece["variant"], piece["seed"])
    begun = time.process_time()
    fit = fit_of(case, piece["seed"])
    answer: dict[str, Any] = {"status": fit.status, "fit": time.process_time() - begun}
    names = TWO_MASS_NAMES if case.shape.size == 2 else {key: key for key in case.free}
    values = dict(zip(case.free, truth.tolist(), strict=True))
    errors = {key: fit.stderr[names[key]] for key in case.free}
    answer["z"] = {
        key: None if error is None else (fit.values[names[key]] - values[key]) / error
        for key, error in errors.items()
    }
    begun = time.process_time()
    try:
        post = ce.posterior(fit, draws=SETTING["draws"])
    except CasadiEngineError as error:
        return answer | {"refused": str(error), "seconds": time.process_time() - begun}
    return answer | {
        "seconds": time.process_time() - begun,
        "rank": {key: float(np.mean(post[names[key]] < value)) for key, value in values.items()},
        "height": height_rank(fit, post, {names[key]: value for key, value in values.items()}),
        "method": post.method,
        "why": post.why,
        "evaluations": post.evaluations,
        "modes": sum(mode.mass > 0.01 for mode in post.modes),
        "size": min([*post.bulk.values(), *post.tail.values()]),
        "log_evidence_error": post.log_evidence_error,
    }


def height_rank(fit: ce.Fit, post: Posterior, truth: dict[str, float]) -> float:
    """The rank of the truth's log density among those of draws, all data looked at."""
    target = Target(fit)
    some = np.linspace(0, len(post.values) - 1, COMPARED).round().astype(int)
    places = [target.coordinates.of(np.array([post[name][k] for name in target.free])) for k in some]
    own = target.coordinates.of(np.array([truth[name] for name in target.free]))
    heights = target.full(np.array([own, *places]))
    return float(np.mean(heights[1:] < heights[0]))


def run(name: str, count: int, folder: Path) -> None:
    """The first simulations of a variant; what was kept is not done again."""
    first, done = VARIANTS[name].first, taken_in(name, folder).rows
    pieces = [{"variant": name, "seed": seed} for seed in range(first, first + count) if seed not in done]
    if pieces:
        study(row, pieces, name=name, setting=SETTING, checkpoint=checkpoint(name, folder))
        taken_in(name, folder)


def checkpoint(name: str, folder: Path) -> Path:
    """Where the rows of a variant go as they are made."""
    return folder / f"posterior-{name}.jsonl"


def taken_in(name: str, folder: Path) -> Kept:
    """The rows that are kept of a variant, with those of its checkpoint."""
    kept, path = Kept(folder, name, SETTING), checkpoint(name, folder)
    lines = path.read_text("utf-8").splitlines(keepends=True) if path.exists() else []
    if lines and lines[0].endswith("\n") and json.loads(lines[0])["setting"] == key_of(SETTING):
        made = [json.loads(line) for line in lines[1:] if line.endswith("\n")]
        kept.add({one["piece"]["seed"]: one["row"] for one in made})
    return kept


# ---- the table


def uniform(ranks: np.ndarray) -> float:
    """Probability of a larger distance from uniform (Kolmogorov & Smirnov), if ranks are."""
    from scipy.stats import kstest

    return float(kstest(ranks, "uniform").pvalue)


def table(found: dict[str, Rows]) -> str:
    """The study as Markdown."""
    head = ["variant", "parameter", "simulations", *(f"in {level} %" for level in LEVELS), "± of these",
            "uniform (p)", "95 % of the fit's ±"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, rows in found.items():
        good = [one for one in rows if "rank" in one]
        for key in good[0]["rank"] if good else ():
            ranks = np.array([one["rank"][key] for one in good])
            inside = [np.mean(np.abs(ranks - 0.5) <= level / 200) for level in LEVELS]
            far = [abs(one["z"][key]) <= 1.96 for one in good if one["z"][key] is not None]
            spread = [np.sqrt(level / 100 * (1 - level / 100) / len(ranks)) for level in LEVELS]
            cells = [VARIANTS[name].words, key, len(ranks), *(f"{100 * one:.1f} %" for one in inside),
                     ", ".join(f"{100 * one:.1f}" for one in spread), f"{uniform(ranks):.2f}",
                     f"{100 * np.mean(far):.1f} %" if far else "none claimed"]  # fmt: skip
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join([*lines, "", *(joint(name, rows) for name, rows in found.items())])


def joint(name: str, rows: Rows) -> str:
    """What all parameters of a variant say together, and what it took."""
    good = [one for one in rows if "rank" in one]
    ranks = np.array([list(one["rank"].values()) for one in good])
    inside = [np.mean(np.abs(ranks - 0.5) <= level / 200) for level in LEVELS]
    seconds = np.array([one["seconds"] for one in rows])
    shares = ", ".join(f"{100 * one:.1f} % in {level} %" for one, level in zip(inside, LEVELS, strict=True))
    walked = sum(one["why"] != FEW for one in good)
    heights = np.array([one["height"] for one in good if one.get("height") is not None])
    words = (
        f"; the truth's log density among {len(heights)} rows' draws: mean rank {heights.mean():.2f}, uniform (p) "
        f"{uniform(heights):.2f}"
        if len(heights)
        else ""
    )
    return (
        f"- {VARIANTS[name].words}: {len(good)} of {len(rows)} answered, of the {VARIANTS[name].count} asked for; "
        f"all parameters together: {shares}{words}; CPU {np.median(seconds):.1f} s median, {seconds.max():.1f} s at "
        f"most; {walked} by an ensemble of walkers; several modes in {sum(one['modes'] > 1 for one in good)}; "
        f"median {np.median([one['evaluations'] for one in good]):.0f} evaluations."
    )


def write(text: str) -> None:
    """POSTERIOR.md: the table between its marks, what is said of it stays."""
    path = HERE / "POSTERIOR.md"
    begin, end = "<!-- begin of what posterior_study.py writes -->", "<!-- end -->"
    old = path.read_text("utf-8") if path.exists() else f"# Is the posterior calibrated?\n\n{begin}\n{end}\n"
    before, after = old.split(begin)[0], old.split(end)[1]
    dated = f"{datetime.date.today():%Y-%m-%d}, `python tests/benchmarks/posterior_study.py --write`."
    path.write_text(f"{before}{begin}\n\n{dated}\n\n{text}\n\n{end}{after}", "utf-8")


def main() -> None:
    """Run what is not done, print the table, write it if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", default=[])
    parser.add_argument("--count", type=int, help="simulations of each variant")
    parser.add_argument("--folder", type=Path, default=HERE)
    parser.add_argument(
        "--kept", action="store_true", help="run nothing: the table of what the checkpoints hold"
    )
    parser.add_argument("--write", action="store_true", help="write POSTERIOR.md from all checkpoints")
    asked = parser.parse_args()
    if not asked.kept:
        for name in asked.names or VARIANTS:
            run(name, asked.count or VARIANTS[name].count, asked.folder)
    found = {name: list(rows.values()) for name in VARIANTS if (rows := taken_in(name, asked.folder).rows)}
    text = table(found)
    referee = posterior_referee.kept(asked.folder)
    if referee:
        text += "\n\n" + posterior_referee.table(referee)
    print(text)
    if asked.write:
        write(text)


if __name__ == "__main__":
    main()
