"""Free parameters in the place of a jump."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

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


ENCODER = shaft(lambda w, p, t: 0, lambda w, p: ca.floor(w / p))


def test_a_free_parameter_that_moves_a_jump_of_an_output_is_refused():
    """Its derivative is 0: p would stay where it is, and c take its part."""
    with pytest.raises(EstimationError, match="the free parameter p moves a jump") as caught:
        ce.estimate(ENCODER, record(), progress=False)
    assert (
        "seen: the output y jumps at (w/p) = a whole number; allowed: free parameters outside of sign, floor "
        "and conditions in outputs" in str(caught.value)
    )
    assert "do: fix p and compare fits at several values, or round the jump" in str(caught.value)


def test_a_tie_moves_a_jump_too():
    pars = ENCODER.parameters()
    pars.tie("p", "2*c")
    with pytest.raises(EstimationError, match="the free parameter p moves a jump"):
        ce.estimate(ENCODER, record(), parameters=pars, progress=False)


def crossing(time, c, p):
    """w' = 2 sin 2t - c w - (0.5 above p), from 0, piece by piece between the crossings."""
    now, w, found = 0.0, np.zeros(1), np.zeros_like(time)
    above = False
    while now < time[-1]:

        def rate(t, w, above=above):
            return 2 * np.sin(2 * t) - c * w - 0.5 * above

        def passed(t, w):
            return w[0] - p

        passed.terminal, passed.direction = True, -1.0 if above else 1.0
        run = solve_ivp(
            rate,
            (now, time[-1]),
            w,
            rtol=1e-11,
            atol=1e-12,
            events=passed,
            dense_output=True,
            method="DOP853",
        )
        here = (time >= now) & (time <= run.t[-1])
        found[here] = run.sol(time[here])[0]
        now, w, above = run.t[-1], run.y[:, -1], not above
    return found


def test_the_place_of_a_jump_of_the_equations_is_estimated():
    model = shaft(lambda w, p, t: ca.if_else(w > p, -0.5, 0))
    time = np.arange(201) * 0.02
    y = crossing(time, 0.2, 0.5) + 1e-3 * np.random.default_rng(0).standard_normal(201)
    # the input as recorded is a broken line: a finer record of it is what the truth has
    fine = np.arange(1001) * 4e-3
    data = ce.Experiment.from_arrays(
        "run", units={"u": "1", "y": "1"}, u=(fine, 2 * np.sin(2 * fine)), y=(time, y)
    )
    fit = ce.estimate(model, data, noise=ce.Noise(y=1e-3), progress=False)
    assert fit.converged
    for name, truth in (("c", 0.2), ("p", 0.5)):
        assert abs(fit.values[name] - truth) < 3.5 * fit.stderr[name], name
        assert fit.stderr[name] < 0.02


def test_the_information_about_it_is_refused_too():
    with pytest.raises(
        EstimationError, match="moves a jump, and the effect of that on the outputs has no slope"
    ):
        fisher(ENCODER, record())
