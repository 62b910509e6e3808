"""The numbers of a page are those of the result, thinned only where a line is longer than a page holds."""

import base64
import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from casadi_engine.report import charts, report
from casadi_engine.report.charts import MOST_POINTS, Numbers, as_json, chart
from casadi_engine.report.sketch import Panel

RECORD = "misfire_1200rpm"


def panel(x, y, fmt="", **style):
    made = Panel(slice(1), slice(1), x="time [s]", y="omega [rad/s]")
    made.plot(x, y, fmt, **style)
    return made


def unpacked(entry):
    """What a browser reads."""
    if isinstance(entry, list):
        return np.linspace(*entry)
    return np.frombuffer(base64.b64decode(entry[1:]), {"4": "<f4", "8": "<f8"}[entry[0]]).astype(float)


def stored(page):
    return [
        json.loads(re.search(f'<script type="application/json" id="{name}">(.*?)</script>', page)[1])
        for name in ("numbers", "charts")
    ]


def test_the_numbers_of_a_page_are_those_of_the_fit(tmp_path, factory):
    fit = factory.fit(samples=9000, predicted=True)
    numbers, found = stored(report(fit, tmp_path / "r.html").read_text(encoding="utf-8"))
    trace = fit.traces[RECORD]["omega"]
    lines = {line["label"]: line for line in found[0]["lines"]}
    assert list(lines) == ["measured", "simulated"]
    np.testing.assert_allclose(unpacked(numbers[lines["measured"]["x"]]), trace.time, rtol=0, atol=1e-9)
    measured = np.where(trace.mask, trace.measured, np.nan)
    np.testing.assert_allclose(unpacked(numbers[lines["measured"]["y"]]), measured, rtol=1e-7)
    np.testing.assert_allclose(unpacked(numbers[lines["simulated"]["y"]]), trace.simulated, rtol=1e-7)
    residual = next(one for one in found if one["y"] == "residual [rad/s]")
    np.testing.assert_allclose(unpacked(numbers[residual["lines"][0]["y"]]), trace.residual, rtol=1e-6)
    assert residual["linked"] == found[0]["linked"] == f"{RECORD}: omega"
    levels = [mark["at"][0] for mark in residual["marks"] if mark["kind"] == "axhline"]
    assert levels == pytest.approx([0.0, 2 * 0.1001, -2 * 0.1001])
    # the same times are stored once
    assert len({line["x"] for one in found if one["linked"] for line in one["lines"]}) == 1


def test_a_long_line_is_thinned_and_the_page_says_so(tmp_path, factory, monkeypatch):
    monkeypatch.setattr(charts, "MOST_POINTS", 1000)
    fit = factory.fit(samples=9000)
    page = report(fit, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "9000 samples, of which the smallest and the largest of each 18 are drawn" in page
    numbers, found = stored(page)
    shown = unpacked(numbers[found[0]["lines"][1]["y"]])
    simulated = fit.traces[RECORD]["omega"].simulated
    assert shown.size == 1000
    assert (shown.max(), shown.min()) == pytest.approx((simulated.max(), simulated.min()), rel=1e-7)


def test_a_record_of_fourteen_thousand_samples_is_whole():
    time = np.arange(14402) / 14402.0
    found, note = chart(panel(time, np.sin(time)), numbers := Numbers())
    assert (note, numbers.entries[found["lines"][0]["x"]][2]) == ("", 14402)
    assert unpacked(numbers.entries[found["lines"][0]["y"]]).size == 14402
    assert MOST_POINTS > 14402


@given(arrays(float, 700, elements=st.one_of(st.floats(-1e6, 1e6), st.just(np.nan))))
def test_thinning_keeps_the_extremes(signal):
    kept, charts.MOST_POINTS = charts.MOST_POINTS, 100
    try:
        found, note = chart(panel(np.arange(700.0), signal), numbers := Numbers())
    finally:
        charts.MOST_POINTS = kept
    shown = unpacked(numbers.entries[found["lines"][0]["y"]])
    assert shown.size <= 100
    assert "of each 14 are drawn" in note
    if np.isfinite(signal).any():
        ends = np.nanmin(signal), np.nanmax(signal)
        assert (np.nanmin(shown), np.nanmax(shown)) == tuple(np.float64(np.float32(end)) for end in ends)


@given(st.floats(-1e3, 1e3), st.floats(1e-6, 1e3), st.integers(3, 500))
def test_evenly_spaced_times_are_their_ends(first, step, n):
    time = first + step * np.arange(n)
    numbers = Numbers()
    np.testing.assert_allclose(
        unpacked(numbers.entries[numbers.add(time, exact=True)]), time, rtol=0, atol=1e-3 * step
    )


def test_uneven_times_keep_their_digits():
    time = np.cumsum(np.linspace(1e-3, 2e-3, 400))
    numbers = Numbers()
    np.testing.assert_array_equal(unpacked(numbers.entries[numbers.add(time, exact=True)]), time)


def test_what_has_nothing_to_zoom_into_stays_a_picture():
    many, few = np.arange(400.0), np.arange(20.0)
    assert chart(panel(many, many), Numbers())[0] is not None
    assert chart(panel(few, few), Numbers())[0] is None
    assert chart(panel(many[::-1], many), Numbers())[0] is None
    named = panel(many, many)
    named.ynames = ([0.0], ["J_eng"])
    assert chart(named, Numbers())[0] is None
    bars = panel(many, many)
    bars.bar(few, few, 0.5)
    assert chart(bars, Numbers())[0] is None


def test_a_level_that_is_no_number_is_left_out():
    made = panel(np.arange(400.0), np.ones(400))
    made.axhline(np.nan)
    found, _ = chart(made, Numbers())
    assert found["marks"][0]["at"] == [None]
    assert "NaN" not in as_json(found)


def test_words_cannot_end_the_script():
    assert "</script>" not in as_json({"words": "</script><script>alert(1)</script>"})
