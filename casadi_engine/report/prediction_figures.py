"""Figures of a simulation with bands."""

from __future__ import annotations

from functools import partial

from casadi_engine.estimation.prediction import Prediction
from casadi_engine.report import panels
from casadi_engine.report.figures import OVERVIEW, Maker, figures
from casadi_engine.report.sketch import Panel, Sketch

# The band of the model is drawn over that with the noise.
MODEL = "#7fb0d8"


@figures.register
def _(result: Prediction) -> dict[str, Maker]:
    made: dict[str, Maker] = {"overview": partial(_drawn, result, tuple(result.bands)[:OVERVIEW])}
    made |= {f"output {name}": partial(_drawn, result, (name,)) for name in result.bands}
    return made


def _drawn(result: Prediction, names: tuple[str, ...]) -> Sketch:
    sketch = Sketch(9, 0.8 + 2.2 * len(names), (len(names), 1), key=True)
    for row, name in enumerate(names):
        _draw_band(sketch.panel(row), result, name)
    return sketch


def _draw_band(panel: Panel, result: Prediction, name: str) -> None:
    """The simulated output in its band, in that with the noise, and what was measured."""
    band = result.bands[name]
    panel.fill_between(
        band.time, band.low_noise, band.high_noise, color=panels.BAND, linewidth=0, label="95 % with noise"
    )
    panel.fill_between(band.time, band.low, band.high, color=MODEL, linewidth=0, label="95 % of the model")
    if name in result.data:
        measured = result.data[name]
        panel.plot(
            measured.time, measured.values, ".", color=panels.MEASURED, markersize=1.5, label="measured"
        )
    panel.plot(band.time, band.value, color=panels.SIMULATED, linewidth=0.9, label="simulated")
    panels.dress(panel, x="time [s]", y=f"{name} [{band.unit}]", title=f"{result.simulated.name}: {name}")
    panel.margin = 0.01
