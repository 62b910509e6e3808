"""Friction that differs by direction: one effect names it, with its mean and its asymmetry."""

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.effects import AsymmetricFriction, CoulombFriction, candidates
from tests.effects.dry_friction import speed_of

TIME = 0.01 * np.arange(500)


def force(t):
    return 3 * np.sin(2 * t) + 1.2 * np.sin(5.3 * t)


def record(seed=0, way=force):
    speed = speed_of(TIME, way, 1.5, 0.4, forward=0.9, backward=0.5)
    noisy = speed + 0.005 * np.random.default_rng(seed).standard_normal(len(TIME))
    units = {"F": "N", "speed": "m/s"}
    return ce.Experiment.from_arrays("run", time=TIME, units=units, F=way(TIME), speed=noisy)


def cart(pull=None):
    """pull : whether a steady force that the model knows is estimated; None without one."""
    b = ce.Blueprint("cart")
    steady = 0.0 if pull is None else b.parameter("pull", 0.1, unit="N", vary=pull)
    m, c = b.parameter("m", 1.2, unit="kg", min=1e-3), b.parameter("c", 0.3, unit="N s/m", min=0)
    v, push = b.state("v", unit="m/s"), b.input("F", unit="N")
    b.ode("v", (push - 2 * steady + b.port("body", "inertia", {"speed": v}) - c * v) / m)
    b.output("speed", v, unit="m/s")
    return b.model()


def test_the_simulation_by_hand_holds_still_and_starts_again():
    still = speed_of(TIME, lambda t: 0.4 + 0 * t, 1.5, 0.4, forward=0.9, backward=0.5)
    assert not still.any()
    ramp = speed_of(TIME, lambda t: 0.5 * t, 1.5, 0.0, forward=1.0, backward=0.5)
    gone = np.maximum(TIME - 2.0, 0)
    np.testing.assert_allclose(ramp, 0.25 * gone**2 / 1.5, atol=1e-6)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_mean_level_and_asymmetry_are_found(seed):
    model = cart().with_effect(AsymmetricFriction(), at="body")
    fit = ce.estimate(model, record(seed), noise=ce.Noise(speed=0.005), progress=False)
    for name, truth in {
        "body.asymmetric_friction.torque": 0.7,
        "body.asymmetric_friction.asymmetry": 2 / 7,
        "m": 1.5,
        "c": 0.4,
    }.items():
        found = fit.estimates[name]
        assert abs(found.value - truth) < 3 * found.stderr < 0.1, name
    plain = cart().with_effect(CoulombFriction(), at="body")
    without = ce.estimate(plain, record(seed), noise=ce.Noise(speed=0.005), progress=False)
    assert without.cost > 5 * fit.cost
    assert fit.parameters["body.asymmetric_friction.torque"].unit == "N"


def test_the_law_has_both_levels():
    model = cart().with_effect(AsymmetricFriction(), at="body", sharp=True)
    values = {
        "body.asymmetric_friction.torque": 2.0,
        "body.asymmetric_friction.asymmetry": 0.25,
        "c": 0.0,
        "m": 1.0,
    }
    data = ce.Experiment.from_arrays("run", time=TIME, units={"F": "N"}, F=0 * TIME)
    for start, level in ((30.0, 2.5), (-30.0, -1.5)):
        run = ce.simulate(model, data, parameters=values, initial={"v": start})["speed"].values
        assert np.diff(run) / 0.01 == pytest.approx(np.full(len(run) - 1, -level), rel=1e-6)


def test_it_is_not_looked_for_where_the_motion_has_one_direction():
    def motion(sign):
        return lambda _: [sign * np.linspace(-0.5, 2.0, 9) if sign == 1 else np.linspace(0.0, 2.0, 9)]

    both = candidates(cart(), [AsymmetricFriction()], record(), courses=motion(1))
    assert [one.values["asymmetry"] for one in both] == pytest.approx([-1, -0.6, -0.2, 0.2, 0.6, 1])
    skipped = []
    assert candidates(cart(), [AsymmetricFriction()], record(), courses=motion(-1), skipped=skipped) == ()
    assert str(skipped[0]) == (
        "asymmetric_friction at body: the simulation of the records moves in one direction alone"
    )


def test_it_is_not_looked_for_beside_a_constant_torque_that_is_estimated():
    skipped = []
    assert candidates(cart(pull=True), [AsymmetricFriction()], record(), skipped=skipped) == ()
    assert [one.why for one in skipped] == ["a constant torque there is estimated already"]
    assert len(candidates(cart(pull=False), [AsymmetricFriction()], record())) == 6
    there = cart().with_effect(ce.effects.ConstantTorque(), at="body")
    assert candidates(there, [AsymmetricFriction()], record()) == ()
    assert len(candidates(there, [AsymmetricFriction()], record(), free=("m", "c", "gone"))) == 6
    assert len(candidates(ce.two_mass(), [AsymmetricFriction()], record())) == 12


def test_what_it_is_made_of_does_the_same():
    values = {"torque": 2.0, "asymmetry": 0.25}
    assert AsymmetricFriction().parts(values) == {"coulomb_friction": 2.0, "constant_torque": -0.5}
    one = cart().with_effect(AsymmetricFriction(width=0.001), at="body", values=values)
    two = cart().with_effect(CoulombFriction(width=0.001), at="body", values={"torque": 2.0})
    two = two.with_effect(ce.effects.ConstantTorque(), at="body", values={"torque": -0.5})
    data = ce.Experiment.from_arrays("run", time=TIME, units={"F": "N"}, F=force(TIME))
    runs = [ce.simulate(m, data, initial={"v": 1.0})["speed"].values for m in (one, two)]
    np.testing.assert_allclose(*runs, atol=2e-3)  # they differ within the corner
    assert ce.effects.QuadraticDrag().parts({"coefficient": 1.0}) == {}


def test_a_constant_force_that_is_larger_than_dry_friction_is_named_beside_it():
    """An asymmetry ends at 1; what is more had been told as an offset, and as a load that comes at the beginning."""

    def pulled(t):
        return force(t) - 1.2

    speed = speed_of(TIME, pulled, 1.5, 0.4, forward=0.5, backward=0.5)
    noisy = speed + 0.02 * np.random.default_rng(1).standard_normal(len(TIME))
    units = {"F": "N", "speed": "m/s"}
    data = ce.Experiment.from_arrays("run", time=TIME, units=units, F=force(TIME), speed=noisy)
    names = ["coulomb_friction", "asymmetric_friction", "constant_torque", "quadratic_drag"]
    found = ce.repair(cart(), data, effects=names, holdout=0.0, starts=1, progress=False)
    assert {one.name for one in found.effects} == {"coulomb_friction", "constant_torque"}
    values = found.fit.estimates
    assert abs(values["body.constant_torque.torque"].value + 1.2) < 0.1
    assert abs(values["body.coulomb_friction.torque"].value - 0.5) < 0.1
