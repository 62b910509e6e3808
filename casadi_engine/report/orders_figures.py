"""Figures of an order analysis: amplitudes over order or over engine speed, the map of both, phases."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from casadi_engine.experiment import Orders
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Curves that can still be told apart.
CURVES = 6


@figures.register
def _(result: Orders) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _overview(result)}
    if len(result.rpm) > 1:
        made["phase"] = lambda: _phases(result)
    return made


def _overview(result: Orders) -> Figure:
    """Over order alone for one row; over speed and as a map for several."""
    several = len(result.rpm) > 1
    figure = _new(10 if several else 7, 3.6)
    if not several:
        _draw_bars(figure.subplots(), result)
        return figure
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1))
    _draw_amplitudes(left, result)
    _draw_map(right, result)
    return figure


def _draw_bars(ax: Axes, result: Orders) -> None:
    size, error = result.amplitude[0], result.stderr[0]
    floor = max(0.5 * float(size.min()), 1e-9 * float(size.max())) or 1e-12
    ax.vlines(result.orders, floor, np.maximum(size, floor), color=panels.SIMULATED, linewidth=3)
    ax.plot(result.orders, 2 * error, color=panels.PREDICTED, linewidth=1, label="two standard errors")
    ax.set_yscale("log")
    title = f"{result.records[0]}: {result.channel} at {result.rpm[0]:.0f} RPM"
    panels.dress(ax, x="engine order [1]", y=f"amplitude [{result.unit}]", title=title)
    ax.legend(frameon=False)


def _strongest(result: Orders) -> list[int]:
    return sorted(np.argsort(-np.sqrt(np.mean(result.amplitude**2, axis=0)))[:CURVES].tolist())


def _draw_amplitudes(ax: Axes, result: Orders) -> None:
    rise = np.argsort(result.rpm, kind="stable")
    for k, colour in zip(_strongest(result), panels.OPTIMA, strict=False):
        mark = "o-" if len(rise) < 60 else "-"
        label = f"order {result.orders[k]:g}"
        ax.plot(result.rpm[rise], result.amplitude[rise, k], mark, color=colour, markersize=3, label=label)
    ax.set_yscale("log")
    title = f"{result.channel}: strongest orders over engine speed"
    panels.dress(ax, x="engine speed [RPM]", y=f"amplitude [{result.unit}]", title=title)
    ax.legend(frameon=False, ncols=2)


def _draw_map(ax: Axes, result: Orders) -> None:
    from matplotlib.colors import LogNorm

    top = float(result.amplitude.max())
    norm = LogNorm(vmin=max(float(np.median(result.stderr)), 1e-5 * top) or 1.0, vmax=top or 10.0)
    hz = result.frequency_hz
    speed = np.broadcast_to(result.rpm[:, None], hz.shape)
    shown = ax.scatter(
        speed, hz, c=np.maximum(result.amplitude, norm.vmin or 0), norm=norm, s=14, cmap="viridis"
    )
    ax.figure.colorbar(shown, ax=ax, label=f"amplitude [{result.unit}]")
    panels.dress(
        ax, x="engine speed [RPM]", y="frequency [Hz]", title="all orders; a resonance is a level line"
    )


def _phases(result: Orders) -> Figure:
    figure = _new(8, 3.4)
    ax = figure.subplots()
    rise = np.argsort(result.rpm, kind="stable")
    for k, colour in zip(_strongest(result), panels.OPTIMA, strict=False):
        turned = np.degrees(np.unwrap(result.phase[rise, k]))
        ax.plot(
            result.rpm[rise], turned, "o-", color=colour, markersize=3, label=f"order {result.orders[k]:g}"
        )
    panels.dress(
        ax, x="engine speed [RPM]", y="phase [deg]", title=f"{result.channel}: phase against the crank"
    )
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _new(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
