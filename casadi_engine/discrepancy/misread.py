"""Data that are not what they are said to be: an input with its sign turned, numbers in another unit, another clock.

Where no fit explains an output, the model is fitted to the records as they would be if one channel, or their time, had
been stated wrong in one of the usual ways (``ways_to_read``). A way that makes the fit good and leaves noise alone is
told before any effect is looked for: a search would spend its time on what no effect can mend. One that leaves more is
told beside what a search finds. Where that has found no answer that holds, the ways are looked at again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.deadline import left as seconds_left
from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.discrepancy.ways_to_read import Reading, readings
from casadi_engine.discrepancy.wording import HINT
from casadi_engine.errors import CasadiEngineError
from casadi_engine.estimation import Fit, estimate
from casadi_engine.estimation.followed import FOLLOWED
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.parameters import Parameters
from casadi_engine.problem.noise import Noise

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import Repair

# Per cent of every output that a fit follows which is called good: a twentieth of its squares is left at most. No
# better than the mean is 0.
_GOOD = 100 * (1 - math.sqrt(0.05))
# Part of the squares which the data as they are leave that another reading leaves at most to be told after a search.
_HALF = 0.5
# Per cent that is next to nothing: a tenth of the squares, as initial states explain some of any motion.
_NOTHING = 100 * (1 - math.sqrt(0.9))
# Part of the squares of an output that a gain and an offset of its own simulation leave where its sensor is at fault.
_BENT = 0.2
# Bands of frequencies in which a residual is looked at, and the numbers that one has at least.
_BANDS, _BINS = 8, 12
# Samples of the outputs on which all ways are looked at, and ways that the parameters are fitted in.
_SAMPLES, _TRIED = 400, 6
# Kinds of ports at which an effect is another way to read the data.
_READ = ("input", "sensor", "parameter")
# Work of a look, of all looks, and of a fit, in multiples of that of one start of the fit before.
_LOOK, _LOOKS, _MORE = 0.3, 6.0, 4.0
# Ways that leave no more than this factor times the squares of the best one are as good.
_ALIKE = 1.1
# Share of the time for all looks that one may take: a way in which nothing can be simulated takes no end.
_LOOKED = 1 / 8
# Beside a way that is good only those are fitted that left no more than this factor times its squares at first sight.
_PROMISING = 2.0
# Way to read records, and these -> the fit to them read so, None where there is none.
Tries = dict[tuple[Reading, tuple[Experiment, ...]], Fit | None]
_FAILURES = (CasadiEngineError, FloatingPointError, np.linalg.LinAlgError, ValueError)


@dataclass(frozen=True)
class Misread:
    """What to say of the data; certain : it makes the fit good, and a search for effects does not tell it."""

    words: str
    certain: bool


def misread(
    fit: Fit,
    parameters: Parameters,
    noise: Noise | None,
    options: Mapping[str, Any],
    work: float,
    *,
    every: bool = False,
    data: Sequence[Experiment] | None = None,
    tries: Tries | None = None,
) -> Misread | None:
    """What is likely wrong with the data of a fit that explains next to nothing of an output, or that is poor with
    parameters at their bounds; None for any other, and where no way to read them makes it good.

    fit : of the model without effects, from ``parameters``, with ``noise`` and ``options``; work : of one of its starts
    every : also what a search for effects would tell, where there is none; data : the records in the units that they
    were stated in, where those are not the model's: columns are exchanged with their headings; tries : takes the fits
    """
    poor = unexplained(fit, every=every)
    if not poor:
        return None
    records = fit.data if data is None else tuple(data)
    ways = readings(fit.model, records, every=every)
    most = len(ways) if every else _TRIED
    job = _Readings(fit.model, records, parameters, noise, options, most, {} if tries is None else tries)
    found = job.good(_of_sensors(fit, poor, ways), work, _is_good) or job.good(ways, work, _is_good)
    if found:
        before = _listed(followed(fit))
        words = f"{_told(found, 'the fit')}. As the records are, no fit explains more than {before}"
        # what leaves more than noise may be led by physics that is missing, which a search tells
        return Misread(words, found[0].to_noise and not any(one.reading.named for one in found))
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


def with_other_reading(
    repair: Repair,
    parameters: Parameters,
    noise: Noise | None,
    options: Mapping[str, Any],
    work: float,
    tries: Tries | None = None,
) -> Repair:
    """The same, and at the top that the data may be stated wrong, where the model without any effect explains them so
    read: no more is left of any output than the answer leaves. It is asked where fresh data have confirmed nothing, and
    half of what is left of every output goes with it; and where they have confirmed an effect without which a good part
    of an output is left, as fresh data are stated wrong likewise. tries : fits that were made before"""
    null = repair.null_fit
    if repair.verdict in (None, "nothing missing") or HINT in repair.options:
        return repair
    before = followed(null)
    ports = [repair.model.ports[one.at].kind for one in repair.effects]
    well = min(before.values(), default=100.0) >= FOLLOWED
    if repair.confirmed and (well or {*ports} <= {*_READ}):
        return repair
    if well and not repair.confirmed and _mostly_noise(null):
        return repair
    answer = [(followed(repair.fit), _ALIKE)] if repair.effects else []
    answer += [] if repair.confirmed else [(before, _HALF)]

    def closes(shares: Mapping[str, float]) -> bool:
        return all(
            (100 - shares.get(name, -math.inf)) ** 2 <= part * (100 - then) ** 2
            for own, part in answer
            for name, then in own.items()
        )

    known = {} if tries is None else tries
    job = _Readings(null.model, repair.data, parameters, noise, options, tries=known)
    # what a search tells by an effect was told, unless another one was found that does as much
    every = bool(repair.confirmed)
    ways = [one for one in readings(null.model, repair.data, every=every) if every or not one.named]
    found = job.good(ways, work, closes)
    if not found:
        return repair
    words = _told(found, "the fit without any effect")
    said = f"W{words[1:]}. As the records are, it explains {_listed(before)}"
    return replace(repair, options={**repair.options, HINT: said})


def unexplained(fit: Fit, *, every: bool = False) -> dict[str, float]:
    """Output -> per cent that is followed, of those of which next to nothing is; where a parameter went to a bound, or
    of ``every`` fit, also of those of which a good part is left."""
    bound = any(fit.estimates[name].at_bound for name in fit.free if name in fit.estimates)
    limit = FOLLOWED if bound or every else _NOTHING
    return {name: share for name, share in followed(fit).items() if share <= limit}


def _mostly_noise(fit: Fit) -> bool:
    """True where half of what is left of an output is as strong at all frequencies: no reading takes that away."""
    return any(
        _floor(trace.residual[trace.mask]) >= _HALF
        for traces in fit.traces.values()
        for trace in traces.values()
    )


def _to_noise(fit: Fit) -> bool:
    """True where what is left of every output is noise: as strong at all frequencies by half, or white."""
    return all(
        _floor(trace.residual[trace.mask]) >= _HALF
        or not any(said.startswith(f"the residual of {record}/{name} is not white") for said in fit.messages)
        for record, traces in fit.traces.items()
        for name, trace in traces.items()
    )


def _floor(residual: Array) -> float:
    """The part of the squares of a residual that white noise has in the band in which there is least of it."""
    size = len(residual) // (2 * _BANDS)
    power = (
        np.abs(np.fft.rfft(residual - residual.mean())[1 : 1 + _BANDS * size]) ** 2
        if size >= _BINS
        else np.zeros(0)
    )
    return float(power.reshape(_BANDS, size).mean(axis=1).min() / power.mean()) if power.any() else 0.0


def _is_good(shares: Mapping[str, float]) -> bool:
    return min(shares.values(), default=0.0) >= _GOOD


def _of_sensors(fit: Fit, poor: Mapping[str, float], ways: Sequence[Reading]) -> list[Reading]:
    """The ways to read that are asked first, where sensors alone seem to be read wrong; none elsewhere."""
    sensors, outputs = _sensors(fit, poor), {out.name for out in fit.model.outputs}
    if sensors is None:
        return []
    return [
        one for one in ways
        if (one.what == "output" and sensors.issuperset(one.names))
        or (one.what in ("exchange", "numbers") and outputs.issuperset(one.names) and sensors.intersection(one.names))
    ]  # fmt: skip


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
                with np.errstate(over="ignore"):  # of a simulation that is lost
                    left[name] = left.get(name, 0.0) + float(e @ e)
                every[name] = every.get(name, 0.0) + float(((y - y.mean()) ** 2).sum())
    return {
        name: 100 * (1 - math.sqrt(left[name] / size)) if math.isfinite(left[name]) else -math.inf
        for name, size in every.items()
        if size > 0
    }


@dataclass(frozen=True)
class _Fitted:
    """A fit to the records read in one way.

    left : see ``_left``; shares : output -> per cent that is followed; to_noise : True where noise alone is left
    """

    left: float
    reading: Reading
    shares: Mapping[str, float]
    to_noise: bool


@dataclass(frozen=True)
class _Readings:
    """Fits of one model to records that are read in other ways."""

    model: Model
    data: tuple[Experiment, ...]
    parameters: Parameters
    noise: Noise | None
    options: Mapping[str, Any]
    tried: int = _TRIED
    tries: Tries = field(default_factory=dict)

    def good(
        self, ways: Sequence[Reading], work: float, is_good: Callable[[Mapping[str, float]], bool]
    ) -> list[_Fitted]:
        """The ways in which the fit is good, the best first, of those that promise most where the parameters start;
        those that are not as good as the best are left out."""
        held = self.parameters.copy()
        for name in held.names:
            if held[name].vary:
                held.fix(name)
        few = tuple(_moving(record, self.model, _SAMPLES // len(self.data)) for record in self.data)
        looks, half = [], 0.5 * seconds_left()  # the rest of a limited time is for what looked well
        with Deadline(best=True) as spent:
            for one in ways:
                found = self._fit([one.of(record) for record in few], held, _LOOK * work, _LOOKED * half)
                if found is not None:
                    looks.append((_left(found), one))
                if spent.done > _LOOKS * work or seconds_left() < half:
                    break
        looks.sort(key=lambda pair: pair[0])
        fits: list[_Fitted] = []
        least = math.inf  # at first sight, of those that are good
        for left, one in looks[: self.tried]:
            if left > least + math.log(_PROMISING):
                break
            records = [one.of(record) for record in self.data]
            found = self._tried(one, records, work)
            if found is None or not is_good(followed(found)):
                continue
            if _bent(found) or not self._inputs_matter(records, found, work):
                continue
            fits.append(_Fitted(_left(found), one, followed(found), _to_noise(found)))
            least = min(least, left)
        fits.sort(key=lambda made: made.left)
        return [one for one in fits if one.left <= fits[0].left + math.log(_ALIKE)]

    def _tried(self, one: Reading, records: Sequence[Experiment], work: float) -> Fit | None:
        """The fit to the records read so, made before a search for after it too; none for which the time was up."""
        key = one, self.data
        if key not in self.tries:
            found = self._fit(records, self.parameters, _MORE * work)
            if found is None and math.isfinite(seconds_left()):
                return None
            self.tries[key] = found
        return self.tries[key]

    def _inputs_matter(self, records: Sequence[Experiment], fit: Fit, work: float) -> bool:
        """True unless the initial states alone make the fit good, as of a model so slow that it hardly moves; one
        without inputs has nothing else."""
        if not self.model.inputs:
            return True
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

    def _fit(
        self, records: Sequence[Experiment], parameters: Parameters, work: float, seconds: float = math.inf
    ) -> Fit | None:
        """The fit to records, as far as the work and the time reach; None where it fails."""
        try:
            with np.errstate(all="ignore"), Deadline(seconds, work=work, best=True):
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


def _told(found: Sequence[_Fitted], what: str) -> str:
    """What a fit explains in the best way to read the data, and the next one that is as good."""
    one = found[0].reading
    beside = "".join(f"; as much with {other.reading.words}: {other.reading.check}" for other in found[1:2])
    return f"with {one.words} {what} explains {_listed(found[0].shares)}: {one.check}{beside}"


def _listed(shares: Mapping[str, float]) -> str:
    return " and ".join(f"{max(share, 0):.0f} % of {name}" for name, share in shares.items())
