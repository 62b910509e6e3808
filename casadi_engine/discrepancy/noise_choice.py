"""Which noise the score tests count with: known or estimated levels, colour where the residual asks for it, and the
scatter of combustions whose pressure was assumed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from casadi_engine.discrepancy.assumed_pressure import carried_cylinders
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.colour_choice import beside, coloured_noise
from casadi_engine.discrepancy.combustion_scatter import Scatter, assumed_cylinders, combustion_scatter
from casadi_engine.discrepancy.compression import Compressed, compress, scatter_columns, white_levels
from casadi_engine.discrepancy.linear_algebra import Array, basis
from casadi_engine.discrepancy.noise_model import NoiseModel, estimated_noise, left_over
from casadi_engine.discrepancy.null_model import Index, NullModel, above_rounding
from casadi_engine.discrepancy.rounding import rounded, rounded_levels
from casadi_engine.discrepancy.score import score
from casadi_engine.discrepancy.wander import spectrum, wander_of
from casadi_engine.distributions import chi2_sf
from casadi_engine.errors import EstimationError
from casadi_engine.experiment import Experiment
from casadi_engine.model import Model
from casadi_engine.validation import whiteness

Columns = Mapping[str, Mapping[str, Array]]
ColourChoice = Literal["auto"] | bool

# Columns of the library that may explain part of the residual while the noise is estimated.
_MOST, _SHARE, _ALIKE = 60, 0.05, 0.9
# A known level is wrong if chance would do as much less often than this; a residual is coloured.
_SURE, _COLOURED_P = 1e-4, 0.01
# Share of a stated level from which what is left is no longer that noise.
_QUIETER = 0.5
# A wander has two parameters: by Akaike's criterion it is there from this drop of -2 log likelihood, which chance makes
# in one white record of twenty. A weak slow one is otherwise seen by no test over a few lags, and raises false alarms.
_WANDER = 4.0
# Share of white records (300 to 3000 samples) in which chance makes -2 log likelihood fall by more than g is this times
# exp(-g / 2).
_CHANCE = 0.37
# A coloured residual is larger than a stated noise by so many standard errors; it is that of at least so many swings.
_LARGER, _SWINGS = 4.0, 20
_ROUNDED = (
    "{} reads in steps, and little noise hides what rounding does: it comes back with the motion, so that samples "
    "are not independent; the noise counts as larger, by as much as rounding scores by itself"
)
_COLOURED = "the residual is coloured: the score tests count with an autoregression of the noise"
_PERHAPS = (
    "the residual may be coloured, or white by chance (p = {:.2g}): the score tests count with that colour"
)


@dataclass(frozen=True, eq=False)
class NoiseChoice:
    """The noise model, its random amplitudes by record, the cylinders that were asked for ("assumed", or names), and
    what the user should know.

    compressed, white : the records with this noise, and with white noise, where they are at hand
    larger : (record, output) of a coloured residual that is larger than the noise that was stated; stated : that noise,
    if there is such a residual
    waits : the residual is coloured and white noise counts for now, until a refit has shown what colours it
    rounded : output -> level that counts where a sensor's steps are most of its noise; see ``rounding``
    chance : how often white noise looks as coloured
    """

    noise: NoiseModel
    scatter: tuple[Scatter, ...] = ()
    cylinders: Any = "assumed"
    messages: tuple[str, ...] = ()
    compressed: Compressed | None = None
    larger: tuple[tuple[str, str], ...] = ()
    stated: NoiseModel | None = None
    waits: bool = False
    white: Compressed | None = None
    rounded: Mapping[str, float] = field(default_factory=dict)
    chance: float = 1.0

    @property
    def is_coloured(self) -> bool:
        """True if the noise is coloured, beyond chance: tests count with less of it too."""
        return bool(self.noise.colour) and self.chance < _COLOURED_P


def scatter_of(
    null: NullModel, data: Sequence[Experiment], cylinders: Any = "assumed"
) -> tuple[Scatter, ...]:
    """Random amplitudes of combustions: of the cylinders given, or with "assumed" of those whose pressure is not
    measured in a record; not of those that the model carries as parameters."""
    found = []
    for record, experiment in zip(null.records, data, strict=True):
        names = assumed_cylinders(experiment) if cylinders == "assumed" else tuple(cylinders or ())
        known = carried_cylinders(null.model)
        names = tuple(name for name in names if name in null.model.ports.names and name not in known)
        if names:
            made = combustion_scatter(null.model, record, cylinders=names)
            if made.directions:
                found.append(made)
    return tuple(found)


def choose_noise(
    null: NullModel,
    candidates: Sequence[Candidate],
    columns: Columns,
    levels: Mapping[str, tuple[float, bool]],
    *,
    cylinders: Any = "assumed",
    data: Sequence[Experiment],
    colour: ColourChoice = "auto",
    wait: bool = False,
    white: Compressed | None = None,
) -> NoiseChoice:
    """The noise of a null model's residuals.

    levels : output -> (sigma, estimated); a known one is held unless the residual that all candidates together leave is
    larger than chance allows. colour : True, False, or "auto" for where the residual is not white
    wait : with "auto", leave the colour open (``NoiseChoice.waits``)
    white : the records compressed with white noise, of whatever levels, if they are at hand
    Raises EstimationError for another colour, or cylinders that are none.
    """
    check_choice(null.model, cylinders, colour)
    scatter = scatter_of(null, data, cylinders)
    random = {r.name: scatter_columns(r, scatter) for r in null.records} if scatter else None
    rough = NoiseModel({name: sigma for name, (sigma, _) in levels.items()})
    if white is None:
        white = compress(null, candidates, rough, scatter=scatter, columns=columns)
    else:
        white = white.relevelled(rough, scatter)
    noise, messages = _white_noise(null, columns, white, levels, random)
    noise = replace(noise, sigma=above_rounding(null, noise.sigma))
    _check_levels(noise.sigma)
    steps = {} if scatter else rounded_levels(null, columns, noise.sigma)
    noise = replace(noise, sigma={**noise.sigma, **steps})
    messages += tuple(_ROUNDED.format(name) for name in steps)
    white = white.relevelled(noise, scatter)
    if colour is False or (colour == "auto" and is_white(null, noise, beside(null, columns, ()), random)):
        return NoiseChoice(noise, scatter, cylinders, messages, white, white=white, rounded=steps)
    if wait and colour == "auto" and not scatter:
        return NoiseChoice(noise, scatter, cylinders, messages, white, waits=True, white=white, rounded=steps)
    found, held = coloured_noise(null, candidates, columns, white, scatter=scatter, random=random)
    left = beside(null, columns, held)
    if colour == "auto" and (not found.colour or is_white(null, noise, left, random)):
        return NoiseChoice(noise, scatter, cylinders, messages, white, white=white, rounded=steps)
    known = {name: sigma for name, (sigma, estimated) in levels.items() if not estimated}
    larger = too_large(null, found, known)
    stated = NoiseModel({**found.sigma, **known}) if larger else None
    chance = 0.0 if colour is True else white_by_chance(null, noise, left, random)
    words = _COLOURED if chance < _COLOURED_P else _PERHAPS.format(chance)
    return NoiseChoice(
        found, scatter, cylinders, (words,), None, larger, stated, white=white, rounded=steps, chance=chance
    )


def check_choice(model: Model, cylinders: Any, colour: Any) -> None:
    """Raise EstimationError for a choice of colour, or of cylinders whose combustion scatters, that is none."""
    if not (colour is True or colour is False or (isinstance(colour, str) and colour == "auto")):
        raise EstimationError(
            "colour is not acceptable",
            seen=repr(colour),
            allowed='True, False or "auto"',
            cure='leave it out: "auto" counts with an autoregression where the residual is not white',
        )
    if cylinders is None or (isinstance(cylinders, str) and cylinders == "assumed"):
        return
    ports = [port.name for port in model.ports if port.kind == "cylinder" and port.name != "cylinders"]
    names = None if isinstance(cylinders, str) or not isinstance(cylinders, Iterable) else tuple(cylinders)
    if names is None or any(name not in ports for name in names):
        raise EstimationError(
            "scatter is not acceptable",
            seen=repr(cylinders),
            allowed=f'"assumed", None, or a sequence of cylinder ports ({", ".join(ports) or "the model has none"})',
            cure='leave it out: "assumed" takes the cylinders whose pressure was assumed',
        )


def _check_levels(sigma: Mapping[str, float]) -> None:
    for name, level in sigma.items():
        if not (math.isfinite(level) and level > 0):
            raise EstimationError(
                f"no level of the noise of {name} can be told from the residual",
                seen=f"a standard deviation of {level:g}",
                allowed="a residual that is not the same nothing everywhere",
                cure=f"state the level, ce.Noise({name}=sigma), or take a record in which something happens",
            )


def _white_noise(
    null: NullModel,
    columns: Columns,
    white: Compressed,
    levels: Mapping[str, tuple[float, bool]],
    random: Columns | None,
) -> tuple[NoiseModel, tuple[str, ...]]:
    """White noise: the levels that are known and true, and those that the whole library leaves."""
    known = {name: sigma for name, (sigma, estimated) in levels.items() if not estimated}
    if random:
        noise = estimated_noise(null, explained=_explained(null, white, columns), scatter=random)
    else:
        sigma, freedom = white_levels(white)
        noise = NoiseModel(sigma, {}, {}, "estimated", freedom)
    messages = []
    for name in list(known):
        count = noise.freedom[name]
        if chi2_sf(count * (noise.sigma[name] / known[name]) ** 2, count) < _SURE:
            messages.append(
                f"the noise of {name} is larger than stated: {noise.sigma[name]:.4g} is left when the whole library "
                f"may explain the residual, {known[name]:.4g} was given; the larger one counts"
            )
            del known[name]
        elif noise.sigma[name] < _QUIETER * known[name]:
            messages.append(
                f"the noise of {name} is smaller than stated: {noise.sigma[name]:.4g} is left when the whole library "
                f"may explain the residual, {known[name]:.4g} was given, which counts, and hides what is smaller"
            )
    if len(known) == len(levels):
        if random:
            explained = _explained(null, white, columns)
            return estimated_noise(null, explained=explained, scatter=random, sigma=known), tuple(messages)
        return NoiseModel(known, source="known"), tuple(messages)
    if known and not random:
        own = {name: nu for name, nu in noise.freedom.items() if name not in known}
        noise = NoiseModel({**noise.sigma, **known}, {}, {}, "estimated", own)
    return noise, tuple(messages)


def _explained(null: NullModel, white: Compressed, columns: Columns) -> dict[str, dict[str, Array]]:
    """Null slopes and the strongest candidates that are not alike: record -> output -> (N, k)."""
    chosen: list[int] = []
    if white.candidates:
        scores = score(white)
        most = min(_MOST, int(_SHARE * null.count))
        for k in sorted(np.flatnonzero(scores.testable), key=lambda k: -scores.statistic[k]):
            if len(chosen) >= most:
                break
            if not chosen or np.abs(scores.correlation[k, chosen]).max() < _ALIKE:
                chosen.append(int(k))
    return beside(null, columns, chosen)


def is_white(null: NullModel, noise: NoiseModel, explained: Columns, random: Columns | None) -> bool:
    """True if the residual that the columns and the scatter leave is white, in all outputs of all records; of one that
    is rounding it is known what it is."""
    tests = 0
    smallest = 1.0
    for gain, p in _looked_at(null, noise, explained, random):
        if gain > _WANDER:
            return False
        if p is not None:
            tests, smallest = tests + 1, min(smallest, p)
    return bool(smallest * tests >= _COLOURED_P)


def white_by_chance(null: NullModel, noise: NoiseModel, explained: Columns, random: Columns | None) -> float:
    """How often white noise looks as coloured as what the columns and the scatter leave, over all tests."""
    chances = []
    for gain, p in _looked_at(null, noise, explained, random):
        chances += [_CHANCE * math.exp(-0.5 * gain), 1.0 if p is None else p]
    return min(1.0, len(chances) * min(chances, default=1.0))


def _looked_at(
    null: NullModel, noise: NoiseModel, explained: Columns, random: Columns | None
) -> Iterator[tuple[float, float | None]]:
    """By how much a slow wander makes each output of each record more probable, and the p-value of its whiteness."""
    left = left_over(null, noise, explained, random)
    for record in null.records:
        for output in record.outputs:
            if rounded(record, output) is not None:
                yield 0.0, 1.0
                continue
            held = explained[record.name][output]
            if random is not None:
                held = np.concatenate([held, random[record.name][output]], axis=1)
            e = left[record.name][output]
            gain = wander_gain(record.index[output], record.length[output], e, held)
            yield gain, white_p(record, output, e, held)


def wander_gain(index: Index, length: int, residual: Array, held: Array) -> float:
    """By how much -2 log likelihood falls from white noise alone to white noise plus a slow wander.

    held : (N, k) columns that were fitted
    """
    full = np.zeros((length, 1 + held.shape[1]))
    frame = basis(held)
    valid = np.zeros(length, dtype=bool)
    valid[index] = True
    full[index, 0], full[index, 1 : 1 + frame.shape[1]] = residual, frame
    power = spectrum(full, valid, np.ones(length))
    found = None if power is None else wander_of(power, 1)
    if power is None or found is None:
        return 0.0
    return float(
        power.deviance(np.ones(len(power.frequency))) - power.deviance(found.density(power.frequency))
    )


def too_large(null: NullModel, noise: NoiseModel, known: Mapping[str, float]) -> tuple[tuple[str, str], ...]:
    """(record, output) whose residual is larger than the stated noise, whatever its colour."""
    left = left_over(null, noise, {r.name: dict(r.slopes) for r in null.records})
    found = []
    for record in null.records:
        for output in record.outputs:
            if output in known:
                e = left[record.name][output]
                colour = noise.colour.get((record.name, output))
                # a few long swings may be large by chance; one that never ends is no noise
                memory = min(1.0 if colour is None else colour.memory, len(e) / _SWINGS)
                excess = float(np.mean(e**2)) / known[output] ** 2 - 1
                if excess > _LARGER * math.sqrt(2 * memory / len(e)):
                    found.append((record.name, output))
    return tuple(found)


def white_p(record: Any, output: str, residual: Array, jacobian: Array | None) -> float | None:
    """The p-value of the whiteness test of a residual (N,) at the valid samples of a channel; None if there is none."""
    length, index = record.length[output], record.index[output]
    full, valid = np.zeros(length), np.zeros(length, dtype=bool)
    full[index], valid[index] = residual, True
    slopes = None
    if jacobian is not None:
        slopes = np.zeros((length, jacobian.shape[1]))
        slopes[index] = jacobian
    return whiteness(full, mask=valid, jacobian=slopes).p_value


def innovation_p(
    record: Any, output: str, residual: Array, jacobian: Array, noise: NoiseModel
) -> float | None:
    """As ``white_p``; of the innovations where the noise is coloured, by an autoregression of the same data.

    That its coefficients were fitted makes the innovations whiter than they are: the test then alarms less often than
    it may, never more often (Box & Pierce 1970). At missing samples there are no innovations.
    """
    colour = noise.colour.get((record.name, output))
    if colour is None or colour.order == 0:
        return white_p(record, output, residual, jacobian)
    white = noise.whiten(record, output, np.column_stack([residual, jacobian]))
    valid = record.valid(output)
    whole = valid.copy()  # samples whose past is there; before the first there is none to miss
    for lag in range(1, colour.reach + 1):
        whole[lag:] &= valid[:-lag]
    if np.count_nonzero(whole) < 2:
        return None
    return whiteness(white[:, 0], mask=whole, jacobian=white[:, 1:]).p_value
