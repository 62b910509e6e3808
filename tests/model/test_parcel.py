"""Models and parameter sets sent to another process are the same there."""

import copy
import pickle  # what joblib and dask use

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine import effects
from casadi_engine.errors import ParameterError

MODELS = {
    "two_mass": lambda: ce.two_mass(),
    "measured": lambda: ce.two_mass(reciprocating_speed="measured"),
    "crankshaft": lambda: ce.crankshaft(reciprocating_speed="measured"),
    "effects": lambda: (
        ce.two_mass(reciprocating_speed="measured")
        .with_effect(effects.CoulombFriction(), at="load")
        .with_effect(effects.CubicStiffness(), at="coupling")
    ),
}


def sent(thing):
    return pickle.loads(pickle.dumps(thing))  # noqa: S301  made in this line


@pytest.mark.parametrize("name", MODELS)
def test_a_sent_model_is_the_same(name):
    model = MODELS[name]()
    other = sent(model)
    assert other is not model
    assert str(other) == str(model)
    assert other.latex() == model.latex()
    assert str(other.ports) == str(model.ports)
    assert [port.slot is None for port in other.ports] == [port.slot is None for port in model.ports]
    assert other.declarations == model.declarations
    assert (other.linear is None) == (model.linear is None)
    assert other.has_slot_laws == model.has_slot_laws
    rng = np.random.default_rng(0)
    arguments = [rng.uniform(0.5, 1.5, s.numel()) for s in (model.x, model.u, model.t)]
    arguments.append(model.parameter_vector())
    for column in ("closed_ode", "closed_outputs"):
        one, two = (
            ca.Function("f", [m.x, m.u, m.t, m.p], [getattr(m, column)])(*arguments).full()
            for m in (model, other)
        )
        assert np.array_equal(one, two)
    for port, twin in zip(model.ports, other.ports, strict=True):
        for key in port.signals:
            signals = [
                ca.Function("f", [m.x, m.u, m.d, m.t, m.p, m.w], [p.signals[key]])
                for m, p in ((model, port), (other, twin))
            ]
            values = [rng.uniform(0.5, 1.5, signals[0].size1_in(k)) for k in range(6)]
            one, two = (float(signal(*values)) for signal in signals)
            assert np.array_equal(one, two, equal_nan=True)


def test_a_sent_model_takes_effects():
    model = ce.two_mass(reciprocating_speed="measured")
    one, two = (m.with_effect(effects.CubicStiffness(), at="coupling") for m in (model, sent(model)))
    assert one.equations() == two.equations()


def test_a_copy_is_a_model_too():
    model = ce.one_inertia()
    assert str(copy.deepcopy(model)) == str(model)


def test_a_sent_parameter_set_is_the_same():
    pars = ce.two_mass().parameters()
    pars["J_eng"].set(0.5, min=0.05, max=4, prior=(0.4, 0.1))
    pars.tie("C_el", "16*C_eng")
    pars.fix("K_el", 1992)
    pars.constrain("J_eng + J_load", 0.4, 0.8)
    pars.constrain_frequency(1, 18, 23)
    other = sent(pars)
    assert str(other) == str(pars)
    assert other.to_dict() == pars.to_dict()
    other["C_eng"].set(0.2)
    assert other.as_dict()["C_el"] == pytest.approx(3.2)
    with pytest.raises(ParameterError, match="frozen"):
        sent(pars.frozen())["J_eng"].set(0.6)
