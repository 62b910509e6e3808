"""The overview of a repair: one scale for each quantity, each output shown, and words that fit their panels."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from casadi_engine.report import matplotlib_figure, repaired_figures
from casadi_engine.report.repaired_gap import Pair, draw_folded, same_height
from casadi_engine.report.sketch import Sketch


def gap(output, unit, size, *, record="run", fresh=False):
    time = np.linspace(0, 10, 400)
    before = size * np.sin(time)
    return Pair(record, output, unit, 0.05 * size, time, before, 0.1 * before, None, fresh, True)


def overview(repair, pairs, monkeypatch):
    monkeypatch.setattr(repaired_figures, "_last", lambda panel, repair: panel.plot([0, 1], [0, 1]))
    return repaired_figures._overview(repair, tuple(pairs))


def test_outputs_of_different_units_have_scales_of_their_own(monkeypatch):
    pairs = [gap("speed", "rad/s", 100.0), gap("place", "m", 0.01), gap("speed", "rad/s", 150.0, fresh=True)]
    tops = overview(None, pairs, monkeypatch).panels[:3]
    assert [panel.title for panel in tops] == ["run: speed", "run: place", "run (fresh): speed"]
    assert [panel.y.partition("[")[2] for panel in tops] == ["rad/s]", "m]", "rad/s]"]
    speed, place, fresh = (panel.limits("y") for panel in tops)
    assert speed == fresh
    assert speed[1] > 100
    assert place[1] < 0.1


def test_two_quantities_of_one_unit_have_scales_of_their_own():
    sketch = Sketch(8, 3, (1, 2))
    panels = [sketch.panel(0, 0), sketch.panel(0, 1)]
    for panel, pair in zip(panels, (gap("case", "K", 1e-3), gap("winding", "K", 5.0)), strict=True):
        draw_folded(panel, pair)
    same_height(panels)
    assert panels[0].limits("y")[1] < 0.01 < 1 < panels[1].limits("y")[1]


def test_every_output_stands_before_the_second_record_of_one(monkeypatch):
    pairs = [gap("speed", "rad/s", 100.0, record=name) for name in ("first", "second", "third")]
    pairs += [gap("place", "m", 0.01, record="first")]
    titles = [panel.title for panel in overview(None, pairs, monkeypatch).panels[:3]]
    assert titles == ["first: speed", "first: place", "second: speed"]


def test_the_widest_gap_is_that_in_units_of_the_noise():
    loud, quiet = gap("speed", "rad/s", 100.0), gap("place", "m", 0.01)
    loud = replace(loud, sigma=100.0)
    assert repaired_figures._widest([loud, quiet]) is quiet
    assert repaired_figures._widest([quiet, replace(loud, before=np.full(400, np.nan))]) is quiet


@pytest.mark.parametrize(
    "words", ["short", "a name so long that nobody reads it in a panel of this size " * 3]
)
def test_long_words_leave_room_for_the_panels(words):
    sketch = Sketch(11, 6.2, (2, 6))
    top = sketch.panel(0, 0, columns=6)
    top.plot([0, 1], [0, 1], label=words)
    top.key, top.title = "upper right", words
    for column in (0, 2, 4):
        panel = sketch.panel(1, column, columns=2)
        panel.barh(0, 1.0, 0.7, label=words)
        panel.key, panel.title, panel.x, panel.y = "lower right", words, words, "y"
    panel.ynames = (range(2), ["sensor_offset at sensor…", "sensor_delay at sensor…"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = matplotlib_figure.figure_of(sketch)
        matplotlib_figure.drawn(figure, "png")
    assert min(ax.get_position().width for ax in figure.axes) > 0.08
    for ax in figure.axes:
        box = ax.title.get_window_extent()
        longest = max(box.width, ax.get_legend().get_window_extent().width, 1.0)
        assert longest < 11 * figure.dpi * (1.02 if ax is figure.axes[0] else 0.45)
