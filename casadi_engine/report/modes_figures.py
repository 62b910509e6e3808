"""Figures of modes and of reductions: mode shapes, receptances of the full and of the lumped model, their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Modes, Reduction
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, figures
from casadi_engine.report.sketch import Panel, Sketch

# Modes drawn in one figure; a figure for each further lot.
LOT = 7
# Torques whose receptances are drawn: more curves cannot be told apart.
CURVES = 2
# More inertias than this are not listed in a figure; `print(reduction)` does.
NAMED = 9


@figures.register
def _(result: Modes) -> dict[str, Maker]:
    which = [k for k, number in enumerate(result.numbers) if number] or list(range(len(result.numbers)))
    lots = [which[at : at + LOT] for at in range(0, len(which), LOT)]
    made: dict[str, Maker] = {"overview": lambda: _shapes(result, lots[0])}
    for lot in lots[1:]:
        first, last = (result.numbers[k] for k in (lot[0], lot[-1]))
        made[f"modes {first} to {last}"] = partial(_shapes, result, lot)
    made["damping"] = lambda: _damping(result)
    return made


@figures.register
def _(result: Reduction) -> dict[str, Maker]:
    return {
        "overview": lambda: _receptances(result),
        "degrees of freedom": lambda: _steps(result),
        "frequencies": lambda: _frequencies(result),
    }


# ---- modes


def _shapes(modes: Modes, which: Sequence[int]) -> Sketch:
    """A row for each mode: how the speeds swing, and how much each coupling twists."""
    turning = bool(modes.displacements.any())
    sketch = Sketch(9, 0.7 + 1.25 * len(which), (len(which), 2 if turning else 1))
    cells = sketch.cells()
    speeds = np.flatnonzero(~modes.displacements)
    for k in which:
        last = k == which[-1]
        number, hz, damping = modes.numbers[k], modes.frequencies_hz[k], modes.damping_ratios[k]
        name = f"mode {number}" if number else "aperiodic mode"
        swing = next(cells)
        _draw_swing(swing, _in_phase(modes.shapes[speeds, k]), [modes.states[i] for i in speeds], last=last)
        swing.title = f"{name}: {hz:.4g} Hz, damping ratio {damping:.3g}"
        if turning:
            names = [name for name, take in zip(modes.states, modes.displacements, strict=True) if take]
            _draw_deformation(next(cells), modes.deformations[:, k], names, last=last)
    return sketch


def _in_phase(shape: NDArray[np.complex128]) -> NDArray[np.float64]:
    """The swing at the moment at which its largest part is largest, that part 1."""
    largest = shape[int(np.argmax(np.abs(shape)))]
    return np.real(shape / largest) if largest else np.real(shape)


def _draw_swing(panel: Panel, swing: NDArray[np.float64], names: Sequence[str], *, last: bool) -> None:
    at = range(len(swing))
    panel.axhline(0.0, color="0.6", linewidth=0.6)
    panel.plot(at, swing, "o-", color=panels.SIMULATED, markersize=4, linewidth=1.1)
    panels.dress(panel, x="speed" if last else "", y="share [1]")
    panel.xnames, panel.ylim = (at, names), (-1.2, 1.2)


def _draw_deformation(panel: Panel, values: NDArray[np.float64], names: Sequence[str], *, last: bool) -> None:
    at = range(len(values))
    panel.bar(at, values, 0.6, color=panels.PREDICTED)
    for x, value in enumerate(values.tolist()):
        panel.write(f"{value:.4f}", x, value + 0.03, ha="center", size=6.5 if len(at) < 9 else 5)
    panels.dress(panel, x="displacement" if last else "", y="|share| [1]")
    panel.xnames, panel.ylim = (at, names), (0, 1.25)


def _damping(modes: Modes) -> Sketch:
    sketch = Sketch(7, 3.2)
    panel = sketch.panel()
    title = "oscillatory modes by number"
    panels.dress(panel, x="natural frequency |λ|/2π [Hz]", y="damping ratio [1]", title=title)
    swings = [k for k, number in enumerate(modes.numbers) if number]
    if not swings:
        panel.note = "there is no oscillatory mode"
        return sketch
    hz, ratios = modes.frequencies_hz[swings], modes.damping_ratios[swings]
    panel.vlines(hz, np.minimum(ratios, 0.0), ratios, color=panels.SIMULATED, linewidth=1.2)
    panel.plot(hz, ratios, "o", color=panels.SIMULATED, markersize=5)
    for x, y, k in zip(hz, ratios, swings, strict=True):
        panel.write(f" {modes.numbers[k]}", x, y)
    panel.ylim = (min(0.0, 1.2 * float(ratios.min())), 1.2 * max(float(ratios.max()), 1e-3))
    return sketch


# ---- reductions


def _receptances(result: Reduction) -> Sketch:
    """Amplitudes of both models above, the relative error over all outputs and torques below."""
    names = [result.exact.torques[0], result.exact.torques[-1]][: min(CURVES, len(result.exact.torques))]
    outputs = result.exact.outputs
    rows = len(outputs) + 1
    sketch = Sketch(8, 2.0 + 2.3 * len(outputs), (rows, 1), down=[1.5] * len(outputs) + [1])
    *amplitudes, error = sketch.cells()
    for row, (panel, output) in enumerate(zip(amplitudes, outputs, strict=True)):
        _draw_amplitudes(panel, result, row, names)
        title = f"{output} over torques: {_inertias(len(result.steps))}, lumped to {result.dof}"
        words = f"|{output}| [{_over_torque(result.exact.units[row])}]"
        panels.dress(panel, x="", y=words, title=title if row == 0 else output)
    amplitudes[0].key = "best"
    _draw_error(error, result)
    for panel in sketch.panels:
        panel.xscale = panel.yscale = "log"
        panel.axvspan(result.exact.hz[0], result.up_to_hz, color=panels.BAND, linewidth=0, zorder=0)
        panel.xlim = (result.exact.hz[0], result.exact.hz[-1])
    return sketch


def _draw_amplitudes(panel: Panel, result: Reduction, row: int, names: Sequence[str]) -> None:
    hz = result.exact.hz
    for name, color in zip(names, (panels.SIMULATED, panels.PREDICTED), strict=False):
        column = result.exact.torques.index(name)
        full, lumped = (np.abs(one.values[:, row, column]) for one in (result.exact, result.lumped))
        panel.plot(hz, full, color=color, linewidth=1.3, label=f"{name}, full")
        panel.plot(hz, lumped, color=color, linewidth=1.1, linestyle="--", label=f"{name}, lumped")


def _draw_error(panel: Panel, result: Reduction) -> None:
    error = 100 * result.exact.error(result.lumped)
    panel.plot(result.exact.hz, np.maximum(error, 1e-3), color="black", linewidth=1.1)
    limit = result.limit_hz
    panel.axhline(100 * result.within, color=panels.PREDICTED, linewidth=0.9, linestyle="--")
    words = "at any frequency" if not math.isfinite(limit) else f"up to {limit:.3g} Hz"
    title = f"within {100 * result.within:g} % {words}; {100 * result.error:.3g} % in the range shaded"
    panels.dress(panel, x="frequency [Hz]", y="error [%]", title=title)
    panel.ylim = (1e-2, None)


def _steps(result: Reduction) -> Sketch:
    """Up to which frequency each number of inertias is within the allowed error."""
    sketch = Sketch(8, 1.3 + 0.36 * len(result.steps))
    panel = sketch.panel()
    top = float(result.exact.hz[-1])
    for at, step in enumerate(result.steps):
        end = min(step.limit_hz, top)
        chosen = step.dof == result.dof and step.rigid == result.rigid
        panel.barh(at, end, 0.6, color=panels.SIMULATED if chosen else "0.7")
        words = "any frequency" if not math.isfinite(step.limit_hz) else f"{step.limit_hz:.3g} Hz"
        if len(step.groups) <= NAMED:
            words += f"  ({', '.join(step.groups)})"
        panel.write(words, end, at, shift=(3, 0), va="center", size=7, clear=True)
    hz = f"{result.up_to_hz:.4g} Hz"
    panel.axvline(result.up_to_hz, color=panels.PREDICTED, linewidth=1, linestyle="--", label=hz)
    panel.ynames = (range(len(result.steps)), [_inertias(step.dof) for step in result.steps])
    panel.xscale, panel.xlim, panel.flipped = "log", (float(result.exact.hz[0]), 30 * top), True
    panel.key = "lower right"
    title = f"receptances within {100 * result.within:g} % of the full model"
    panels.dress(panel, x="frequency [Hz]", y="", title=title)
    return sketch


def _frequencies(result: Reduction) -> Sketch:
    sketch = Sketch(7, 3.0)
    panel = sketch.panel()
    panels.dress(panel, x="mode [number]", y="natural frequency [Hz]")
    numbers = range(1, len(result.frequencies) + 1)
    if not numbers:
        panel.note = "there is no oscillatory mode"
        return sketch
    full, lumped = zip(*result.frequencies, strict=True)
    panel.yscale, panel.xticks, panel.key = "log", numbers, "upper left"
    style = {"color": panels.SIMULATED, "markersize": 7, "markerfacecolor": "none", "label": "full"}
    panel.plot(numbers, full, "o", **style)
    panel.plot(numbers, lumped, "x", color=panels.PREDICTED, markersize=6, label="lumped")
    return sketch


def _inertias(count: int) -> str:
    return f"{count} inertia{'s' * (count != 1)}"


def _over_torque(unit: str) -> str:
    return f"{unit}/(N m)" if "/" not in unit else f"({unit})/(N m)"
