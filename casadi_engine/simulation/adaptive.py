"""Values of any model to a tolerance: steps that follow the error, events met at their instant, stiff equations too.

Smooth pieces are integrated by the explicit scheme of order 8 of Dormand and Prince (Hairer, Nørsett & Wanner,
Solving Ordinary Differential Equations I, section II.10), each step one CasADi call; by CVODES (Hindmarsh et al.
2005) from where the step is limited by stability and not by accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np

from casadi_engine.deadline import ask
from casadi_engine.simulation.adaptive_steps import cvodes, dormand_prince, error_norm, error_norms
from casadi_engine.simulation.jets import Array
from casadi_engine.simulation.swept_steps import FEWEST, Sweeps, Swept
from casadi_engine.simulation.switched_field import Mode, Segment, SwitchedField

# Steps whose length times the fastest mode exceed this are limited by stability: the scheme's limit is about 6.
_STABILITY = 3.5
# So many of them, looked at every so many steps, make the equations stiff.
_STIFF, _LOOKED = 6, 10
# Between two knots explicit steps that are limited by stability cost less than a fresh start of CVODES, up to so many.
_DEAR = 20.0
# Error control: safety, least and largest change of the step's length.
_SAFETY, _LEAST, _MOST = 0.9, 0.2, 6.0
# Of the largest state: a state smaller than that is integrated as exactly as one of that size.
_SMALL = 1e-9
# Of its declared size, what a state that has always been at rest is integrated to: it may be set in motion by a corner.
_REST = 1e-18
# Of the states themselves, what sensitivities to scaled parameters are integrated to: the first digits of one that was
# 0 until a corner drown in the rounding of the states.
_FELT = 1e-6
# To this share of its largest value the course of a switching function within a step is known.
_COURSE = 1e-3
# And so near to 0 a cubic through it is looked at more closely.
_NEAR = 1e-2
# What is left of two fields that cancel, relative to them.
_ROUNDING = 1e-14
# Knots that CVODES meets in one run: the last is at most so many times as far as the first.
_SPREAD = 1e3
# Two passes of a switch within this share of the record count as none.
_BRIEF = 1e-6
# An instant is rounded to this share of the time, and no step is shorter. The rates of sensitivities jump at a corner
# of the equations; where these were 0 before, no step across it meets a tolerance that is relative. One of this share
# of the record is taken then, so many times in a row at most.
_SHORTEST, _CORNER = 1e-15, 5
# A switching function counts as passed beyond this share of its largest value.
_PASSED = 1e-12
MOST_STEPS, MOST_EVENTS = 2_000_000, 50_000
TOO_MANY = "too many steps or events"


@dataclass
class Run:
    """States (N, n) at the knots; steps taken, events met, and whether the equations were stiff."""

    states: Array
    steps: int
    events: int
    stiff: bool


class Adaptive:
    """An integration of a field from knot to knot; between two knots the channels are straight lines."""

    def __init__(
        self, field: SwitchedField, tolerance: float, z: Array | None = None, scale: Array | None = None
    ) -> None:
        self.field, self.tolerance = field, tolerance
        sizes = np.ones(field.n) if scale is None else scale
        self._sizes, self._floor = sizes, _REST * np.tile(sizes, field.size // field.n)
        wide = field.size // field.n - 1
        self._per = np.concatenate([1 / sizes, np.ones(wide - field.n)]) if wide else np.zeros(0)
        self.z = np.zeros(0) if z is None else z
        self.mode: Mode = ()
        self.side = np.zeros(field.switches)
        self.b = self.c = np.zeros(len(field.owner))
        self.steps = self.events = self.limited = self._forced = 0
        self.stiff = False
        self.h = self.time = self._length = 0.0
        # of the switching functions and themselves at the beginning and the end of the last explicit step
        self._rates: list[Array] = []
        self._ends: list[Array] = []
        # (n,) what the fields on both sides of the switches differ by on which the state stays: they cancel
        self._held = np.zeros(field.n)

    # ---- the whole run

    def run(self, x: Array, time: Array, low: Array, high: Array) -> Run:
        """States at the knots ``time`` (N,) from x (n,), with sensitivities behind them if the field has them.

        low, high : (nu, N-1) channels at the ends of each piece

        Raises FloatingPointError where the state is not finite, or steps or events become too many.
        """
        states = np.empty((len(time), len(x)))
        states[0] = x
        self.peak, self.g_peak = np.abs(x), np.zeros(self.field.switches)
        # Without channels and switches nothing asks for a fresh start at a knot.
        self._span = float(time[-1] - time[0])
        self._free = not len(low) and not self.field.switches
        sweeps = Sweeps(self.field) if len(time) > FEWEST else None
        jumps = np.append(
            True, (low[:, 1:] != high[:, :-1]).any(axis=0)
        )  # of channels at the beginning of each piece
        done, waits = 0, False
        for k in range(len(time) - 1):
            if k + 1 < done:
                continue
            if sweeps and k and not waits and not self.stiff:
                found = self._swept(sweeps, x, time[k:], low[:, k:], high[:, k:], jumps[k:])
                if len(found):
                    done, x = k + len(found) + 1, found[-1]
                    states[k + 1 : done] = found
                    waits = (
                        bool(self.field.switches) and sweeps.cut
                    )  # until the switch that is near is passed
                    continue
            length = time[k + 1] - time[k]
            segment = Segment(time[k], low[:, k], (high[:, k] - low[:, k]) / length, self.z).row
            if k == 0:
                self.h = self._first_step(x, time[0], length, segment)
            if self.field.switches and jumps[k]:
                x = self._settle(x, time[k], segment)
            met = self.events
            x = self._piece(x, time[k], time[k + 1], segment)
            states[k + 1] = x
            waits = waits and met == self.events and not self._far(length)
            while self.stiff and self._free and k + 1 < len(time) - 1:
                # knots whose distances are not too different in one run: CVODES counts its time from its beginning
                far = time[k + 1] + _SPREAD * (time[k + 2] - time[k + 1])
                done = max(int(np.searchsorted(time, far, side="right")), k + 3)
                states[k + 2 : done] = self._stiff_rest(x, time[k + 1 : done], segment)
                self.peak = np.maximum(self.peak, np.abs(states[k + 2 : done]).max(axis=0))
                k, x = done - 2, states[done - 1]
        return Run(states, self.steps, self.events, self.stiff)

    def _first_step(self, x: Array, t: float, length: float, segment: Array) -> float:
        slope = self.field.field(())(x, t, segment, self._values(x, t, segment), self.c)[0]
        fast = float(np.linalg.norm(slope))
        size = float(np.linalg.norm(x)) + 1e-6 * fast * length
        return min(float(length), 0.01 * max(size, 1e-12) / max(fast, 1e-300))

    def _values(self, x: Array, t: float, segment: Array) -> Array:
        return self.field.nodes(x, t, segment) if len(self.field.owner) else self.b

    def _weights(self, x: Array, peak: Array) -> Array:
        """What states x (..., size) may be off by, beside the largest ones so far."""
        n = self.field.n
        size = np.abs(x) + 1e-3 * peak + self._floor
        felt = _FELT * self._per[:, None] * peak[..., None, :n]
        size[..., n:] += felt.reshape(*peak.shape[:-1], -1)
        return np.asarray(self.tolerance * size)

    def _piece(self, x: Array, t: float, end: float, segment: Array) -> Array:
        """From one knot to the next."""
        self._length = end - t
        if self.stiff and not self._free and self._fastest(x, t, segment) * (end - t) < _STABILITY * _DEAR:
            self.stiff, self.limited, self.h = False, 0, end - t  # a corner is passed
        while t < end:
            self.time = t
            self._count()
            left = end - t
            if self.stiff:
                h, ahead, share = left, *self._stiff_step(x, t, left, segment)
            else:
                h, ahead, share = self._accepted(x, t, left, segment)
            later = end if h >= left else t + h
            if self.field.switches:
                found = self._event(x, t, h, ahead, share, segment)
                if found is not None:
                    t, x = found
                    continue
            t, x = later, ahead
            self.peak = np.maximum(self.peak, np.abs(x))
        return x

    def _count(self) -> None:
        ask(1)
        self.steps += 1
        if self.steps > MOST_STEPS or self.events > MOST_EVENTS:
            raise FloatingPointError(TOO_MANY)

    # ---- explicit steps

    @np.errstate(all="ignore")
    def _swept(self, sweeps: Sweeps, x: Array, time: Array, low: Array, high: Array, jumps: Array) -> Array:
        """(K, size) states at the next knots, as far as steps of one sweep meet the tolerance and pass no switch; none
        where none does."""
        made = sweeps.of(x, time, low, high, self.h, self.z, (self.mode, self.b, self.c))
        if made is None:
            return np.zeros((0, len(x)))
        lengths, ends, parts = made.lengths, made.ends, made.parts
        ask(len(lengths))
        sizes = np.abs(np.concatenate([x[None], ends]))
        peaks = np.maximum.accumulate(np.concatenate([self.peak[None], sizes[1:]]), axis=0)
        weights = self._weights(np.maximum(sizes[:-1], sizes[1:]), peaks[:-1])
        weights[:, : self.field.n] += _ROUNDING * lengths[:, None] * self._held
        errors = error_norms(made.fifth / weights, made.third / weights)
        passed = np.maximum.accumulate(np.concatenate([self.g_peak[None], np.abs(made.late_g)]), axis=0)
        if self.field.switches:
            errors = np.maximum(errors, self._course_errors(made, passed[1:]))
        good = np.isfinite(ends).all(axis=1) & (errors <= 1)
        if self.field.switches:
            begun = np.zeros(len(good), dtype=bool)
            begun[::parts] = jumps[: len(good) // parts]
            near = 1e3 * _PASSED * passed[:-1]
            good &= made.undisturbed(self.side, self.mode, near, begun)
            good &= ~(begun & self.field.inputs_switch)
        count = len(good) if good.all() else int(np.argmin(good))
        sweeps.went(count, len(good))
        count -= count % parts
        if not count:
            return np.zeros((0, len(x)))
        grown = lengths[:count] * np.minimum(_MOST, _SAFETY * np.maximum(errors[:count], 1e-10) ** (-1 / 8))
        self.h = float(grown.min())
        self.steps += count
        self.peak, self.g_peak = peaks[count], passed[count]
        if self.steps > MOST_STEPS:
            raise FloatingPointError(TOO_MANY)
        return np.asarray(ends[parts - 1 : count : parts])

    def _course_errors(self, made: Swept, peak: Array) -> Array:
        """(K,) errors of the course of the switching functions within steps, in what is allowed; 0 of brief ones."""
        weights = _COURSE * peak + 1e-300
        errors = error_norms(made.passing5 / weights, made.passing3 / weights)
        return np.where(made.lengths > _BRIEF * self._span, errors, 0.0)

    def _step(self, x: Array, t: float, h: float, segment: Array) -> list[Array]:
        return self.field.stepper(self.mode, dormand_prince)(x, t, h, segment, self.b, self.c)

    def _accepted(self, x: Array, t: float, left: float, segment: Array) -> tuple[float, Array, Array]:
        """A step that meets the tolerance: its length, end, and α there."""
        h = min(self.h, left)
        while True:
            ahead, fifth, third, share, passing5, passing3, *ends, _ = self._step(x, t, h, segment)
            self._rates, self._ends = ends[:2], ends[2:]
            weight = self._weights(np.maximum(np.abs(x), np.abs(ahead)), self.peak)
            weight[: self.field.n] += _ROUNDING * h * self._held
            finite = bool(np.isfinite(ahead).all())
            error = error_norm(fifth / weight, third / weight)
            if (
                self.field.switches and h > _BRIEF * self._span
            ):  # a switch that is passed twice within a step is seen where its course is known
                weight = _COURSE * np.maximum(self.g_peak, np.abs(self._ends[1]))
                error = max(error, error_norm(passing5 / (weight + 1e-300), passing3 / (weight + 1e-300)))
            finite = finite and bool(np.isfinite(error))
            brief = _SHORTEST * max(abs(t), self._span)
            if finite and error <= 1:
                self._forced = self._forced if h <= 1e3 * brief else 0
                break
            if finite and h <= brief and self._forced < _CORNER:
                self._forced += 1
                break
            if h <= max(_SHORTEST * abs(t), 1e-290):
                raise FloatingPointError("the step has become too short")
            shorter = h * (max(_LEAST, _SAFETY * error ** (-1 / 8)) if finite else _LEAST)
            h = max(shorter, brief) if h > brief else shorter
            self._count()
        grown = h * min(_MOST, _SAFETY * max(error, 1e-10) ** (-1 / 8))
        self.h = max(grown, self.h) if h >= left and h < self.h else grown
        if self.steps % _LOOKED == 0:
            self._look_for_stiffness(ahead, t + h, h, segment)
        return h, ahead, share

    def _look_for_stiffness(self, x: Array, t: float, h: float, segment: Array) -> None:
        fastest = self._fastest(x, t, segment)
        if not np.isfinite(fastest):
            return
        self.limited = self.limited + 1 if fastest * h > _STABILITY else 0
        dear = self._free or fastest * self._length > _STABILITY * _DEAR
        self.stiff = self.limited >= _STIFF and dear

    def _fastest(self, x: Array, t: float, segment: Array) -> float:
        """Rate of the fastest mode [1/s]; nan where the equations are not finite."""
        slope = self.field.jacobian(x, t, segment, self.b, self.c, self.mode)
        return float(np.abs(np.linalg.eigvals(slope)).max()) if np.isfinite(slope).all() else np.nan

    # ---- stiff pieces

    def _stiff_step(self, x: Array, t: float, h: float, segment: Array) -> tuple[Array, Array]:
        """The end of a stiff piece, and α there."""
        ahead = self._stiff_end(x, t, h, segment)
        share = self.field.field(self.mode)(ahead, t + h, segment, self.b, self.c)[1]
        return ahead, share

    def _stiff_end(self, x: Array, t: float, h: float, segment: Array) -> Array:
        key = ("cvodes", self.mode)
        made = self.field.__dict__.setdefault("solvers", {})
        name = (*key, self.tolerance)
        if name not in made:
            made[name] = cvodes(self.field.field_function(self.mode), self.tolerance)
        scale = self._scale()
        try:
            found = made[name](x0=x / scale, p=ca.vertcat(t, h, segment, self.b, self.c, scale))["xf"]
        except RuntimeError as failure:
            raise FloatingPointError("CVODES gave up") from failure
        ahead = np.asarray(found, dtype=float).ravel() * scale
        if not np.isfinite(ahead).all():
            raise FloatingPointError("the state is not finite")
        return ahead

    def _stiff_rest(self, x: Array, time: Array, segment: Array) -> Array:
        """(K, n) states at all knots after the first, in one run."""
        scale, span = self._scale(), float(time[-1] - time[0])
        solver = cvodes(self.field.field_function(()), self.tolerance, (time[1:] - time[0]) / span)
        try:
            found = solver(x0=x / scale, p=ca.vertcat(time[0], span, segment, self.b, self.c, scale))["xf"]
        except RuntimeError as failure:
            raise FloatingPointError("CVODES gave up") from failure
        self.steps += int(solver.stats().get("nsteps", 0))
        states = np.asarray(found, dtype=float).T * scale
        if not np.isfinite(states).all():
            raise FloatingPointError("the state is not finite")
        return states

    def _scale(self) -> Array:
        """(n,) sizes of the states so far."""
        return np.maximum(self.peak, _SMALL * float(self.peak.max()) + 1e-300)

    # ---- events

    def _functions(self, x: Array, t: float, share: Array, segment: Array, g: Array | None = None) -> Array:
        """What has to stay positive: side * g of the free switches, and α, 1 - α of those the state stays on.

        g : (switches,) where they are known
        """
        g = self.field.g(x, t, segment, self.b) if g is None else g
        self.g_peak = np.maximum(self.g_peak, np.abs(g))
        # on a side, or where the function is flat at 0
        within = _PASSED * self.g_peak
        signed = np.where(self.side == 0, within - np.abs(g), self.side * g + within)
        for place, i in enumerate(self.mode):
            signed[i] = min(share[place], 1 - share[place]) + 1e-10
        return signed

    def _at(self, x: Array, t: float, h: float, segment: Array) -> tuple[Array, Array]:
        if self.stiff:
            return self._stiff_step(x, t, h, segment)
        ahead, _, _, share, *_ = self._step(x, t, h, segment)
        return ahead, share

    def _event(
        self, x: Array, t: float, h: float, ahead: Array, share: Array, segment: Array
    ) -> tuple[float, Array] | None:
        """The first event within a step, (its instant, the state after it), or None."""
        from scipy.optimize import brentq

        end = self._functions(ahead, t + h, share, segment, None if self.stiff else self._ends[1])
        if not np.isfinite(end).all():
            raise FloatingPointError("the equations are not finite at a switch")
        reach = h
        if (end >= 0).all():
            if self._far(h):
                return None
            flat = self._turned_flat(x, t, h, ahead, segment)
            if flat is not None:
                return flat
            between = self._passed_twice(x, t, h, ahead, segment)
            if between is None:
                return None
            reach, end = between

        def value(i: int, length: float) -> float:
            if length == 0.0:
                return float(max(self._functions(x, t, self._share(x, t, segment), segment)[i], 0.0))
            place, alpha = self._at(x, t, length, segment)
            return float(self._functions(place, t + length, alpha, segment)[i])

        instants = []
        for i in np.flatnonzero(end < 0):
            begin, least = value(int(i), 0.0), 1e-15 * max(abs(t), reach)
            at_most = 0.0
            if begin > 0:
                at_most = float(brentq(partial(value, int(i)), 0.0, reach, xtol=least, rtol=1e-15))
            instants.append((at_most, int(i)))
        length, _ = min(instants)
        self.events += 1
        where, _ = self._at(x, t, length, segment) if length > 0 else (x, share)
        at = t + length
        passed = [i for instant, i in instants if instant <= length * (1 + 1e-12)]
        return at, self._after(where, at, segment, passed)

    def _far(self, h: float) -> bool:
        """True if the free switches are so far from 0 at both ends of a step that none is passed in between."""
        if self.stiff:
            return False
        free = np.ones(self.field.switches, dtype=bool)
        free[list(self.mode)] = False
        if (free & (self.side == 0)).any():
            return False
        ends = [self.side * g for g in self._ends]
        reach = 0.5 * h * np.maximum(np.abs(self._rates[0]), np.abs(self._rates[1]))
        return bool((np.minimum(*ends) > reach)[free].all())

    def _passed_twice(
        self, x: Array, t: float, h: float, ahead: Array, segment: Array
    ) -> tuple[float, Array] | None:
        """A place within a step at which a switch is on its other side, though not at the end; and the functions there.

        Looked for at the lowest points of the cubics through the functions and their rates at both ends and in the
        middle.
        """
        middle, _ = self._at(x, t, 0.5 * h, segment)
        rows = []
        for point, at in ((x, t), (middle, t + 0.5 * h), (ahead, t + h)):
            rate = self.field.field(self.mode)(point, at, segment, self.b, self.c)[2]
            rows.append((self.side * self.field.g(point, at, segment, self.b), 0.5 * h * self.side * rate))
        places = {0.5}
        for k in (0, 1):
            (p, m), (q, n) = rows[k], rows[k + 1]
            a, b = 2 * p + m - 2 * q + n, -3 * p + 3 * q - 2 * m - n
            root = np.sqrt(np.maximum(b * b - 3 * a * m, 0.0))
            low = np.where(a != 0, (-b + root) / np.where(a != 0, 3 * a, 1), -m / np.where(b != 0, 2 * b, 1))
            low = np.where((low > 0) & (low < 1), low, 0.0)
            value = ((a * low + b) * low + m) * low + p
            near = (low > 0) & (value < _NEAR * self.g_peak) & (self.side != 0)
            places |= {0.5 * (k + float(share)) for share in low[near]}
        for share in sorted(places):
            point, alpha = self._at(x, t, share * h, segment)
            found = self._functions(point, t + share * h, alpha, segment)
            if (found < 0).any():
                return share * h, found
        return None

    def _turned_flat(
        self, x: Array, t: float, h: float, ahead: Array, segment: Array
    ) -> tuple[float, Array] | None:
        """The event of a switching function that becomes 0 and stays there, as max(u - 1, 0) does."""
        g = self.field.g(ahead, t + h, segment, self.b)
        turned = (g == 0) & (self.side != 0)
        turned[list(self.mode)] = False
        if not turned.any():
            return None
        slopes = self.field.slopes(ahead, t + h, segment, self.b)[:, : self.field.n + 1]
        turned &= ~slopes.any(axis=1)
        if not turned.any():
            return None
        low, high = 0.0, h
        while high - low > 1e-15 * max(abs(t), h):  # the first instant at which one of them is 0
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            there, _ = self._at(x, t, middle, segment)
            if (self.field.g(there, t + middle, segment, self.b)[turned] == 0).any():
                high = middle
            else:
                low = middle
        where, _ = self._at(x, t, high, segment)
        self.events += 1
        at = t + high
        for i in np.flatnonzero(turned & (self.field.g(where, at, segment, self.b) == 0)):
            own = self.field.owner == i
            self.side[i] = 0.0
            self.b = np.where(own, self.field.nodes(where, at, segment), self.b)
        self.h = max(self.h * 0.1, 1e-14 * max(abs(t), 1e-3))
        return at, where

    def _share(self, x: Array, t: float, segment: Array) -> Array:
        return self.field.field(self.mode)(x, t, segment, self.b, self.c)[1]

    def _after(self, x: Array, t: float, segment: Array, passed: list[int]) -> Array:
        """Take the sides that hold after an event."""
        for i in passed:
            if i in self.mode:
                share = self._share(x, t, segment)[self.mode.index(i)]
                self._leave(i, 1.0 if share > 0.5 else -1.0)
            else:
                x = self._decide(i, x, t, segment, came_from=self.side[i])
        self.h = max(self.h * 0.1, 1e-14 * max(abs(t), 1e-3))
        return x

    def _settle(self, x: Array, t: float, segment: Array) -> Array:
        """Sides at a point where they are not known."""
        self.mode, self.b = (), self._values(x, t, segment)
        self.side = np.sign(self.field.g(x, t, segment, self.b))
        reach = np.abs(self.field.slopes(x, t, segment, self.b)[:, : self.field.n]) @ self._sizes
        self.g_peak = np.maximum(self.g_peak, reach)
        self.c = np.zeros_like(self.b)
        g = self.field.g(x, t, segment, self.b)
        near = np.abs(g) <= 1e3 * _PASSED * np.maximum(self.g_peak, 1e-300)
        flat = ~self.field.slopes(x, t, segment, self.b)[:, : self.field.n + 1].any(axis=1)
        for i in np.flatnonzero((near | (g == 0)) & ~flat):
            x = self._decide(int(i), x, t, segment, came_from=0.0)
        return x

    def _decide(self, i: int, x: Array, t: float, segment: Array, *, came_from: float) -> Array:
        """Pass a switch, turn back from it, or stay on it, by where the fields on both sides point."""
        n = self.field.n
        if not self.field.slopes(x, t, segment, self.b)[i, : n + 1].any():
            return self._left_flat(i, x, t, segment)
        sizes = np.maximum(self.peak[:n], 1e-12) + np.abs(x[:n])
        (low, g_low), (high, g_high) = self.field.sides(x, t, segment, self.b, i, sizes)
        own = self.field.owner == i
        slope = self.field.slopes(x, t, segment, self.b)[i]
        fields = []
        for values in (low, high):
            b = np.where(own, values, self.b)
            fields.append(self.field.field(self.mode)(x, t, segment, b, self.c)[0][:n])
        rates = [float(slope[:n] @ field + slope[n]) for field in fields]
        before = fields[1] if came_from > 0 else fields[0]
        if rates[0] > 0 > rates[1]:
            self.b, self.c = np.where(own, low, self.b), np.where(own, high - low, self.c)
            self.mode = tuple(sorted((*self.mode, i)))
            self._held = np.maximum(self._held, np.abs(fields[0]) + np.abs(fields[1]))
            x = x.copy()
            x[:n] -= (
                float(self.field.g(x, t, segment, self.b)[i])
                * slope[:n]
                / max(float(slope[:n] @ slope[:n]), 1e-300)
            )
            after = self.field.field(self.mode)(x, t, segment, self.b, self.c)[0][:n]
            return self._moved(x, slope, before, after)
        if rates[0] <= 0 and rates[1] <= 0:
            side = -1.0
        elif rates[0] >= 0 and rates[1] >= 0:
            side = 1.0
        else:  # both lead away
            side = came_from if came_from else 1.0
        self.side[i] = side
        self.b = np.where(own, high if side > 0 else low, self.b)
        self._follow(i, high if side > 0 else low, g_high if side > 0 else g_low)
        return self._moved(x, slope, before, fields[1] if side > 0 else fields[0]) if came_from else x

    def _left_flat(self, i: int, x: Array, t: float, segment: Array) -> Array:
        """The side of a switch that has no slope here, by where it is a moment later."""
        late = 1e-9 * max(abs(t), 1e-3)
        ahead = x + late * self.field.field(self.mode)(x, t, segment, self.b, self.c)[0]
        self.side[i] = np.sign(self.field.g(ahead, t + late, segment, self.b)[i])
        self.b = np.where(self.field.owner == i, self.field.nodes(ahead, t + late, segment), self.b)
        return x

    def _moved(self, x: Array, slope: Array, before: Array, after: Array) -> Array:
        """The sensitivities after an event: its instant moves with start and z, and the field is another before it.

        With dt/dθ = -(∂g/∂x S + ∂g/∂θ) / (dg/dt), S grows by (f before - f after) dt/dθ: the saltation matrix of
        Aizerman and Gantmakher (1958).
        """
        n = self.field.n
        if not self.field.sensitivities:
            return x
        rate = float(slope[:n] @ before + slope[n])
        if rate == 0:
            return x
        s = x[n:].reshape(-1, n).T
        instant = slope[:n] @ s
        instant[n:] += slope[n + 1 :]
        moved = s - np.outer(before - after, instant / rate)
        return np.concatenate([x[:n], moved.T.ravel()])

    def _follow(self, i: int, values: Array, g: Array) -> None:
        """Take along the switches whose functions jump at the event of another, as fractions of floor(t) do."""
        for j in range(self.field.switches):
            if j == i or j in self.mode or 0 < abs(g[j]) <= 1e-6 * self.g_peak[j]:
                continue
            if np.sign(g[j]) != self.side[j]:
                self.side[j] = np.sign(g[j])
                self.b = np.where(self.field.owner == j, values, self.b)

    def _leave(self, i: int, side: float) -> None:
        own = self.field.owner == i
        self.b = np.where(own & (side > 0), self.b + self.c, self.b)
        self.c = np.where(own, 0.0, self.c)
        self.mode = tuple(j for j in self.mode if j != i)
        self.side[i] = side
