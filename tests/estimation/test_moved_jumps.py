"""Free parameters in the place of a jump."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError
from casadi_engine.identifiability import fisher
from casadi_engine.model import Blueprint


def shaft(torque, shown=lambda w, p: w):
    b = Blueprint("shaft")
    w, c, p = b.state("w"), b.parameter("c", 0.3), b.parameter("p", 0.4)
    b.ode("w", b.input("u") - c * w + torque(w, p, b.time))
    b.output("y", shown(w, p))
    return b.model()


def record():
    t = np.arange(201) * 0.02
    return ce.Experiment.from_arrays(
        "run", time=t, units={"u": "1", "y": "1"}, u=2 * np.sin(2 * t), y=np.cos(t)
    )


REFUSED = {
    "a threshold of a state": (shaft(lambda w, p, t: ca.if_else(w > p, -0.5, 0)), "the ode of w jumps at (w-p) = 0"),
    "play": (shaft(lambda w, p, t: -ca.sign(w - p)), "the ode of w jumps at (w-p) = 0"),
    "steps of an encoder": (
        shaft(lambda w, p, t: 0, lambda w, p: ca.floor(w / p)), "the output of y jumps at (w/p) = a whole number",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_free_parameter_that_moves_a_jump_is_refused(name):
    """Else p stays where it is, and c takes its part: 0.193 ± 0.0005 for 0.2, "converged"."""
    model, where = REFUSED[name]
    with pytest.raises(EstimationError, match="the free parameter p moves a jump") as caught:
        ce.estimate(model, record(), progress=False)
    assert f"seen: {where}; allowed: free parameters outside of sign, floor and conditions on states" in str(
        caught.value
    )
    assert "do: fix p and compare fits at several values, or round the jump" in str(caught.value)


def test_a_tie_moves_a_jump_too():
    model = REFUSED["play"][0]
    pars = model.parameters()
    pars.tie("p", "2*c")
    with pytest.raises(EstimationError, match="the free parameter p moves a jump"):
        ce.estimate(model, record(), parameters=pars, progress=False)


def test_a_fixed_place_or_a_free_size_is_no_matter():
    model = REFUSED["a threshold of a state"][0]
    pars = model.parameters()
    pars.fix("p")
    assert ce.estimate(model, record(), parameters=pars, progress=False).status == "converged"
    for sized in (shaft(lambda w, p, t: -p * ca.sign(w)), shaft(lambda w, p, t: -ca.fmax(w, p))):
        assert ce.estimate(sized, record(), progress=False).estimates["c"].value is not None


def test_the_information_about_it_is_refused_too():
    model = REFUSED["steps of an encoder"][0]
    with pytest.raises(
        EstimationError, match="moves a jump, and the effect of that on the outputs has no slope"
    ):
        fisher(model, record())
