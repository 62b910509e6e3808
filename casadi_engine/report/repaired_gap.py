"""The gap between simulation and measurement, before a repair and after it: one record, one panel each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from casadi_engine.discrepancy.clocks import SECONDS, Clock, clock_of
from casadi_engine.discrepancy.repaired import Repair, Side
from casadi_engine.estimation.fit import Trace
from casadi_engine.report import panels
from casadi_engine.report.sketch import Panel

Array = NDArray[np.float64]

BEFORE, AFTER = panels.PREDICTED, panels.SIMULATED
FOUR_STROKE = 4 * math.pi
# A cycle is averaged in pieces of 4 degrees of the crank; a record without crank angle in so many pieces of its time.
ANGLES, PIECES = 180, 120
HIGHEST_ORDER = 16
# |A|^2 of white noise at one order is chi-squared with two degrees of freedom: so much of it is exceeded by 1 %.
_ONE_PERCENT = -2 * math.log(0.01)
_DENSITY_BINS = 60


@dataclass(frozen=True, eq=False)
class Pair:
    """The gap of one output in one record.

    before, after : (N,) measured less simulated, in ``unit``, NaN where a sample does not count
    theta : (N,) rad, or None without a crank angle; sigma : of the noise; fresh : not used to find the repair
    changed : False where nothing was added, and before and after are the same; clock : the unit of the times shown
    """

    record: str
    output: str
    unit: str
    sigma: float
    time: Array
    before: Array
    after: Array
    theta: Array | None
    fresh: bool
    changed: bool
    clock: Clock = SECONDS

    @property
    def title(self) -> str:
        return f"{self.record}{' (fresh)' if self.fresh else ''}: {self.output}"

    @property
    def cycles(self) -> int:
        """Engine cycles in the record; 0 without a crank angle."""
        return 0 if self.theta is None else max(1, round(float(self.theta[-1] - self.theta[0]) / FOUR_STROKE))

    @property
    def shown(self) -> tuple[tuple[str, str, Array], ...]:
        """(label, colour, residual) of what there is to draw."""
        if not self.changed:
            return (("without any addition", AFTER, self.after),)
        return ("before", BEFORE, self.before), ("after", AFTER, self.after)


def pairs(repair: Repair) -> tuple[Pair, ...]:
    """Every output of every record with its gap before and after, those of the search first."""
    gaps = repair.gaps
    if gaps is None:
        return ()
    made = list(_pairs(repair, gaps.estimation_before, gaps.estimation_after, fresh=False))
    if gaps.validation_before is not None and gaps.validation_after is not None:
        made += _pairs(repair, gaps.validation_before, gaps.validation_after, fresh=True)
    return tuple(made)


def _pairs(repair: Repair, before: Side, after: Side, *, fresh: bool) -> Iterator[Pair]:
    units = {variable.name: variable.unit for variable in repair.model.outputs}
    angles = {one.name: one["theta"] for one in (repair.fresh if fresh else repair.data) if "theta" in one}
    for record, outputs in before.traces.items():
        for output, old in outputs.items():
            new: Trace = after.traces[record][output]
            angle = angles.get(record)
            yield Pair(
                record,
                output,
                units.get(output, "1"),
                noise_level(repair, output),
                old.time,
                old.residual,
                new.residual,
                None if angle is None else np.interp(old.time, angle.time, angle.values),
                fresh,
                bool(repair.effects),
                clock_of(repair.model),
            )


def noise_level(repair: Repair, output: str) -> float:
    """Standard deviation of the noise of an output: that of the score tests, or else of the last fit."""
    known = repair.fit.noise if repair.noise is None else repair.noise.sigma
    return float(known.get(output, (math.nan, False))[0])


# ---- numbers ------------------------------------------------------------------------------------------


def folded(pair: Pair, residual: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Mean of a residual over all cycles by crank angle, or in pieces of the time without a crank angle.

    Returns place (K,) deg or s, mean (K,) in the output's unit, count (K,) of samples; empty pieces are left out.

    >>> import numpy as np
    >>> t = np.arange(8.0)
    >>> pair = Pair("r", "y", "1", 1.0, t, t, t, np.pi * t, False, True)
    >>> place, mean, count = folded(pair, t)
    >>> place, mean, count
    (array([  2., 182., 362., 542.]), array([2., 3., 4., 5.]), array([2, 2, 2, 2]))
    """
    good = np.isfinite(residual)
    if pair.theta is None:
        first, span = float(pair.time[0]), float(pair.time[-1] - pair.time[0]) or 1.0
        share = (pair.time[good] - first) / span
        number, size = np.minimum((share * PIECES).astype(int), PIECES - 1), PIECES
        place = first + (np.arange(size) + 0.5) * span / size
    else:
        share = np.mod(pair.theta[good], FOUR_STROKE) / FOUR_STROKE
        number, size = np.minimum((share * ANGLES + 1e-9).astype(int), ANGLES - 1), ANGLES
        place = (np.arange(size) + 0.5) * 720.0 / size
    count = np.bincount(number, minlength=size)
    total = np.bincount(number, residual[good], minlength=size)
    used = count > 0
    return place[used], total[used] / count[used], count[used]


def order_amplitudes(pair: Pair, residual: Array) -> tuple[Array, Array, float] | None:
    """Engine orders (K,) [per revolution], amplitude of the residual at them (K,), and the level that white noise of
    this size exceeds at 1 % of orders; over whole engine cycles. None without a crank angle or a whole cycle.

    >>> import numpy as np
    >>> theta = np.arange(7200) * 4 * np.pi / 3600
    >>> e = 0.3 * np.cos(2 * theta)
    >>> pair = Pair("r", "y", "rad/s", 0.1, theta, e, e, theta, False, True)
    >>> orders, amplitude, level = order_amplitudes(pair, e)
    >>> float(orders[3]), round(float(amplitude[3]), 9), round(level, 4)
    (2.0, 0.3, 0.0051)
    """
    if pair.theta is None:
        return None
    step = np.median(np.diff(pair.theta))
    whole = math.floor((pair.theta[-1] - pair.theta[0] + step) / FOUR_STROKE + 1e-6)
    if whole < 1:
        return None
    good = np.isfinite(residual) & (pair.theta < pair.theta[0] + whole * FOUR_STROKE - 1e-9)
    theta, e = pair.theta[good], residual[good]
    orders = np.asarray(0.5 * np.arange(1, 2 * HIGHEST_ORDER + 1), dtype=np.float64)
    wave, amplitude = np.exp(-0.5j * theta), np.empty(len(orders))
    power = np.ones_like(wave)
    for k in range(
        len(orders)
    ):  # powers of the first: exponentials of all orders would cost more than the page
        power = power * wave
        amplitude[k] = 2 * abs(power @ e) / len(e)
    return np.asarray(orders), np.asarray(amplitude), pair.sigma * math.sqrt(2 * _ONE_PERCENT / len(e))


def inside_share(pair: Pair, residual: Array) -> float:
    """Share of the samples within two standard deviations of the noise, 0..1."""
    e = residual[np.isfinite(residual)]
    return float(np.mean(np.abs(e) <= 2 * pair.sigma)) if len(e) else math.nan


# ---- panels -------------------------------------------------------------------------------------------


def draw_folded(panel: Panel, pair: Pair) -> None:
    """The gap by crank angle, mean of all cycles, with the band that noise alone would fill."""
    place, _, count = folded(pair, pair.after)
    if not len(count):
        panel.note = "no sample counts"
        return
    clock = pair.clock if pair.theta is None else SECONDS
    band = 2 * pair.sigma / np.sqrt(count)
    words = "±2σ of the noise in this mean"
    panel.fill_between(clock.of(place), -band, band, color=panels.BAND, linewidth=0, label=words)
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    for label, colour, residual in pair.shown:
        where, mean, _ = folded(pair, residual)
        panel.plot(clock.of(where), mean, color=colour, linewidth=1.2, label=label)
    gap = f"{pair.output}: measured − simulated [{pair.unit}]"
    if pair.theta is None:
        panels.dress(panel, x=f"{clock.axis}, mean of pieces", y=gap, title=pair.title)
        return
    words = f"mean of {pair.cycles} cycles" if pair.cycles > 1 else "one cycle"
    panels.dress(panel, x=f"crank angle [deg], {words}", y=gap, title=pair.title)
    panel.xlim, panel.xticks = (0, 720), range(0, 721, 180)


def draw_orders(panel: Panel, pair: Pair) -> None:
    """Amplitude of the gap at the engine orders, before and after, and what noise alone reaches."""
    words = f"amplitude of the gap [{pair.unit}]"
    panels.dress(panel, x="engine order [per revolution]", y=words, title=f"{pair.title}: orders")
    found = order_amplitudes(pair, pair.after)
    if found is None:
        panel.note = "no orders: no crank angle, or less than one engine cycle"
        return
    orders, _, level = found
    shown = pair.shown
    width = 0.42 / len(shown)
    for k, (label, colour, residual) in enumerate(shown):
        amplitude = order_amplitudes(pair, residual)
        assert amplitude is not None
        place = orders + (k - (len(shown) - 1) / 2) * width
        panel.bar(place, amplitude[1], width, color=colour, label=label)
    words = "noise alone exceeds this at 1 % of orders"
    panel.axhline(level, color="black", linewidth=0.9, linestyle="--", label=words)
    panel.xlim = (0, min(HIGHEST_ORDER, 10) + 0.5)


def draw_density(panel: Panel, chosen: tuple[Pair, ...]) -> None:
    """How the residuals are spread in units of the noise, before and after, beside the normal distribution."""
    edges = np.linspace(-5, 5, _DENSITY_BINS + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    normal = np.exp(-0.5 * middle**2) / math.sqrt(2 * math.pi)
    panel.fill_between(middle, normal, color=panels.BAND, linewidth=0, label="noise alone")
    for k, (label, colour, _) in enumerate(chosen[0].shown):
        scaled = np.concatenate([pair.shown[k][2] / pair.sigma for pair in chosen])
        scaled = scaled[np.isfinite(scaled)]
        density = np.histogram(scaled, edges)[0] / (max(len(scaled), 1) * np.diff(edges))
        inside = 100 * float(np.mean(np.abs(scaled) <= 2)) if len(scaled) else math.nan
        words = f"{label}: {inside:.1f} % within ±2σ"
        panel.plot(middle, density, color=colour, linewidth=1.2, label=words)
    words = "residual / σ of the noise [1]"
    if len({pair.sigma for pair in chosen}) == 1:
        words = f"residual / σ of the noise [1], σ = {chosen[0].sigma:.3g} {chosen[0].unit}"
    for edge in (-2, 2):
        panel.axvline(edge, color="0.4", linewidth=0.7, linestyle=":")
    title = "residuals (noise: 95.4 % within ±2σ)"
    panels.dress(panel, x=words, y="probability density [1]", title=title)
    panel.ylim = (0, None)


def draw_course(panel: Panel, pair: Pair, which: int) -> None:
    """One residual over time with the band ±2σ of the noise, and the share of samples inside."""
    label, colour, residual = pair.shown[which]
    panel.axhspan(-2 * pair.sigma, 2 * pair.sigma, color=panels.BAND, linewidth=0)
    panel.plot(pair.clock.of(pair.time), residual, color=colour, linewidth=0.6)
    for edge in (-2 * pair.sigma, 2 * pair.sigma):
        panel.axhline(edge, color="black", linewidth=0.8, linestyle="--", zorder=3)
    share = 100 * inside_share(pair, residual)
    title = f"{pair.title}, {label}: {share:.1f} % inside ±2σ (noise: 95.4 %)"
    panels.dress(panel, x=pair.clock.axis, y=f"residual [{pair.unit}]", title=title)
    panel.linked, panel.margin = pair.title, 0.01


def same_height(chosen: list[Panel]) -> None:
    """One vertical scale for panels that are compared: those of one quantity, by the words of their axis."""
    for words in {panel.y for panel in chosen}:
        alike = [panel for panel in chosen if panel.y == words]
        limits = [panel.limits("y") for panel in alike]
        for panel in alike:
            panel.ylim = min(low for low, _ in limits), max(high for _, high in limits)
