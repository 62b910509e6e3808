"""What a model needs of an experiment."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.errors import DataFileError, ExperimentError

from .arrival import check_dimension
from .channel import Channel
from .header import name_list
from .holes import refuse_holes
from .units import NOT_STATED, split_header

if TYPE_CHECKING:
    from .experiment import Experiment

# Times that were computed by different roads differ in their last digits.
COVER_SLACK = 1e-6

Names = Iterable[str] | Mapping[str, str]


def require(experiment: Experiment, *, inputs: Names, outputs: Names) -> None:
    """Raise if the experiment lacks something that is needed; see ``Experiment.require``."""
    wanted = {"input": _with_units(inputs, "inputs"), "output": _with_units(outputs, "outputs")}
    for role, names in wanted.items():
        for name, unit in names.items():
            _present(experiment, role, name)
            if unit is not None and unit != NOT_STATED:
                check_dimension(experiment, experiment[name], unit)
    whole: set[tuple[int, str, bool]] = set()  # times without holes; channels of one file share theirs
    for name in wanted["input"]:
        channel = experiment[name]
        _complete(experiment, channel)
        if (kind := (id(channel.time), channel.hold, bool(channel.bridge))) not in whole:
            refuse_holes(experiment, channel, "nothing says what the input did there")
            whole.add(kind)
    for name in wanted["output"]:
        _not_empty(experiment, experiment[name])
    for output in wanted["output"]:
        for name in wanted["input"]:
            _covers(experiment, experiment[name], experiment[output])


def _with_units(names: Names, option: str) -> dict[str, str | None]:
    if isinstance(names, Mapping):
        return dict(names.items())
    return dict.fromkeys(name_list(names, option))


def _present(experiment: Experiment, role: str, name: str) -> None:
    if name in experiment:
        return
    ignored = [label for label in experiment.ignored if split_header(label)[0] == name]
    near = difflib.get_close_matches(name, experiment.names, n=1)
    if ignored:
        cure = f"column {ignored[0]!r} was left out on reading: add {name!r} to required= or optional="
    elif near:
        cure = f"did you mean {near[0]!r}?"
    else:
        cure = "record it, or take a model that does not need it"
    raise ExperimentError(
        f"{experiment.place}: {role} channel {name!r} is missing",
        seen=", ".join(experiment.names),
        allowed=f"a channel {name!r}",
        cure=cure,
    )


def _complete(experiment: Experiment, channel: Channel) -> None:
    gaps = np.flatnonzero(~channel.mask)
    if not gaps.size:
        return
    index = int(gaps[0])
    from_file = experiment.source is not None and channel.rows.size > 0
    where = f"row {channel.rows[index]}" if from_file else f"sample {index}"
    kind = DataFileError if from_file else ExperimentError
    raise kind(
        f"{experiment.place}, column {channel.name!r}, {where}: a missing sample in an input",
        seen=f"{gaps.size} missing, the first at {channel.time[index]:.9g} s",
        allowed="a number in every sample of an input; only outputs may have missing samples",
        cure="fill the gap, or cut the record there by between",
    )


def _not_empty(experiment: Experiment, channel: Channel) -> None:
    if not channel.mask.any():
        raise ExperimentError(
            f"{experiment.place}, column {channel.name!r}: every sample of this output is missing",
            seen=f"{len(channel)} missing",
            allowed="one valid sample or more",
            cure="leave the output out of the model, or take another record",
        )


def _covers(experiment: Experiment, channel: Channel, output: Channel) -> None:
    (low, high), (first, last) = channel.span, output.span
    if low <= first and high >= last:
        return
    slack = COVER_SLACK * float(np.median(np.diff(channel.time)))
    if low > first + slack or high < last - slack:
        raise ExperimentError(
            f"{experiment.place}: input {channel.name!r} does not cover output {output.name!r} in time",
            seen=f"input from {low:.9g} to {high:.9g} s",
            allowed=f"at least {first:.9g} to {last:.9g} s, the span of the output",
            cure="cut the record by between(start, stop, inputs=(...)) to where all inputs are there",
        )
