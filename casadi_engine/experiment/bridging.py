"""What a user can say of the holes in a record: that a channel goes on over them, or that the record is cut there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.errors import ExperimentError

from .channel import Channel, Step
from .conditioning import changed, picked
from .holes import LONGER, holes

if TYPE_CHECKING:
    from .experiment import Experiment

BRIDGES = ("hold", "join")


def bridged(experiment: Experiment, how: Mapping[str, str]) -> Experiment:
    """Say what channels do in their holes; see ``Experiment.bridged``."""
    done: dict[str, Channel] = {}
    counts: dict[str, Any] = {}
    if not how:
        raise ExperimentError(
            "bridged was given no channel", cure='name the channels: bridged(T_load="join")'
        )
    for name, word in how.items():
        channel = experiment[name]
        if not isinstance(word, str) or word not in BRIDGES:
            raise ExperimentError(
                f"what {name!r} is to do in its holes is not known",
                seen=repr(word),
                allowed=", ".join(BRIDGES),
                cure=f'write bridged({name}="join") for a straight line, or "hold" for the last value',
            )
        if word == "join" and channel.hold == "zero":
            raise ExperimentError(
                f"channel {name!r} holds its samples, so no line joins them",
                seen=f'bridged({name}="join") of a channel with hold "zero"',
                allowed='"hold"',
                cure=f'write bridged({name}="hold"), or set with_hold({name}="first") before',
            )
        done[name] = dataclasses.replace(_held(channel) if word == "hold" else channel, bridge=word)
        counts[name] = word
    return changed(experiment, "bridged", counts, done)


def _held(channel: Channel) -> Channel:
    """The channel with its last value once more at the end of each hole, a usual step before the next sample."""
    found = holes(channel)
    if channel.hold == "zero" or not found.size:
        return channel
    step = np.diff(channel.time)
    beside = np.minimum(step[np.maximum(found - 1, 0)], step[np.minimum(found + 1, step.size - 1)])
    usual = np.minimum(beside, step[found] / LONGER)  # shorter than that it is, or the hole would be none
    rows = np.insert(channel.rows, found + 1, channel.rows[found]) if channel.rows.size else channel.rows
    return dataclasses.replace(
        channel,
        time=np.insert(channel.time, found + 1, channel.time[found + 1] - usual),
        values=np.insert(channel.values, found + 1, channel.values[found]),
        mask=np.insert(channel.mask, found + 1, channel.mask[found]),
        rows=rows,
    )


def split_at_holes(experiment: Experiment) -> tuple[Experiment, ...]:
    """The pieces between the holes; see ``Experiment.split_at_holes``."""
    names = experiment.inputs or experiment.names
    gaps = sorted(
        (float(channel.time[at]), float(channel.time[at + 1]))
        for channel in (experiment[name] for name in names)
        for at in holes(channel)
    )
    merged: list[tuple[float, float]] = []
    for first, last in gaps:
        if merged and first < merged[-1][1]:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    if not merged:
        return (experiment,)
    starts = [-np.inf, *(last for _, last in merged)]
    stops = [*(first for first, _ in merged), np.inf]
    made = [_piece(experiment, start, stop) for start, stop in zip(starts, stops, strict=True)]
    whole = [piece for piece in made if piece is not None]
    if not whole:
        raise ExperimentError(
            f"{experiment.place}: no piece between the holes has two samples of every channel",
            seen=f"{len(merged)} holes",
            allowed="one piece or more with two samples of every channel",
            cure="leave out the channels that are seldom sampled by without(...)",
        )
    return tuple(piece.renamed(f"{experiment.name}/{number}") for number, piece in enumerate(whole, start=1))


def _piece(experiment: Experiment, start: float, stop: float) -> Experiment | None:
    """The samples from start to stop [s], or None if a channel has fewer than two there."""
    kept = []
    for channel in experiment.channels:
        first = int(np.searchsorted(channel.time, start, side="left"))
        last = int(np.searchsorted(channel.time, stop, side="right"))
        if last - first < 2:
            return None
        kept.append(picked(channel, slice(first, last)))
    span = min(c.span[0] for c in kept), max(c.span[1] for c in kept)
    step = Step(
        "split_at_holes", {"start": span[0], "stop": span[1]}, experiment.samples, max(map(len, kept))
    )
    return dataclasses.replace(experiment, channels=tuple(kept), history=(*experiment.history, step))
