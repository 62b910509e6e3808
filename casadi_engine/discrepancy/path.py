"""The one path of refits: every candidate's complete model, from short windows to the whole record.

Long simulations of a wrong model have many optima; over short windows, whose first states are free, an added torque is
nearly linear and there are few. A refit therefore starts in windows, goes on to longer ones and ends with the whole
record (``estimation.refit_entry``); it is also started from the best point that is known, where the new amplitude is
what one step predicts. The better end counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp, lifted
from casadi_engine.discrepancy.arrived import Arrived, arrived_at
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.null_model import NullModel, null_at
from casadi_engine.discrepancy.read_late import are_of, leaves_more
from casadi_engine.discrepancy.refit import Addition, Refitter
from casadi_engine.discrepancy.refit_null import null_of_refit
from casadi_engine.discrepancy.start import Start
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation.corner_widths import FACTOR as SHARPER_BY
from casadi_engine.estimation.corner_widths import FELT
from casadi_engine.estimation.refit_answer import Windowed
from casadi_engine.estimation.refit_entry import RefitProblem
from casadi_engine.estimation.refit_problem import EXACT
from casadi_engine.model import Model
from casadi_engine.model.lags import delays, is_late, lagged, nearest_lags
from casadi_engine.model.late_inputs import reads
from casadi_engine.parameters import Parameters
from casadi_engine.simulation.exponential_runge_kutta import MOST_SUBSTEPS
from casadi_engine.simulation.propagator import bends_between_samples, switches_with_states
from casadi_engine.simulation.runge_kutta import RungeKuttaPropagator

# What is refitted of a structure.
Form = frozenset[tuple[str, str, bool, bool]]
FAILURES = (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError)
# Standard errors by which the search for an optimum may end off it where structures are compared, a hundredth of
# chi-squared; twice as much by the integration, which moves the log of the odds of two structures by a few tenths.
FELT_ERRORS = 0.1
# Steps over one horizon: a model that explains the data takes ten, one that does not has not arrived after a hundred.
STEPS = 20
# Corners are sharpened at most so often; steps of the integration of all records, if all samples asked for as many as
# the one that asks for most, beyond which they are short in places alone.
_SHARPER, _INTEGRATED = 3, 1e5
# How many times corners are wider by that factor when a refit begins: then about as wide as the motion.
_WIDER = 3
# A refit is given up that has cost so many times as much as they do in the middle, or as one of its structure that
# arrived, and more than this; what the first one may well cost, in steps over the whole record for every step allowed
# over one horizon.
_MANY, _AGAIN, _FREE, _AHEAD = 20.0, 3.0, 1e6, 10
# What a refit with sharper corners may cost more: there are few, and the last ones count.
_PATIENCE = 5.0
# Times that the samples of late sensors are read anew, as a delay turns out; chi-squared by which a delay of whole
# samples has to leave less than where a refit ended.
_LATER, _LESS = 6, 1.0
# Chi-squared, in units of what a sample leaves, by which a refit with sharper corners has to be worse for the law to be
# no sharper: two standard errors.
_REFUSED = 4.0


@dataclass(frozen=True, eq=False)
class _Way:
    """A search over windows: what it is known by, where it ended with the widest corners, and with those that there
    are; end : of an earlier refit that came the same way, None where it is the first; wider : by how many steps corners
    are wider there than they are to be, where windows with sharper ones led astray."""

    key: tuple[Any, ...]
    first: Windowed
    there: Windowed
    end: Arrived | None
    wider: int = 0


class Path:
    """Refits of one set of records at held noise levels; a model with its effects is set up once.

    levels : output -> standard deviation of the noise; felt : standard errors by which refits may be off, but for
    those that are asked for ``exactly``
    """

    def __init__(self, refitter: Refitter, levels: Mapping[str, float], felt: float = FELT_ERRORS) -> None:
        self.refitter, self.levels, self.felt_errors = refitter, dict(levels), felt
        self._made: dict[tuple[Any, ...], tuple[Model, Parameters, RefitProblem]] = {}
        self._kept: list[Addition] = []
        # chi-squared by which corners that are sharper still may change the best fit; nan where it is not known
        self.felt = math.nan
        # parameter -> by how much such corners may change it, where refits with two widths tell
        self.moved: dict[str, float] = {}
        # where one simulation told it last, and the share
        self._felt: tuple[Arrived, float, float] | None = None
        # structure and share -> both, where a refit with corners so sharp told them
        self._told: dict[tuple[Form, float], tuple[float, dict[str, float]]] = {}
        self._least: dict[int, float] = {}  # the least work that a refit of a structure took
        # structure, share and lags -> where searches over windows of it came by, and ended
        self._ways: dict[tuple[Any, ...], list[tuple[Windowed, Arrived]]] = {}
        # structure -> least chi-squared over windows, at these levels
        self.bounds: dict[Form, float] = {}
        # where, on the way to the last corners, a refit left least, and their share: None where that is their end
        self.turned: tuple[float, Arrived] | None = None
        # share of the corners' widths -> work of the refits so far, that which is expected of the first one first
        self._work: dict[float, list[float]] = {}

    def from_point(self, effects: Sequence[Addition], start: Start | Arrived | None) -> Arrived | None:
        """The end of a refit from a point, None for the parameters' own values; None where the model fails."""
        return self._ended(effects, start)

    def exactly(self, effects: Sequence[Addition], arrived: Arrived) -> Arrived | None:
        """The end of a refit from where another one arrived, as exact as whole fits are."""
        _, _, problem = self._problem(effects, arrived.lags)
        try:
            problem.felt = EXACT
            return self._ended(effects, arrived)
        finally:
            problem.felt = self.felt_errors

    def from_windows(
        self, effects: Sequence[Addition], start: Start | None = None, most: float = math.inf
    ) -> Arrived | None:
        """The end of a refit that begins in short windows, at the values of a start or the parameters' own.

        Corners of a law are as wide as its motion at first, and sharper from one refit over windows to the next: a wide
        one shows the way, a sharp one is felt only where it is passed; over whole records they are not rounded so.
        most : chi-squared beyond which nobody asks for the end: what windows leave is the least that it can be
        """
        return self._ended(effects, start, windows=True, most=most)

    def cornered(self, effects: Sequence[Addition]) -> bool:
        """True if a law has corners whose width follows the motion."""
        refitter, own = self.refitter, self.refitter.share
        found = [refitter.rounded(one) for one in effects]
        refitter.share = own * SHARPER_BY
        try:
            return found != [refitter.rounded(one) for one in effects]
        finally:
            refitter.share = own

    @property
    def samples(self) -> int:
        """How many samples count."""
        return self._problem(())[2].count

    @property
    def linear(self) -> bool:
        """True if the equations without effects have a linear core: then windows have nothing to tell."""
        _, _, problem = self._problem(())
        return not any(isinstance(record.propagator, RungeKuttaPropagator) for record in problem.records)

    def at(self, values: Mapping[str, float], initial: Mapping[str, Mapping[str, float]]) -> Arrived | None:
        """The model without effects near known parameters and first states: an optimum of another integrator is one
        here but for its steps, which are as long as they may be only where a search has settled."""
        _, _, problem = self._problem(())
        with Deadline() as own:
            found = problem.run(start=values, initial=initial, horizons=(None,), most=STEPS)
        self._done(_AHEAD * STEPS * own.done / max(found.steps, 1), first=True)
        return arrived_at(problem, found, self.levels)

    def cost_without(self, effects: Sequence[Addition], arrived: Arrived, amplitude: str) -> float:
        """Chi-squared where a refit arrived, an amplitude put to zero and all else as it is; inf where that fails."""
        _, _, problem = self._problem(effects, arrived.lags)
        values = {n: 0.0 if n.partition("@")[0] == amplitude else v for n, v in arrived.values.items()}
        with suppress(*FAILURES), np.errstate(all="ignore"):
            return problem.glance(values, problem.nodes_of(arrived.refit))
        return math.inf

    def residuals(self, effects: Sequence[Addition], arrived: Arrived) -> NullModel:
        """Residuals and slopes where a refit of these effects ended, as its own integrator has them; without the paths
        that candidates act along."""
        model, parameters, problem = self._problem(effects, arrived.lags)
        return null_of_refit(model, parameters, problem, arrived.refit, arrived.levels)

    def null_at(self, effects: Sequence[Addition], arrived: Arrived) -> NullModel:
        """The model with these effects, linearised along a simulation where a refit of them ended."""
        model, parameters, problem = self._problem(effects, arrived.lags)
        names = [state.name for state in model.states]
        first = {record: np.array([own[n] for n in names]) for record, own in arrived.initial.items()}
        z = np.array([arrived.values[name] for name in problem.pmap.free])
        return null_at(model, self.refitter.data, parameters, z, first)

    def first_states(self, model: Model) -> dict[str, Array]:
        """record -> (n,) first states that the measurement gives at the parameters' own values, for a model with
        effects: states of theirs begin at 0."""
        found = self._problem(())[2].run(horizons=(None,), most=1)
        names = [state.name for state in model.states]
        return {record: np.array([own.get(n, 0.0) for n in names]) for record, own in found.initial.items()}

    def parameters(self, effects: Sequence[Addition]) -> Parameters:
        """The parameters of the model with these effects."""
        return self._problem(effects, {})[1]

    def relevel(self, levels: Mapping[str, float]) -> None:
        """Weigh all further refits by other levels."""
        self.levels = dict(levels)
        self._ways.clear()
        self.bounds.clear()
        for model, _, problem in self._made.values():
            for record in problem.records:
                record.set_sigma(np.array([levels[out.name] for out in model.outputs]))

    def sharpness(self, effects: Sequence[Addition], arrived: Arrived, worth: float = 1.0) -> float:
        """The share of the motion's widths at which the data do not tell corners from sharper ones.

        A corner's width is a bias: friction that sticks creeps. Chi-squared at the values where a refit arrived tells
        which width is felt; what it would still change by is kept as ``felt``.
        worth : the share of the samples that count as independent ones
        """
        refitter, before = self.refitter, self.refitter.share
        model, _, own = self._problem(effects, arrived.lags)
        shares = self.shares(before)
        if not self.cornered(effects) or switches_with_states(model) or len(shares) == 1:
            return before
        last, wider = math.nan, before
        # another structure's says nothing of this one
        self.felt, self.moved = self._told.get((form_of(effects), before), (math.nan, {}))
        felt = FELT * max(arrived.cost / max(own.count, 1), 1.0) / worth
        try:
            with np.errstate(all="ignore"):
                states = [path.x for path in own.paths(arrived.values, own.nodes_of(arrived.refit))]
                alike = _followed(own)
                for level, share in enumerate(shares):
                    refitter.share = share
                    if level > alike:  # beyond that steps have to be short in places alone
                        if not self._same_in_places(effects, arrived, states):
                            break
                        refitter.sharpest = max(refitter.sharpest, share)
                    cost = _cost_along(self._problem(effects, arrived.lags)[2], arrived.values, states)
                    if level:  # what is left falls by the factor from one share to the next
                        self.felt, self.moved = FELT * abs(cost - last) / (SHARPER_BY - 1) / felt, {}
                    if self.felt * SHARPER_BY < FELT:
                        self.felt = 0.0
                        return wider
                    last, wider = cost, share
        except FAILURES:
            pass  # sharper than the integrator can follow
        finally:
            refitter.share = before
        return wider

    def felt_along(self, effects: Sequence[Addition], arrived: Arrived) -> float:
        """The same ``felt`` by one simulation with sharper corners along the motion of a refit, where nothing else has
        told it: a corner that no record comes near is not felt. nan where it cannot be simulated."""
        refitter, before = self.refitter, self.refitter.share
        if self._felt is not None and self._felt[:2] == (arrived, before):
            return self._felt[2]
        _, _, own = self._problem(effects, arrived.lags)
        try:
            with np.errstate(all="ignore"), lifted():  # what was refitted is an answer
                states = [path.x for path in own.paths(arrived.values, own.nodes_of(arrived.refit))]
                cost = _cost_along(own, arrived.values, states)
                refitter.share = before / SHARPER_BY
                sharper = _cost_along(self._problem(effects, arrived.lags)[2], arrived.values, states)
        except FAILURES:
            return math.nan
        finally:
            refitter.share = before
        change = abs(cost - sharper) / (1 - 1 / SHARPER_BY)
        self._felt = arrived, before, change / max(arrived.cost / max(own.count, 1), 1.0)
        return self._felt[2]

    def _same_in_places(self, effects: Sequence[Addition], arrived: Arrived, states: Sequence[Array]) -> bool:
        """True if steps that are short in places alone have the answer of those of a linear core: with corners as wide
        as the motion chi-squared is the same by both. Between samples the one reads channels, the other what they
        drive."""
        refitter, before = self.refitter, self.refitter.share
        try:
            refitter.share = max(1.0, before)
            model, pars, wide = self._problem(effects, arrived.lags)
            if not any(bends_between_samples(record.model) for record in wide.records):
                return True
            how = {"levels": self.levels, "interval": refitter.interval, "felt": self.felt_errors}
            other = RefitProblem(model, refitter.data, pars, **how)
            if not other.step_in_places(anyway=True):
                return True
            costs = [_cost_along(one, arrived.values, states) for one in (wide, other)]
        finally:
            refitter.share = before
        return abs(costs[0] - costs[1]) <= FELT * max(arrived.cost / max(wide.count, 1), 1.0)

    def shares(self, begun: float) -> list[float]:
        """Shares of the motion's widths from one on, each sharper by a factor, to the least that is tried."""
        found = [begun]
        while found[-1] > 1.01 * SHARPER_BY**-_SHARPER:
            found.append(found[-1] / SHARPER_BY)
        return found

    def sharpest(
        self, effects: Sequence[Addition], arrived: Arrived, target: float, worth: float
    ) -> tuple[float, Arrived] | None:
        """The sharpest corners, down to a share, with which a refit settles or is better, and where it arrived; no
        sharper than chi-squared of the refits feels, or than the law itself is. None where there are none."""
        refitter, before = self.refitter, self.refitter.share
        _, _, own = self._problem(effects, arrived.lags)
        felt = FELT * max(arrived.cost / max(own.count, 1), 1.0) / worth
        reached, last, self.turned = None, arrived, None
        try:
            for share in self.shares(before)[1:]:
                if share < 0.99 * target:
                    break
                refitter.share = share
                there = self._ended(effects, last, patience=_PATIENCE)
                if there is None or (not there.settled and there.cost > last.cost):
                    break
                if there.cost > last.cost + _REFUSED * felt / FELT:
                    self.felt, self.moved = 0.0, {}
                    self.turned = reached or (before, arrived)
                    break
                self.felt = FELT * abs(there.cost - last.cost) / (SHARPER_BY - 1) / felt
                both = {
                    name: (one, last.values[name])
                    for name, one in there.values.items()
                    if name in last.values
                }
                self.moved = {
                    name: abs(one - other) / (SHARPER_BY - 1) for name, (one, other) in both.items()
                }
                self._told[form_of(effects), share] = self.felt, self.moved
                reached, last = (share, there), there
                if self.felt < FELT or not there.settled:
                    break
        finally:
            refitter.share = before
        return reached

    def sharper(self, effects: Sequence[Addition], arrived: Arrived, before: float) -> Arrived | None:
        """A refit with corners as sharp as they are now, from where it arrived with those before, in steps."""
        refitter, own, found = self.refitter, self.refitter.share, arrived
        least, self.turned = (before, arrived), None
        try:
            steps = [share for share in self.shares(before)[1:] if share > 1.01 * own]
            for share in (*steps, own):
                refitter.share = share
                there = self._ended(effects, found, patience=_PATIENCE)
                if there is None:
                    return None
                found = there
                least = (share, there) if there.cost < least[1].cost else least
            unit = max(least[1].cost / max(self.samples, 1), 1.0)
            self.turned = least if found.cost > least[1].cost + _REFUSED * unit else None
        finally:
            refitter.share = own
        return found

    # ---- inside

    def _ended(
        self,
        effects: Sequence[Addition],
        start: Any,
        *,
        windows: bool = False,
        patience: float = 1.0,
        most: float = math.inf,
    ) -> Arrived | None:
        """The end of a refit; samples of late sensors are read anew until it says that they are no later."""
        try:
            model, data = self._model(effects, {}), self.refitter.data
        except FAILURES:  # effects that cannot be together
            return None
        known = {one.amplitude: one.start for one in effects} | dict(
            start.values if start is not None else {}
        )
        lags = nearest_lags(model, known, data, begun=True)
        if isinstance(start, Arrived) and reads(start.lags):  # its inputs are read off the record already
            lags = nearest_lags(self._model(effects, start.lags), known, data, begun=True)
        before: Arrived | None = None
        for _ in range(_LATER):
            try:
                way = self._in_windows(effects, start, lags) if windows else None
                if way is not None and way.end is None and not way.wider:  # wide corners leave no bound
                    form = form_of(effects)
                    self.bounds[form] = min(way.there.cost, self.bounds.get(form, math.inf))
                    if way.there.cost > most:
                        return None
                found = (
                    way.end or self._after_windows(effects, way, patience, lags) if way is not None else None
                )
                if found is None or (way is not None and self._astray(effects, start, lags, found)):
                    there = self._ended_with(effects, start, patience, lags, None)
                    found = min(
                        (one for one in (found, there) if one), key=lambda one: one.cost, default=None
                    )
            except (*FAILURES, TimeUp):
                return before
            if found is None:
                return before
            if way is not None and way.end is None:
                self._ways.setdefault(way.key, []).append((way.first, found))
            if leaves_more(found.cost, None if before is None else before.cost, len(data)):
                return before
            own = nearest_lags(self._model(effects, lags), found.values, data)
            before = found if reads(own) and not reads(lags) else before
            if own == lags:
                return self._on_a_sample(effects, found, patience)
            start, windows, lags = found, False, own
        return found

    def _astray(
        self,
        effects: Sequence[Addition],
        start: Start | Arrived | None,
        lags: Mapping[str, float],
        found: Arrived,
    ) -> bool:
        """True if windows led to an end that explains less than the start, whose first states are known, did."""
        with suppress(*FAILURES), np.errstate(all="ignore"):
            _, _, problem = self._problem(effects, lags)
            if start is not None and start.initial:
                values = _begun(problem, effects, start.values)
                return problem.glance_from(values, start.initial) < found.cost - _LESS
        return False

    def _on_a_sample(self, effects: Sequence[Addition], found: Arrived, patience: float) -> Arrived:
        """A refit with its delays at whole samples, where that leaves less: over a part of one the law is a series,
        and where the output bends sharply chi-squared has an optimum beside each other."""
        model, _, problem = self._problem(effects, found.lags)
        whole = {
            name: found.lags.get(out, 0.0) for out, name in delays(model).items() if name in found.values
        }
        if not any(whole.values()):
            return found
        values, other = {**found.values, **whole}, None
        with suppress(*FAILURES, TimeUp), np.errstate(all="ignore"):
            least = found.refit.cost - found.refit.prior_cost - _LESS
            if problem.glance(values, problem.nodes_of(found.refit)) < least:
                other = self._ended_with(effects, replace(found, values=values), patience, found.lags, None)
        return found if other is None or other.cost > found.cost else other

    def _in_windows(
        self, effects: Sequence[Addition], start: Start | Arrived | None, lags: Mapping[str, float]
    ) -> _Way | None:
        """The search over windows; where no integrator follows sharp corners of effects that are there already, from
        wide ones, and None where it follows none: the whole record may be followed."""
        wide = self.cornered(effects[-1:])
        with suppress(*FAILURES):
            return self._through_windows(effects, start, lags, wide=wide)
        with suppress(*FAILURES):
            return None if wide else self._through_windows(effects, start, lags, wide=self.cornered(effects))
        return None

    def _through_windows(
        self,
        effects: Sequence[Addition],
        start: Start | Arrived | None,
        lags: Mapping[str, float],
        *,
        wide: bool,
    ) -> _Way:
        """The search over windows, from wide corners to those that there are."""
        refitter, own = self.refitter, self.refitter.share
        first: Windowed | None = None
        there: Windowed | None = None
        key = (form_of(effects), own, tuple(lags.items()))
        levels = range(_WIDER if wide else 0, -1, -1)
        try:
            for level in levels:
                refitter.share = own * SHARPER_BY**level
                _, _, problem = self._problem(effects, lags)
                begun = {} if start is None else start.values
                values = _begun(problem, effects, begun) if there is None else None
                with Deadline(work=self.allowed(problem)):
                    found = problem.windowed(values, there, most=STEPS)
                if first is None or there is None:
                    first, unit = found, max(1.0, found.cost / max(problem.count, 1))
                    for one, end in self._ways.get(key, ()):
                        if end.settled and abs(one.cost - found.cost) <= 2 * self.felt_errors**2 * unit:
                            return _Way(key, first, found, end)
                elif not found.converged and found.cost > there.cost:
                    return _Way(key, first, there, None, wider=level + 1)
                there = found
        finally:
            refitter.share = own
        assert first is not None  # of one level at least
        assert there is not None
        return _Way(key, first, there, None)

    def _after_windows(
        self, effects: Sequence[Addition], way: _Way, patience: float, lags: Mapping[str, float]
    ) -> Arrived | None:
        """The end over whole records after a search over windows; with corners as wide as they were there first."""
        refitter, own, found = self.refitter, self.refitter.share, None
        try:
            for level in range(way.wider, -1, -1):
                refitter.share = own * SHARPER_BY**level
                found = self._ended_with(effects, found, patience, lags, way.there if found is None else None)
                if found is None:
                    return None
        finally:
            refitter.share = own
        return found

    def _model(self, effects: Sequence[Addition], lags: Mapping[str, float]) -> Model:
        """The model with these effects and, beside those of the base, these lags of its sensors."""
        model = self.refitter.extended(effects)
        return lagged(model, {**dict(model.lags), **lags}) if is_late(model) else model

    def _ended_with(
        self,
        effects: Sequence[Addition],
        start: Any,
        patience: float,
        lags: Mapping[str, float],
        after: Windowed | None,
    ) -> Arrived | None:
        """The end over whole records, from a start or where the search over windows ended."""
        _, _, problem = self._problem(effects, lags)
        how: dict[str, Any] = {"horizons": (None,), "most": STEPS}
        with Deadline(work=patience * self.allowed(problem)) as own:
            if after is not None:
                found = problem.run(after=after, **how)
            else:
                values = _begun(problem, effects, {} if start is None else start.values)
                initial = (start.initial if start is not None else None) or None
                near = None
                if isinstance(start, Arrived) and initial is not None and are_of(problem.model, initial):
                    near = start.refit.nodes
                found = problem.run(start=values, initial=initial, near=near, **how)
        if found.converged:  # what wanders is no measure of what refits cost
            self._done(own.done)
            self._least[id(problem)] = min(own.done, self._least.get(id(problem), math.inf))
        return arrived_at(problem, found, self.levels, lags)

    def allowed(self, problem: RefitProblem) -> float:
        """Work that a refit may cost: some of what they cost in the middle, less if one of this structure arrived."""
        # sharper corners cost more: what wider ones did is no measure of them
        share = self.refitter.share
        work = self._work.get(share if share in self._work else min(self._work, default=share), [])
        known = work[1:] or work
        most = _MANY * float(np.median(known)) if known else math.inf
        return max(min(most, _AGAIN * self._least.get(id(problem), math.inf)), _FREE)

    @property
    def usual(self) -> float:
        """Work of a refit in the middle, with corners as they are; 0 before the first one."""
        known = self._work.get(self.refitter.share, [])
        return float(np.median(known)) if known else 0.0

    def _done(self, work: float, *, first: bool = False) -> None:
        """Remember what a refit cost; first : what the first one may, in place of what was expected of it before."""
        known = self._work.setdefault(self.refitter.share, [])
        if first:
            known[:1] = [work]
        else:
            known.append(work)

    def _problem(
        self, effects: Sequence[Addition], lags: Mapping[str, float] = MappingProxyType({})
    ) -> tuple[Model, Parameters, RefitProblem]:
        own = tuple((id(one.candidate), one.shared, one.width, _in_order(one.times)) for one in effects)
        key = (self.refitter.share, tuple(lags.items()), *own)
        if key not in self._made:
            self._kept += effects  # alive, so that no other candidate takes its identity
            refitter = self.refitter
            model = self._model(effects, lags)
            pars = refitter.parameters_of(model, effects).unconstrained()
            interval = refitter.interval
            problem = RefitProblem(
                model, refitter.data, pars, levels=self.levels, interval=interval, felt=self.felt_errors
            )
            if refitter.in_places:
                problem.step_in_places(anyway=True)
            self._made[key] = model, pars, problem
        return self._made[key]


def form_of(effects: Sequence[Addition]) -> Form:
    """Effects and ports, which events have one amplitude for all records, and which laws are rounded themselves."""
    return frozenset((*one.candidate.key, one.shared, one.width is not None) for one in effects)


def _begun(
    problem: RefitProblem, effects: Sequence[Addition], known: Mapping[str, float]
) -> dict[str, float]:
    """Values from which a refit starts: those that are known, and of the other amplitudes what is hoped for."""
    found = dict(known)
    for one in effects:
        own = [name for name in problem.pmap.free if name.partition("@")[0] == one.amplitude]
        found |= {name: one.start for name in own if name not in known}
    return found


def _followed(problem: RefitProblem) -> int:
    """How many times an integrator with steps alike everywhere can follow corners that are sharper by the factor."""
    steps = max((getattr(record.propagator, "substeps", 1) for record in problem.records), default=1)
    allowed = min(MOST_SUBSTEPS, _INTEGRATED / sum(record.grid.samples for record in problem.records))
    return int(math.log(max(allowed / steps, 1.0), SHARPER_BY) + 1e-9)


def _cost_along(problem: RefitProblem, values: Mapping[str, float], states: Sequence[Array]) -> float:
    """Chi-squared of the run near known states (n, N); raises FloatingPointError where it has none."""
    nodes = [
        (x[:, :: record.plan.length][:, : record.plan.m] / record.scale[:, None]).T
        for record, x in zip(problem.records, states, strict=True)
    ]
    cost = problem.cost_from(values, nodes)
    if not math.isfinite(cost):
        raise FloatingPointError("the simulation has no numbers")
    return cost


def _in_order(times: Mapping[str, Mapping[str, float]]) -> tuple[Any, ...]:
    return tuple((name, record, time) for name, own in times.items() for record, time in own.items())
