"""Channels with samples in few of their rows."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.experiment.pace import paced

RNG = np.random.default_rng(2)


def record(valid, values=None):
    time = 0.5 * np.arange(len(valid))
    y = np.where(valid, np.arange(len(valid)) if values is None else values, np.nan)
    return ce.Experiment.from_arrays(
        "r", time=time, units={"u": "1", "y": "1"}, u=0 * time, y=y, inputs=("u",)
    )


@pytest.mark.parametrize("step", [2, 3, 7])
def test_every_so_many_rows(step):
    valid = np.arange(80) % step == 1
    valid[1 + 3 * step] = False  # one is missing among them
    own = paced(record(valid), ["y"])
    assert np.allclose(np.diff(own["y"].time), 0.5 * step)
    assert np.array_equal(own["y"].mask, np.arange(len(own["y"])) != 3)
    assert len(own["u"]) == 80


def test_any_few_rows():
    valid = RNG.uniform(size=400) < 0.1
    own = paced(record(valid), ["y"])
    assert np.array_equal(own["y"].time, 0.5 * np.flatnonzero(valid))
    assert own["y"].mask.all()


@pytest.mark.parametrize("share", [1.0, 0.9, 0.5])
def test_rows_with_neighbours_stay(share):
    made = record(RNG.uniform(size=400) < share)
    assert paced(made, ["y"]) is made
    assert paced(made, ["not there"]) is made


def level():
    b = ce.Blueprint("level")
    x, a = b.state("x"), b.parameter("a", 1.0)
    b.ode("x", a - x)
    b.output("y", x, unit="1")
    return b.model()


@pytest.fixture
def noise():
    found = np.zeros(600)
    for k in range(1, 600):
        found[k] = 0.95 * found[k - 1] + 0.01 * RNG.standard_normal()
    return found


def error_of(y):
    time = 0.5 * np.arange(len(y))
    made = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=y)
    found = ce.estimate(level(), made, progress=False).estimates["a"]
    return found.stderr or found.quadratic


def test_errors_count_with_the_colour_of_noise_beside_missing_samples(noise):
    """A third of the samples missing at random made errors of white noise."""
    whole = error_of(1 + noise)
    part = error_of(np.where(np.arange(600) % 7 % 3 < 2, 1 + noise, np.nan))
    assert part == pytest.approx(whole, rel=0.3)


def test_errors_count_with_the_colour_of_noise_between_empty_cells(noise):
    """The same samples with empty cells between and without any: the same errors, wide ones."""
    valid = np.arange(600) % 2 == 0
    fits = []
    for own in (record(valid, 1 + noise), record(valid[::2], 1 + noise[::2])):
        time = (0.5 if len(own["y"]) == 600 else 1.0) * np.arange(len(own["y"]))
        made = ce.Experiment.from_arrays("r", time=time, units={"y": "1"}, y=own["y"].values)
        fits.append(ce.estimate(level(), made, progress=False).estimates["a"])
    assert fits[0].value == pytest.approx(fits[1].value, rel=1e-6)
    errors = [one.stderr or one.quadratic for one in fits]
    assert errors[0] == pytest.approx(errors[1], rel=1e-3)
    assert errors[0] > 2 * np.sqrt(np.var(noise) / 300)  # that of white noise
