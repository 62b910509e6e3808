"""Order analysis: amplitude and phase of a channel at multiples of the crank's turning, over engine speed."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from casadi_engine.errors import ExperimentError

from .channel import Channel
from .experiment import Experiment
from .slicing import FOUR_STROKE, crank_angle, crossing, finite, whole_cycles
from .units import FloatArray

HIGHEST = 10.0  # order, where nothing else is asked for
SHOWN_ORDERS, SHOWN_ROWS, NAME = 6, 12, 24  # of a printed table; letters of a record's name
# Of the strongest order, what is rounding.
_ROUNDING = 1e-9
# Least strength of a combination of orders, of the strongest one's, that samples still tell.
WEAKEST = 1e-10


@dataclass(frozen=True, eq=False)
class Orders:
    """The answer of ``orders``: a row for each stretch of a record, a column for each order.

    Attributes
    ----------
    channel, unit : what was analysed, and its unit
    orders : (K,) multiples of the crank's turning; order 1 is once a revolution
    rpm : (M,) mean engine speed of each row [RPM]
    time : (M,) middle of each row [s]
    records : (M,) names of the records
    amplitude : (M, K) in ``unit``
    phase : (M, K) rad: the part of order n is amplitude · cos(n θ + phase), θ the crank angle
    stderr : (M, K) standard error of an amplitude, in ``unit``, if what no order explains is white noise
    """

    channel: str
    unit: str
    orders: FloatArray
    rpm: FloatArray
    time: FloatArray
    records: tuple[str, ...]
    amplitude: FloatArray
    phase: FloatArray
    stderr: FloatArray

    def __post_init__(self) -> None:
        for array in (self.orders, self.rpm, self.time, self.amplitude, self.phase, self.stderr):
            array.setflags(write=False)

    @property
    def frequency_hz(self) -> FloatArray:
        """(M, K) frequency of each order in each row [Hz]."""
        return np.outer(self.rpm / 60.0, self.orders)

    @property
    def phasors(self) -> NDArray[np.complex128]:
        """(M, K) amplitude · exp(i phase), in ``unit``; differences of records are differences of these."""
        return self.amplitude * np.exp(1j * self.phase)

    def of(self, order: float) -> FloatArray:
        """Return the amplitude of one order over the rows, (M,), in ``unit``.

        Raises
        ------
        ExperimentError : the order was not analysed
        """
        return self.amplitude[:, self._column(order)]

    def peak(self, order: float) -> tuple[float, float]:
        """Return where an order is largest: engine speed [RPM] and its frequency there [Hz]; a resonance, if it peaks.

        Raises
        ------
        ExperimentError : the order was not analysed
        """
        row = int(np.argmax(self.of(order)))
        return float(self.rpm[row]), float(self.rpm[row] / 60.0 * order)

    @property
    def resonant(self) -> tuple[float, ...]:
        """Orders larger in between than at the lowest and the highest speed, by a third at least; strongest first.

        Differences within three standard errors do not count, nor does what is rounding beside the strongest order.
        """
        if len(self.rpm) < 3:
            return ()
        ends = np.array([np.argmin(self.rpm), np.argmax(self.rpm)])
        edge, top = self.amplitude[ends].max(axis=0), self.amplitude.max(axis=0)
        clear = top > 4 / 3 * edge + 3 * self.stderr.max(axis=0) + _ROUNDING * top.max()
        return tuple(float(self.orders[k]) for k in np.argsort(-top) if clear[k])

    def _column(self, order: float) -> int:
        found = np.flatnonzero(np.isclose(self.orders, order, rtol=0, atol=1e-9))
        if not found.size:
            raise ExperimentError(
                "that order was not analysed",
                seen=repr(order),
                allowed=", ".join(f"{one:g}" for one in self.orders),
                cure="name it in orders(..., orders=(...))",
            )
        return int(found[0])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, ready for JSON."""
        arrays = ("orders", "rpm", "time", "amplitude", "phase", "stderr")
        return {
            "channel": self.channel,
            "unit": self.unit,
            "records": list(self.records),
            **{name: getattr(self, name).tolist() for name in arrays},
        }

    def _table(self) -> tuple[list[str], list[list[str]]]:
        strongest = np.argsort(np.sqrt(np.mean(self.amplitude**2, axis=0)))[::-1][:SHOWN_ORDERS]
        columns = np.sort(strongest)
        rows = np.unique(
            np.linspace(0, len(self.rpm) - 1, min(len(self.rpm), SHOWN_ROWS)).round().astype(int)
        )
        head = ["record", "RPM", *(f"order {self.orders[k]:g}" for k in columns)]
        body = [
            [
                self.records[i] if len(self.records[i]) <= NAME else f"{self.records[i][: NAME - 1]}…",
                f"{self.rpm[i]:.1f}",
                *(f"{self.amplitude[i, k]:.4g} ± {self.stderr[i, k]:.1g}" for k in columns),
            ]
            for i in rows
        ]
        return head, body

    def __str__(self) -> str:
        head, body = self._table()
        widths = [max(len(row[k]) for row in (head, *body)) for k in range(len(head))]
        lines = [f"Orders of {self.channel} [{self.unit}]: {len(self.orders)} orders, {len(self.rpm)} rows"]
        lines += ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in (head, *body)]
        left_out = len(self.orders) - (len(head) - 2), len(self.rpm) - len(body)
        if any(left_out):
            lines.append(f"not shown: {left_out[0]} weaker orders, {left_out[1]} rows; ce.plot draws all")
        for order in self.resonant[:3]:
            rpm, hz = self.peak(order)
            lines.append(f"order {order:g} peaks at {rpm:.0f} RPM, {hz:.1f} Hz: a resonance?")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        head, body = self._table()
        cells = "".join(
            "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>"
            for tag, rows in (("th", [head]), ("td", body))
            for row in rows
        )
        return f"<table>{cells}</table>"


def orders(
    data: Experiment | Sequence[Experiment],
    *,
    channel: str = "omega",
    orders: Iterable[float] | None = None,
    cycles: int | None = None,
    theta: str = "theta",
    cycle_length: float = FOUR_STROKE,
) -> Orders:
    """Find amplitude and phase of a channel at multiples of the crank's turning, over engine speed.

    Least squares in the crank angle over whole engine cycles: a mean, a trend and every multiple of one per cycle up
    to the highest order, so that missing and unequally spaced samples do no harm.

    Parameters
    ----------
    data : an experiment, or several, each with the crank angle and the channel
    channel : what is analysed; its unit is that of the amplitudes
    orders : multiples of the crank's turning; left out, all multiples of one per cycle up to 10, or as high as the
        samples allow. For a four-stroke engine 0.5, 1, 1.5, …
    cycles : engine cycles in a row of the answer; left out, one row with all whole cycles of a record. Give a few for
        a run-up
    theta : name of the crank angle [rad], unwrapped
    cycle_length : crank angle of an engine cycle [rad]; 4π for four strokes, 2π for two

    Returns
    -------
    Orders : amplitudes, phases and their errors; ``ce.plot`` draws them

    Raises
    ------
    ExperimentError : no crank angle or no such channel, an angle that goes back, a record shorter than the cycles asked
        for, orders that are not multiples of one per cycle, or too few samples for them

    References
    ----------
    Thesis of N. Nickmehr, sections 3.2.1 and 4.2.3 (there by FFT, Tables 4.6 and 4.8).

    Examples
    --------
    >>> import numpy as np, casadi_engine as ce
    >>> time = np.arange(2000) / 5000.0
    >>> theta = 125.6 * time
    >>> run = ce.Experiment.from_arrays("idle", time=time, units={"theta": "rad", "omega": "rad/s"}, theta=theta,
    ...     omega=125.6 + 0.3 * np.cos(theta - 0.5) + 0.8 * np.cos(2 * theta))
    >>> found = ce.orders(run, orders=(1, 2))
    >>> found.amplitude.round(6), found.phase.round(6) + 0.0
    (array([[0.3, 0.8]]), array([[-0.5,  0. ]]))
    """
    records = (data,) if not isinstance(data, Sequence) else tuple(data)
    if not records or not all(isinstance(one, Experiment) for one in records):
        raise ExperimentError(
            "there is nothing to analyse",
            seen=type(data).__name__ if records else "no experiment",
            allowed="an Experiment, or several",
            cure="read one by read_experiment",
        )
    length = finite(cycle_length, "cycle_length")
    if length <= 0:
        raise ExperimentError(
            "cycle_length is not positive",
            seen=f"{length:g}",
            allowed="4 pi (four-stroke), 2 pi (two-stroke)",
        )
    whole = isinstance(cycles, int | np.integer) and not isinstance(cycles, bool) and cycles >= 1
    if cycles is not None and not whole:
        raise ExperimentError(
            "cycles is not acceptable",
            seen=repr(cycles),
            allowed="a whole number >= 1, or None for all cycles of a record",
            cure="give cycles=2, for instance",
        )
    unit = _same_unit(records, channel)
    pieces = [piece for one in records for piece in _pieces(one, channel, theta, length, cycles)]
    asked = _asked(orders, pieces, length)
    found = [piece.fitted(asked, length) for piece in pieces]
    parts = np.array([one for one, _ in found])
    return Orders(
        channel,
        unit,
        asked,
        rpm=np.array([piece.rpm for piece in pieces]),
        time=np.array([piece.middle for piece in pieces]),
        records=tuple(piece.record for piece in pieces),
        amplitude=np.abs(parts),
        phase=np.angle(parts),
        stderr=np.array([error for _, error in found]),
    )


@dataclass(frozen=True, eq=False)
class _Piece:
    """Whole engine cycles of one channel: samples by crank angle [rad], mean speed [RPM], middle [s]."""

    record: str
    angle: FloatArray
    values: FloatArray
    revolutions: float
    rpm: float
    middle: float

    def fitted(self, asked: FloatArray, length: float) -> tuple[NDArray[np.complex128], FloatArray]:
        """Complex amplitudes (K,) of the orders asked for, and their standard errors (K,)."""
        base = 2 * math.pi / length
        if not self.tells(float(asked[-1]), base):
            raise _coarse(self, f"order {asked[-1]:g}", base)
        # Orders that nobody asked for are fitted as well: over cycles that the samples do not quite fill they would
        # leak into those that were.
        top = max(float(asked[-1]), HIGHEST if self.tells(HIGHEST, base) else 0.0)
        count = math.floor(top / base + 1e-6)
        turn = np.exp(1j * base * self.angle)[:, None]
        turns = np.cumprod(np.broadcast_to(turn, (turn.size, count)), axis=1)
        trend = (self.angle - self.angle.mean()) / np.ptp(self.angle)
        basis = np.column_stack([np.ones_like(trend), trend, turns.real, turns.imag])
        # Samples count by the angle that they stand for: sums are then integrals over the crank angle.
        weight = np.gradient(self.angle)[:, None] / np.ptp(self.angle)
        strength, directions = np.linalg.eigh(basis.T @ (weight * basis))
        if strength[0] < WEAKEST * strength[-1]:
            raise _coarse(self, f"{count} orders where samples are missing", base)
        solve = directions / strength @ directions.T @ (weight * basis).T
        found = solve @ self.values
        noise = float(np.sum((self.values - basis @ found) ** 2)) / (self.values.size - basis.shape[1])
        variance = noise * np.sum(solve**2, axis=1)
        at = np.rint(asked / base).astype(int) + 1
        error = np.sqrt((variance[at] + variance[at + count]) / 2)
        return found[at] - 1j * found[at + count], error

    def tells(self, order: float, base: float) -> bool:
        """True if there are samples enough for all multiples of ``base`` up to an order."""
        fine = self.angle.size > 2 * order * self.revolutions
        return fine and self.angle.size >= 4 * (round(order / base) + 1)


def _pieces(record: Experiment, channel: str, theta: str, length: float, cycles: int | None) -> list[_Piece]:
    """The record's whole cycles, in lots of as many as asked for."""
    if theta not in record:
        raise ExperimentError(
            f"experiment {record.name!r} has no crank angle",
            seen=", ".join(record.names),
            allowed=f"a channel {theta!r} [rad], unwrapped",
            cure="name the angle by theta=, or add it by with_channel",
        )
    time, angle = crank_angle(record, theta)
    low, high = whole_cycles(angle, cycle_length=length, tdc=0.0)
    held = max(high - low + 1, 0)
    lot = held if cycles is None else int(cycles)
    if not 1 <= lot <= held:
        raise ExperimentError(
            f"the record {record.name!r} is too short for an order analysis",
            seen=f"{held} whole engine cycles of {length:.4g} rad",
            allowed=f"{lot or 1} or more",
            cure="give a longer record" if not held else f"give cycles={held} at most",
        )
    starts = low - 1 + np.arange(0, held - lot + 1, lot)
    return [_cut(record, record[channel], time, angle, k * length, (k + lot) * length) for k in starts]


def _cut(
    record: Experiment, channel: Channel, time: FloatArray, angle: FloatArray, first: float, last: float
) -> _Piece:
    start, stop = crossing(first, time, angle), crossing(last, time, angle)
    inside = channel.mask & (channel.time >= start) & (channel.time < stop)
    turned = float(np.interp(stop, time, angle) - np.interp(start, time, angle))
    return _Piece(
        record.name,
        angle=np.interp(channel.time[inside], time, angle),
        values=channel.values[inside],
        revolutions=turned / (2 * math.pi),
        rpm=turned / (stop - start) * 30 / math.pi,
        middle=(start + stop) / 2,
    )


def _same_unit(records: Sequence[Experiment], channel: str) -> str:
    units = {one[channel].unit for one in records}
    if len(units) > 1:
        raise ExperimentError(
            f"the channel {channel!r} has different units in these records",
            seen=", ".join(sorted(units)),
            allowed="one unit",
            cure="convert them by in_units",
        )
    return units.pop()


def _asked(orders: Iterable[float] | None, pieces: Sequence[_Piece], length: float) -> FloatArray:
    """(K,) the orders asked for, rising; checked against one per cycle."""
    base = 2 * math.pi / length
    if orders is None:
        finest = min(piece.angle.size / piece.revolutions for piece in pieces)
        most = min(HIGHEST, 0.4 * finest, *(base * (piece.angle.size / 4 - 1) for piece in pieces))
        if most < base:
            raise _coarse(min(pieces, key=lambda piece: piece.angle.size), "any order", base)
        return np.asarray(base * np.arange(1, math.floor(most / base + 1e-9) + 1), dtype=np.float64)
    try:
        asked = np.unique(np.array([finite(one, "an order") for one in orders], dtype=float))
    except TypeError:
        asked = np.zeros(0)
    share = asked / base
    if not asked.size or asked[0] <= 0 or np.abs(share - np.rint(share)).max() > 1e-6:
        raise ExperimentError(
            "the orders are not acceptable",
            seen=repr(orders),
            allowed=f"numbers > 0, multiples of {base:.4g} (one per engine cycle)",
            cure="give orders=(0.5, 1, 2), for instance, or leave it out",
        )
    return asked


def _coarse(piece: _Piece, what: str, base: float) -> ExperimentError:
    return ExperimentError(
        f"the record {piece.record!r} has too few samples for {what}",
        seen=f"{piece.angle.size} valid samples in {piece.revolutions:.3g} revolutions",
        allowed=f"more than two for each turn of the highest order, and four for each multiple of {base:.3g} up to it",
        cure="ask for lower orders, or for more cycles in a row",
    )
