"""Evidence and masses of modes by the package and by nested sampling (dynesty), of the same densities.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/posterior_referee.py [NAME ...] [--folder PLACE]

NAME : two_modes (a density whose modes weigh 0.8 and 0.2), A, inertias (seven, one record: inertia_count.py), lynx_hare
and one_compartment (posteriordb, tests/posterior/test_reference_draws.py); all if none is given. So many live points
that dynesty's own error is below 0.1. It draws with the data that hold 90 % of the information; what the others say is
added at its own draws. Answers are kept in `posterior-referee.json`; ``posterior_study.py --write`` puts them into the
table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
for place in (HERE, HERE.parent / "posterior"):
    if str(place) not in sys.path:
        sys.path.insert(0, str(place))

import casadi_engine as ce  # noqa: E402
from casadi_engine.posterior.importance import sample  # noqa: E402
from casadi_engine.posterior.mixture import Mixture  # noqa: E402
from casadi_engine.posterior.psis import log_mean  # noqa: E402
from casadi_engine.posterior.target import LEVELS, Target  # noqa: E402

Answer = dict[str, Any]
FILE = "posterior-referee.json"
# Live points; draws at which the data that were left out are looked at.
LIVE, LOOKED_AT = 2500, 400
# Half the width of the box of the density with two modes, and how far these are apart.
WIDE, APART = 25.0, 15.0


def nested(log_likelihood: Callable[[Any], Any], from_unit: Callable[[Any], Any], d: int, live: int) -> Any:
    """dynesty's results."""
    import dynesty

    sampler = dynesty.NestedSampler(
        lambda u: max(float(log_likelihood(u[None])[0]), -1e300), from_unit, d, nlive=live,
        rstate=np.random.default_rng(0),
    )  # fmt: skip
    sampler.run_nested(dlogz=0.01, print_progress=False)
    return sampler.results


def two_modes() -> tuple[Answer, Answer]:
    """Two normal densities in four dimensions, of weights 0.8 and 0.2 and evidence 1 / width^4."""
    turn = np.random.default_rng(3).standard_normal((4, 4))
    covariance, width = turn @ turn.T + 0.1 * np.eye(4), 2 * WIDE + APART
    factor = np.linalg.cholesky(covariance)

    def normal(x: Any, mean: Any) -> Any:
        away = np.linalg.solve(factor, (x - mean).T)
        return -0.5 * np.square(away).sum(axis=0) - np.log(np.diag(factor)).sum() - 2 * np.log(2 * np.pi)

    def density(x: Any) -> Any:
        return np.logaddexp(np.log(0.8) + normal(x, 0.0), np.log(0.2) + normal(x, APART))

    centres, seen = np.array([np.zeros(4), np.full(4, APART)]), [0]

    def counted(x: Any) -> Any:
        seen[0] += len(x)
        return density(x)

    begun = time.process_time()
    own = sample(
        counted, Mixture.of(np.ones(2), centres, np.array([covariance] * 2)), np.random.default_rng(0)
    )
    ours = {"log_evidence": own.log_evidence - 4 * np.log(width), "error": own.error, "evaluations": seen[0],
            "seconds": time.process_time() - begun, "masses": _masses(own.x, own.weight, centres)}  # fmt: skip
    begun = time.process_time()
    found = nested(density, lambda unit: -WIDE + width * unit, 4, LIVE)
    draws = found.samples_equal(rstate=np.random.default_rng(1))
    return ours, _theirs(found, 0.0, begun) | {"masses": _masses(draws, np.ones(len(draws)), centres)}


def of_fit(fit: ce.Fit) -> tuple[Answer, Answer]:
    """The posterior of a fit both ways."""
    post = ce.posterior(fit, draws=4000)
    tops = np.array([[one.values[name] for name in post.names] for one in post.modes if one.mass > 0.01])
    spread = post.values.std(axis=0)
    ours = {"log_evidence": post.log_evidence, "error": post.log_evidence_error, "evaluations": post.evaluations,
            "seconds": post.seconds, "masses": _masses(post.values / spread, np.ones(4000), tops / spread)}  # fmt: skip
    begun, target = time.process_time(), Target(fit)
    target.choose([target.start[: target.nv]], 0.1)
    levels = (len(target.names) - target.nv) * float(np.log(2 * np.log(LEVELS)))

    def likelihood(u: Any) -> Any:
        return target.log_density(u) - target.prior.log_density(u[:, : target.nv]) + levels

    found = nested(likelihood, _prior_of(fit, target), len(target.names), LIVE)
    u = found.samples_equal(rstate=np.random.default_rng(1))
    some = u[np.random.default_rng(2).choice(len(u), LOOKED_AT, replace=False)]
    more = log_mean(target.full(some) - target.log_density(some))
    draws = target.values(u) / spread
    return ours, _theirs(found, more, begun) | {"masses": _masses(draws, np.ones(len(u)), tops / spread)}


def _prior_of(fit: ce.Fit, target: Target) -> Callable[[Any], Any]:
    """From the unit cube to the target's coordinates, by the prior."""
    from scipy.stats import truncnorm

    width = target.high - target.low
    given = {name: fit.parameters[name] for name in target.free if fit.parameters[name].prior is not None}

    def from_unit(unit: Any) -> Any:
        u = target.low + np.where(np.isfinite(width), width, 0.0) * unit
        if given:
            z = target.values(np.where(np.isfinite(u), u, target.start)[None])[0][: target.nv]
            for k, name in enumerate(target.free):
                if name in given:
                    (mean, sigma), own = given[name].prior, given[name]
                    ends = (own.min - mean) / sigma, (own.max - mean) / sigma
                    z[k] = truncnorm.ppf(unit[k], *ends, loc=mean, scale=sigma)
            u[: target.nv] = target.coordinates.of(z)
        return u

    return from_unit


def _masses(x: Any, weight: Any, tops: Any) -> list[float]:
    """Share of draws x (n, d) nearest to each of the modes' tops (k, d)."""
    nearest = np.argmin(np.square(x[:, None] - tops).sum(axis=2), axis=1)
    return [float(weight[nearest == k].sum() / weight.sum()) for k in range(len(tops))]


def _theirs(found: Any, more: float, begun: float) -> Answer:
    return {"log_evidence": float(found.logz[-1] + more), "error": float(found.logzerr[-1]),
            "evaluations": int(np.sum(found.ncall)), "seconds": time.process_time() - begun}  # fmt: skip


def _fit_of_a() -> ce.Fit:
    from posterior_study import drawn, fit_of

    return fit_of(drawn("A", 0)[0], 0)


def _fit_of_inertias() -> ce.Fit:
    from inertia_count import fit_of, problem

    return fit_of(7, *problem(7, 0))


def _reference(name: str) -> ce.Fit:
    import test_reference_draws

    found: ce.Fit = getattr(test_reference_draws, f"{name}_fit")()
    return found


PROBLEMS: dict[str, tuple[str, Callable[[], tuple[Answer, Answer]]]] = {
    "two_modes": ("two normal densities, 0.8 and 0.2, d = 4", two_modes),
    "A": ("A, d = 5", lambda: of_fit(_fit_of_a())),
    "inertias": ("seven inertias, one record, d = 6", lambda: of_fit(_fit_of_inertias())),
    "lynx_hare": ("lynx and hare, d = 8", lambda: of_fit(_reference("lynx_hare"))),
    "one_compartment": ("one compartment, d = 4", lambda: of_fit(_reference("one_compartment"))),
}


def table(kept: dict[str, dict[str, Answer]]) -> str:
    """What the referee says, as Markdown."""
    lines = [
        f"Against dynesty, {LIVE} live points, the same density:",
        "",
        "| problem | log evidence here | dynesty | apart | masses of modes here | dynesty | evaluations here | dynesty "
        "| CPU s here | dynesty |",
        "|---" * 10 + "|",
    ]
    for name, answer in kept.items():
        one, two = answer["ours"], answer["dynesty"]
        masses = [", ".join(f"{share:.3f}" for share in own["masses"]) for own in (one, two)]
        logs = [f"{own['log_evidence']:.2f} ± {own['error']:.2f}" for own in (one, two)]
        apart = abs(one["log_evidence"] - two["log_evidence"])
        cells = [PROBLEMS[name][0], *logs, f"{apart:.2f}", *masses, one["evaluations"], two["evaluations"],
                 f"{one['seconds']:.1f}", f"{two['seconds']:.0f}"]  # fmt: skip
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def kept(folder: Path) -> dict[str, dict[str, Answer]]:
    """The answers so far."""
    path = folder / FILE
    return dict(json.loads(path.read_text("utf-8"))) if path.exists() else {}


def main() -> None:
    """Do what is not done yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", default=[])
    parser.add_argument("--folder", type=Path, default=HERE)
    asked = parser.parse_args()
    for name in asked.names or PROBLEMS:
        if name not in kept(asked.folder):
            ours, theirs = PROBLEMS[name][1]()
            answers = kept(asked.folder) | {name: {"ours": ours, "dynesty": theirs}}
            path = asked.folder / FILE
            part = path.with_suffix(".part")
            part.write_text(json.dumps(answers, indent=1), "utf-8")
            part.replace(path)
    print(table(kept(asked.folder)))


if __name__ == "__main__":
    main()
