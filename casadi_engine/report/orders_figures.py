"""Figures of an order analysis: amplitudes over order or over engine speed, the map of both, phases."""

from __future__ import annotations

import numpy as np

from casadi_engine.experiment import Orders
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, figures
from casadi_engine.report.sketch import Panel, Sketch

# Curves that can still be told apart.
CURVES = 6
# Colours of the map from weak to strong, each for so many times the amplitude of the one before.
SHADES = ("#440154", "#414487", "#2a788e", "#22a884", "#7ad151", "#fde725")


@figures.register
def _(result: Orders) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": lambda: _overview(result)}
    if len(result.rpm) > 1:
        made["phase"] = lambda: _phases(result)
    return made


def _overview(result: Orders) -> Sketch:
    """Over order alone for one row; over speed and as a map for several."""
    if len(result.rpm) == 1:
        sketch = Sketch(7, 3.6)
        _draw_bars(sketch.panel(), result)
        return sketch
    sketch = Sketch(10, 3.6, (1, 2), across=(1.2, 1))
    _draw_amplitudes(sketch.panel(0, 0), result)
    _draw_map(sketch.panel(0, 1), result)
    return sketch


def _draw_bars(panel: Panel, result: Orders) -> None:
    size, error = result.amplitude[0], result.stderr[0]
    floor = max(0.5 * float(size.min()), 1e-9 * float(size.max())) or 1e-12
    panel.vlines(result.orders, floor, np.maximum(size, floor), color=panels.SIMULATED, linewidth=3)
    panel.plot(result.orders, 2 * error, color=panels.PREDICTED, linewidth=1, label="two standard errors")
    panel.yscale, panel.key = "log", "best"
    title = f"{result.records[0]}: {result.channel} at {result.rpm[0]:.0f} RPM"
    panels.dress(panel, x="engine order [1]", y=f"amplitude [{result.unit}]", title=title)


def _strongest(result: Orders) -> list[int]:
    return sorted(np.argsort(-np.sqrt(np.mean(result.amplitude**2, axis=0)))[:CURVES].tolist())


def _draw_amplitudes(panel: Panel, result: Orders) -> None:
    rise = np.argsort(result.rpm, kind="stable")
    for k, colour in zip(_strongest(result), panels.OPTIMA, strict=False):
        mark = "o-" if len(rise) < 60 else "-"
        label = f"order {result.orders[k]:g}"
        panel.plot(result.rpm[rise], result.amplitude[rise, k], mark, color=colour, markersize=3, label=label)
    panel.yscale, panel.key = "log", "center left"
    title = f"{result.channel}: strongest orders over engine speed"
    panels.dress(panel, x="engine speed [RPM]", y=f"amplitude [{result.unit}]", title=title)


def _draw_map(panel: Panel, result: Orders) -> None:
    """A point for each order at each speed, its colour by the amplitude; the weak ones first."""
    top = float(result.amplitude.max()) or 1.0
    low = max(float(np.median(result.stderr)), 1e-5 * top) or 1e-5
    share = np.log(np.maximum(result.amplitude, low) / low) / max(np.log(top / low), 1e-12)
    shade = np.minimum((share * len(SHADES)).astype(int), len(SHADES) - 1)
    hz = result.frequency_hz
    speed = np.broadcast_to(result.rpm[:, None], hz.shape)
    for k, colour in enumerate(SHADES):
        own = shade == k
        if own.any():
            least = low * (top / low) ** (k / len(SHADES))
            panel.plot(speed[own], hz[own], "o", color=colour, markersize=4, label=f"from {least:.1g}")
    panel.key = "upper left"
    title = f"all orders, amplitude [{result.unit}]; a resonance is a level line"
    panels.dress(panel, x="engine speed [RPM]", y="frequency [Hz]", title=title)


def _phases(result: Orders) -> Sketch:
    sketch = Sketch(8, 3.4)
    panel = sketch.panel()
    rise = np.argsort(result.rpm, kind="stable")
    for k, colour in zip(_strongest(result), panels.OPTIMA, strict=False):
        turned = np.degrees(np.unwrap(result.phase[rise, k]))
        panel.plot(
            result.rpm[rise], turned, "o-", color=colour, markersize=3, label=f"order {result.orders[k]:g}"
        )
    panel.key = "best"
    title = f"{result.channel}: phase against the crank"
    panels.dress(panel, x="engine speed [RPM]", y="phase [deg]", title=title)
    return sketch
