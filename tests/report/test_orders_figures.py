"""Figures of an order analysis."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ResultError
from casadi_engine.report.figures import figures


def record(rpm, size=0.3):
    time = np.arange(0, 0.6, 1 / 4000)
    theta = rpm * np.pi / 30 * time
    return ce.Experiment.from_arrays(
        f"rpm_{rpm}",
        time=time,
        units={"theta": "rad", "omega": "rad/s"},
        theta=theta,
        omega=125 + size * np.cos(theta) + 0.5 * np.cos(2 * theta + 1),
    )


@pytest.fixture
def several():
    return ce.orders([record(rpm, size) for rpm, size in ((1000, 0.1), (1800, 0.2), (1200, 0.9))])


def test_one_row_is_drawn_over_the_order():
    found = ce.orders(record(1200))
    assert list(figures(found)) == ["overview"]
    (ax,) = ce.plot(found).axes
    assert ax.get_xlabel() == "engine order [1]"
    assert ax.get_ylabel() == "amplitude [rad/s]"
    segments = ax.collections[0].get_segments()
    assert len(segments) == 20
    assert segments[1][1] == pytest.approx([1, 0.3])  # the bar of order 1 ends at its amplitude


def test_rows_are_drawn_over_rising_speed_and_as_a_map(several):
    curves, chart = ce.plot(several).axes
    order_1 = next(line for line in curves.lines if line.get_label() == "order 1")
    assert order_1.get_xdata() == pytest.approx([1000, 1200, 1800])
    assert order_1.get_ydata() == pytest.approx([0.1, 0.9, 0.2])
    points = np.concatenate([line.get_xydata() for line in chart.lines])
    assert len(points) == 3 * 20
    strongest = chart.lines[-1].get_xydata()
    assert [1200, 20] in strongest.round(9).tolist()
    assert [1000, pytest.approx(1000 / 60)] not in strongest.tolist()


def test_phases_are_drawn(several):
    (ax,) = ce.plot(several, what="phase").axes
    order_2 = next(line for line in ax.lines if line.get_label() == "order 2")
    assert order_2.get_ydata() == pytest.approx(np.degrees([1, 1, 1]))


def test_an_unknown_figure_is_named(several):
    with pytest.raises(
        ResultError, match=r"no such figure of this result; seen: 'map'; allowed: 'overview', 'phase'"
    ):
        ce.plot(several, what="map")
