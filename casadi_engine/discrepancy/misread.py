"""Data that are not what they are said to be: an input with its sign turned, numbers in another unit, another clock.

Where no fit explains an output, the model is fitted to the records as they would be if one channel, or their time, had
been stated wrong in one of the usual ways. A way that makes the fit good is told before any effect is looked for: a
search would spend its time on what no effect can mend.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.discrepancy.exchanged_units import exchanges
from casadi_engine.discrepancy.wording import HINT
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.followed import FOLLOWED
from casadi_engine.experiment import Channel, Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

# Per cent of every output that a fit follows which is called good: a twentieth of its squares is left at most. No
# better than the mean is 0.
_GOOD = 100 * (1 - math.sqrt(0.05))
# Per cent that is next to nothing: a tenth of the squares, as initial states explain some of any motion.
_NOTHING = 100 * (1 - math.sqrt(0.9))
# Part of the squares of an output that a gain and an offset of its own simulation leave where its sensor is at fault.
_BENT = 0.2
# Samples of the outputs on which all ways are looked at, and ways that the parameters are fitted in.
_SAMPLES, _TRIED = 400, 3
# Kinds of ports at which an effect is another way to read the data.
_READ = ("input", "sensor", "parameter")
# Work of a look, of all looks, and of a fit, in multiples of that of one start of the fit before.
_LOOK, _LOOKS, _MORE = 0.5, 5.0, 4.0
# Ways that leave no more than this factor times the squares of the best one are as good.
_ALIKE = 1.1
# Beside a way that is good only those are fitted that left no more than this factor times the least at first sight.
_PROMISING = 2.0
_PREFIX = "a prefix, milli or kilo, that was not stated or not meant"
# Factors of a time that is taken for seconds, or was made of them.
_CLOCKS = {
    1e-3: "milliseconds stated as seconds", 1e3: "seconds stated as milliseconds", 60.0: "minutes stated as seconds",
    1 / 60.0: "seconds stated as minutes",
}  # fmt: skip
_FAILURES = (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError, ValueError)
_TIME = "the time"


@dataclass(frozen=True)
class Reading:
    """A way to read the records: a channel, or the time, times a factor.

    what : "input", "output" or "time"; words : what is done, for a sentence; check : what may be wrong;
    named : a search for effects tells it, by the gain of a sensor
    """

    what: str
    name: str
    factor: float
    words: str
    check: str
    named: bool = False

    def of(self, record: Experiment) -> Experiment:
        """The record read so."""
        if self.what != "time":
            own = record[self.name]
            return record.with_channel(replace(own, values=self.factor * own.values))
        begin = None if record.begin is None else self.factor * record.begin
        return replace(record, channels=tuple(_later(c, self.factor) for c in record.channels), begin=begin)


@dataclass(frozen=True)
class Misread:
    """What to say of the data; certain : it makes the fit good, and a search for effects does not tell it."""

    words: str
    certain: bool


def misread(
    fit: Fit, parameters: Parameters, noise: Noise | None, options: Mapping[str, Any], work: float
) -> Misread | None:
    """What is likely wrong with the data of a fit that explains next to nothing of an output, or that is poor with
    parameters at their bounds; None for any other, and where no way to read them makes it good.

    fit : of the model without effects, from ``parameters``, with ``noise`` and ``options``; work : of one of its starts
    """
    poor = unexplained(fit)
    if not poor:
        return None
    job = _Readings(fit.model, fit.data, parameters, noise, options)
    ways = readings(fit.model, fit.data)
    if (sensors := _sensors(fit, poor)) is not None:
        ways = [one for one in ways if one.what == "output" and one.name in sensors]
    found = job.good(ways, work)
    if found:
        said = _told(*found[0])
        said += "".join(f"; as much with {one.words}: {one.check}" for one, _ in found[1:2])
        before = _listed(followed(fit))
        words = f"{said}. As the records are, no fit explains more than {before}"
        return Misread(words, not any(one.named for one, _ in found))
    still = _still(fit)
    lost = " and ".join(name for name, share in poor.items() if share <= _NOTHING)
    if still and lost:
        words = f"{still} in all samples, and no fit explains more than next to nothing of {lost}"
        return Misread(f"{words}: look whether that is so", False)
    return None


def with_hint(repair: Repair, found: Misread | None) -> Repair:
    """The repair with what may be wrong with its data said first, unless it has a name for what is missing, of a size
    that the data tell: a gain of an input without one stands for any sign and unit, a law does not."""
    told = repair.verdict in ("named", "class") and all(
        e.amplitude.stderr or repair.model.ports[e.at].kind not in _READ for e in repair.effects
    )
    if found is None or told:
        return repair
    return replace(repair, options={**repair.options, HINT: found.words})


def unexplained(fit: Fit) -> dict[str, float]:
    """Output -> per cent that is followed, of those of which next to nothing is; where a parameter went to a bound also
    of those of which a good part is left."""
    bound = any(fit.estimates[name].at_bound for name in fit.free if name in fit.estimates)
    limit = FOLLOWED if bound else _NOTHING
    return {name: share for name, share in followed(fit).items() if share <= limit}


def _sensors(fit: Fit, poor: Mapping[str, float]) -> set[str] | None:
    """The outputs that are poorly followed, where all others are followed and these are but for a gain and an offset:
    what an input or the time does wrong, every output would show. None elsewhere."""
    others = [share for name, share in followed(fit).items() if name not in poor]
    if not others or min(others) < FOLLOWED:
        return None
    for traces in fit.traces.values():
        for name in set(poor) & set(traces):
            trace = traces[name]
            y, shown = trace.measured[trace.mask], trace.simulated[trace.mask]
            if not np.isfinite(shown).all() or not np.std(shown) * np.std(y) > 0:
                return None
            if 1 - np.corrcoef(y, shown)[0, 1] ** 2 > _BENT:
                return None
    return set(poor)


def followed(fit: Fit) -> dict[str, float]:
    """Output -> per cent of its motion that is followed, over all records."""
    left, every = dict[str, float](), dict[str, float]()
    for traces in fit.traces.values():
        for name, trace in traces.items():
            y, e = trace.measured[trace.mask], trace.residual[trace.mask]
            if len(y):
                left[name] = left.get(name, 0.0) + float(e @ e)
                every[name] = every.get(name, 0.0) + float(((y - y.mean()) ** 2).sum())
    return {
        name: 100 * (1 - math.sqrt(left[name] / size)) if math.isfinite(left[name]) else -math.inf
        for name, size in every.items()
        if size > 0
    }


def readings(model: Model, data: Sequence[Experiment]) -> list[Reading]:
    """The usual ways in which a record is stated wrong, one at a time, of channels that move; the most usual first.

    Of one output among several those are left out that a search for effects tells.
    """
    found = []
    for variable in model.inputs:
        if any(np.ptp(record[variable.name].values) > 0 for record in data):
            words = f"the input {variable.name} reversed"
            found.append(Reading("input", variable.name, -1.0, words, "look at its sign"))
            found += _units("input", variable.name, variable.unit)
    outputs = [variable for variable in model.outputs if any(variable.name in record for record in data)]
    for variable in outputs:
        words = f"the output {variable.name} reversed"
        own = [Reading("output", variable.name, -1.0, words, "look at its sign", True)]
        own += _units("output", variable.name, variable.unit)
        found += [one for one in own if len(outputs) == 1 or not one.named]
    for factor, words in _CLOCKS.items():
        found.append(Reading("time", "", factor, f"{_TIME} times {factor:.4g} ({words})", "look at its unit"))
    return sorted(found, key=lambda one: (one.factor != -1.0, one.what != "time", _PREFIX not in one.words))


def _units(what: str, name: str, unit: str) -> Iterator[Reading]:
    """Numbers in a unit that is taken for that of the channel, or a prefix that is not its own."""
    found: dict[float, str] = {}
    for right, label, ratio in exchanges(unit):
        found.setdefault(float(f"{1 / ratio:.6g}"), f"numbers in {right} labelled {label}")
    told = set(found) if what == "output" else set()
    for factor in (1e-3, 1e3):
        found.setdefault(factor, _PREFIX)
    for factor, words in found.items():
        said = f"the {what} {name} times {factor:.4g} ({words})"
        yield Reading(what, name, factor, said, "look at its unit", factor in told)


def _later(channel: Channel, factor: float) -> Channel:
    return replace(channel, time=factor * channel.time)


@dataclass(frozen=True)
class _Readings:
    """Fits of one model to records that are read in other ways."""

    model: Model
    data: tuple[Experiment, ...]
    parameters: Parameters
    noise: Noise | None
    options: Mapping[str, Any]

    def good(self, ways: Sequence[Reading], work: float) -> list[tuple[Reading, dict[str, float]]]:
        """The ways in which the fit is good, the best first, of those that promise most where the parameters start,
        with the per cent of each output that it follows; those that are not as good as the best are left out."""
        held = self.parameters.copy()
        for name in held.names:
            if held[name].vary:
                held.fix(name)
        few = tuple(_moving(record, self.model, _SAMPLES // len(self.data)) for record in self.data)
        looks = []
        with Deadline(best=True) as spent:
            for one in ways:
                found = self._fit([one.of(record) for record in few], held, _LOOK * work)
                if found is not None:
                    looks.append((_left(found), one))
                if spent.done > _LOOKS * work:
                    break
        looks.sort(key=lambda pair: pair[0])
        fits: list[tuple[float, Reading, dict[str, float]]] = []
        for left, one in looks[:_TRIED]:
            if fits and left > looks[0][0] + math.log(_PROMISING):
                break
            records = [one.of(record) for record in self.data]
            found = self._fit(records, self.parameters, _MORE * work)
            if found is None or min(followed(found).values(), default=0.0) < _GOOD:
                continue
            if _bent(found) or not self._inputs_matter(records, found, work):
                continue
            fits.append((_left(found), one, followed(found)))
        fits.sort(key=lambda made: made[0])
        return [(one, shares) for left, one, shares in fits if left <= fits[0][0] + math.log(_ALIKE)]

    def _inputs_matter(self, records: Sequence[Experiment], fit: Fit, work: float) -> bool:
        """True unless the initial states alone make the fit good, as of a model so slow that it hardly moves."""
        held = self.parameters.copy()
        for name in held.names:
            one = held[name]
            if one.vary:  # a fit may end a rounding beyond a bound
                held.fix(name, min(max(fit.values[name], one.min), one.max))
        still = []
        for record in records:
            for variable in self.model.inputs:
                own = record[variable.name]
                record = record.with_channel(replace(own, values=np.full(len(own), np.nanmean(own.values))))
            still.append(record)
        found = self._fit(still, held, _LOOK * work)
        return found is None or min(followed(found).values(), default=0.0) < _GOOD

    def _fit(self, records: Sequence[Experiment], parameters: Parameters, work: float) -> Fit | None:
        """The fit to records, as far as the work reaches; None where it fails."""
        try:
            with np.errstate(all="ignore"), Deadline(work=work, best=True):
                found = estimate(
                    self.model, records, parameters=parameters, noise=self.noise, starts=1, progress=False,
                    errors="quadratic", **self.options,
                )  # fmt: skip
        except (TimeUp, *_FAILURES):
            return None
        return found if math.isfinite(found.cost) else None


def _bent(fit: Fit) -> bool:
    """True where a parameter went to a bound that is not zero: right data ask for no such value, and what a wrong
    reading explains with it is what any law does that bends."""
    return any(fit.estimates[n].at_bound and fit.values[n] for n in fit.free if n in fit.estimates)


def _left(fit: Fit) -> float:
    """Mean logarithm of the part of the squares of an output that is left, whatever its unit."""
    shares = [1 - min(share, 100 - 1e-6) / 100 for share in followed(fit).values()]
    return float(np.mean([2 * math.log(share) for share in shares])) if shares else math.inf


def _moving(record: Experiment, model: Model, samples: int) -> Experiment:
    """The part of a record, of so many samples of its outputs, in which these move most; all of a shorter one."""
    names = [out.name for out in model.outputs if out.name in record]
    longest = max((record[name] for name in names), key=len)
    pieces = len(longest) // max(samples, 1)
    if pieces < 2:
        return record
    edges = np.linspace(*longest.span, pieces + 1)

    def moved(k: int) -> float:
        total = 0.0
        for channel in (record[name] for name in names):
            inside = channel.values[(channel.time >= edges[k]) & (channel.time <= edges[k + 1])]
            spread = float(np.nanvar(channel.values))
            total += float(np.nanvar(inside)) / spread if np.isfinite(inside).any() and spread > 0 else 0.0
        return total

    best = max(range(pieces), key=moved)
    try:
        inputs = [variable.name for variable in model.inputs]
        return replace(record, begin=None).between(edges[best], edges[best + 1], inputs=inputs)
    except CasadiEngineError:
        return record


def _still(fit: Fit) -> str:
    """Inputs that have one and the same value in all records: ``steer is 0``; "" where all move."""
    found = []
    for variable in fit.model.inputs:
        values = np.concatenate([record[variable.name].values for record in fit.data])
        values = values[np.isfinite(values)]
        if values.size and np.ptp(values) == 0:
            found.append(f"{variable.name} is {values[0]:.6g}")
    return " and ".join(found)


def _told(one: Reading, shares: Mapping[str, float]) -> str:
    return f"with {one.words} the fit explains {_listed(shares)}: {one.check}"


def _listed(shares: Mapping[str, float]) -> str:
    return " and ".join(f"{max(share, -999):.0f} % of {name}" for name, share in shares.items())
