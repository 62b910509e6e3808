"""repair: find where simulation and data disagree, name the missing effect, add it, and test it on fresh data."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from casadi_engine.blas_threads import one_blas_thread
from casadi_engine.deadline import Deadline, TimeUp, late, lifted
from casadi_engine.discrepancy.answer import Answer
from casadi_engine.discrepancy.assumed_pressure import carry, remarks, settle_scatter
from casadi_engine.discrepancy.checked_errors import with_checked_errors, with_errors_of_rounding
from casadi_engine.discrepancy.choice import ANY, TIME_UP, Choice
from casadi_engine.discrepancy.event_intervals import with_intervals_of_times
from casadi_engine.discrepancy.first_fit import continued, first_fit
from casadi_engine.discrepancy.fresh import Portions, check_fresh, portions
from casadi_engine.discrepancy.fresh_choice import FreshChoice
from casadi_engine.discrepancy.fresh_misfit import FRESH
from casadi_engine.discrepancy.input_hold import other_hold
from casadi_engine.discrepancy.kept_near import KEPT_NEAR, is_far_off, kept_near
from casadi_engine.discrepancy.law_refit import follows_by_function
from casadi_engine.discrepancy.lost_beginning import with_lost_beginning
from casadi_engine.discrepancy.lost_fit import explained, found_again
from casadi_engine.discrepancy.lower_rate import LowerRate, at_lower_rate
from casadi_engine.discrepancy.misread import Misread, Tries, misread, with_hint, with_other_reading
from casadi_engine.discrepancy.noise_choice import ColourChoice, check_choice
from casadi_engine.discrepancy.null_model import refuse_jumps
from casadi_engine.discrepancy.one_law import told_as_one_law
from casadi_engine.discrepancy.output_check import noise_alone, refuse_still
from casadi_engine.discrepancy.own_jumps import JUMPED, with_own_jumps
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.progress import Progress, shown
from casadi_engine.discrepancy.refit import Refitter
from casadi_engine.discrepancy.repaired import Repair
from casadi_engine.discrepancy.requests import check_alpha, left_out, read_request
from casadi_engine.discrepancy.screening import Screened, screen_in_turn
from casadi_engine.discrepancy.unstable_records import cut_words, in_pieces
from casadi_engine.discrepancy.wider_bounds import with_free_starts, with_wider_bounds
from casadi_engine.discrepancy.withdrawal import held_to_sizes
from casadi_engine.discrepancy.wording import AT_FAULT, BUDGET, SHARE_OVER, UNRESOLVED, USER
from casadi_engine.effects.candidate import Known
from casadi_engine.errors import CasadiEngineError, EstimationError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.corner_widths import ROUNDED, felt_by, with_widths_of
from casadi_engine.estimation.estimate import _own, _records
from casadi_engine.estimation.faulty_samples import at_its_limit, stands_still, wild_samples
from casadi_engine.estimation.few_samples import UNKNOWN
from casadi_engine.estimation.followed import not_followed
from casadi_engine.estimation.interrupts import Interrupts
from casadi_engine.estimation.ipopt import ONE_STEP
from casadi_engine.estimation.options import USUAL, as_number, whole
from casadi_engine.estimation.parallel import checked_jobs
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.model.corners import with_rounded_jumps
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

_STARTS, _MOST = 4, 4
# Share of the largest motion over which jumps of the model's own laws are rounded at first, which steps as long as the
# samples follow: corners are sharper where the data feel it, and what lacks an effect does not.
_WIDE = 5e-2
# Share of the time that is left of the budget that the fit without effects may take, once more that by predictions, and
# a third of it other readings of the data: one that lacks an effect may crawl without end, and the search goes on from
# where it is. Seconds that the first of these may take in any case.
_NULL, _AT_LEAST = 0.3, 5.0
# Share of that time for intervals of its numbers.
_CHECKS = 0.002
_UNCHECKED = (
    "the errors of the fit without effects were not checked, as its share of the time budget was over"
)
# Work that a fit without its bounds may cost, in multiples of that of one start of the fit without effects.
_AGAIN = 2.0
# Behind a budget or a Ctrl-C an answer is made of what was found, within this share of the budget or so many seconds;
# share of that time up to which the fit without effects and its scores may last, without which there is no answer.
_SPARE, _LEAST_SPARE, _FIRST = 0.1, 2.0, 0.5
# Iterations of the fit without effects by default.
_ITERATIONS = 200
_NO_VALUE = "the model without effects comes to where its equations have no value"
_JUMPED = (
    JUMPED + "; here tanh stands in place of their jumps, as sharp as the motion asks for "
    "({}): the parameters of repair.fit belong to these equations"
)
_EXCHANGED = (
    "The records of the search show nothing that is missing, but the fresh ones do: effects were looked for in these, "
    "and what was found was held against the others"
)
_LOWER = "the time was up before the whole data were fitted: all values are those of records of a lower rate"


@one_blas_thread
def repair(
    model: Model,
    data: Experiment | Sequence[Experiment],
    *,
    parameters: Parameters | None = None,
    effects: Any = None,
    at: Sequence[str] | str | None = None,
    fresh: Experiment | Sequence[Experiment] | None = None,
    noise: Noise | None = None,
    alpha: float = 0.01,
    holdout: float = 0.3,
    colour: ColourChoice = "auto",
    scatter: Any = "assumed",
    most: int = _MOST,
    without: Sequence[str] | str = (),
    budget: float | None = None,
    starts: int = _STARTS,
    neighbours: int = 0,
    seed: int = 0,
    jobs: int | None = 1,
    interval: Any = "auto",
    initial: Any = None,
    method: str = "exact",
    max_iterations: int = _ITERATIONS,
    progress: Any = None,
) -> Repair:
    """Find the physical effects that a model lacks, name them, refit with them, and test them on fresh data.

    The model is fitted (multi-start); scores with all parameters free tell, at one false-alarm rate for the whole
    library, whether anything is missing; every effect at every port is refitted in a complete model, and the most
    probable one is kept, dropped or exchanged until no change gains a factor of 20; fresh data, on which initial states
    alone are found, rank the structures.

    Parameters
    ----------
    model, data, parameters, noise, interval, initial, method, max_iterations : as in ``estimate``, of output error
    effects : None for the library ``ce.effects.library()``, or a sequence of effects (your own too), of names, or of
        pairs (effect or name, port); at : names of ports to which the search is held
    fresh : experiments to confirm on; without them the last ``holdout`` share of the cycles of every record is held out
    alpha : false-alarm rate of "something is missing" over all tests together
    colour : count with an autoregression of the noise: True, False, or "auto" where the residual asks for it
    scatter : cylinder ports whose combustion is not what their pressure channel says, but scatters about it from cycle
        to cycle and differs a little in strength, timing and charge: these are estimated with priors. "assumed" for the
        cylinders with an assumed pressure, or None
    without : names of effects that are not to be looked for
    budget : seconds after which everything that runs is ended: the best answer so far is given, within a tenth of the
        budget or 2 s of processor time, and what was not tried is listed. None for no limit. Ctrl-C does the same; a
        second one ends at once, with the best fit so far
    most : effects at most; starts, neighbours, seed, jobs : of the fit without effects, as in ``estimate``
    progress : None for one line on a terminal, False for none, or a function of a text; it says what is being tried
        and, after a few refits, how long the others may take

    Returns a Repair; its ``verdict`` is "named", "class", "unnamed", "nothing missing", or None with ``status`` saying
    why (the first fit did not converge). Raises EffectError, EstimationError, ExperimentError, ParameterError for input
    that cannot be used. Sources: score tests (Rao 1948), evidence (Laplace 1774, MacKay 1992).

    >>> import numpy as np, casadi_engine as ce
    >>> t = np.arange(400) * 0.02
    >>> exp = ce.Experiment.from_arrays("swing", time=t, units={"T": "N m"}, T=80 * np.sin(1.5 * t))
    >>> lossy = ce.one_inertia().with_effect(ce.effects.CoulombFriction(), at="engine", values={"torque": 3.0})
    >>> run = ce.simulate(lossy, exp, initial={"omega_eng": 0.0})
    >>> noisy = run["omega"].values + 0.1 * np.random.default_rng(0).standard_normal(400)
    >>> exp = ce.Experiment.from_arrays("swing", time=t, units={"T": "N m", "omega": "rad/s"}, T=exp["T"].values,
    ...     omega=noisy)
    >>> effects = ["coulomb_friction", "quadratic_drag"]
    >>> found = ce.repair(ce.one_inertia(), exp, effects=effects, noise=ce.Noise(omega=0.1), progress=False)
    >>> found.verdict, found.confirmed, found.effects[0].key, round(found.effects[0].amplitude.value, 1)
    ('named', True, 'engine.coulomb_friction', 3.0)
    """
    begun = time.perf_counter()
    own, given, records = _own(model, parameters), model, _records(data, model)
    model = with_rounded_jumps(model, _largest(model, records), share=_WIDE)
    pars = own if model is given else own.extended(model)
    others = () if fresh is None else _records(fresh, model)
    effects = left_out(effects, without)
    read_request(model, effects, at)
    refuse_jumps(model)
    seconds = _seconds(budget)
    _check(noise, alpha, holdout)
    check_choice(model, scatter, colour)
    for record in others:
        check_fresh(model, record)
    refuse_still(model, records)
    most, starts = whole("most", most, 1), whole("starts", starts, 1)
    neighbours, seed, jobs = whole("neighbours", neighbours, 0), whole("seed", seed, 0), checked_jobs(jobs)
    tell, done = shown(progress)
    portion = portions(model, records, others, share=holdout)
    cylinders = scatter if method == "exact" else None
    carried = carry(model, pars, portion.data, portion.fresh, cylinders=cylinders)
    portion = replace(portion, data=carried.data, fresh=carried.fresh)
    initial = _of_data(initial, portion)
    options = {
        "interval": interval, "initial": initial, "method": method, "max_iterations": max_iterations,
    }  # fmt: skip
    several: dict[str, Any] = {"starts": starts, "neighbours": neighbours, "seed": seed}
    spare = max(_LEAST_SPARE, _SPARE * seconds) if math.isfinite(seconds) else _LEAST_SPARE
    deadline = Deadline(seconds - (time.perf_counter() - begun), spare=spare)
    job = _Job(
        carried.model, carried.parameters, portion, noise, options, several, tell, begun, deadline, seconds
    )
    job.asked = {"alpha": alpha, "holdout": holdout, "most": most, **several, **options}

    laws: Known = {}

    last: list[tuple[Fit, Screened]] = []  # which is asked for again

    def scores(fit: Fit) -> Screened:
        if not last or last[0][0] is not fit:
            found = screen_in_turn(
                fit, effects, at=at, alpha=alpha, colour=colour, scatter=scatter, seed=seed, known=laws
            )
            last[:] = [(fit, found)]
        return last[0][1]

    with deadline, Interrupts(job.stop) as asked_to_stop:
        job.interrupts = asked_to_stop
        try:
            return job.run(scores, alpha=alpha, most=most, scatter=scatter, jobs=jobs, given=(given, own))
        except (KeyboardInterrupt, TimeUp):
            return job.interrupted(alpha)
        finally:
            done()


@dataclass
class _Job:
    """One repair: its fit without effects, its search, and what is left where it is stopped."""

    model: Model
    parameters: Parameters
    portion: Portions
    noise: Noise | None
    options: dict[str, Any]
    several: dict[str, Any]
    tell: Progress
    begun: float
    deadline: Deadline
    seconds: float
    asked: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)
    interrupts: Interrupts | None = None
    null_fit: Fit | None = None
    search: Choice | None = None
    felt: float = 0.0
    misread: Misread | None = None
    tries: Tries = field(default_factory=dict)  # of other ways to read the data
    kept: bool = False  # the fit without effects had run away
    cut: tuple[str, ...] = ()  # that records are searched in pieces

    def stop(self) -> None:
        """End the search with what it has; called at the first Ctrl-C."""
        self.tell.stopping = True
        self.deadline.stop()

    def run(
        self,
        scores: Any,
        *,
        alpha: float,
        most: int,
        scatter: Any,
        jobs: int | None,
        given: tuple[Model, Parameters],
    ) -> Repair:
        """The answer; that for another hold of the inputs where this is what the records ask for, and of the search in
        the fresh records where these alone show that something is missing.

        given : model and parameters as they were given, before jumps were rounded
        """
        how: dict[str, Any] = {"alpha": alpha, "most": most, "scatter": scatter, "jobs": jobs}
        found = self._of_these(scores, how, given)
        alone = found.unknown is not None and FRESH in found.unknown.tests
        if not alone or self.portion.source != "records" or found.stopped:
            return found
        if self.deadline.left < time.perf_counter() - self.begun:
            return found
        self.tell("the search in the fresh records, which alone show that something is missing")
        kept = self.portion, self.options, dict(self.timing)
        self.portion = replace(self.portion, data=self.portion.fresh, fresh=self.portion.data)
        self.options = {**self.options, "initial": None}  # those that were given are of the other records
        try:
            other = self._of_these(scores, how, given)
        except (TimeUp, EstimationError):
            other = found
        if other.verdict in ("named", "class") and other.confirmed is not False:
            return replace(other, options={**other.options, "exchanged": _EXCHANGED})
        self.portion, self.options, self.timing = kept
        return found

    def _of_these(self, scores: Any, how: Mapping[str, Any], given: tuple[Model, Parameters]) -> Repair:
        """The answer of the records as they are divided."""
        found = self._answered(scores, **how)
        if self.model.corners and found.verdict == "nothing missing":
            with suppress(TimeUp):
                found = with_own_jumps(found, *given, self.noise, self.options)
        if self.search is None:
            return found
        memory = max(self.search.refits.levels.memory.values(), default=1.0)
        portion = self.portion
        try:
            other = other_hold(found, self.noise, self.options, memory)
            if other is None:
                return found
            used = time.perf_counter() - self.begun
            if not other.better or found.stopped or self.deadline.left < used:
                return other.told(found, again=False)
            self.tell("the search with another hold of the inputs")
            self.portion = other.of(portion)
            return other.told(self._answered(scores, **how), again=True)
        except TimeUp:  # there is an answer
            self.portion = portion
            return found

    def _answered(self, scores: Any, *, alpha: float, most: int, scatter: Any, jobs: int | None) -> Repair:
        """The fit without effects, the search, the answer."""
        with self.deadline.spared(_FIRST):
            null_fit, pars, work = self._null(jobs, scores)
            options = self.options
            if null_fit.status == "interrupted" or not math.isfinite(null_fit.cost):
                return self._no_answer(null_fit, alpha)
            at_fault = _fault_of(null_fit)
            if at_fault is None and self.misread is not None and self.misread.certain:
                at_fault = self.misread.words
            if at_fault is not None:
                return self._no_answer(null_fit, alpha, at_fault)
            self.felt = self._felt_by_corners(null_fit)
            lower = at_lower_rate(null_fit, pars, self.portion, self.noise, options)
            searched, own_noise = (
                (self.portion, self.noise) if lower is None else (lower.portion, lower.noise)
            )
            refitter = Refitter(self.model, pars, searched.data, own_noise, options)
            self.search = search = Choice(refitter, scores, most, self.tell, self.deadline, scatter)
            search.null_time = self.timing.get("null fit", 0.0)
            fresh = FreshChoice(search, searched, self.tell, [], work)
            search.idle_on_fresh = fresh.idle
            fault = self._searched(search, null_fit if lower is None else lower.fit)
            if fault is not None:
                self.search = None
                return self._no_answer(null_fit, alpha, fault, of=_NO_VALUE)
        self.timing |= search.timing
        creeps = ONE_STEP in null_fit.status  # along a valley, as a model that lacks something may
        if not (null_fit.converged or creeps or search.best or follows_by_function(search.refits)):
            return self._no_answer(null_fit, alpha)
        fresh.messages[:0] = self._told_first(search, null_fit, pars, scatter)
        answer = Answer(fresh, alpha, self.asked, self.timing, self.begun, self.tell)
        with self.deadline.spared(math.inf):  # what it can do without asks the time itself
            made = answer.made()
        made = self._of_all_data(made, search, lower)
        with self.deadline.spared(1.0), suppress(TimeUp, *FAILURES):
            made = with_intervals_of_times(made, search.refits)
        self.timing["total"] = time.perf_counter() - self.begun
        if (why := self._unresolved(made)) is not None:
            return self._no_answer(null_fit, alpha, why, UNRESOLVED)
        return self._looked_over(made, search, work)

    def _told_first(self, search: Choice, null_fit: Fit, pars: Parameters, scatter: Any) -> list[str]:
        """What is said before all else: of the data, the corners, and the fit without effects."""
        chosen, refits = search.chosen, search.refits
        told = [*remarks(chosen.fit, scatter), *self.cut]
        widths = ", ".join(f"{one.width} = {pars[one.width].value:.2g}" for one in self.model.corners)
        told += [_JUMPED.format(widths)] if widths else []
        told += [words for words in null_fit.messages if words.startswith(ROUNDED)]
        told += refits.doubt(chosen.effects)
        told += [KEPT_NEAR] if self.kept else []
        if not null_fit.converged:  # a wrong model may have a valley without end; the right one has none
            told.append(
                f"the fit without effects has {null_fit.status}; effects were looked for from where it ended"
            )
        return told

    def _of_all_data(self, made: Repair, search: Choice, lower: LowerRate | None) -> Repair:
        """The answer with fits of the whole data, where a lower rate was searched, and errors that were checked."""
        if lower is None:
            in_places = search.refits.refitter.in_places
            with self.deadline.spared(1.0):
                return with_checked_errors(made, self.noise, self.options, in_places=in_places)
        self.tell("fits of the whole data")
        clock = time.perf_counter()
        try:
            with self.deadline.spared(1.0):
                made = lower.told(made)
        except TimeUp:
            made = replace(made, messages=(*made.messages, _LOWER))
            search.failed["the whole data"] = TIME_UP
        self.timing["whole data"] = time.perf_counter() - clock
        return made

    def _looked_over(self, made: Repair, search: Choice, work: float) -> Repair:
        """The answer with all that is said beside it: what was not searched, what else would read the data alike."""
        refits, options = search.refits, self.options
        left = _not_searched(search, made)
        felt = refits.rounding_felt(search.chosen.effects, ended=bool(left))
        with lifted():  # one simulation at most, by which an answer may have to be less sure
            made = told_as_one_law(made)
        rounding = refits.may_be_rounding(search.chosen.effects)
        made = with_errors_of_rounding(made, felt, refits.path.moved, ended=bool(left), all_of_it=rounding)
        made = with_hint(replace(made, stopped=self._by if left else "", not_searched=left), self.misread)
        with self.deadline.spared(1.0), suppress(TimeUp), Deadline(work=_AGAIN * work):
            made = with_wider_bounds(made, self.parameters, self.noise, options)
            made = with_free_starts(made, self.parameters, self.noise, options)
        with self.deadline.spared(1.0), suppress(TimeUp):
            made = with_other_reading(made, self.parameters, self.noise, options, work, self.tries)
        found = frozenset((one.name, one.at) for one in made.effects)
        return with_lost_beginning(held_to_sizes(made), refits.pool.get(found))

    def _null(self, jobs: int | None, scores: Any) -> tuple[Fit, Parameters, float]:
        """The fit without effects, the parameters that later fits start from, and the work of a start."""
        self.tell(f"fit without effects, {self.several['starts']} starts")
        options: dict[str, Any] = {"noise": self.noise, "progress": False, **self.options}
        given: dict[str, Any] = {
            "model": self.model,
            "data": self.portion.data,
            "parameters": self.parameters,
        }
        given |= {"jobs": jobs, "enough": "white", **self.several, **options}
        if math.isfinite(self.deadline.left):  # what the model lacks makes these errors worth little
            given.setdefault("errors", min(_CHECKS * self.deadline.left, USUAL))
        share = max(_NULL * self.deadline.left, _AT_LEAST)
        fit, own = first_fit(given, share, patient=self.patient)
        if fit.status == "interrupted" and own.over and not late() and math.isfinite(fit.cost):
            # else it goes on as refits do, which begin in short windows
            later = self._at_its_end(fit, options) or continued(fit, given, _NULL * self.deadline.left)
            fit = later or replace(fit, status=SHARE_OVER)
        pieces = None if self.cut else in_pieces(self.portion, fit)
        if pieces is not None:
            self.cut = (cut_words(fit),)
            self.portion, self.options = pieces, {**self.options, "initial": None}
            return self._null(jobs, scores)
        self.null_fit, work = fit, own.done / max(sum(one.starts for one in fit.optima), 1)
        if _fault_of(fit) is None:
            with suppress(TimeUp), Deadline(_NULL / 3 * self.deadline.left):
                self.misread = misread(
                    fit, self.parameters, self.noise, self.options, work, data=self.portion.data,
                    tries=self.tries,
                )  # fmt: skip
            if self.misread is not None and self.misread.certain:
                return fit, self.parameters, work
        ended = fit.status in ("interrupted", SHARE_OVER)
        if (
            not fit.converged
            and (not ended or is_far_off(fit))
            and (near := kept_near(fit, own.done, given, _NULL * self.deadline.left)) is not None
        ):
            self.null_fit, self.kept = near, True
            fit = near
        if not_followed(fit) and not (fit.converged and explained(scores(fit))):
            self.tell("fit without effects by predictions, as the simulation does not follow the data")
            self.null_fit = fit = found_again(fit, own.done, given, _NULL * self.deadline.left)
        fit, pars = settle_scatter(fit, self.parameters, noise=self.noise, options=self.options)
        self.null_fit = fit
        pars = with_widths_of(fit, pars)
        self.timing["null fit"] = time.perf_counter() - self.begun
        return fit, pars, work

    def _at_its_end(self, fit: Fit, options: dict[str, Any]) -> Fit | None:
        """The fit of the best start, where the time was up in another one; None where that had not converged."""
        best = min(fit.optima, key=lambda one: one.cost, default=None)
        if best is None or best.status != "converged":
            return None
        with suppress(TimeUp, CasadiEngineError), Deadline(_NULL / 3 * self.deadline.left):
            again = estimate(
                self.model,
                self.portion.data,
                parameters=self.parameters,
                warm=fit,
                errors="quadratic",
                **options,
            )
            return replace(again, messages=(*again.messages, _UNCHECKED)) if again.converged else None
        return None

    @property
    def patient(self) -> bool:
        """True unless fewer iterations were asked for than there are by default."""
        return int(self.options["max_iterations"]) >= _ITERATIONS

    @property
    def _by(self) -> str:
        """Who ended the search, where anyone did."""
        return USER if self.interrupts is not None and self.interrupts.stopped else BUDGET

    def _searched(self, search: Choice, null_fit: Fit) -> str | None:
        """Run the search; one that is ended has what it had kept before. What to say where the fit without effects
        cannot be simulated, None otherwise."""
        try:
            search.run(null_fit)
        except FloatingPointError as error:
            if search.scored:
                raise
            return (
                f"along the simulation of that fit the equations have no finite value ({error}): give bounds to states "
                "and parameters that keep roots, logarithms and quotients away from it, as fmax(x, 0) under a root does"
            )
        except TimeUp:
            if not search.scored:
                raise
            beside = f" beside {search.pool[search.best].label}" if search.best else ""
            search.failed[f"{ANY}{beside}"] = TIME_UP
        return None

    def interrupted(self, alpha: float) -> Repair:
        """What there is where the user would not wait for the rest."""
        if self.null_fit is None:
            if self._by == USER:
                raise KeyboardInterrupt
            raise EstimationError(
                "the time was up before the model could be evaluated",
                seen=f"budget={self.seconds:g}",
                allowed="time for the fit without effects at least",
                cure="give more time, or fewer samples",
            )
        best = self.null_fit if self.search is None else self.search.fit
        self.timing["total"] = time.perf_counter() - self.begun
        why = "interrupted before the search was at its end: the best model so far has no verdict"
        made = Repair(
            "interrupted", None, None, self.null_fit, best, alpha, data=self.portion.data, fresh=self.portion.fresh,
            timing=self.timing, options=self.asked, messages=(why,), stopped=self._by,
        )  # fmt: skip
        return with_hint(made, self.misread)

    def _felt_by_corners(self, fit: Fit) -> float:
        """By how much wider corners of the user's own laws change chi-squared of the fit without effects, where no
        sharper ones were reached; 0 where they are sharp."""
        if not any(words.startswith(ROUNDED) for words in fit.messages):
            return 0.0
        rounded = [one.width for one in fit.model.effects] + [one.width for one in fit.model.corners]
        widths = {name: fit.parameters[name].value for name in rounded if name}
        with suppress(CasadiEngineError, FloatingPointError):
            return felt_by(fit, widths)
        return 0.0

    def _unresolved(self, made: Repair) -> str | None:
        """Why nobody can say that something is missing: what no effect names is no more than what a fit does that
        rounds the corners of the user's own laws. None where that is not so."""
        if made.verdict != "unnamed" or made.gaps is None or not self.felt:
            return None
        gap = made.gaps.estimation_before.gap
        if (gap.chi2_per_sample - 1) * gap.samples >= self.felt:
            return None
        return (
            "whether anything is missing cannot be told: what is left is no more than corners twice as wide would "
            f"change (chi-squared by {self.felt:.2g}), and no fit with sharper ones was reached; "
            "with_effect(..., sharp=True) keeps the corners as they are"
        )

    def _no_answer(self, fit: Fit, alpha: float, at_fault: str | None = None, of: str = AT_FAULT) -> Repair:
        """What there is without a fit to look for effects from; at_fault : what the data, or with another status the
        model, have to be freed of first."""
        cut = fit.status == "interrupted"
        why = (
            "the time was up before the model without effects fitted, and no effect can be looked for before it does"
            if fit.status == SHARE_OVER
            else "no effect can be looked for before the model without effects fits: give other start values, bounds, "
            "or more starts; a wrong optimum looks like missing physics"
        )
        if cut:
            why = (
                "interrupted in the fit without effects: nothing was searched. Give it more time, budget=..., or fewer "
                "starts, starts=1; where ce.estimate follows the record no better, begin with what "
                'ce.estimate(model, data, approach="prediction") finds, as start values'
            )
        status = fit.status if cut else f"the fit without effects has {fit.status}"
        if at_fault is not None:
            status, why = of, at_fault
        self.timing["total"] = time.perf_counter() - self.begun
        return Repair(
            status, None, None, fit, fit, alpha, data=self.portion.data, fresh=self.portion.fresh,
            timing=self.timing, options=self.asked, messages=(why,), stopped=self._by if cut else "",
        )  # fmt: skip


def _fault_of(fit: Fit) -> str | None:
    """What to say of outputs that a search has no use for; None where there are none."""
    unknown = next(
        (words for words in fit.messages if UNKNOWN in words), None
    )  # nothing is beyond such a noise
    return noise_alone(fit) or at_its_limit(fit) or stands_still(fit) or wild_samples(fit) or unknown


def _not_searched(search: Choice, made: Repair) -> tuple[str, ...]:
    """What the time was up for: effects beside those of the answer, whatever the search stood at then."""
    named = " and ".join(f"{one.name} at {one.at}" for one in made.effects)
    missed = [name for name, why in search.failed.items() if why == TIME_UP]
    own = [f"{ANY} beside {named}" if named and name.startswith(ANY) else name for name in missed]
    return tuple(dict.fromkeys(own))


def _largest(model: Model, records: Sequence[Experiment]) -> dict[str, float]:
    """State or input -> its largest magnitude in these records, of the states that an output shows as they are."""
    outputs = zip(model.outputs, ca.vertsplit(model.output_expressions), strict=True)
    shown = {out.name: str(value) for out, value in outputs if value.is_symbolic()}
    found: dict[str, float] = {}
    for channel, name in [*shown.items(), *((one.name, one.name) for one in model.inputs)]:
        courses = [np.abs(record[channel].values) for record in records if channel in record]
        seen = [course[np.isfinite(course)] for course in courses]
        if any(course.size for course in seen):
            found[name] = float(max(course.max() for course in seen if course.size))
    return found


def _of_data(initial: Any, portion: Portions) -> Any:
    """The initial states that were given, without those of records that are fresh alone: these are found there."""
    if not isinstance(initial, Mapping) or not all(isinstance(one, Mapping) for one in initial.values()):
        return initial
    fresh = {one.name for one in portion.fresh} - {one.name for one in portion.data}
    return {name: own for name, own in initial.items() if name not in fresh}


def _seconds(budget: Any) -> float:
    """The time budget [s]; EstimationError for one that is none."""
    if budget is None:
        return math.inf
    number = as_number(budget)
    if number is None or not number > 0:
        raise EstimationError(
            "invalid `budget`",
            seen=repr(budget),
            allowed="seconds > 0, or None",
            cure="give budget=60 for a minute, or leave it out",
        )
    return number


def _check(noise: Noise | None, alpha: Any, holdout: Any) -> None:
    if isinstance(noise, Noise) and noise.predicts:
        raise EstimationError(
            "effects are looked for in simulations, and this noise asks for a one-step predictor",
            seen=repr(noise),
            allowed="output error: levels of the outputs, or none",
            cure='write noise=ce.Noise(omega="estimate")',
        )
    check_alpha(alpha)
    number = as_number(holdout)
    if number is None or not 0 <= number <= 0.9:
        raise EstimationError(
            "invalid `holdout`",
            seen=holdout,
            allowed="a share of the cycles from 0 to 0.9",
            cure="give holdout=0.3, or fresh data",
        )
