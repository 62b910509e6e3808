"""Noise of different sizes may look like what is missing: it is said beside a finding that nothing confirms."""

from dataclasses import replace

import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.repaired import Unknown
from casadi_engine.discrepancy.verdict_words import headline, next_step, uneven_noise

SIZE = "the size of the residual of b/conc depends on what the sensor shows, as a share of it, and the fit weights all"
LEVEL = "the residual of b/conc is 1.4 times as large as that of conc in the other records, and one noise level is"
SAID = "; or the noise is not of one size, as the residual is not, which all tests take it to be"


@pytest.fixture(scope="module")
def unnamed(shaft):
    found = ce.repair(shaft.model, shaft.data(n=400), effects=["coulomb_friction"], starts=1, progress=False)
    law = Unknown(
        "the parameter k seems not to be constant: it depends on c", {"a function of c at k": 3.8e-5}
    )

    def made(*messages):
        fit = replace(found.null_fit, messages=messages)
        return replace(found, verdict="unnamed", null_fit=fit, fit=fit, unknown=law, effects=(), withdrawn=())

    return made


@pytest.mark.parametrize("message", [SIZE, LEVEL])
def test_a_residual_that_is_white_and_uneven_is_said(unnamed, message):
    """Of concentrations with noise of 8 % of their value three of four said that something is missing, each another."""
    repair = unnamed(message)
    assert uneven_noise(repair) == SAID
    assert headline(repair).startswith("something may be missing")
    assert headline(repair).endswith(SAID)
    assert "give the logarithm, of which the noise is of one size" in next_step(repair)


@pytest.mark.parametrize(
    "messages",
    [(), (SIZE, "the residual of b/conc is not white (neighbours correlate by 0.7): the model lacks")],
)
def test_what_is_missing_makes_a_residual_uneven_too(unnamed, messages):
    repair = unnamed(*messages)
    assert uneven_noise(repair) == ""
    assert headline(repair).startswith("something is missing")
    assert "logarithm" not in next_step(repair)


def test_what_fresh_data_confirm_is_no_noise(unnamed):
    assert uneven_noise(replace(unnamed(SIZE), verdict="named", confirmed=True)) == ""
