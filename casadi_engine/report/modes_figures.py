"""Figures of modes and of reductions: mode shapes, receptances of the full and of the lumped model, their limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from casadi_engine.model import Modes, Reduction
from casadi_engine.report import panels
from casadi_engine.report.figures import Maker, figures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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


def _shapes(modes: Modes, which: Sequence[int]) -> Figure:
    """A row for each mode: how the speeds swing, and how much each coupling twists."""
    figure = _new(9, 0.7 + 1.25 * len(which))
    turning = bool(modes.displacements.any())
    axes = figure.subplots(len(which), 2 if turning else 1, squeeze=False, sharex="col")
    speeds = np.flatnonzero(~modes.displacements)
    for row, k in zip(axes, which, strict=True):
        last = k == which[-1]
        number, hz, damping = modes.numbers[k], modes.frequencies_hz[k], modes.damping_ratios[k]
        name = f"mode {number}" if number else "aperiodic mode"
        _draw_swing(row[0], _in_phase(modes.shapes[speeds, k]), [modes.states[i] for i in speeds], last=last)
        row[0].set_title(f"{name}: {hz:.4g} Hz, damping ratio {damping:.3g}", loc="left")
        if turning:
            names = [name for name, take in zip(modes.states, modes.displacements, strict=True) if take]
            _draw_deformation(row[1], modes.deformations[:, k], names, last=last)
    return figure


def _in_phase(shape: NDArray[np.complex128]) -> NDArray[np.float64]:
    """The swing at the moment at which its largest part is largest, that part 1."""
    largest = shape[int(np.argmax(np.abs(shape)))]
    return np.real(shape / largest) if largest else np.real(shape)


def _draw_swing(ax: Axes, swing: NDArray[np.float64], names: Sequence[str], *, last: bool) -> None:
    at = np.arange(len(swing))
    ax.axhline(0.0, color="0.6", linewidth=0.6)
    ax.plot(at, swing, "o-", color=panels.SIMULATED, markersize=4, linewidth=1.1)
    panels.dress(ax, x="speed" if last else "", y="share [1]")
    _name_ticks(ax, at, names)
    ax.set_ylim(-1.2, 1.2)


def _draw_deformation(ax: Axes, values: NDArray[np.float64], names: Sequence[str], *, last: bool) -> None:
    at = np.arange(len(values))
    ax.bar(at, values, width=0.6, color=panels.PREDICTED)
    for x, value in enumerate(values.tolist()):
        ax.text(x, value + 0.03, f"{value:.4f}", ha="center", fontsize=6.5 if len(at) < 9 else 5)
    panels.dress(ax, x="displacement" if last else "", y="|share| [1]")
    _name_ticks(ax, at, names)
    ax.set_ylim(0, 1.25)


def _name_ticks(ax: Axes, at: NDArray[np.int_], names: Sequence[str]) -> None:
    ax.set_xticks(at, names, rotation=35 if len(names) > 5 else 0, ha="right" if len(names) > 5 else "center")
    ax.tick_params(axis="x", labelsize=7)


def _damping(modes: Modes) -> Figure:
    figure = _new(7, 3.2)
    ax = figure.subplots()
    swings = [k for k, number in enumerate(modes.numbers) if number]
    hz, ratios = modes.frequencies_hz[swings], modes.damping_ratios[swings]
    if not swings:
        panels.note(ax, "there is no oscillatory mode")
        ax.set_ylabel("damping ratio [1]")
        return figure
    ax.vlines(hz, np.minimum(ratios, 0.0), ratios, color=panels.SIMULATED, linewidth=1.2)
    ax.plot(hz, ratios, "o", color=panels.SIMULATED, markersize=5)
    for x, y, k in zip(hz, ratios, swings, strict=True):
        ax.annotate(f" {modes.numbers[k]}", (x, y), fontsize=8)
    ax.set_ylim(min(0.0, 1.2 * float(ratios.min())), 1.2 * max(float(ratios.max()), 1e-3))
    panels.dress(
        ax, x="natural frequency |λ|/2π [Hz]", y="damping ratio [1]", title="oscillatory modes by number"
    )
    return figure


# ---- reductions


def _receptances(result: Reduction) -> Figure:
    """Amplitudes of both models above, the relative error over all outputs and torques below."""
    names = [result.exact.torques[0], result.exact.torques[-1]][: min(CURVES, len(result.exact.torques))]
    outputs = result.exact.outputs
    figure = _new(8, 2.0 + 2.3 * len(outputs))
    axes = figure.subplots(
        len(outputs) + 1, 1, squeeze=False, sharex=True, height_ratios=[1.5] * len(outputs) + [1]
    )[:, 0]
    for row, output in enumerate(outputs):
        _draw_amplitudes(axes[row], result, row, names)
        unit = result.exact.units[row]
        title = (
            f"{output} over torques: {_inertias(len(result.steps))}, lumped to {result.dof}"
            if row == 0
            else output
        )
        panels.dress(axes[row], x="", y=f"|{output}| [{_over_torque(unit)}]", title=title)
    axes[0].legend(frameon=False, fontsize=8)
    _draw_error(axes[-1], result)
    for ax in axes:
        ax.axvspan(result.exact.hz[0], result.up_to_hz, color=panels.BAND, linewidth=0, zorder=0)
        ax.set_xlim(result.exact.hz[0], result.exact.hz[-1])
    return figure


def _draw_amplitudes(ax: Axes, result: Reduction, row: int, names: Sequence[str]) -> None:
    hz = result.exact.hz
    for name, color in zip(names, (panels.SIMULATED, panels.PREDICTED), strict=False):
        column = result.exact.torques.index(name)
        ax.loglog(
            hz, np.abs(result.exact.values[:, row, column]), color=color, linewidth=1.3, label=f"{name}, full"
        )
        lumped = np.abs(result.lumped.values[:, row, column])
        ax.loglog(hz, lumped, color=color, linewidth=1.1, linestyle="--", label=f"{name}, lumped")


def _draw_error(ax: Axes, result: Reduction) -> None:
    error = 100 * result.exact.error(result.lumped)
    ax.loglog(result.exact.hz, np.maximum(error, 1e-3), color="black", linewidth=1.1)
    limit = result.limit_hz
    ax.axhline(100 * result.within, color=panels.PREDICTED, linewidth=0.9, linestyle="--")
    words = "at any frequency" if not math.isfinite(limit) else f"up to {limit:.3g} Hz"
    title = f"within {100 * result.within:g} % {words}; {100 * result.error:.3g} % in the range shaded"
    panels.dress(ax, x="frequency [Hz]", y="error [%]", title=title)
    ax.set_ylim(bottom=1e-2)


def _steps(result: Reduction) -> Figure:
    """Up to which frequency each number of inertias is within the allowed error."""
    figure = _new(8, 1.3 + 0.36 * len(result.steps))
    ax = figure.subplots()
    top = float(result.exact.hz[-1])
    for at, step in enumerate(result.steps):
        end = min(step.limit_hz, top)
        chosen = step.dof == result.dof and step.rigid == result.rigid
        ax.barh(at, end, color=panels.SIMULATED if chosen else "0.7", height=0.6)
        words = "any frequency" if not math.isfinite(step.limit_hz) else f"{step.limit_hz:.3g} Hz"
        if len(step.groups) <= NAMED:
            words += f"  ({', '.join(step.groups)})"
        white = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
        ax.annotate(words, (end, at), (3, 0), textcoords="offset points", va="center", fontsize=7, bbox=white)
    ax.axvline(
        result.up_to_hz,
        color=panels.PREDICTED,
        linewidth=1,
        linestyle="--",
        label=f"{result.up_to_hz:.4g} Hz",
    )
    ax.set_yticks(range(len(result.steps)), [_inertias(step.dof) for step in result.steps])
    ax.set_xscale("log")
    ax.set_xlim(float(result.exact.hz[0]), 30 * top)
    ax.invert_yaxis()
    panels.dress(
        ax, x="frequency [Hz]", y="", title=f"receptances within {100 * result.within:g} % of the full model"
    )
    ax.legend(frameon=False, loc="lower right")
    return figure


def _frequencies(result: Reduction) -> Figure:
    figure = _new(7, 3.0)
    ax = figure.subplots()
    numbers = np.arange(1, len(result.frequencies) + 1)
    if not len(numbers):
        panels.note(ax, "there is no oscillatory mode")
    both = np.array(
        [[one, math.nan if other is None else other] for one, other in result.frequencies]
    ).reshape(-1, 2)
    ax.semilogy(
        numbers, both[:, 0], "o", color=panels.SIMULATED, markersize=7, fillstyle="none", label="full"
    )
    ax.semilogy(numbers, both[:, 1], "x", color=panels.PREDICTED, markersize=6, label="lumped")
    ax.set_xticks(numbers)
    panels.dress(ax, x="mode [number]", y="natural frequency [Hz]")
    if len(numbers):
        ax.legend(frameon=False, loc="upper left")
    return figure


def _inertias(count: int) -> str:
    return f"{count} inertia{'s' * (count != 1)}"


def _over_torque(unit: str) -> str:
    return f"{unit}/(N m)" if "/" not in unit else f"({unit})/(N m)"


def _new(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
