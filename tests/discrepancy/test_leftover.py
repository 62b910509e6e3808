"""What the residual tests say beside the library: which of them speaks."""

from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.certificate import unknown_of
from casadi_engine.discrepancy.leftover import Leftover
from casadi_engine.discrepancy.screening import screen

LINE = "run/omega/line at 1.7 Hz"


@pytest.mark.parametrize(
    ("p", "line", "family", "wanted"),
    [(1e-9, 900.0, 100.0, LINE), (1e-9, 100.0, 900.0, None), (0.5, 900.0, 100.0, None)],
)
def test_a_line_speaks_where_it_is_clear_and_explains_more_than_a_function_does(p, line, family, wanted):
    tests = {LINE: p, "run/omega/whiteness": 1e-20, "a function of speed at engine": 0.0}
    assert Leftover(tests, 1e-3, lines={LINE: line}, drop=family).line == wanted


def test_there_is_no_line_without_one():
    assert Leftover({"run/omega/whiteness": 1e-20}, 1e-3).line is None


def test_a_line_that_the_inputs_have_too_does_not_speak():
    tests, lines = {LINE: 1e-9, "run/omega/whiteness": 1e-20}, {LINE: 900.0}
    found = Leftover(tests, 1e-3, lines=lines, drop=100.0, driven={LINE: ("T",)})
    assert (found.line, found.driven_line) == (None, LINE)
    assert Leftover(tests, 1e-3, lines=lines, drop=1e3, driven={LINE: ("T",)}).driven_line is None


def screened(law, swing=None):
    """A torque that the model lacks, on one inertia in steps of a random torque, or one that swings at three
    frequencies; white noise of a stated level."""
    rng = np.random.default_rng(3)
    t = 0.02 * np.arange(500)
    torque, w, seen = np.repeat(rng.uniform(-3, 3, 25), 20), 0.5, []
    if swing is not None:
        torque = sum(np.sin(2 * np.pi * f * t + f) for f in swing)
    for k in range(len(t)):
        seen.append(w)
        for part in range(50):
            s = t[k] + part * 4e-4
            w += 4e-4 * (torque[k] - 0.5 * w + law(s, w)) / 0.4
    omega = np.array(seen) + 0.01 * rng.standard_normal(len(t))
    data = ce.Experiment.from_arrays(
        "run/1", time=t, units={"T": "N m", "omega": "rad/s"}, hold={"T": "zero", "omega": "first"}, T=torque,
        omega=omega,
    )  # fmt: skip
    fit = ce.estimate(ce.one_inertia(), data, noise=ce.Noise(omega=0.01), progress=False)
    return screen(fit, "sensor_offset", colour=False)


def test_a_torque_of_time_is_no_function_of_the_speed():
    """The record's name may hold the sign that parts a test's name."""
    words = unknown_of(screened(lambda s, w: 0.3 * np.sin(2 * np.pi * 1.7 * s))).sentence
    assert words.startswith("the spectrum of the residual of omega in run/1 has a line at 1.7")


def test_a_torque_of_the_speed_is_no_line():
    words = unknown_of(screened(lambda s, w: 0.4 * np.sin(3 * w))).sentence
    assert words.startswith("an unknown torque at engine that depends on its speed")


@pytest.mark.parametrize(("swing", "foreign"), [((0.45, 1.7, 3.1), False), ((0.45, 2.3, 4.1), True)])
def test_what_comes_back_as_an_input_does_is_no_foreign_line(swing, foreign):
    found = screened(lambda s, w: 0.3 * np.cos(2 * np.pi * 1.7 * s), swing)
    assert found.leftover.alarms[LINE.replace("run", "run/1")] < 1e-6
    words = "the spectrum of the residual of omega in run/1 has a line at 1.7"
    assert unknown_of(found).sentence.startswith(words) == foreign


def test_where_nothing_explains_more_than_such_a_line_it_is_said_what_it_repeats():
    found = Leftover({LINE: 1e-9}, 1e-3, lines={LINE: 900.0}, driven={LINE: ("T", "p")})
    null = SimpleNamespace(model=ce.one_inertia())
    assert unknown_of(SimpleNamespace(leftover=found, null=null)).sentence == (
        "the residual of omega in run repeats what the inputs T and p do at 1.7 Hz: what is missing responds to it, or "
        "has that period by itself"
    )
    day = LINE.replace("1.7", "0.0000116")
    found = Leftover({day: 1e-9}, 1e-3, lines={day: 900.0}, driven={day: ("T",)})
    hours = SimpleNamespace(model=SimpleNamespace(time_unit="h"))
    assert "input T does at 0.0000116 Hz, once in about 24 h: " in (
        unknown_of(SimpleNamespace(leftover=found, null=hours)).sentence
    )
