"""The torque of unknown course at a port, over time, twist, speed and crank angle, with the named law over it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.clocks import SECONDS, Clock, clock_of
from casadi_engine.discrepancy.latent_torque import LatentCourse, LatentTorque
from casadi_engine.discrepancy.repaired import FoundEffect, Repair
from casadi_engine.discrepancy.wording import what_acts
from casadi_engine.experiment.units import NOT_STATED
from casadi_engine.report import panels
from casadi_engine.report.repaired_gap import FOUR_STROKE
from casadi_engine.report.sketch import Panel

Array = NDArray[np.float64]

LAW = panels.PREDICTED
# Signals over which a course is drawn, with their factors.
AXES = {"twist": 1.0, "twist_rate": 1.0, "speed": 1.0, "crank_angle": 180 / math.pi}
# Parts linear in these are what inertias, stiffness and damping can take over.
LINEAR = ("twist", "twist_rate", "speed")
_CYCLES_SHOWN = 2
_BINS = 36
_LEVEL = 1e-9


@dataclass(frozen=True, eq=False)
class Seen:
    """The latent torque of one record at its knots, as it is drawn.

    time (K,) s; mean, band (K,) N m; law : (K,) N m of the effects found at the port, or None
    signals : name -> (K,), crank_angle in 0..4 pi among them where it is known
    """

    record: str
    time: Array
    mean: Array
    band: Array
    law: Array | None
    signals: Mapping[str, Array]


def acting(repair: Repair, port: str, unit: bool = True) -> str:
    """What acts at a port, with its unit: ``torque [N m]``."""
    quantity, own = what_acts(repair.model, port)
    return f"{quantity} [{own}]" if unit and own != NOT_STATED else quantity


def axis_of(repair: Repair, port: str, signal: str) -> str:
    """A signal of a port with its unit: ``speed [rad/s]``."""
    if signal in ("crank_angle", "time"):
        return {"crank_angle": "crank angle [deg]", "time": clock_of(repair.model).axis}[signal]
    known = repair.model.ports[port] if port in repair.model.ports.names else None
    if known is None:
        return signal.replace("_", " ")
    if known.kind in ("input", "sensor") and signal == "value":
        _, own = what_acts(repair.model, port)
        return port.partition("_")[2] + (f" [{own}]" if own != NOT_STATED else "")
    if signal == "turn":
        return "angle, the speed added up [rad]"
    every = {one.name: one.unit for one in (*repair.model.states, *repair.model.inputs)}
    unit = known.units.get(signal, None if signal in known.signals else every.get(signal))
    return known.called(signal) + ("" if unit is None else f" [{unit}]")


def latent_at(repair: Repair, port: str | None = None) -> LatentTorque | None:
    """The latent torque at a port: the given one, or that of the first effect found, or the one that explains most."""
    known = {one.port: one for one in repair.latent}
    if port is not None:
        return known.get(port)
    for effect in repair.effects:
        if effect.at in known:
            return known[effect.at]
    return repair.latent[0] if repair.latent else None


def laws_at(repair: Repair, port: str) -> tuple[FoundEffect, ...]:
    """The effects found at a port whose course is known."""
    return tuple(one for one in repair.effects if one.at == port and one.course)


def seen(repair: Repair, latent: LatentTorque) -> tuple[Seen, ...]:
    """What is drawn of a latent torque, record by record.

    The free parameters can take over any part of an unknown torque that is linear in the signals of its port, so that
    the data do not determine these parts. Where a law was found they are set so that they agree with it, by least
    squares over all records together; what is left to compare is the rest, which the data do determine.
    """
    angles = {one.name: one["theta"] for one in repair.data if "theta" in one}
    made = []
    for record, course in latent.courses.items():
        signals = {
            name: value for name, value in course.signals.items() if name in AXES and np.ptp(value) > _LEVEL
        }
        if record in angles:
            theta = np.interp(course.time, angles[record].time, angles[record].values)
            signals["crank_angle"] = np.mod(theta, FOUR_STROKE)
        law = _law(laws_at(repair, latent.port), record, course)
        made.append(Seen(record, course.time, course.mean, course.band, law, signals))
    return tuple(_given_back(made)) if all(one.law is not None for one in made) else tuple(made)


def _law(effects: Sequence[FoundEffect], record: str, course: LatentCourse) -> Array | None:
    """Sum of the laws at the knots, each the mean over the piece around its knot (a law may jump)."""
    if not effects:
        return None
    middle = 0.5 * (course.time[1:] + course.time[:-1])
    total = np.zeros(len(course.time))
    for effect in effects:
        if record not in effect.course:
            continue  # an effect of other records, such as a load step of one of them
        time, value = effect.course[record]
        piece = np.searchsorted(middle, time)
        count = np.bincount(piece, minlength=len(total))
        mean = np.bincount(piece, value, minlength=len(total)) / np.maximum(count, 1)
        total += np.where(count > 0, mean, np.interp(course.time, time, value))
    return total


def _given_back(made: Sequence[Seen]) -> list[Seen]:
    names = [name for name in LINEAR if all(name in one.signals for one in made)]
    columns = [
        np.column_stack([np.ones(len(one.time)), *(one.signals[name] for name in names)]) for one in made
    ]
    weight = np.concatenate([1 / np.maximum(one.band, _LEVEL) for one in made])
    short = np.concatenate([np.asarray(one.law) - one.mean for one in made])
    stacked = np.concatenate(columns)
    scale = np.abs(stacked).max(axis=0)
    taken = np.linalg.lstsq(stacked / scale * weight[:, None], short * weight, rcond=None)[0] / scale
    return [
        Seen(one.record, one.time, one.mean + column @ taken, one.band, one.law, one.signals)
        for one, column in zip(made, columns, strict=True)
    ]


def binned(signal: Array, value: Array, band: Array) -> tuple[Array, Array, Array]:
    """Mean of a course in pieces of a signal, and the standard error of each mean; at least two knots in a piece.

    >>> import numpy as np
    >>> x = np.array([0.0, 0.0, 1.0, 1.0])
    >>> place, mean, error = binned(x, np.array([1.0, 3.0, 5.0, 7.0]), np.full(4, 2.0))
    >>> place, mean, np.round(error, 3)
    (array([0., 1.]), array([2., 6.]), array([1.414, 1.414]))
    """
    low, high = float(signal.min()), float(signal.max())
    piece = np.minimum(((signal - low) / max(high - low, _LEVEL) * _BINS).astype(int), _BINS - 1)
    count = np.bincount(piece, minlength=_BINS)
    used = count > 1
    safe = np.maximum(count, 1)

    def mean(of: Array) -> Array:
        return np.asarray((np.bincount(piece, of, minlength=_BINS) / safe)[used])

    inside = np.zeros(_BINS)
    inside[used] = mean(value)
    spread = np.sqrt(mean((value - inside[piece]) ** 2))  # the difference of squares can fall below 0
    error = np.maximum(spread, mean(band)) / np.sqrt(count[used])
    return mean(signal), mean(value), error


# ---- panels -------------------------------------------------------------------------------------------


def draw_over_time(
    panel: Panel, one: Seen, law: str, acts: str = "torque [N m]", clock: Clock = SECONDS
) -> None:
    """The latent torque with its band over the last engine cycles, and the law."""
    start = _first_shown(one)
    inside = one.time >= start
    time, mean, band = clock.of(one.time[inside]), one.mean[inside], 2 * one.band[inside]
    words = "±2 standard errors"
    panel.fill_between(time, mean - band, mean + band, color=panels.BAND, linewidth=0, label=words)
    panel.plot(
        time, mean, color=panels.SIMULATED, linewidth=1.0, label=f"{_bare(acts)} that the data ask for"
    )
    if one.law is not None:
        panel.plot(time, one.law[inside], color=LAW, linewidth=1.2, label=law)
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    title = f"{one.record}, its last {time[-1] - clock.of(start):.2g} {clock.unit}"
    panels.dress(panel, x=clock.axis, y=acts, title=title)


def _first_shown(one: Seen) -> float:
    """Where the last engine cycles of a record begin; without a crank angle its last fifth."""
    angle = one.signals.get("crank_angle")
    if angle is not None:
        turns = np.flatnonzero(np.diff(angle) < 0)
        if len(turns) > _CYCLES_SHOWN:
            return float(one.time[turns[-_CYCLES_SHOWN - 1] + 1])
    return float(one.time[-1] - 0.2 * (one.time[-1] - one.time[0]))


def draw_over(
    panel: Panel, records: Sequence[Seen], signal: str, law: str, words: str, acts: str = "torque [N m]"
) -> None:
    """The latent torque over a signal: knots, their means in pieces of the signal, and the law.

    words : the signal with its unit; acts : what acts at the port, with its unit
    """
    factor = AXES[signal]
    x = np.concatenate([one.signals[signal] for one in records])
    mean, band = (np.concatenate([getattr(one, name) for one in records]) for name in ("mean", "band"))
    panel.plot(factor * x, mean, ".", color="0.75", markersize=2, label="at each knot")
    place, value, error = binned(x, mean, band)
    panel.errorbar(
        factor * place, value, yerr=2 * error, color=panels.SIMULATED, markersize=3, linewidth=1.0,
        label=f"{_bare(acts)} that the data ask for, mean ±2 s.e.",
    )  # fmt: skip
    if all(one.law is not None for one in records):
        total = np.concatenate([np.asarray(one.law) for one in records])
        order = np.argsort(x)
        if _single_valued(total[order]):
            panel.plot(factor * x[order], total[order], color=LAW, linewidth=1.4, label=law)
        else:
            where, level, _ = binned(x, total, np.zeros(len(total)))
            panel.plot(factor * where, level, color=LAW, linewidth=1.4, label=f"{law} (mean)")
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    panels.dress(panel, x=words, y=acts, title=f"over {_bare(words)}")
    if signal == "crank_angle":
        panel.xlim, panel.xticks = (0, 720), range(0, 721, 180)


def _bare(words: str) -> str:
    """Words without their unit."""
    return words.partition(" [")[0]


def _single_valued(values: Array) -> bool:
    """Whether a law, sorted by a signal, is a function of it: it goes up and down a few times at most."""
    span = float(np.ptp(values))
    return span == 0 or float(np.abs(np.diff(values)).sum()) < 6 * span


def law_words(effects: Sequence[FoundEffect]) -> str:
    """Names of the laws of a port for a legend."""
    return " + ".join(effect.name for effect in effects) or "no law was found here"
