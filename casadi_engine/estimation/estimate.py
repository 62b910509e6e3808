"""estimate: fit a model's free parameters to experiments by multiple shooting."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.deadline import Deadline, TimeUp, best_wanted, is_set, late, was_stopped
from casadi_engine.errors import CasadiEngineError, EstimationError
from casadi_engine.estimation.aliased import aliased
from casadi_engine.estimation.answer import make_fit
from casadi_engine.estimation.behind_a_bound import told_from_their_bounds
from casadi_engine.estimation.corner_widths import (
    CORNERS,
    follow_motion,
    from_wide_corners,
    open_widths,
    with_cut_corners,
)
from casadi_engine.estimation.cut_short import GIVEN_UP, MANY, in_time
from casadi_engine.estimation.faulty_samples import faults
from casadi_engine.estimation.fit import Fit
from casadi_engine.estimation.followed import lost
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.ipopt import ONE_STEP
from casadi_engine.estimation.late_sensors import begun_late, follow_delays
from casadi_engine.estimation.loss import read_loss
from casadi_engine.estimation.lower_optimum import from_lower_places, merit
from casadi_engine.estimation.lower_rate import ONE_SEARCH, lower_rate
from casadi_engine.estimation.moved_jumps import refuse_moved_jumps
from casadi_engine.estimation.multistart import attempts_from, distinct_optima, interrupted, settled
from casadi_engine.estimation.nothing_left import nothing_left
from casadi_engine.estimation.options import begun_at, chosen, seconds_for_intervals, small, whole
from casadi_engine.estimation.parallel import checked_jobs
from casadi_engine.estimation.search import Attempt, Search
from casadi_engine.estimation.second_look import LOWER, has_rivals, looked_at_twice, or_whole
from casadi_engine.estimation.short_intervals import short_enough
from casadi_engine.estimation.two_stages import bent_by_thinning, lower_search, on_whole_data, searched_on
from casadi_engine.estimation.unused_parameters import held_if_unused, not_asked
from casadi_engine.estimation.whole_turns import but_for_turns
from casadi_engine.estimation.workers import Workers
from casadi_engine.experiment import Experiment
from casadi_engine.experiment.experiment import with_unique_names
from casadi_engine.experiment.pace import paced
from casadi_engine.experiment.twins import refuse_twins
from casadi_engine.model import Model
from casadi_engine.model.arrival import arriving
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

Array = NDArray[np.float64]

# How often a fit goes on that ended a step short of an optimum.
_FURTHER = 6
# Share of the time that is of no part of the last search, from which on it is said; and what it is called.
_OTHERS, OTHER_SEARCHES = 0.1, "other searches"
_ENDED = "interrupted by the user before all that follows a search was done: its checks are not complete"


@one_blas_thread
def estimate(
    model: Model,
    data: Experiment | Sequence[Experiment],
    *,
    parameters: Parameters | None = None,
    noise: Noise | None = None,
    interval: Any = "auto",
    initial: Any = None,
    loss: Any = "square",
    ties: str = "substitute",
    method: str = "exact",
    approach: str = "direct",
    starts: int = 1,
    seed: int = 0,
    neighbours: int = 0,
    enough: str = "all",
    jobs: int | None = 1,
    warm: Any = None,
    progress: Any = None,
    errors: str | float = "checked",
    max_iterations: int = 200,
    tolerance: float = 1e-9,
) -> Fit:
    """Estimate the free parameters and initial states of a model from one experiment or several.

    Minimises the sum of squared weighted residuals plus priors by direct multiple shooting (Bock & Plitt 1984) with
    IPOPT, subject to the bounds, ties and constraints of the parameter set.

    Parameters
    ----------
    model : the equations; data : one Experiment or several, each with its own initial state. Noise levels, initial
        values, bounds and all that is printed are in the units that the model declares, whatever the data's are
    parameters : the set to start from (default: the model's); it is copied, never changed
    noise : standard deviations per output, known or "estimate" (the default), and the gain of a one-step predictor
    interval : shooting interval: "auto", "single", a number of samples, or a time such as "10 ms"
    initial : initial states: state -> number (fixed), (low, high), "free"; or record -> such a mapping; those of a
        fit are taken as they are, ``initial=fit.initial`` or ``fit.initial["record"]``, and kept fixed
    loss : "square", "huber", or ("huber", knee in standard deviations)
    ties : "substitute", or "constraint" to keep ties as equality constraints of the solver: the same answer
    method : "exact", or "euler" for the forward-Euler discretisation of a linear model
    approach : "direct", or "prediction" for a start that may be far off: the parameters are fitted to predictions over
        short pieces of the data first, from there and from points around it, and then to longer and longer ones
    starts, seed : number of starts, the first from the set's values, the others drawn within the bounds
    neighbours : number of directions, those the data tell least of, along which to look for a lower optimum beside
        the best: searches that start to either side of it; in the frequency domain others are looked for in any case
    enough : "all" starts; or "white": no other start beside the first where that has ended at a residual that is white,
        of the stated level, and is small beside what the simulation follows, as no other optimum can be better
    jobs : processes for the starts and neighbours, by joblib (extra "cluster"): the same answer as in one; None takes
        what ``joblib.parallel_config`` says, such as a dask cluster
    warm : a Fit (or loaded result) whose parameters and initial states are the start
    progress : None for a bar on a terminal, False for none, or a function (iteration, cost, fit percent)
    errors : "checked": standard errors where the likelihood is quadratic around the optimum, intervals by profile where
        it is not, if they take a few seconds, and otherwise none, with what to call; a number: the same, with so many
        seconds of processor time for these intervals (3); "quadratic": standard errors by
        the curvature at the optimum whatever the likelihood does beside it, for loops over fits
    max_iterations, tolerance : of IPOPT, for each start

    A linear model on complete, equally spaced records is searched in the frequency domain first, in the band in which
    its parameters act; the last steps, the errors and all that is reported are of all samples.
    ``fit.options["searched on"]`` says which, or why all samples were searched from the start.

    Equations that jump with their states (a play, dry friction as a sign) are searched with rounded corners over short
    windows first, and then as they are.

    A parameter that starts at 0 takes its scale from what the data feel of it, never from a bound; one counts as at its
    bound only within 0.03 standard errors of it, and if it would go beyond.

    Returns a Fit; its ``status`` says "converged" (see ``Fit``), "interrupted" (Ctrl-C: the best
    point so far) or why not.
    Raises EstimationError, ParameterError, ConstraintError, ExperimentError for input that cannot be used,
    MissingDependencyError for ``jobs`` without joblib.

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(200) * 0.01
    >>> exp = ce.Experiment.from_arrays("run_up", time=t, units={"T": "N m", "omega": "rad/s"}, hold="zero",
    ...     T=np.full(200, 2.0), omega=4 * (1 - np.exp(-t / 0.8)))
    >>> pars = ce.one_inertia().parameters()
    >>> fit = ce.estimate(ce.one_inertia(), exp, parameters=pars, noise=ce.Noise(omega=0.01))
    >>> {name: round(value, 4) for name, value in fit.values.items()}
    {'J_eng': 0.4, 'C_eng': 0.5}
    """
    begun = time.perf_counter()
    records = _records(data, model)
    names = tuple(record.name for record in records)
    records = tuple(begun_at(record, initial, model, names) for record in records)
    starts = whole("starts", starts, 1)
    max_iterations = whole("max_iterations", max_iterations, 1)
    seed, tolerance = whole("seed", seed, 0), small(tolerance)
    neighbours, jobs = whole("neighbours", neighbours, 0), checked_jobs(jobs)
    arguments: dict[str, Any] = {
        "model": model,
        "data": records,
        "parameters": _own(model, parameters),
        "noise": noise,
        "interval": interval,
        "initial": initial,
        "loss": read_loss(loss),
        "ties": ties,
        "method": method,
        "approach": chosen("approach", approach, ("direct", "prediction")),
        "max_iterations": max_iterations,
        "tolerance": tolerance,
        "warm": warm,
    }
    robust, idle = arguments["loss"].robust, held_if_unused(model, arguments["parameters"])
    refuse_twins(records, [out.name for out in model.outputs])
    arguments["model"] = begun_late(arguments)
    within = is_set()  # then who set that deadline takes Ctrl-C too
    own = Deadline(best=best_wanted())
    asked = Interrupts(own.stop)
    run = partial(
        _searched,
        interrupts=asked,
        seed=seed,
        jobs=jobs,
        enough=nothing_left if chosen("enough", enough, ("all", "white")) == "white" else None,
        progress=progress,
        check=seconds_for_intervals(errors),
        shown={
            "interval": interval,
            "loss": repr(loss) if isinstance(loss, tuple) else "huber" if robust else "square",
            "approach": approach,
            "starts": starts,
            "neighbours": neighbours,
        },
    )
    try:
        with own, nullcontext() if within else asked:
            fit = _followed_up(
                run, arguments, (starts, neighbours, begun), alone=within or errors == "quadratic"
            )
    except TimeUp:
        if late():
            raise
        raise KeyboardInterrupt from None  # there is no point yet
    fit = _as_asked(fit, _own(model, parameters) if warm is None else None, time.perf_counter() - begun)
    asked_for = () if within else not_asked(arguments["parameters"], [record.name for record in records])
    fit = replace(fit, messages=(*idle, *asked_for, *fit.messages))
    if asked.stopped and fit.status != "interrupted":
        return replace(fit, status="interrupted", messages=(_ENDED, *fit.messages))
    return fit


def _as_asked(fit: Fit, begun: Parameters | None, total: float) -> Fit:
    """The fit with the values that were given as its start, not those of the last search of several, and with what
    these took together. begun : the set that was given, None where another fit was the start; total : seconds"""
    start = dict(fit.start)
    for name in start:
        bare, _, record = name.partition("@")
        if begun is not None and bare in begun:
            start[name] = begun[bare].in_record(record)[0] if record else begun[bare].value
    timing = {**fit.timing, "total": total}
    others = total - sum(value for name, value in timing.items() if name != "total")
    if others > _OTHERS * total:
        timing = {OTHER_SEARCHES: others, **timing}
    return replace(fit, start=start, timing=timing)


def _followed_up(
    run: partial[Fit], arguments: dict[str, Any], how: tuple[int, int, float], *, alone: bool
) -> Fit:
    """The fit, and those that follow from it: with sharper corners, with later channels, from other places.

    how : starts, neighbours and when all began; alone : another verb asks for what else it needs
    """

    def again(changed: dict[str, Any], **how_else: Any) -> Fit:
        changed = dict(changed)
        starts = changed.pop("starts", 1)
        return run(arguments | changed, starts, 0, how[-1], **how_else)

    def with_errors(found: Fit, changed: dict[str, Any]) -> Fit:
        """A fit that was made without its errors; made anew where it is not met from its optimum, or has rivals."""
        if has_rivals(found) and not lost(found):
            return again(changed)
        there = {"parameters": found.parameters, "warm": found, "approach": "direct"}
        whole = again({"interval": found.options["interval"]} | there)
        return whole if whole.converged and merit(whole) <= merit(found) + LOWER else again(changed)

    # of one search alone, whose corners are made sharper, the errors are looked at in the end
    check = run.keywords["check"]
    later = (
        check is not None
        and how[:2] == (1, 0)
        and bool(open_widths(arguments["model"], arguments["parameters"]))
    )

    def begun(more: dict[str, Any]) -> Fit:
        first = partial(run, check=None) if later else run
        return from_wide_corners(lambda changed: first(arguments | more | changed, *how), again, arguments)

    fit = begun({}) if alone else or_whole(begun)
    fit = in_time(lambda: follow_delays(fit, arguments["parameters"], again), lambda: fit)
    arguments["model"] = fit.model
    fit = _with_sharp_corners(
        fit, arguments, partial(again, check=None), None if check is None else again, later
    )
    if alone:
        return fit
    fit = in_time(lambda: _gone_on(fit, again), lambda: fit)
    fit = in_time(lambda: from_lower_places(fit, again), lambda: fit)
    quick = partial(again, check=None)
    fit = in_time(lambda: looked_at_twice(fit, quick, with_errors), lambda: fit)
    fit = in_time(lambda: but_for_turns(fit, again), lambda: fit)
    fit = in_time(lambda: told_from_their_bounds(fit, arguments["parameters"], again), lambda: fit)
    return replace(fit, messages=(*faults(fit), *aliased(fit), *fit.messages))


def _gone_on(fit: Fit, run: Callable[[dict[str, Any]], Fit]) -> Fit:
    """The fit that goes on from where one ended a step short of an optimum, along a valley that is all but flat."""
    further = fit
    for _ in range(_FURTHER):
        if ONE_STEP not in further.status:
            break
        further = run({"parameters": further.parameters, "warm": further, "approach": "direct"})
    return further if further.converged else fit


def _with_sharp_corners(
    fit: Fit,
    arguments: Mapping[str, Any],
    run: Callable[[dict[str, Any]], Fit],
    checked: Callable[[dict[str, Any]], Fit] | None,
    later: bool,
) -> Fit:
    """The fit with corners as sharp as the motion asks, as far as time allows.

    run : makes a fit whose errors are not looked at; checked : one whose errors are, of the last one alone; None where
    nobody asks for that; later : those of ``fit`` were not looked at either
    """
    interval, reached = arguments["interval"], [fit]

    def again(pars: Parameters, warm: Fit, length: int) -> Fit:
        interval_of = length if interval == "auto" else interval
        changed = {"parameters": pars, "warm": warm, "interval": interval_of, "approach": "direct"}
        found = run(changed)
        if found.converged:
            reached.append(found)
        return found

    def so_far() -> Fit:
        best = min(reached, key=merit)  # the last one may have tried wider ones
        return fit if best is fit else with_cut_corners(best)

    def looked_at(sharp: Fit, checked: Callable[[dict[str, Any]], Fit]) -> Fit:
        own = {"parameters": sharp.parameters, "warm": sharp, "interval": sharp.options["interval"]}
        try:
            whole = checked({**own, "approach": "direct"})
        except (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError):
            return _unchecked(sharp)
        # the search goes on where it ended: what it says of its corners is the same
        told = [words for words in sharp.messages if words.startswith(CORNERS)]
        return replace(whole, messages=(*told, *whole.messages)) if whole.converged else _unchecked(sharp)

    sharp = in_time(lambda: follow_motion(fit, arguments["parameters"], again), so_far)
    if checked is None or not sharp.converged or (sharp.z is fit.z and not later):
        return sharp
    return in_time(lambda: looked_at(sharp, checked), lambda: _unchecked(sharp))


def _unchecked(fit: Fit) -> Fit:
    words = (
        "the errors are those of the curvature at the optimum, and were not checked away from it: the search that "
        "would tell ended before; ce.profile(fit) looks there"
    )
    return replace(fit, messages=(*fit.messages, words))


def _searched(
    arguments: dict[str, Any],
    starts: int,
    neighbours: int,
    begun: float,
    *,
    seed: int,
    jobs: int | None,
    enough: Callable[[Search, Attempt], bool] | None,
    progress: Any,
    check: float | None,
    shown: Mapping[str, Any],
    interrupts: Interrupts,
) -> Fit:
    """One estimate from its checked arguments; shown : options as the user gave them."""
    entered = time.perf_counter()
    own = Deadline(best=best_wanted())
    with own:
        report = _reporter(progress, starts + 2 * neighbours, arguments["max_iterations"])
        laid = lambda changed: Search(**changed, progress=report, interrupts=interrupts)  # noqa: E731
        search, arguments = short_enough(laid(arguments), arguments, laid)
        setup = time.perf_counter() - entered
        # set-up, errors and last steps are of the whole data anyhow: one search from near by is as fast there
        several_searches = starts + neighbours > 1 or arguments["approach"] == "prediction"
        lower = lower_rate(search) if several_searches else ONE_SEARCH
        first = search
        if not isinstance(lower, str):
            first = lower_search(search, arguments, lower, report)
            why = bent_by_thinning(search, first)
            if why:
                lower, first = why, search
        changed = arguments | {"data": first.data, "noise": first.noise}
        several = jobs != 1 and starts + neighbours > 1
        workers = Workers(changed, jobs, interrupts, first.tell) if several else None
        drawn = first.drawn(starts, seed)
        outcomes = workers.outcomes if workers else None
        attempts = attempts_from(first, drawn, neighbours, outcomes=outcomes, enough=enough)
        if first is not search:
            attempts = on_whole_data(search, first, attempts)
        best, attempts = settled(search, attempts)
        optima = in_time(lambda: distinct_optima(search, attempts, best))
        timing = {"setup": setup, "solve": time.perf_counter() - entered - setup}
        options = {
            **{name: arguments[name] for name in ("ties", "method", "max_iterations", "tolerance")},
            "seed": seed,
            **shown,
            **({"knee": loss.knee} if (loss := arguments["loss"]).robust else {}),
            "searched on": searched_on(search, best, lower),
        }
        made = partial(make_fit, search, best, optima, options, timing, begun)
        by = "the time budget" if own.late and not was_stopped() else "the user"
        if interrupted(attempts):
            own.stop()
        fit = in_time(lambda: made(check=check), lambda: made(stopped=by, check=None))
        fit = replace(fit, messages=(*fit.messages, *_given_up(attempts)))
        return replace(fit, status="interrupted") if own.late else fit


def _given_up(attempts: Sequence[Attempt]) -> tuple[str, ...]:
    count = sum(attempt.solution.status == GIVEN_UP for attempt in attempts)
    if not count:
        return ()
    return (
        f"{count} of {len(attempts)} starts given up: together they cost {MANY:.0f} times as much as the best one, and "
        "were not lower",
    )


def _own(model: Model, parameters: Any) -> Parameters:
    """A copy of the parameter set, or the model's own."""
    if not isinstance(model, Model):
        raise EstimationError(
            "there is no model to fit",
            seen=type(model).__name__,
            allowed="a Model",
            cure="give estimate(model, data); ce.two_mass() and Blueprint.model() make one",
        )
    if parameters is not None and not isinstance(parameters, Parameters):
        raise EstimationError(
            "the parameters are not a parameter set",
            seen=type(parameters).__name__,
            allowed="a Parameters object",
            cure="start from model.parameters() and set values by pars[name].set(value)",
        )
    own = model.parameters() if parameters is None else parameters.copy()
    refuse_moved_jumps(model, own)
    return own


def _records(data: Any, model: Model) -> tuple[Experiment, ...]:
    """The records with names of their own, their channels in the units that the model declares."""
    several = isinstance(data, Iterable) and not isinstance(data, str)
    records = (data,) if isinstance(data, Experiment) else tuple(data) if several else ()
    if not records or not all(isinstance(record, Experiment) for record in records):
        kinds = sorted({type(record).__name__ for record in records})
        raise EstimationError(
            "there is nothing to fit to",
            seen=f"{type(data).__name__} of {', '.join(kinds) or 'none'}",
            allowed="an Experiment, or a sequence of one or more",
            cure="read one by read_experiment(path)",
        )
    named = with_unique_names(records)
    if not isinstance(model, Model):
        return named
    outputs = [out.name for out in model.outputs]
    return tuple(paced(arriving(model, record), outputs) for record in named)


def _reporter(progress: Any, starts: int, most: int) -> Any:
    if progress is None:
        from casadi_engine.estimation.progress import terminal_bar

        return terminal_bar(starts, most)
    if progress is False:
        return None
    if not callable(progress):
        raise EstimationError(
            "progress is not acceptable",
            seen=repr(progress),
            allowed="None, False, or a function of (iteration, cost, fit percent)",
            cure="leave it out",
        )
    return progress
