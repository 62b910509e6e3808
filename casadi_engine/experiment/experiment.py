"""Experiment: the channels of one record, and the verbs that condition them."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from casadi_engine.errors import ExperimentError

from . import (
    arrays,
    arrival,
    bridging,
    conditioning,
    csv_writer,
    npz_reader,
    pegging,
    pressures,
    requirements,
    slicing,
    summary,
)
from .channel import Channel, Step
from .decimation import Decimation
from .header import make_request, name_list
from .source import read_source, record_key

if TYPE_CHECKING:
    import os

    import pandas as pd


@dataclass(frozen=True, eq=False)
class Experiment:
    """The channels of one record, each with its own time; every verb returns a new experiment.

    name : record key.  channels : tuple of :class:`Channel`, in SI when read.
    history : what was done, one :class:`Step` a verb.  ignored : columns of the file that were not read.
    source, sha256 : file that it was read from (None when made of arrays).
    inputs : channels known to be inputs (may be empty: the model knows them).
    begin : instant [s] at which its initial states hold, where that is not the first valid sample of the outputs.
    decimation : how it was made of a record of a higher rate, for the search of a fit.

    Raises :class:`ExperimentError` for no channel, a repeated one or an unknown input.

    >>> exp = Experiment.from_arrays("demo", time=[0.0, 0.1, 0.2], units={"omega": "rpm"}, omega=[1200] * 3)
    >>> exp["omega"].unit, exp.duration
    ('rad/s', 0.2)
    >>> len(exp.resample(omega=2)["omega"])
    2
    """

    name: str
    channels: tuple[Channel, ...]
    history: tuple[Step, ...] = ()
    ignored: tuple[str, ...] = ()
    source: str | None = None
    sha256: str | None = None
    inputs: tuple[str, ...] = ()
    begin: float | None = None
    decimation: Decimation | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise ExperimentError(
                "an experiment needs a name", seen=repr(self.name), allowed="text", cure="give a name"
            )
        for key in ("channels", "history", "ignored", "inputs"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        if not self.channels or not all(isinstance(channel, Channel) for channel in self.channels):
            raise ExperimentError(
                f"experiment {self.name!r} has no channels",
                seen=f"{[type(channel).__name__ for channel in self.channels]}",
                allowed="one Channel or more",
                cure="make it by read_experiment or Experiment.from_arrays",
            )
        names = self.names
        for name in names:
            if names.count(name) > 1:
                raise ExperimentError(
                    f"experiment {self.name!r} has channel {name!r} twice",
                    allowed="each name once",
                    cure="rename one of them",
                )
        for name in self.inputs:
            _ = self[name]

    # -- made from ---------------------------------------------------------------------------------------

    @classmethod
    def from_arrays(
        cls,
        name: str,
        *,
        units: Mapping[str, str],
        time: Any = None,
        hold: str | Mapping[str, str] = "first",
        origin: str | Mapping[str, str] = "measured",
        inputs: Iterable[str] = (),
        **channels: Any,
    ) -> Experiment:
        """Experiment from arrays.

        time : (N,) common time, in ``units.get("time", "s")``.  units : unit of every channel.
        channels : name=values (N,) on the common time, or name=(time, values) on its own; NaN is missing.
        hold, origin : one word for all, or a mapping by name.  inputs : names that may have no NaN.

        Raises :class:`ExperimentError` or :class:`UnitError` with the channel and the sample.
        """
        loaded = arrays.load_arrays(channels, time=time, units=units, hold=hold, origin=origin, inputs=inputs)
        return cls(name, **loaded.fields())

    @classmethod
    def from_dataframe(
        cls,
        frame: pd.DataFrame,
        *,
        name: str,
        units: Mapping[str, str] | None = None,
        hold: str | Mapping[str, str] = "first",
        origin: str | Mapping[str, str] = "measured",
        inputs: Iterable[str] = (),
    ) -> Experiment:
        """Experiment from a pandas data frame with columns ``name [unit]``, or plain ones and ``units``.

        The time is the column, or the index, called ``time [s]``; NaN is a missing sample.
        Raises :class:`ExperimentError` or :class:`UnitError` with the column.
        """
        loaded = arrays.load_frame(frame, units=units, hold=hold, origin=origin, inputs=inputs)
        return cls(name, **loaded.fields())

    @classmethod
    def from_npz(
        cls,
        path: str | os.PathLike[str],
        *,
        name: str | None = None,
        channels: Mapping[str, Sequence[str]] | None = None,
        assumed: Iterable[str] = (),
        optional: Iterable[str] = (),
        required: Iterable[str] | None = None,
        inputs: Iterable[str] | None = None,
        hold: str = "first",
    ) -> Experiment:
        """Experiment from a NumPy archive (never unpickled).

        Keys ``time [s]`` and ``name [unit]``, or channels={"omega": ("omega_time_s", "omega_rad_s",
        "rad/s")} for channels with their own times. Other options as in :func:`read_experiment`.
        Raises :class:`DataFileError` or :class:`UnitError` with file and key.
        """
        request = make_request(
            assumed=assumed, optional=optional, required=required, inputs=inputs, hold=hold
        )
        source = read_source(path)
        loaded = npz_reader.read_npz(source, request, channels)
        return cls(record_key(source.path) if name is None else name, **loaded.fields())

    # -- looked at ---------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and any(channel.name == name for channel in self.channels)

    def __getitem__(self, name: str) -> Channel:
        for channel in self.channels:
            if isinstance(name, str) and channel.name == name:
                return channel
        near = difflib.get_close_matches(name, self.names, n=1) if isinstance(name, str) else []
        raise ExperimentError(
            f"experiment {self.name!r} has no channel {name!r}",
            allowed=", ".join(self.names),
            cure=f"did you mean {near[0]!r}?" if near else "use one of the channels that are there",
        )

    @property
    def place(self) -> str:
        """Where the data came from, to open a message: the file, or the experiment's name."""
        return self.source if self.source is not None else f"experiment {self.name!r}"

    @property
    def samples(self) -> int:
        """Number of samples of the longest channel."""
        return max(len(channel) for channel in self.channels)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time [s] of any channel."""
        return (
            min(channel.span[0] for channel in self.channels),
            max(channel.span[1] for channel in self.channels),
        )

    @property
    def duration(self) -> float:
        """Time [s] from the first sample to the last."""
        first, last = self.span
        return last - first

    def require(self, *, inputs: requirements.Names | None = None, outputs: requirements.Names = ()) -> None:
        """Raise unless the experiment holds what a model needs.

        inputs, outputs : names, or a mapping name -> unit that the model declares; inputs left out are
        those of the experiment.

        Raises :class:`ExperimentError` for a missing channel, a missing sample in an input (file, column
        and row in the message) and inputs that do not cover the outputs' time; :class:`UnitError` for a
        unit of another dimension.
        """
        requirements.require(self, inputs=self.inputs if inputs is None else inputs, outputs=outputs)

    def describe(self, *, outputs: Iterable[str] | None = None) -> dict[str, Any]:
        """JSON-able dict: name, file, sha256, samples, outputs, channels, ignored, history.

        outputs : names of the outputs; left out, every channel that is not known to be an input.
        """
        return summary.describe(self, outputs)

    def __str__(self) -> str:
        return summary.text(self)

    def _repr_html_(self) -> str:
        return summary.as_html(self)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the experiment as a data file by the contract, atomically; gzip if it ends in .gz.

        Values stand in the channels' units. A channel that was resampled gets empty cells. Hold, origin and
        history are not part of a data file.
        Raises :class:`ExperimentError` when the channels' times do not fit together, :class:`OutputError`
        when the file cannot be written.
        """
        csv_writer.to_csv(self, path)

    # -- conditioned -------------------------------------------------------------------------------------

    def resample(self, /, **factors: int) -> Experiment:
        """Keep every n-th sample of the named outputs alone; inputs stay at their rate.

        resample(omega=15) keeps samples 0, 15, 30, ... There is no filter in it: use ``low_pass`` first.
        Raises :class:`ExperimentError` for an unknown channel or a factor that leaves fewer than two samples.
        """
        return conditioning.resample(self, factors)

    def low_pass(self, *, cutoff_hz: float, channels: Iterable[str] | str, order: int = 4) -> Experiment:
        """Zero-phase Butterworth low-pass of the named channels.

        cutoff_hz : below half the rate; run forwards and backwards, so the gain there is 1/2 and the
        order in effect twice ``order``.
        Raises :class:`ExperimentError` for non-uniform or missing samples, or a record that is too short.
        """
        return conditioning.low_pass(self, cutoff_hz=cutoff_hz, order=order, channels=channels)

    def moving_average(self, /, **lengths: int) -> Experiment:
        """Centred mean over an odd number of samples: moving_average(T_load=51).

        Towards an end, and towards a hole in the rows, the window shrinks on both sides. Missing samples are left
        out and stay missing.
        Raises :class:`ExperimentError` for an even or too long window.
        """
        return conditioning.moving_average(self, lengths)

    def between(self, start: float, stop: float, *, inputs: Iterable[str] | None = None) -> Experiment:
        """Samples with start <= time <= stop [s].

        inputs : channels that keep one sample beyond each end, so that they still cover the outputs (left
        out: ``self.inputs``). Needed only where inputs and outputs do not share their times.
        Raises :class:`ExperimentError` when a channel keeps fewer than two samples.
        """
        return slicing.between(self, start, stop, inputs=inputs)

    def pieces(self, length: float, *, inputs: Iterable[str] | None = None) -> tuple[Experiment, ...]:
        """Pieces of equal length, of up to ``length`` s each, called name/1, name/2, ...; times stay as they are.

        An unstable motion, as of a machine that a controller balances, is followed by no simulation for long: each
        piece starts anew. A record that is as short comes back alone, under its name.
        Raises :class:`ExperimentError` when a piece keeps fewer than two samples of a channel.
        """
        return slicing.pieces(self, length, inputs=inputs)

    def cycles(
        self,
        first: int,
        last: int,
        *,
        cycle_length: float = slicing.FOUR_STROKE,
        theta: str = "theta",
        tdc: float = 0.0,
        inputs: Iterable[str] | None = None,
    ) -> Experiment:
        """Engine cycles first..last, both included, without the first sample of the next cycle.

        Cycle k >= 1 starts where the angle ``theta`` [rad] passes ``tdc + (k - 1) * cycle_length``: the
        combustion TDC of the cylinder whose TDC angle ``tdc`` is. A cycle of which an end of the record
        cuts off less than 2 % counts as whole. inputs : as in ``between``.
        Raises :class:`ExperimentError` with the cycles that the record holds.
        """
        return slicing.cycles(
            self, first, last, cycle_length=cycle_length, theta=theta, tdc=tdc, inputs=inputs
        )

    def shift_pressures(
        self,
        pairs: Mapping[str, str],
        *,
        offsets: Mapping[str, float] | None = None,
        theta: str = "theta",
        cycle_length: float = slicing.FOUR_STROKE,
    ) -> Experiment:
        """Make pressures that were not measured by shifting measured ones by the firing order.

        pairs : {"p3": "p1", "p4": "p2"}, new from measured.  offsets : combustion TDC [rad] of each
        pressure; left out, firing order 1-3-4-2. The shift is done in crank angle, p_new(theta) =
        p_old(theta - (tdc_new - tdc_old)), linear between samples; where the record ends, the
        neighbouring cycle is taken. The origin is "assumed". (Thesis, chapter 4.)
        Raises :class:`ExperimentError` for missing offsets, gaps, or less than one engine cycle.
        """
        return pressures.shift_pressures(self, pairs, offsets=offsets, theta=theta, cycle_length=cycle_length)

    def peg_pressures(
        self,
        channels: Iterable[str] | str,
        *,
        compression_ratio: float,
        rod_ratio: float,
        exponent: float | None = 1.32,
        window: tuple[float, float] = (math.radians(-110), math.radians(-35)),
        offsets: Mapping[str, float] | None = None,
        theta: str = "theta",
        cycle_length: float = slicing.FOUR_STROKE,
    ) -> Experiment:
        """Make relative cylinder pressures absolute: in every cycle p + p_0 follows V^-n over the compression.

        compression_ratio : V_bdc/V_tdc.  rod_ratio : crank radius over rod length.  exponent : n of the polytrope;
        None finds one for all cycles of a cylinder.  window : angles [rad] from combustion TDC between which the
        valves are shut and nothing burns.  offsets : combustion TDC [rad] of each pressure; left out, firing order
        1-3-4-2. p_0 is found by least squares per cycle and added from one gas exchange TDC to the next; a cycle whose
        compression is not in the record takes that of the nearest. The history tells n and every p_0.
        Raises :class:`ExperimentError` for a channel that is no pressure, for missing offsets, for holes in the crank
        angle, and where no compression is found.
        """
        return pegging.peg_pressures(
            self, channels, compression_ratio=compression_ratio, rod_ratio=rod_ratio, exponent=exponent, window=window,
            offsets=offsets, theta=theta, cycle_length=cycle_length,
        )  # fmt: skip

    def masked(self, name: str, mask: Any) -> Experiment:
        """Mark samples of a channel as missing: mask (N,) bool, True where the sample stays valid."""
        return conditioning.masked(self, name, mask)

    def with_channel(self, channel: Channel) -> Experiment:
        """Add a channel, or replace the one of that name."""
        if not isinstance(channel, Channel):
            raise ExperimentError(
                "not a channel", seen=type(channel).__name__, allowed="Channel", cure="make a Channel first"
            )
        if channel.name in self:
            return conditioning.changed(self, "with_channel", {"name": channel.name}, {channel.name: channel})
        step = Step("with_channel", {"name": channel.name}, 0, len(channel))
        return dataclasses.replace(self, channels=(*self.channels, channel), history=(*self.history, step))

    def with_hold(self, /, **holds: str) -> Experiment:
        """Set how channels go on between their samples: with_hold(T_load="zero")."""
        done = {name: dataclasses.replace(self[name], hold=hold) for name, hold in holds.items()}
        return conditioning.changed(self, "with_hold", holds, done)

    def bridged(self, /, **how: str) -> Experiment:
        """Say what channels do where rows are missing: bridged(T_load="join").

        "join" : a straight line over the hole.  "hold" : the last value stays, until a usual step before the next
        sample. Without this an input with a hole is refused by every verb that takes a model.
        Raises :class:`ExperimentError` for an unknown channel or word.
        """
        return bridging.bridged(self, how)

    def split_at_holes(self) -> tuple[Experiment, ...]:
        """The pieces of a record between the holes of its inputs, called name/1, name/2, ...; times stay as they are.

        A hole is a step more than five times as long as those around it. Looked at are the channels known to be
        inputs, or all if none is. A piece with fewer than two samples of a channel is left out; a record without
        holes comes back alone, under its name.
        """
        return bridging.split_at_holes(self)

    def in_units(self, units: Mapping[str, str], /) -> Experiment:
        """Convert channels to other units of their dimension: in_units({"omega": "rpm"}).

        Verbs that take a model do this themselves. The same object comes back if nothing is to be converted.
        Raises :class:`UnitError` for a unit of another dimension, with both.
        """
        return arrival.in_units(self, units)

    def with_inputs(self, *names: str) -> Experiment:
        """Say which channels are inputs, for ``between``, ``cycles``, ``require`` and ``describe``."""
        return dataclasses.replace(self, inputs=name_list(names, "inputs"))

    def without(self, *names: str) -> Experiment:
        """Leave channels out."""
        gone = [self[name].name for name in names]
        return self._keeping("without", gone, [name for name in self.names if name not in gone])

    def only(self, *names: str) -> Experiment:
        """Keep the named channels alone."""
        kept = [self[name].name for name in names]
        return self._keeping("only", kept, kept)

    def _keeping(self, function: str, asked: list[str], kept: list[str]) -> Experiment:
        step = Step(function, {"names": asked}, self.samples, self.samples)
        return dataclasses.replace(
            self,
            channels=tuple(channel for channel in self.channels if channel.name in kept),
            inputs=tuple(name for name in self.inputs if name in kept),
            history=(*self.history, step),
        )

    def renamed(self, name: str) -> Experiment:
        """The same experiment under another record key."""
        return dataclasses.replace(self, name=name)


def with_unique_names(experiments: Iterable[Experiment]) -> tuple[Experiment, ...]:
    """Give every record its own key: a repeated ``stem`` becomes ``stem_2``, ``stem_3``, ..."""
    experiments = tuple(experiments)
    taken = {experiment.name for experiment in experiments}
    seen: set[str] = set()
    result: list[Experiment] = []
    for experiment in experiments:
        name, number = experiment.name, 2
        if name in seen:
            while f"{name}_{number}" in taken:
                number += 1
            name = f"{name}_{number}"
            taken.add(name)
        seen.add(name)
        result.append(experiment if name == experiment.name else experiment.renamed(name))
    return tuple(result)


def given_records(data: Any) -> tuple[Experiment, ...]:
    """One experiment or several that were given as such, each with a key of its own; ExperimentError for others."""
    several = isinstance(data, Iterable) and not isinstance(data, str | bytes)
    records = (data,) if isinstance(data, Experiment) else tuple(data) if several else (data,)
    other = next((one for one in records if not isinstance(one, Experiment)), None)
    if any(not isinstance(one, Experiment) for one in records):
        raise ExperimentError(
            "the data are no experiment",
            seen=f"{type(other).__name__} {other!r:.60}",
            allowed="an Experiment, or a sequence of them",
            cure="read a file by ce.read_experiment(path), or make one by ce.Experiment.from_arrays",
        )
    return with_unique_names(records)
