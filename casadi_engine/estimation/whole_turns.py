"""Angles that the data tell but for whole turns, and frequencies but for those that a record does not show.

An angle that enters the equations through its sine and cosine alone may be larger by 2 pi. Where equations count the
time from long before a record begins, as sin(w t) from 1000 s on, w may be larger by 2 pi over that time: all that the
record tells apart is how fast the angle turns while it lasts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.estimation.lower_optimum import Place, merit
from casadi_engine.experiment.units import read_unit

Array = NDArray[np.float64]

TURN = 2 * math.pi
# Points at which equations are asked whether they know of a turn, and the share of their size that is rounding.
_POINTS, _ROUNDING = 4, 1e-9
# Share of a turn that is no period of what turns.
_PART = 0.3
# Lengths of a record from which on before it the time is counted from long ago: then a turn more until its middle is
# half a turn, and less, at its ends.
_LATE = 1.0
# Twice the log likelihood by which another optimum is lower, and within which it is a rival; and how many are looked at
# to either side while each is lower than the one before.
_LOWER, _RIVAL, _MOST = 0.1, 10.0, 20
_OTHERS = "other optima (see note)"
Again = Callable[[dict[str, Any]], Fit]


def but_for_turns(fit: Fit, again: Again) -> Fit:
    """The fit with first states within half a turn, and what is said of angles that the data tell but for whole turns;
    the best one of frequencies that a late record hardly tells apart, without an error where others are as good.

    again(changes) : makes a fit with changed arguments
    """
    if not fit.converged:
        return fit
    equations = _Equations(fit)
    for name, step in equations.late_steps():
        fit = _best_of(fit, name, step, again)
    turning = [state.name for state in fit.model.states if equations.turn(state=state.name)]
    angles = [name for name in fit.free if equations.turn(parameter=name) and _may_turn(fit, name)]
    initial = {
        record: {name: _within(one) if name in turning else one for name, one in own.items()}
        for record, own in fit.initial.items()
    }
    free = [
        f"the first {name}" for name in turning if any(not own[name].fixed for own in fit.initial.values())
    ]
    said = [
        f"{name} is determined only up to whole turns: 2 pi more give the same data"
        for name in (*angles, *free)
    ]
    return replace(fit, initial=initial, messages=(*fit.messages, *said))


def _may_turn(fit: Fit, name: str) -> bool:
    """True where the bounds of a parameter leave room for a turn more or less."""
    own, value = fit.parameters[name], fit.values[name]
    return bool(own.min <= value - TURN or value + TURN <= own.max)


def _within(one: Estimate) -> Estimate:
    """An angle that was estimated, within half a turn of 0."""
    if one.fixed or one.at_bound is not False:
        return one
    turns = TURN * round(one.value / TURN)
    interval = None if one.interval is None else (one.interval[0] - turns, one.interval[1] - turns)
    return replace(one, value=one.value - turns, interval=interval)


class _Equations:
    """The equations of a fit's model near its first states, asked about turns of what bends them."""

    def __init__(self, fit: Fit) -> None:
        model, record = fit.model, fit.data[0]
        self.fit, self.model, self.span = fit, model, record.span
        both = ca.vertcat(model.closed_ode, model.closed_outputs)
        self.timed = bool(ca.depends_on(both, model.t))
        flags = ca.which_depends(both, ca.vertcat(model.x, model.p), 2, False)
        names = (*(state.name for state in model.states), *model.parameter_names)
        self.bending = {name for name, bends in zip(names, flags, strict=True) if bends}
        self.function = ca.Function("equations", [model.x, model.u, model.t, model.p], [ca.densify(both)])
        self.first = np.array([fit.initial[record.name][one.name].value for one in model.states])
        known = fit.values_for(record.name)
        self.p = np.array([known[name] for name in model.parameter_names])

    def turn(self, *, state: str = "", parameter: str = "") -> bool:
        """True if a turn more of a state or of a parameter changes nothing, and a part of one does."""
        change = partial(self._changed, state=state, parameter=parameter)
        return (state or parameter) in self.bending and not change(TURN) and change(_PART * TURN)

    def late_steps(self) -> Iterator[tuple[str, float]]:
        """Parameters of which a step adds a whole turn until the middle of a record that begins long after 0."""
        low, high = self.span
        middle = 0.5 * (low + high)
        # other records, at other times, tell more
        late = high > low and min(abs(low), abs(high)) >= _LATE * (high - low)
        if not (self.timed and late) or len(self.fit.data) > 1:
            return
        units = dict.fromkeys((1.0, float(read_unit(self.model.time_unit).factor)))  # of rates, [s]
        for name in self.fit.free:
            for step in (turn * unit / middle for unit in units for turn in (TURN, 1.0)):
                change = partial(self._changed, parameter=name, time=middle)
                if name in self.model.parameter_names and not change(step) and change(_PART * step):
                    yield name, abs(step)
                    break

    def _changed(self, by: float, *, state: str = "", parameter: str = "", time: float | None = None) -> bool:
        """Whether the equations have other values where a state or a parameter is larger; time : at this one alone."""
        random, model = np.random.default_rng(0), self.model
        size = np.array([one.scale for one in model.states])
        more_x = by * np.array([one.name == state for one in model.states])
        more_p = by * np.array([name == parameter for name in model.parameter_names])
        for _ in range(_POINTS):
            x = self.first + size * random.standard_normal(len(self.first))
            u = random.standard_normal(int(model.u.numel()))
            t = random.uniform(*self.span) if time is None else time
            here, there = (
                np.asarray(self.function(*at), dtype=float)
                for at in ((x, u, t, self.p), (x + more_x, u, t, self.p + more_p))
            )
            if not (np.isfinite(here).all() and np.isfinite(there).all()):
                return True  # of no periodic law
            # a large angle is known to its own digits
            digits = _ROUNDING + 1e-15 * abs(t) * np.abs(self.p + more_p).max(initial=0.0)
            if np.abs(there - here).max(initial=0.0) > digits * max(
                1.0, float(np.abs(here).max(initial=0.0))
            ):
                return True
        return False


def _best_of(fit: Fit, name: str, step: float, again: Again) -> Fit:
    """The lowest of the optima that lie steps of a parameter apart; without its error where others are as good."""
    best, rivals = fit, []
    for side in (-step, step):
        for _ in range(_MOST):
            value = best.values[name] + side
            initial = {
                record: {state: one.value for state, one in own.items()}
                for record, own in best.initial.items()
            }
            found = again({"warm": Place({**best.values, name: value}, initial, best.noise)})
            if not found.converged or abs(found.values[name] - value) > 0.5 * step:
                break
            rise = merit(found) - merit(best)
            if rise > -_LOWER:
                rivals += [(rise, found.values[name])] if rise < _RIVAL else []
                break
            best = found
            rivals = [(-rise, best.values[name] - side)] if -rise < _RIVAL else []
    if not rivals:
        return best
    _, other = min(rivals)
    begin = fit.data[0].span[0]
    words = (
        f"{name} is determined only up to steps of {step:.3g}: the equations count the time from an instant "
        f"{abs(begin):.4g} s from the begin of the record, and {other:.9g} describes it as well as "
        f"{best.values[name]:.9g}: count the time from its begin"
    )
    own = best.estimates[name]
    known = replace(own, stderr=None, interval=None, why=_OTHERS, quadratic=own.stderr or own.quadratic)
    return replace(best, estimates={**best.estimates, name: known}, messages=(*best.messages, words))
