"""A posterior on one screen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.posterior.target import NARROW

if TYPE_CHECKING:
    from casadi_engine.posterior.result import Posterior

# Modes with a smaller share of the draws are not shown, and of the others at most so many.
_SMALL, _SHOWN = 0.01, 4
_LEVELS = (50, 80, 95)
# Share of the prior in a 95 % interval of the posterior from which the records tell hardly anything.
_UNTOLD = 0.8


def table(post: Posterior) -> str:
    """Median and intervals, with R-hat where there are chains, and the effective sample size."""
    head = ["parameter", "median", *(f"{level} % interval" for level in _LEVELS), "unit"]
    head += ["R-hat", "ESS"] if post.rhat else ["ESS"]
    rows = [head]
    for name, unit in zip(post.names, post.units, strict=True):
        own = post[name]
        ends = [post.interval(name, level / 100) for level in _LEVELS]
        digits = _digits(ends[-1])
        row = [name, _number(float(np.median(own)), digits)]
        row += [f"{_number(low, digits)} .. {_number(high, digits)}" for low, high in ends]
        row.append(unit)
        size = min(post.bulk[name], post.tail[name])
        row += [f"{post.rhat[name]:.3f}"] if post.rhat else []
        rows.append([*row, f"{size:.0f}"])
    wide = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if k in (0, 5) else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(row, wide, strict=True))
        ).rstrip()
        for row in rows
    )


def _digits(ends: tuple[float, float]) -> int:
    """Digits after the point that show two of the interval's width; negative ones are zeros before it."""
    width = ends[1] - ends[0]
    if not width > 0:
        return 6
    return int(1 - np.floor(np.log10(width)))


def _number(value: float, digits: int) -> str:
    """A number with so many digits after the point, or two that count where these are zeros; as a power of ten where
    that is too long."""
    if value and abs(value) < 10.0 ** (1 - digits):
        digits = int(1 - np.floor(np.log10(abs(value))))
    size = np.floor(np.log10(abs(value))) if value else 0.0
    if size >= 7 or size < -4:
        return f"{value:.{max(int(size) + digits, 1)}e}"
    return f"{value:.{max(digits, 0)}f}"


def summary(post: Posterior) -> str:
    """What was found, how, and what it means."""
    records = post.fit.data
    count = len(post.names)
    head = f"Posterior of {count} parameter{'s' * (count > 1)} given {len(records)} record{'s' * (len(records) > 1)}"
    lines = [f"{head}: {len(post.values)} draws, {post.method}", "", table(post), ""]
    lines += _modes(post)
    lines.append(f"log evidence: {post.log_evidence:.2f} ± {post.log_evidence_error:.2g}")
    lines.append(f"prior: {_priors(post)}")
    lines += _untold(post) + _elsewhere(post) + _noise(post) + _states(post)
    lines.append(_quality(post))
    return "\n".join(lines)


def _untold(post: Posterior) -> list[str]:
    """Parameters whose interval is nearly that of the prior."""
    names = post.names[: len(post.prior.low)]
    shares = {name: post.prior.share(k, *post.interval(name, 0.95)) for k, name in enumerate(names)}
    untold = [name for name, share in shares.items() if share > _UNTOLD]
    return (
        [f"the records tell hardly anything of {', '.join(untold)}: intervals are the prior's"]
        if untold
        else []
    )


def _states(post: Posterior) -> list[str]:
    """That the prior of initial states decides, where the records do not tell them."""
    untold, whole = post.untold_states
    if not untold:
        return []
    return [
        f"the records hardly tell {untold} of {whole} directions of their initial states: these are taken to be like "
        "those of a later moment at which the drives go on alike, or like the motion along the record; where they are "
        "neither, intervals may be too narrow"
    ]


def _noise(post: Posterior) -> list[str]:
    """That the likelihood of white noise counts for less, where the residual is none."""
    if post.root == 1.0:
        return []
    grown = {name: post.fit.own_noise.get(name, 1.0) for name in post.fit.free}
    most, least = max(grown, key=lambda name: grown[name]), min(grown.values())
    wide = grown[most] / max(least, 1.0)
    others = f"; those of others may be up to {wide:.2g} times too wide" if wide >= NARROW else ""
    return [
        "the residual is not white noise of the fit's level, as the likelihood has it: the log likelihood is "
        f"divided by {post.root:.3g}, so that the interval of {most} is as wide as its error in the fit asks{others}"
    ]


def _elsewhere(post: Posterior) -> list[str]:
    """That the fit ended at a poor optimum, if it did."""
    outside = [
        name
        for name, own in post.draws.items()
        if name in post.fit.free
        and post.fit.estimates[name].at_bound is False
        and not own.min() <= post.fit.values[name] <= own.max()
    ]
    if not outside:
        return []
    words = f"the fit's {', '.join(outside)} lies outside all draws: a better optimum was met"
    return [f"{words}; start a fit from post.modes[0].values"]


def _modes(post: Posterior) -> list[str]:
    shown = [one for one in post.modes if one.mass >= _SMALL][:_SHOWN]
    joined = sum(one.optima for one in post.modes)
    if len(shown) < 2:
        many = f" that joins {joined} optima of the density" if joined > 1 else ""
        return [f"one mode{many}, found by {post.searches} searches"]
    lines = [f"{len(shown)} modes, found by {post.searches} searches: an interval may have gaps"]
    for one in shown:
        values = ", ".join(f"{name} {one.values[name]:.4g}" for name in _apart(post))
        lines.append(f"  {100 * one.mass:5.1f} % of the mass about {values}")
    return lines


def _apart(post: Posterior) -> list[str]:
    """The parameters in which the first two modes differ most, in standard deviations of the draws."""
    first, second = post.modes[0].values, post.modes[1].values
    far = [abs(second[name] - first[name]) / max(float(post[name].std()), 1e-300) for name in post.names]
    return [post.names[k] for k in np.argsort(far)[::-1][:3]]


def _priors(post: Posterior) -> str:
    kinds: dict[str, list[str]] = {}
    for name, words in post.priors.items():
        kind = words.split(",")[0]
        kinds.setdefault("given, normal" if kind == "normal" else kind + " between the bounds", []).append(
            name
        )
    return "; ".join(f"{kind}: {', '.join(names)}" for kind, names in kinds.items())


def _quality(post: Posterior) -> str:
    size = min([*post.bulk.values(), *post.tail.values()])
    seen = f"R-hat {max(post.rhat.values()):.3f} at most" if post.rhat else f"Pareto k-hat {post.shape:.2f}"
    where = (
        "" if post.bins is None else f", in {post.bins[0]} of {post.bins[1]} frequency bins and then in all"
    )
    return (
        f"quality: {seen}, worth {size:.0f} independent draws; {post.evaluations} evaluations{where}, "
        f"{post.seconds:.1f} s"
    )
