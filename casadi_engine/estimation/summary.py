"""A fit on one screen: what was found, how sure it is, and what to do next."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.estimation.behind_a_bound import NOT_TOLD
from casadi_engine.estimation.faulty_samples import IN_DOUBT, faults
from casadi_engine.estimation.few_samples import UNKNOWN
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.followed import OTHERS, lost
from casadi_engine.estimation.gain_table import gain_rows, predictor_words
from casadi_engine.estimation.loss import loss_of
from casadi_engine.experiment.units import unit_words
from casadi_engine.model.declared_units import seconds_in

if TYPE_CHECKING:
    from casadi_engine.parameters import Parameter

LINES, COLUMNS = 45, 100
# Standard deviations beyond which a sample is no noise, where a robust loss is to say so.
_WILD = 5.0
# How far chi-squared per sample may be from 1 to be near it.
_NEAR = 0.5
# Rows of each part at most; what is left out is said in words.
ROWS = {"fit": 6, "parameters": 20, "initial": 4, "correlations": 5, "directions": 3, "gain": 4}
STRONG = 0.5
# Two costs closer than this are one optimum for the reader: a chi-square difference of 0.01 means nothing.
SAME_COST = 0.01

FRESH = "test it on data it has not seen: print(ce.validate(fit, fresh))"
BOUND_WORDS = {"min": "lower", "max": "upper"}


def summary(fit: Fit) -> str:
    """Return a fit as text of at most 45 lines and 100 columns, with the next step last.

    Values stand with their standard errors in the parameter's unit; fit percentages (2.32) are labelled
    simulation or one-step prediction.
    """
    for notes in (9, 6, 4, 2):  # parameters give way first, then the notes; the next step stays
        for rows in range(ROWS["parameters"], 3, -1):
            lines = _lines(fit, rows, notes)
            if len(lines) <= LINES:
                return "\n".join(line.rstrip() for line in lines)
    return "\n".join(line.rstrip() for line in lines[:LINES])


def _lines(fit: Fit, rows: int, notes: int) -> list[str]:
    return [
        *_header(fit),
        *_fit_rows(fit),
        *parameter_lines(fit, rows),
        *_gain(fit),
        *_initial(fit),
        *_correlations(fit),
        *_directions(fit),
        *_optima(fit),
        *_said(fit, notes),
        *wrapped(f"Next: {'; '.join(next_steps(fit)[:2])}", "      "),
    ]


def _said(fit: Fit, most: int) -> list[str]:
    """The messages that have room in so many lines, each whole, but for those on directions, which have lines of their
    own; the first one is cut where it has none, and how many more there are is said."""
    rest = [message for message in fit.messages if not message.startswith("the data do not determine")]
    notes, lines, shown = [wrapped(f"Note: {message}", "      ") for message in rest], list[str](), 0
    for note in notes:
        room = most - len(lines) - (shown + 1 < len(notes))  # the count of the others stands behind
        if len(note) > room and lines:
            break
        shown += 1
        lines += note if len(note) <= most else [*note[: most - 1], f"{note[most - 1][: COLUMNS - 2]} …"]
    if shown < len(notes) and len(lines) < most:
        lines.append(f"Note: {len(notes) - shown} more in fit.messages")
    return lines


# ---- numbers ------------------------------------------------------------------------------------------


def with_error(value: float, stderr: float | None) -> str:
    """Write ``value ± stderr``: the error with two significant digits, the value to the same place.

    >>> with_error(0.391083, 0.00042), with_error(1992.0, 12.0), with_error(2.5, None)
    ('0.39108 ± 0.00042', '1992 ± 12', '2.5')
    >>> with_error(3.1234e9, 2.1e6), with_error(0.0, 3.0e-7)
    ('3.1234e+09 ± 2.1e+06', '0 ± 3.0e-07')
    """
    if stderr is None or not math.isfinite(stderr) or not math.isfinite(value):
        return f"{value:.6g}"
    if stderr <= 0:
        return f"{value:.6g} ± 0"
    place = math.floor(math.log10(float(f"{stderr:.1e}")))  # after rounding: 0.0996 is 0.10
    size = max(abs(value), stderr)
    if 1e-4 <= size < 1e6 and -8 <= place <= 5:
        decimals = max(1 - place, 0)
        return f"{value:.{decimals}f} ± {stderr:.{decimals}f}"
    digits = 0 if value == 0 else max(math.floor(math.log10(abs(value))) - place + 1, 0)
    return f"{'0' if value == 0 else f'{value:.{digits}e}'} ± {stderr:.1e}"


def with_interval(low: float, high: float, value: float | None = None) -> str:
    """Write a 95 % interval, its ends with two significant digits of its half width, or of how far each is from a
    value between them.

    >>> with_interval(0.02134, 0.04871), with_interval(0.0, 3.1e-7), with_interval(0.534, 42.63, 0.887)
    ('95 %: 0.021 to 0.049', '95 %: 0 to 3.1e-07', '95 %: 0.53 to 43')
    """
    half = (high - low) / 2
    apart = (half if value is None else min(abs(end - value) or half, half) for end in (low, high))
    ends = (with_error(end, own).split(" ±")[0] for end, own in zip((low, high), apart, strict=True))
    return f"95 %: {' to '.join(ends)}"


def percent(value: float, stderr: float | None) -> str:
    """Write the standard error as a share of the value, ``(3.2 %)``; empty if there is none.

    >>> percent(2.0, 0.064), percent(2.0, None), percent(1.0, 1.234)
    ('(3.2 %)', '', '(123 %)')
    """
    if stderr is None or not math.isfinite(stderr) or value == 0 or not math.isfinite(value):
        return ""
    share = 100 * stderr / abs(value)
    if share >= 1000:
        return "(> 1000 %)"
    return f"({share:.3g} %)" if share >= 99.5 else f"({share:.2g} %)"


def number(value: float | None, form: str = ".6g") -> str:
    """Write a number, or a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:{form}}"


def count(n: int) -> str:
    """Write a count with thin groups of three: ``14 400``."""
    return f"{n:,}".replace(",", " ")


# ---- parts --------------------------------------------------------------------------------------------


def _header(fit: Fit) -> list[str]:
    spent = {name: value for name, value in fit.timing.items() if name != "total"}
    seconds = fit.timing.get("total", sum(spent.values()))
    parts = ", ".join(f"{name} {value:.2g}" for name, value in spent.items())
    how = f"{fit.iterations} iterations, {seconds:.2g} s" + (f" ({parts})" if parts else "")
    names = [experiment.name for experiment in fit.data]
    lines = wrapped(f"Fit of {fit.model.name}: {fit.status}", "  ")[:3]
    lines += _labelled("records", f"{_some(names, 4)}{lengths(fit)}{assumed_words(fit)}")
    lines += _labelled("samples", f"{count(fit.n)} that count, in {count(fit.nodes)} shooting intervals")
    lines += _labelled("solved", how)
    if "searched on" in fit.options:
        lines += _labelled("searched", f"on {fit.options['searched on']}")[:3]
    worst = max(fit.integration.values(), key=lambda found: found.largest, default=None)
    if worst is not None:
        how = str(worst).removeprefix("integration: ")
    elif fit.model.linear is not None:
        how = "exactly (a linear model on equal steps)"
    else:
        how = "by steps whose errors were not looked at, as the fit was ended"
    lines += _labelled("integrated", how)
    lines += _labelled("noise", "; ".join(noise_words(fit)))
    lines += _labelled("cost", cost_words(fit))
    return lines


def lengths(fit: Fit) -> str:
    """How long the records are, and how far apart the samples of their outputs: a wrong unit of time shows here."""
    long = [record.duration for record in fit.data]
    steps = [
        float(np.median(np.diff(one.time)))
        for own in fit.traces.values()
        for one in own.values()
        if len(one.time) > 1
    ]
    if not steps:
        return ""
    unit = fit.model.time_unit
    long, steps = ([one / seconds_in(unit) for one in part] for part in (long, steps))
    return f", {_range(long)} {unit} long, outputs every {_range(steps)} {unit}"


def _range(values: Sequence[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def assumed_words(fit: Fit) -> str:
    """Say which channels were not measured but assumed; empty if none."""
    wanted = {variable.name for variable in (*fit.model.inputs, *fit.model.outputs)}
    assumed = {
        channel.name
        for experiment in fit.data
        for channel in experiment.channels
        if channel.origin == "assumed" and channel.name in wanted
    }
    return f" (assumed, not measured: {', '.join(sorted(assumed))})" if assumed else ""


def noise_words(fit: Fit) -> list[str]:
    """One phrase for each output: sigma with its unit, known or estimated."""
    units = {variable.name: variable.unit for variable in fit.model.outputs}
    return [
        f"{name} sigma {number(sigma, '.4g')} {units.get(name, '')} ({'estimated' if estimated else 'known'})"
        for name, (sigma, estimated) in fit.noise.items()
    ]


def _gain(fit: Fit) -> list[str]:
    """The predictor and its gain K, for a fit that has one."""
    if fit.innovations is None:
        return []
    rows = gain_rows(fit, with_error)
    shown = [(f"K {short(state, 24)} by {short(output, 20)}", value) for state, output, value in rows]
    lines = limited(wrapped(f"Predictor: {predictor_words(fit)}", "  "), 2)
    lines += aligned(shown[: ROWS["gain"]], right=())
    if len(shown) > ROWS["gain"]:
        lines.append(f"  … and {len(shown) - ROWS['gain']} more: fit.innovations.kalman")
    return lines


def cost_words(fit: Fit) -> str:
    """The cost, what it is per sample, and what that can tell."""
    text = f"{number(fit.cost, '.7g')}   chi2/N {number(fit.cost / fit.n if fit.n else None, '.4g')}"
    loss = loss_of(fit)
    if loss.robust:  # which has the level of the inner residuals
        pairs = ((one, fit.noise[name][0]) for own in fit.traces.values() for name, one in own.items())
        r = np.abs(np.concatenate([one.residual[one.mask] / sigma for one, sigma in pairs]))
        beyond, wild = int((r > loss.knee).sum()), int((r > _WILD).sum())
        text += f" ({beyond} of {fit.n} samples are beyond {loss.knee:.3g} sigma and count less than their squares"
        text += f", {wild} of them beyond {_WILD:g} sigma)" if wild else ")"
    elif (
        fit.noise
        and all(estimated for _, estimated in fit.noise.values())
        and abs(fit.cost / max(fit.n, 1) - 1) < _NEAR
    ):
        text += " (near 1 by construction: sigma is estimated)"
    return text + f"   dof {number(fit.dof, '.6g')}"


def fit_rows(fit: Fit) -> list[tuple[str, str, str, str]]:
    """Record, output, fit % in simulation, fit % of the one-step prediction (a dash for output error)."""
    return [
        (record, output, number(found.get("simulation"), ".2f"), number(found.get("prediction"), ".2f"))
        for record, outputs in fit.fit_percent.items()
        for output, found in outputs.items()
    ]


def _fit_rows(fit: Fit) -> list[str]:
    rows = fit_rows(fit)
    shown = [(short(record, 40), short(output, 20), *rest) for record, output, *rest in rows[: ROWS["fit"]]]
    header = ("fit %", "output", "simulation", "one-step prediction")
    lines = aligned([header, *shown], right=(2, 3))
    if len(rows) > len(shown):
        lines.append(f"  … and {len(rows) - len(shown)} more: fit.fit_percent")
    return lines


def parameter_rows(fit: Fit) -> list[tuple[str, str, str, str, str]]:
    """Name, value ± stderr, unit, relative error and notes of every parameter."""
    return [
        (
            name,
            with_error(estimate.value, _error(estimate)),
            unit_words(estimate.unit),
            percent(estimate.value, _error(estimate)),
            "  ".join(_notes(fit, name, estimate)),
        )
        for name, estimate in fit.estimates.items()
    ]


def parameter_lines(fit: Fit, rows: int) -> list[str]:
    """The table of parameters; with more than ``rows`` of them the fixed ones move into one sentence."""
    body = parameter_rows(fit)
    fixed: list[str] = []
    if len(body) > rows:
        fixed = [f"{row[0]} {row[1]} {row[2]}" for row in body if fit.estimates[row[0]].fixed]
        body = [row for row in body if not fit.estimates[row[0]].fixed]
    room = rows - 2 * bool(fixed)
    wide = max((len(row[3]) for row in body[:room]), default=0)
    shown = []
    for name, value, unit, share, notes in body[:room]:
        # A missing error is explained at length, where the relative error would stand.
        long = not share and not fit.estimates[name].fixed
        shown.append((short(name, 30), value, unit, notes if long else f"{share:<{wide}}  {notes}"))
    lines = ["Parameters", *(short(line, COLUMNS) for line in aligned(shown, right=()))]
    if len(body) > room:
        lines.append(f"  … and {len(body) - room} more: fit.estimates")
    if fixed:
        lines += limited(wrapped(f"  fixed: {', '.join(fixed)}", "    "), 2)
    return lines


def parameter_of(fit: Fit, name: str) -> Parameter | None:
    """The parameter behind a name, also behind ``name@record``; None for an unknown one."""
    for known in (name, name.split("@", maxsplit=1)[0]):
        if known in fit.parameters:
            return fit.parameters[known]
    return None


def _error(estimate: Estimate) -> float | None:
    return None if estimate.at_bound or estimate.fixed else estimate.stderr


def _open_to(interval: tuple[float, float], parameter: Parameter | None) -> str:
    """Which ends of an interval the bounds set, not the data."""
    bounds = (None, None) if parameter is None else (parameter.min, parameter.max)
    sides = [
        words
        for end, bound, words in zip(interval, bounds, ("lower", "upper"), strict=True)
        if bound is not None and math.isclose(end, bound, rel_tol=1e-9, abs_tol=1e-300)
    ]
    return f" (open to its {' and its '.join(sides)} bound)" if sides else ""


def _notes(fit: Fit, name: str, estimate: Estimate) -> list[str]:
    parameter = parameter_of(fit, name)
    notes = []
    if estimate.interval is not None:
        notes.append(
            with_interval(*estimate.interval, estimate.value) + _open_to(estimate.interval, parameter)
        )
    if estimate.at_bound:
        notes.append(f"at its {BOUND_WORDS[estimate.at_bound]} bound: no symmetric error")
    if name in fit.start:
        notes.append(f"(start {fit.start[name]:.4g})")
    if parameter is not None and parameter.tie is not None:
        notes.append(f"== {parameter.tie}")
    if estimate.fixed:
        notes.append("(fixed)")
    if (estimate.stderr, estimate.interval) == (None, None) and not estimate.fixed and not estimate.at_bound:
        notes.append(f"no error: {estimate.why or 'not known'}")
    if parameter is not None and parameter.prior is not None:
        notes.append("prior {:.4g} ± {:.4g}".format(*parameter.prior))
    return notes


def initial_words(fit: Fit, record: str) -> str:
    """The initial states of one record in one phrase."""
    words = []
    for state, estimate in fit.initial[record].items():
        text = f"{state} {with_error(estimate.value, _error(estimate))} {estimate.unit}"
        if estimate.fixed:
            text += " (fixed)"
        elif estimate.at_bound:
            text += f" (at its {BOUND_WORDS[estimate.at_bound]} bound)"
        elif estimate.interval is not None:
            text += f" ({with_interval(*estimate.interval, estimate.value)})"
        elif estimate.stderr is None:  # what is doubted has a note of its own
            why = f"no error: {estimate.why or 'not known'}"
            text += f" ({why})" if estimate.quadratic is None else " (error not known)"
        words.append(text)
    return ", ".join(words)


def _initial(fit: Fit) -> list[str]:
    if not fit.initial:
        return []
    shown = list(fit.initial)[: ROWS["initial"]]
    lines = ["Initial states"]
    for record in shown:
        lines += limited(wrapped(f"  {short(record, 40)}: {initial_words(fit, record)}", "    "), 2)
    if len(fit.initial) > len(shown):
        lines.append(f"  … and {len(fit.initial) - len(shown)} more: fit.initial")
    return lines


def correlations(fit: Fit) -> list[tuple[str, str, float]]:
    """Pairs of free parameters and their correlation, the strongest first."""
    matrix = fit.correlation
    first, second = np.triu_indices(len(fit.free), 1)
    values = matrix[first, second]
    order = [k for k in np.argsort(-np.abs(values), kind="stable") if np.isfinite(values[k])]
    return [(fit.free[first[k]], fit.free[second[k]], float(values[k])) for k in order]


def _correlations(fit: Fit) -> list[str]:
    pairs = correlations(fit)
    if not pairs:
        return []
    strong = [pair for pair in pairs if abs(pair[2]) >= STRONG]
    if not strong:
        return [f"Correlations: all below {STRONG} in size"]
    words = [f"{a} ~ {b} {value:+.3f}" for a, b, value in strong[: ROWS["correlations"]]]
    rest = len(strong) - len(words)
    more = f", {rest} more at or above {STRONG}: fit.correlation" if rest > 0 else ""
    return limited(wrapped(f"Correlations: {', '.join(words)}{more}", "  "), 3)


def _directions(fit: Fit) -> list[str]:
    if not fit.undetermined:
        return []
    shown = fit.undetermined[: ROWS["directions"]]
    lines = ["Not determined by these data:"]
    for direction in shown:
        lines += limited(wrapped(f"  {direction.text}", "    "), 2)
    if len(fit.undetermined) > len(shown):
        lines.append(f"  … and {len(fit.undetermined) - len(shown)} more: fit.undetermined")
    return lines


def _optima(fit: Fit) -> list[str]:
    return limited(wrapped(f"Optima: {optima_words(fit)}", "  "), 2) if len(fit.optima) > 1 else []


def optima_words(fit: Fit) -> str:
    """How many starts ended where, the lowest cost first, and the directions in which optima differ from the best."""
    ordered = sorted(fit.optima, key=lambda optimum: (not math.isfinite(optimum.cost), optimum.cost))
    total = sum(optimum.starts for optimum in ordered)
    found = [optimum for optimum in ordered if optimum.status == "converged"] or ordered
    words = [f"{found[0].starts} of {total} searches reached the lowest cost {number(found[0].cost)}"]
    for optimum in found[1:4]:
        where = f" ({optimum.apart})" if optimum.apart else ""
        words.append(f"{optimum.starts} ended at {number(optimum.cost)}{where}")
    if len(found) > 4:
        words.append(f"{len(found) - 4} more optima: fit.optima")
    lost = total - sum(optimum.starts for optimum in found)
    if lost:
        words.append(f"{lost} did not converge")
    return "; ".join(words)


# ---- what to do next ----------------------------------------------------------------------------------


def next_steps(fit: Fit) -> list[str]:
    """What to type next, the most urgent first; never empty."""
    doubtful = IN_DOUBT in fit.options or faults(fit)
    steps = ["look at the data first, as noted above, and fit again"] if doubtful else []
    if fit.status == "interrupted":
        steps.append("it was interrupted; go on from here: ce.estimate(model, data, warm=fit)")
    elif not fit.converged:
        steps.append(
            'try other starts: ce.estimate(model, data, approach="prediction"), starts=8, or bounds closer to what '
            "can be"
        )
    for key, share in lost(fit).items():
        if not fit.free:
            steps.append(
                f"the simulation follows {max(share, 0.0):.0f} % of {key}, and no parameter is free: free some, or "
                "ce.repair(model, data) looks for what the model lacks"
            )
            break
        if OTHERS in fit.options:
            steps.append(
                f"the simulation follows {max(share, 0.0):.0f} % of {key}, and no search over short pieces or from "
                f"{fit.options[OTHERS]} other starts led lower: look at what is left, ce.plot(fit); where that is no "
                "noise, ce.repair(model, data) looks for what the model lacks"
            )
            break
        how = 'approach="prediction"' if fit.options.get("approach") == "direct" else "starts=20"
        steps.append(
            f"the simulation follows {max(share, 0.0):.0f} % of {key}: look for a better optimum, "
            f"ce.estimate(model, data, {how})"
        )
        break
    steps += list(dict.fromkeys(_cure(fit, direction.weights) for direction in fit.undetermined))
    for name, estimate in fit.estimates.items():
        told = any(words.startswith(f"{name} {NOT_TOLD}") for words in fit.messages)
        if estimate.at_bound and name in fit.free and not told:
            if name.startswith("process."):
                state = name.removeprefix("process.")
                steps.append(
                    f"these data show no process noise of {state}: leave it out of process=, and fit again"
                )
                continue
            bound = estimate.at_bound
            steps.append(f'{name} rests on its bound: widen it, pars["{name}"].set({bound}=...), or fix it')
    converged = [optimum for optimum in fit.optima if optimum.status == "converged"]
    lowest = min((optimum.cost for optimum in fit.optima if math.isfinite(optimum.cost)), default=math.nan)
    if fit.converged and fit.cost > lowest + max(SAME_COST, 1e-9 * abs(lowest)):
        steps.append(
            "a search that did not converge came lower than this optimum: look at fit.optima, allow max_iterations=1000"
        )
    elif len(converged) > 1 and min(converged, key=lambda optimum: optimum.cost).starts == 1:
        steps.append("only one search found the lowest cost: repeat with starts=32")
    if any(UNKNOWN in words for words in fit.messages):
        steps.append("state the noise level that is not known, as noted above, and fit again")
    elif fit.doubted:
        steps += _for_errors(fit)
    return steps or [FRESH]


def _for_errors(fit: Fit) -> list[str]:
    """What tells the errors that are doubted; a posterior is of fits with the noise of the measurement alone."""
    if fit.innovations is None and not loss_of(fit).robust:
        return [f"{_bounded_first(fit)}the errors that the data do tell: print(ce.posterior(fit))"]
    if fit.innovations is None or fit.innovations.kind == "process":
        return []
    return ["estimate the process noise instead of its gain, ce.Noise(..., process={...}), and fit again"]


def _bounded_first(fit: Fit) -> str:
    """What a posterior asks for before it is drawn: bounds or a prior of each parameter that is no effect's."""
    keys = tuple(f"{one.key}." for one in fit.model.effects)
    every = dict.fromkeys(free.partition("@")[0] for free in fit.free)
    own = [name for name in every if name in fit.parameters and not name.startswith((*keys, "\0"))]
    names = [name for name in own if _is_open(fit.parameters[name])]
    if not names:
        return ""
    how = f'pars["{names[0]}"].set(min=..., max=...)'
    return f"give {' and '.join(names)} bounds on both sides, {how}, fit again, then "


def _is_open(parameter: Parameter) -> bool:
    return parameter.prior is None and not (math.isfinite(parameter.min) and math.isfinite(parameter.max))


def _cure(fit: Fit, weights: object) -> str:
    """What to type to determine a direction: fix its largest parameter, or its initial state."""
    names = sorted(dict(weights), key=lambda name: -abs(dict(weights)[name]))  # type: ignore[call-overload]
    for name in names:
        parameter = parameter_of(fit, name)
        if parameter is not None and parameter.vary:
            known = parameter.name
            return (
                f'fix one of them or give it a prior: pars.fix("{known}"), pars["{known}"].set(prior=(m, s))'
            )
    for name in names:
        for state in (variable.name for variable in fit.model.states):
            if state in name.replace("@", " ").replace("[", " ").replace("(", " ").split():
                return f'give the initial state: initial={{"{state}": ...}}'
    return "fix one of them, or add an experiment " + (
        "that excites it" if fit.model.inputs else "with another start"
    )


# ---- layout -------------------------------------------------------------------------------------------


def aligned(rows: Sequence[Sequence[str]], *, right: Iterable[int], indent: str = "  ") -> list[str]:
    """Lines of cells in columns, the columns in ``right`` flush right."""
    if not rows:
        return []
    flush = set(right)
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        indent
        + "  ".join(
            cell.rjust(width) if k in flush else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _labelled(label: str, text: str) -> list[str]:
    return limited(wrapped(f"  {label:<9} {text}", " " * 12), 2)


def wrapped(text: str, indent: str, width: int = COLUMNS) -> list[str]:
    """Lines of at most ``width`` columns, the later ones indented; spaces at the start are kept."""
    lead = text[: len(text) - len(text.lstrip())]
    flat = lead + " ".join(text.split("\n"))[len(lead) :]
    return textwrap.wrap(flat, width, subsequent_indent=indent, break_on_hyphens=False) or [""]


def limited(lines: list[str], most: int) -> list[str]:
    """The first lines; the last of them ends in … if any are left out."""
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], lines[most - 1][: COLUMNS - 2].rstrip() + " …"]


def short(text: str, width: int) -> str:
    """The text, cut to ``width`` characters with … at its end."""
    return text if len(text) <= width else text[: width - 1] + "…"


def _some(names: Sequence[str], most: int) -> str:
    shown = ", ".join(short(name, 40) for name in names[:most])
    return shown + (f" and {len(names) - most} more" if len(names) > most else "")
