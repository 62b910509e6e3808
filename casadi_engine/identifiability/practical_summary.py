"""Practical identifiability on one screen each: information, profiles, sweeps and choices of experiments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.estimation.fit import Estimate
from casadi_engine.estimation.summary import COLUMNS, LINES, aligned, count, number, short, wrapped

if TYPE_CHECKING:
    from casadi_engine.identifiability.choice import ExperimentChoice
    from casadi_engine.identifiability.fisher import Information
    from casadi_engine.identifiability.profile import Profile, ProfileLine
    from casadi_engine.identifiability.sweep import LossSweep

# Relative standard errors: below the first a number is known well, above the second hardly at all.
WELL, HARDLY = 0.05, 0.5
ROWS, DIRECTIONS, COLUMNS_OF_CHOICE = 24, 4, 8


def percent(estimate: Estimate) -> str:
    """Expected error in per cent of the value, or a dash.

    >>> percent(Estimate(2.0, 0.01, "kg m2")), percent(Estimate(2.0, None, "kg m2"))
    ('0.5', '-')
    """
    if estimate.stderr is None or estimate.value == 0:
        return "-"
    return number(100 * abs(estimate.stderr / estimate.value), ".2g")


def verdict(estimate: Estimate) -> str:
    """What an expected error means, in a word or two."""
    if estimate.fixed:
        return "fixed"
    if estimate.stderr is None:
        return estimate.why or "no error"
    if estimate.value == 0:
        return ""
    relative = abs(estimate.stderr / estimate.value)
    return "well known" if relative <= WELL else "hardly known" if relative > HARDLY else "known"


def information_text(info: Information) -> str:
    """Expected errors of all parameters that are not fixed, and the sloppiest directions in words."""
    shown = [(name, one) for name, one in info.errors.items() if not one.fixed]
    units = {out.name: out.unit for out in info.model.outputs}
    noise = ", ".join(
        f"{name} {level:.3g} {units[name]}{' (what these values leave)' if found else ''}"
        for name, (level, found) in info.noise.items()
    )
    if any(found for _, found in info.noise.values()):
        noise += "; where the values are guesses, their misfit counts as noise: fit first, or state it"
    lines = [
        f"Fisher information of {info.model.name}: {len(info.records)} record"
        f"{'s' * (len(info.records) > 1)}, {count(info.n)} samples, {info.duration:.4g} s",
        *wrapped(f"  noise     {noise}; initial states estimated too unless known", " " * 12),
        "Expected standard errors (Cramér-Rao)",
    ]
    rows = [
        (short(name, 24), f"{one.value:.6g}", number(one.stderr, ".2g"), one.unit, percent(one), verdict(one))
        for name, one in shown[:ROWS]
    ]
    lines += aligned([("parameter", "value", "error", "unit", "%", ""), *rows], right=(1, 2, 4))
    if len(shown) > ROWS:
        lines.append(f"  … and {len(shown) - ROWS} more: info.errors")
    lines.append("Sloppiest directions (relative changes that go together)")
    for direction in info.directions[:DIRECTIONS]:
        known = (
            "not determined at all"
            if not math.isfinite(direction.stderr)
            else f"known to {100 * direction.stderr:.2g} %"
        )
        lines += wrapped(f"  {known:<22} {direction.text}", " " * 25)
    return "\n".join([*lines[: LINES - 2], *wrapped(f"Next: {_next_of_information(info)}", "      ")])


def _next_of_information(info: Information) -> str:
    if info.undetermined:
        return (
            f"fix or tie one of {', '.join(info.undetermined[0].weights)}, or excite the system otherwise: "
            "ce.choose_experiments"
        )
    poor = [name for name in info.free if (info.relative.get(name) or 0) > HARDLY]
    if poor:
        return f"give {', '.join(poor[:3])} a prior, fix or tie them, or look for a better experiment"
    return "look at the profiles, which need no quadratic: ce.profile(fit)"


def profile_text(profile: Profile) -> str:
    """Intervals of all profiled parameters beside those of the standard errors."""
    level = f"{100 * profile.level:.4g} %"
    lines = [
        f"Profile likelihood of {profile.fit.model.name}: {profile.refits} refits, {level} intervals",
    ]
    rows = [
        (short(name, 24), f"{line.estimate.value:.6g}", *_ends(line), line.unit, _by_error(line), shape(line))
        for name, line in list(profile.lines.items())[:ROWS]
    ]
    header = ("parameter", "estimate", "from", "to", "unit", "by standard error", "shape")
    lines += aligned([header, *rows], right=(1, 2, 3))
    for line in profile.lines.values():
        for side, why in (("below", line.interval.low_why), ("above", line.interval.high_why)):
            if why is not None:
                lines += wrapped(f"  {line.name}, {side}: {why}", "    ")
    for message in profile.messages:
        lines += wrapped(f"Note: {message}", "      ")
    return "\n".join([*lines[: LINES - 1], "Next: look at the curves: ce.plot(profile)"])


def _ends(line: ProfileLine) -> tuple[str, str]:
    return tuple(number(end, ".6g") for end in (line.interval.low, line.interval.high))  # type: ignore[return-value]


def _by_error(line: ProfileLine) -> str:
    error = line.error
    if not error:
        return "-"
    half = math.sqrt(line.threshold) * error
    return f"{line.estimate.value - half:.6g} … {line.estimate.value + half:.6g}"


def shape(line: ProfileLine) -> str:
    """How far the interval is from the symmetric one of the standard error."""
    low, high = line.interval.low, line.interval.high
    if line.interval.lost:
        bare = not any("optimum" in (why or "") for why in (line.interval.low_why, line.interval.high_why))
        return f"not known: {'a refit did not end' if bare else 'there is another optimum'}"
    if low is None and high is None:
        return "flat: not identifiable in practice"
    if low is None or high is None:
        return "open on one side"
    below, above = line.estimate.value - low, high - line.estimate.value
    error = line.error
    if below <= 0 or above <= 0:
        return "the estimate lies outside"
    skew = above / below
    same = error and abs(0.5 * (above + below) / (math.sqrt(line.threshold) * error) - 1) < 0.1
    if same and 0.8 < skew < 1.25:
        return "parabola"
    return (
        f"one side {max(skew, 1 / skew):.2g} times the other" if not 0.8 < skew < 1.25 else "not a parabola"
    )


def sweep_text(sweep: LossSweep) -> str:
    """Where the loss of each sweep is lowest, and how it rises to both ends."""
    lines = [
        f"Loss of {sweep.model.name}, one parameter at a time, {count(sweep.samples)} samples, "
        f"initial states {sweep.start}",
        f"  V at the reference values  {sweep.at_reference:.4g}",
    ]
    rows = []
    for name in sweep.values:
        at, lowest = sweep.minimum(name)
        loss = sweep.loss[name][np.isfinite(sweep.loss[name])]
        words = "U-shape" if sweep.has_minimum(name) else "no minimum in the range"
        rows.append(
            (
                name,
                f"{sweep.reference[name]:.5g}",
                f"{at:.5g}",
                f"{lowest:.3g}",
                f"{loss[0]:.3g}",
                f"{loss[-1]:.3g}",
                words,
            )
        )
    header = ("parameter", "reference", "lowest at", "V there", "V low end", "V high end", "")
    lines += aligned([header, *rows[:ROWS]], right=range(1, 6))
    return "\n".join([*lines, "Next: others held, a sweep hides correlation: compare ce.profile(fit)"])


def choice_text(choice: ExperimentChoice) -> str:
    """Expected errors of every candidate alone, and of the set chosen."""
    names = _asked(choice)
    sets = "all sets" if choice.every else "greedy with exchange"
    lines = [
        *wrapped(
            f"Choice of {len(choice.chosen)} of {len(choice.candidates)} experiments by {_criterion(choice)} "
            f"({choice.tried} sets tried, {sets})",
            "  ",
        ),
        "Expected errors in % of the value, each alone",
    ]
    shown = names[:COLUMNS_OF_CHOICE]
    rows = [("experiment", *(short(name, 10) for name in shown), "criterion")]
    ordered = sorted(choice.candidates.values(), key=lambda one: one.value)
    for one in ordered[:16]:
        mark = "* " if one.name in choice.chosen else "  "
        rows.append((mark + short(one.name, 34), *_cells(one.errors, shown), f"{one.value:.3g}"))
    rows.append(("= the set (*)", *_cells(choice.errors, shown), f"{choice.value:.3g}"))
    lines += aligned(rows, right=range(1, len(shown) + 2), indent="")
    if len(ordered) > 16:
        lines.append(f"  … and {len(ordered) - 16} more candidates: choice.candidates")
    if len(names) > len(shown):
        rest = ", ".join(f"{name} {percent(choice.errors[name])}" for name in names[len(shown) :])
        lines += wrapped(f"  the set, other parameters: {rest}", "    ")
    if len(choice.by_size) > 1:
        steps = ", ".join(f"{k}: {value:.3g}" for k, value in enumerate(choice.by_size, start=1))
        lines += wrapped(f"  criterion by number of experiments  {steps}", "    ")
    lines = [line[:COLUMNS] for line in lines[: LINES - 3]]
    return "\n".join([*lines, *wrapped(f"Next: {_next_of_choice(choice)}", "      ")])


def _asked(choice: ExperimentChoice) -> list[str]:
    if isinstance(choice.criterion, Mapping):
        return list(choice.criterion)
    free = [name for name in choice.free if name in choice.errors]
    return free or list(choice.errors)


def _cells(errors: Mapping[str, Estimate], names: Iterable[str]) -> list[str]:
    return [percent(errors[name]) for name in names]


def _criterion(choice: ExperimentChoice) -> str:
    if isinstance(choice.criterion, Mapping):
        wanted = ", ".join(f"{name} {100 * target:.3g} %" for name, target in choice.criterion.items())
        return f"wanted errors: {wanted}"
    words = {"A": "mean square error", "D": "volume of the confidence ellipsoid", "E": "worst direction"}
    return f"{choice.criterion} ({words[choice.criterion]})"


def _next_of_choice(choice: ExperimentChoice) -> str:
    together = " and fit them together" if len(choice.chosen) > 1 else " and fit it"
    made = f"make {', '.join(choice.chosen)}{together}"
    if choice.met is False and isinstance(choice.criterion, Mapping):
        late = [
            (name, choice.length_for(name, target))
            for name, target in choice.criterion.items()
            if (choice.relative[name] or math.inf) > target
        ]
        words = [
            f"{name} would take {length:.3g} s of such data"
            if length is not None
            else f"{name} is not determined"
            for name, length in late[:3]
        ]
        return f"not all wanted errors are met: {'; '.join(words)}; fix, tie or give a prior, or add a sensor"
    return made
