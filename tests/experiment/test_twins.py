"""One measurement given twice is refused; two that look alike, or sensors at rest, are two."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ExperimentError
from casadi_engine.experiment.twins import refuse_twins, twin_of

T = np.arange(50) * 0.1


def record(name, omega, **others):
    units = {"T": "N m", "omega": "rad/s"} | dict.fromkeys(others, "rad/s")
    return ce.Experiment.from_arrays(name, time=T, units=units, T=np.sin(T), omega=omega, **others)


def test_the_same_measurement_under_another_name_is_refused():
    noise = np.random.default_rng(0).standard_normal((2, 50))
    one, copy, other = record("one", noise[0]), record("copy", noise[0]), record("other", noise[1])
    with pytest.raises(ExperimentError, match=r"'copy' is given twice; seen: the measurements of .*'one'"):
        refuse_twins([one, other, copy], ["omega"])
    refuse_twins([one, other], ["omega"])
    assert twin_of(copy, [other, one], ["omega"]) is one
    with pytest.raises(ExperimentError, match="is given twice"):
        ce.estimate(ce.one_inertia(), [one, copy], progress=False)


def test_what_stands_still_in_two_records_is_no_twin():
    assert twin_of(record("a", 0 * T), [record("b", 0 * T)], ["omega"]) is None


def test_a_record_that_shows_more_is_a_twin_of_what_both_show():
    noise = np.random.default_rng(0).standard_normal(50)
    assert twin_of(record("a", noise, second=noise), [record("b", noise)], ["omega", "second"]) is not None


def measured(name, time, values):
    return ce.Experiment.from_arrays(name, time=time, units={"y": "m"}, y=values)


def test_a_measurement_that_was_shifted_cut_or_thinned():
    rng = np.random.default_rng(2)
    t = 0.01 * np.arange(600)
    y = np.round(np.sin(3 * t) + 0.05 * rng.standard_normal(600), 4)
    first = measured("first", t, y)
    for name, other in {
        "shifted": measured("shifted", t + 100, y),
        "cut": measured("cut", t[:300], y[:300]),
        "cut and shifted": measured("late", t[200:550] - 2, y[200:550]),
        "thinned": measured("thinned", t[::4], y[::4]),
    }.items():
        assert twin_of(other, [first], ["y"]) is first, name
        assert twin_of(first, [other], ["y"]) is other, name


def test_a_copy_with_fewer_decimals():
    rng = np.random.default_rng(3)
    t = 0.01 * np.arange(600)
    y = np.sin(3 * t) + 0.05 * rng.standard_normal(600)
    fine, coarse = measured("fine", t, y), measured("coarse", t, np.round(y, 3))
    assert twin_of(coarse, [fine], ["y"]) is fine
    assert twin_of(fine, [coarse], ["y"]) is coarse
    again = measured("again", t, np.round(np.sin(3 * t) + 0.05 * rng.standard_normal(600), 3))
    assert twin_of(again, [fine, coarse], ["y"]) is None
    # two encoders whose steps are wider than their noise, and two switches, are two
    slow = 0.4 * np.sin(0.2 * t)
    one, other = (
        measured(n, t, np.round(slow + 0.01 * rng.standard_normal(600), k)) for n, k in (("a", 1), ("b", 4))
    )
    assert twin_of(one, [other], ["y"]) is None
    on = (t > 3).astype(float)
    assert (
        twin_of(measured("c", t, on), [measured("d", t, on + 1e-3 * rng.standard_normal(600))], ["y"]) is None
    )


def test_what_is_no_twin():
    rng = np.random.default_rng(2)
    t = 0.01 * np.arange(600)
    clean = np.sin(3 * t)
    first = measured("first", t, np.round(clean + 0.05 * rng.standard_normal(600), 2))
    others = [
        measured("again", t, np.round(clean + 0.05 * rng.standard_normal(600), 2)),
        # neighbours in time share a few samples alone
        measured("next", t, np.concatenate([first["y"].values[450:], np.round(rng.standard_normal(450), 2)])),
        measured("still", t, np.zeros(600)),
        # an encoder that passes each of its steps once, at another speed
        measured("ramp", t, np.round(7.0 * t, 2)),
    ]
    for other in others:
        assert twin_of(first, [other], ["y"]) is None, other.name
    assert twin_of(measured("run", t, np.round(5.0 * t, 2)), [others[3]], ["y"]) is None
