"""Static pictures: what stands where, thinned to the pixels, without what a picture cannot show."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import signal

from casadi_engine.report.colours import css, shade
from casadi_engine.report.figures import figures
from casadi_engine.report.sketch import Panel, Sketch, forward
from casadi_engine.report.spectrum import welch
from casadi_engine.report.svg import FINE, svg
from casadi_engine.report.ticks import ticks


def panel(**given):
    return Panel(slice(1), slice(1), **given)


def field(picture):
    """Width and height of the inner field in pixels."""
    return [
        float(one) / FINE for one in re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)" preserve', picture).groups()
    ]


def lines(picture):
    """Points (x, y) of every line of data, in pixels of the field."""
    return [
        np.array([float(one) for one in re.findall(r"-?\d+", path)]).reshape(-1, 2) / FINE
        for path in re.findall(r'<path d="(M[\d\- ]+)" style="fill:none', picture)
    ]


def test_a_line_stands_where_its_numbers_are():
    made = panel(xlim=(0, 10), ylim=(-1, 1))
    made.plot([0, 5, 10], [-1, 0, 1])
    picture = svg(made, 500, 300)
    width, height = field(picture)
    np.testing.assert_allclose(
        lines(picture)[0], [[0, height], [width / 2, height / 2], [width, 0]], atol=0.05
    )


@pytest.mark.parametrize(("scale", "middle"), [("log", 10.0), ("symlog", 1.0)])
def test_bent_axes(scale, middle):
    made = panel(xlim=(1, 100) if scale == "log" else (0, 10), ylim=(0, 1), xscale=scale)
    made.plot([middle, middle], [0, 1])
    picture = svg(made, 500, 300)
    assert lines(picture)[0][0, 0] == pytest.approx(field(picture)[0] / 2, abs=0.06)
    assert np.isnan(forward(-1.0, "log"))


def test_a_flipped_axis_grows_downwards():
    made = panel(xlim=(0, 1), ylim=(0, 1), flipped=True)
    made.plot([0, 1], [0, 1])
    assert lines(svg(made, 300, 300))[0][0].tolist() == [0, 0]


@given(arrays(float, st.integers(1, 5000), elements=st.one_of(st.floats(-1, 1), st.just(np.nan))))
def test_a_long_line_is_thinned_and_keeps_its_extremes(values):
    made = panel(xlim=(0, values.size), ylim=(-1, 1))
    made.plot(np.arange(values.size), values)
    picture = svg(made, 200, 300)
    width, height = field(picture)
    points = lines(picture)
    if not np.isfinite(values).any():
        assert not points or not points[0].size
        return
    (path,) = re.findall(r'<path d="(M[\d\- Mh]+)" style="fill:none', picture)
    numbers = re.findall(r"-?\d+", path.replace("h0", ""))
    shown = np.array([float(one) for one in numbers]).reshape(-1, 2) / FINE
    assert len(shown) <= 2 * width
    ends = (1 - np.array([np.nanmax(values), np.nanmin(values)])) / 2 * height
    np.testing.assert_allclose([shown[:, 1].min(), shown[:, 1].max()], ends, atol=0.051)


def test_missing_samples_are_gaps():
    made = panel()
    made.plot(np.arange(6), [0, 1, np.nan, 2, 3, 4])
    (path,) = re.findall(r'<path d="(M[^"]+)" style="fill:none', svg(made, 300, 200))
    assert path.count("M") == 2


def test_every_figure_is_well_formed_and_has_words(factory, validation, repaired, nothing_missing, unnamed):
    class Reader(HTMLParser):
        def __init__(self):
            super().__init__()
            self.open = []

        def handle_starttag(self, tag, attributes):
            self.open.append(tag)

        def handle_endtag(self, tag):
            assert self.open.pop() == tag

    for result in (factory.fit(predicted=True), validation, repaired, nothing_missing, unnamed):
        for name, make in figures(result).items():
            sketch = make()
            assert isinstance(sketch, Sketch)
            for one in sketch.panels:
                picture = svg(one, 480, 300)
                reader = Reader()
                reader.feed(picture)
                assert not reader.open, name
                assert not re.search(
                    r"\b(nan|inf|None)\b", re.sub(r">[^<]*<|aria-label=\"[^\"]*\"", "", picture)
                ), name
                assert one.note or one.x in picture.replace("&#x27;", "'"), name


def test_words_are_escaped():
    made = panel(title="<b>", x="<script>", note="<i>")
    made.ynames = ([0.0], ["<u>"])
    picture = svg(made, 300, 200)
    assert not re.search("<(b|script|i|u)>", picture)
    assert "&lt;script&gt;" in picture


def test_colours_of_the_page_fit_light_and_dark():
    assert css("#0072B2") == "var(--simulated)"
    assert css("#009E73") == "#009E73"
    assert (shade(-1.0), shade(0.0), shade(1.0)) == ("rgb(33 102 172)", "rgb(247 247 247)", "rgb(178 24 43)")
    assert shade(np.nan) == "var(--band)"


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6), st.integers(2, 12))
def test_ticks_are_few_and_inside(low, width, most):
    found = ticks((low, low + width), most=most)
    assert len(found) <= most + 1
    spare = 1e-6 * (width + abs(low))
    assert all(low - spare <= one <= low + width + spare for one in found)


@pytest.mark.parametrize(("n", "segment"), [(4000, 500), (4001, 333), (300, 300)])
def test_the_spectrum_is_that_of_an_independent_code(n, segment):
    values = np.random.default_rng(n).standard_normal(n)
    frequency, density = welch(values, 100.0, segment)
    expected = signal.welch(values, fs=100.0, nperseg=segment, detrend=False)
    np.testing.assert_allclose(frequency, expected[0])
    np.testing.assert_allclose(density, expected[1], rtol=1e-10)
