"""Values of an earlier result, put into the problem that it was made with."""

from __future__ import annotations

import json

import pytest

import casadi_engine as ce
from casadi_engine.cli.earlier import values_of
from casadi_engine.cli.options import Options
from casadi_engine.errors import ResultError


def stored(folder, **values):
    """A result.json with these values."""
    parameters = {name: {"value": value, "unit": "1"} for name, value in values.items()}
    path = folder / "result.json"
    path.write_text(json.dumps({"format": 1, "command": "repair", "parameters": parameters}))
    return path


def given():
    b = ce.Blueprint("lag")
    k, x = b.parameter("k", 1.0, unit="1", min=0.1, max=10), b.state("x")
    b.ode("x", -k * x)
    b.output("y", x)
    return b.model().parameters()


def test_widths_of_jumps_that_a_repair_rounded_are_none_of_the_problems(tmp_path):
    """`validate --from` of a repair whose model has a sign was refused: "give the problem file that the result was made
    with", and that it was."""
    path = stored(tmp_path, k=2.5, **{"corner_1.jump.width": 0.01})
    assert values_of(path, given(), given=Options("validate", tmp_path))["k"].value == 2.5


def test_a_value_of_no_parameter_is_named(tmp_path):
    path = stored(tmp_path, k=2.5, width=0.01)
    with pytest.raises(ResultError, match="the result has a parameter that the problem does not have; seen: width"):
        values_of(path, given(), given=Options("validate", tmp_path))
