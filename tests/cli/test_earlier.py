"""Values of an earlier result, put into the problem that it was made with."""

from __future__ import annotations

from pathlib import Path

import pytest

import casadi_engine as ce
from casadi_engine.cli import earlier
from casadi_engine.cli.options import Options
from casadi_engine.errors import ResultError

ASKED = Options("validate", Path("problem.py"))


@pytest.fixture
def put(monkeypatch):
    """Puts stored values into the set of a problem."""
    b = ce.Blueprint("lag")
    k, x = b.parameter("k", 1.0, unit="1", min=0.1, max=10), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    own = b.model().parameters()

    def values(**stored):
        monkeypatch.setattr(
            earlier, "_stored", lambda _: {name: (value, "1") for name, value in stored.items()}
        )
        return earlier.values_of(Path("result.json"), own, given=ASKED)

    return values


def test_widths_of_jumps_that_a_repair_rounded_are_none_of_the_problems(put):
    """`validate --from` of a repair whose model has a sign was refused: "give the problem file that the result was made
    with", and that it was."""
    assert put(k=2.5, **{"corner_1.jump.width": 0.01})["k"].value == 2.5


def test_a_value_of_no_parameter_is_named(put):
    with pytest.raises(
        ResultError, match="the result has a parameter that the problem does not have; seen: width"
    ):
        put(k=2.5, width=0.01)
