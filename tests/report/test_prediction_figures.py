"""Figures of a simulation with bands."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.report.figures import figures


@pytest.fixture(scope="module")
def prediction():
    time = np.arange(200) * 0.01
    noise = 0.05 * np.random.default_rng(1).standard_normal(200)
    data = ce.Experiment.from_arrays(
        "run_up",
        time=time,
        units={"T": "N m", "omega": "rad/s"},
        hold="zero",
        T=np.full(200, 2.0),
        omega=4 * (1 - np.exp(-time / 0.8)) + noise,
    )
    fit = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.05), progress=False)
    return ce.simulate(fit, data, band=True)


def test_both_bands_are_drawn_around_the_simulation(prediction):
    assert list(figures(prediction)) == ["overview", "output omega"]
    (ax,) = ce.plot(prediction).axes
    assert ax.get_ylabel() == "omega [rad/s]"
    assert ax.get_title(loc="left") == "run_up: omega"
    noisy, own = ax.collections[:2]
    band = prediction["omega"]
    for shape, low, high in ((noisy, band.low_noise, band.high_noise), (own, band.low, band.high)):
        drawn = shape.get_paths()[0].vertices[:, 1]
        assert (drawn.min(), drawn.max()) == pytest.approx((low.min(), high.max()))
    lines = {line.get_label(): line for line in ax.get_lines()}
    np.testing.assert_allclose(lines["simulated"].get_ydata(), band.value)
    assert "measured" in lines
