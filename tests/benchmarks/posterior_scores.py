"""Is the likelihood of the posterior's six records right? Its score at the truth, by simulation.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/posterior_scores.py [--seeds N] [--draws N] [--left-out SHARE]

Of a right likelihood the mean square of the score at the truth is the information, the mean of its negative curvature,
in every direction: a necessary condition of calibrated posteriors that costs far less than a posterior, and says in
which direction they are too narrow. The truths are those of posterior_study.py; records are simulated in the few
dimensions in which parameters and initial states act, the rest of them being noise alone.

Initial states, of each simulation anew: "thesis", the thesis's, whatever the parameters; "running", of an engine that
has been running with these parameters, at the crank angle of the record's beginning; "anywhere", at any moment of the
later half of the record. Priors: "known", none is needed; "motion", of the motion along the record or wide, as until
2026-11-24; "now", that of ``posterior.states``.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from cases import STARTS_FILE, kept_channels  # noqa: E402
from ours import experiments, model_of, parameters_of  # noqa: E402
from posterior_study import VARIANTS, drawn, running  # noqa: E402

import casadi_engine as ce  # noqa: E402
from casadi_engine.estimation.record import RecordTerm  # noqa: E402
from casadi_engine.estimation.search import Search  # noqa: E402
from casadi_engine.estimation.single_shots import evaluator  # noqa: E402
from casadi_engine.estimation.starts import chained_nodes  # noqa: E402
from casadi_engine.posterior.last_state import last_state  # noqa: E402
from casadi_engine.posterior.modal import Transients  # noqa: E402
from casadi_engine.posterior.spectral_likelihood import SpectralLikelihood  # noqa: E402
from casadi_engine.posterior.states import StatePrior, state_prior  # noqa: E402

Array = np.ndarray
VARIANT = "B6"
# Length of the differences, in standard errors of a direction; samples between states along a record.
STEP, APART = 0.1, 25
# What is less than this share of a standard deviation of the noise is nothing.
NOTHING = 1e-4


@dataclass(frozen=True)
class World:
    """One record near a truth, in the dimensions in which something acts.

    rows : (P, n, r) what the first state does; rest : (P, r) the outputs without it, less those at the truth
    prior : of the first state; starts : population -> (m, n) first states to choose from
    """

    rows: Array
    rest: Array
    prior: StatePrior
    starts: dict[str, Array]


def truth_of(seed: int) -> tuple[Search, Array, Array]:
    """The problem of a seed's records, its truth's coordinates, and the full vector of its parameters."""
    case, values = drawn(VARIANT, seed)
    model, names = model_of(case)
    parameters = parameters_of(case, model, names, values)
    for name, low, high in zip(case.free, *VARIANTS[VARIANT].bounds(case), strict=True):
        parameters[names[name]].set(min=float(low), max=float(high))
    search = evaluator(model, experiments(case), parameters, ce.Noise(omega=case.sigma))
    own = dict(zip(case.free, values, strict=True))
    return (
        search,
        search.coordinates.of(np.array([own[name] for name in search.pmap.free])),
        case.full(values),
    )


def starts_of(record: RecordTerm, search: Search, v: Array, full: Array, seed: int) -> dict[str, Array]:
    """First states of each population, scaled."""
    shape, key = VARIANTS[VARIANT].nominal(VARIANT).shape, record.experiment.name
    labels = [f"omega_{k + 1}" for k in range(shape.size)]
    labels += [f"twist_{k + 2}{k + 1}" for k in range(shape.size - 1)]
    order = [labels.index(state.name) for state in search.model.states]
    thesis, source = (
        np.array(json.loads(STARTS_FILE.read_text())[key]),
        kept_channels(f"crankshaft/{key}.csv.gz"),
    )
    runs = [running(shape, full, thesis, source, np.random.default_rng([seed, k])) for k in range(4)]
    scaled = np.array([thesis, *runs])[:, order] / record.scale
    nodes = chained_nodes(record.again(gain=record.gain, length=APART), v, scaled[0])
    return {"thesis": scaled[:1], "running": scaled[1:], "anywhere": nodes[len(nodes) // 2 :]}


def worlds_of(seed: int, left_out: float) -> list[World]:
    """Of the records of one seed: at the truth, and a step to either side along each direction of the information, the
    one that the data tell least of first."""
    search, v, full = truth_of(seed)
    sigma = np.array([VARIANTS[VARIANT].sigma])
    starts = [starts_of(record, search, v, full, seed) for record in search.records]
    priors = [
        state_prior(record, v, own["running"][0]) for record, own in zip(search.records, starts, strict=True)
    ]
    likelihood = SpectralLikelihood(search.records, v, priors)
    likelihood.choose([v], sigma, left_out)
    found = likelihood.squares(v, sigma)
    assert found is not None
    sizes, axes = np.linalg.eigh(found.matrix)
    sides = STEP * axes.T / np.sqrt(sizes)[:, None]
    points = v + np.array([0 * v, *(sign * side for side in sides for sign in (1, -1))])
    core = search.records[0].propagator.core
    model = Transients(core, points[:, search.records[0].active], np.tile(sigma, (len(points), 1)))
    turn = model.turn.swapaxes(1, 2)
    return [
        _reduced(record, model.at(likelihood._basis(k, v, whole=False)), turn, points, priors[k], starts[k])
        for k, record in enumerate(search.records)
    ]


def _reduced(
    record: RecordTerm,
    bins: tuple[Array, Array],
    turn: Array,
    points: Array,
    prior: StatePrior,
    starts: dict[str, Array],
) -> World:
    """One record in the dimensions that a step of parameters and states of the motion's size act in; bins : what the
    transients do in them, in coordinates that ``turn`` leads back from, and the residual without any."""
    rows, rest = turn @ bins[0], bins[1]
    last = [last_state(record, v) for v in points]
    rest = rest + np.array([forced @ own for (_, forced), own in zip(last, rows, strict=True)])
    rows = np.array([(np.eye(record.n) + ahead).T @ own for (ahead, _), own in zip(last, rows, strict=True)])
    centre = starts["thesis"][0]
    rest = rest + centre @ rows
    rest = rest - rest[0]
    size = 3 * starts["anywhere"].std(axis=0)
    acts = np.concatenate([(rows * size[:, None]).reshape(-1, rows.shape[2]), rest[1:]])
    squares, axes = np.linalg.eigh(acts @ acts.T)
    some = squares > NOTHING**2
    span = np.linalg.qr(((axes[:, some] / np.sqrt(squares[some])).T @ acts).T)[0]
    rows = rows @ span
    return World(rows, rest @ span - centre @ rows, prior, starts)


def scores(worlds: list[World], population: str, draws: int, random: np.random.Generator) -> dict[str, Array]:
    """Prior -> (2, draws, d) squared score and negative curvature at the truth, in squares of a standard error."""
    points = len(worlds[0].rest)
    logs = {name: np.zeros((draws, points)) for name in ("known", "motion", "now")}
    for world in worlds:
        motion = StatePrior(world.prior.means[:2], world.prior.factors[:2])
        for k in range(draws):
            first = random.choice(world.starts[population])
            noise = random.standard_normal(world.rest.shape[1])
            rest = world.rest - world.rest[0] - first @ world.rows[0] - noise
            logs["known"][k] -= 0.5 * np.square(rest + first @ world.rows).sum(axis=1)
            logs["motion"][k] += motion.integral(world.rows, rest)[0]
            logs["now"][k] += world.prior.integral(world.rows, rest)[0]
    found = {}
    for name, own in logs.items():
        here, up, down = own[:, :1], own[:, 1::2], own[:, 2::2]
        score, curvature = (up - down) / (2 * STEP), (2 * here - up - down) / STEP**2
        found[name] = np.array([np.square(score), curvature])
    return found


def table(seeds: int, draws: int, left_out: float) -> str:
    """Mean square of the score over the information, over all seeds, with the spread of the seeds."""
    lines = [
        "| initial states | prior | ratio in each direction, the weakest first | of all |",
        "|---|---|---|---|",
    ]
    found: dict[tuple[str, str], list[Array]] = {}
    for seed in range(VARIANTS[VARIANT].first, VARIANTS[VARIANT].first + seeds):
        worlds = worlds_of(seed, left_out)
        for population in worlds[0].starts:
            own = scores(worlds, population, draws, np.random.default_rng([seed, len(population)]))
            for name, parts in own.items():
                found.setdefault((population, name), []).append(parts.mean(axis=1))
    for (population, name), parts in found.items():
        square, curvature = np.moveaxis(np.array(parts), 1, 0)
        ratio = square.mean(axis=0) / curvature.mean(axis=0)
        spread = (square - ratio * curvature).std(axis=0) / np.sqrt(seeds) / curvature.mean(axis=0)
        cells = ", ".join(f"{one:.2f} ± {two:.2f}" for one, two in zip(ratio, spread, strict=True))
        whole = np.mean(square / curvature.mean(axis=0))
        lines.append(f"| {population} | {name} | {cells} | {whole:.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--draws", type=int, default=100, help="simulations of each seed")
    parser.add_argument("--left-out", type=float, default=0.0)
    asked = parser.parse_args()
    print(table(asked.seeds, asked.draws, asked.left_out))


if __name__ == "__main__":
    main()
