"""Constants of physics among the parameters: told by value and unit, and never what is wrong."""

import numpy as np
import pytest
from scipy import constants

import casadi_engine as ce
from casadi_engine.model.constants_of_nature import is_constant_of_nature


@pytest.mark.parametrize(
    ("value", "unit"),
    [
        (constants.g, "m/s2"), (9.81, "m/s2"), (10, "m/s2"), (981, "cm/s2"), (constants.R, "J/(mol K)"),
        (8.314e-3, "kJ/(mol K)"), (constants.sigma, "W/(m2 K4)"), (96485, "A s/mol"),
        (constants.c, "m/s"), (constants.h, "J s"), (constants.e, "A s"), (constants.k, "J/K"),
        (constants.epsilon_0, "A s/(V m)"), (constants.mu_0, "V s/(A m)"), (constants.G, "m3/(kg s2)"),
        (constants.N_A, "1/mol"),
    ],
)  # fmt: skip
def test_a_constant_is_told_by_value_and_unit_whatever_it_is_called(value, unit):
    assert is_constant_of_nature("k", value, unit)
    assert not is_constant_of_nature("k", 1.1 * value, unit)
    assert not is_constant_of_nature("k", value, "kg")


def test_without_a_unit_by_its_name_and_value():
    assert is_constant_of_nature("g", 9.81, "1")
    assert not is_constant_of_nature("m", 9.81, "1")
    assert not is_constant_of_nature("g", 0.3, "1")
    assert not is_constant_of_nature("g", 9.81, "no unit at all")


def pendulum(vary=False):
    b = ce.Blueprint("pendulum")
    g, length = b.parameter("g", 9.81, unit="m/s2", vary=vary), b.parameter("l", 1.0, unit="m", vary=False)
    damping = b.parameter("c", 0.1, unit="1/s", min=0, max=5)
    angle, rate = b.state("phi", unit="rad"), b.state("w", unit="rad/s")
    b.ode("phi", rate)
    b.ode("w", -g / length * angle - damping * rate)
    b.output("shown", angle, unit="rad")
    return b.model()


def run(seed, length=1.3):
    """In closed form."""
    time = np.arange(400) * 0.02
    root = np.sqrt(complex(0.15**2 - 9.81 / length))
    one, other = -0.15 + root, -0.15 - root
    course = (0.5 * np.exp(one * time) + 0.5 * np.exp(other * time)).real
    noise = 0.002 * np.random.default_rng(seed).standard_normal(400)
    return ce.Experiment.from_arrays(f"r{seed}", time=time, units={"shown": "rad"}, shown=course + noise)


def test_a_repair_says_that_the_length_is_wrong_not_gravity():
    found = ce.repair(pendulum(), run(1), fresh=run(2), effects=["wrong_value"], progress=False)
    (one,) = found.effects
    assert one.key == "parameter_l.wrong_value"
    assert len(one.members) == 1
    assert found.verdict == "named"
    why = [o.why for o in found.not_applicable if o.at == "parameter_g"]
    assert why == ["no rig has another value of a constant of physics"]


def test_one_that_is_estimated_is_left_to_the_user():
    assert not pendulum(vary=True).declarations[0].is_constant_of_nature
    assert pendulum().declarations[0].is_constant_of_nature
