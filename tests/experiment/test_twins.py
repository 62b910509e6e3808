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
