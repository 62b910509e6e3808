"""Laws whose corners are rounded themselves: contacts that give way before they slide."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.screening import screen
from casadi_engine.estimation.corner_widths import Motion, _as_rounded

LEVEL = 0.03


def shaft():
    b = ce.Blueprint("shaft")
    inertia = b.parameter("J", 0.7, unit="kg m2", min=0.05)
    damping = b.parameter("c", 0.2, unit="N m s/rad", min=0)
    w, torque = b.state("w", unit="rad/s"), b.input("T", unit="N m")
    b.ode("w", (torque - damping * w + b.port("shaft", "inertia", {"speed": w})) / inertia)
    b.output("speed", w, unit="rad/s")
    return b.model()


def run(name, seed, width, samples=500, drag=0.0):
    """Friction of 0.8 N m that is rounded over a width [rad/s], and a drag, by SciPy."""
    rng = np.random.default_rng(seed)
    time, (a, b, c) = np.arange(samples) * 0.02, rng.uniform(0, 6, 3)

    def torque(t):
        return 2.0 * np.sin(2 * t + a) + 1.5 * np.sin(0.7 * t + b) + 0.8 * np.sin(5 * t + c)

    speed = solve_ivp(
        lambda t, y: [(torque(t) - 0.3 * y[0] - 0.8 * np.tanh(y[0] / width) - drag * y[0] * abs(y[0])) / 0.5],
        (0, time[-1]), [0.0], t_eval=time, method="LSODA", rtol=1e-9, atol=1e-11,
    ).y[0]  # fmt: skip
    shown = speed + LEVEL * rng.standard_normal(samples)
    units = {"T": "N m", "speed": "rad/s"}
    return ce.Experiment.from_arrays(name, time=time, units=units, T=torque(time), speed=shown)


@pytest.mark.parametrize("width", [0.2, 0.05])
def test_friction_that_is_rounded_itself_is_dry_friction_with_its_width(width):
    """It was Stribeck friction of 0.70 +- 0.003 N m, named and confirmed: with corners of one width for all laws the
    one with a further number bent to the rounding."""
    found = ce.repair(shaft(), run("a", 0, width), fresh=run("b", 1, width), progress=False)
    assert [one.key for one in found.effects] == ["shaft.coulomb_friction"]
    assert (found.verdict, found.confirmed) == ("named", True)
    torque = found.effects[0].amplitude
    assert abs(torque.value - 0.8) < 3 * torque.stderr
    own = found.effects[0].parameters["shaft.coulomb_friction.width"]
    assert abs(own.value - width) < 3 * own.stderr
    assert own.unit == "rad/s"
    assert "tanh(w/shaft.coulomb_friction.width)" in found.equation.text
    assert "shaft.coulomb_friction.width = " in str(found)


def test_a_width_is_a_corner_and_no_law_of_its_own():
    """A brake by eddy currents was a friction that is rounded over a third of the motion, and a drag, confirmed."""
    base, record = shaft(), run("a", 0, 0.2)
    fit = ce.estimate(base, record, noise=ce.Noise(speed=LEVEL), progress=False)
    (one,) = screen(fit, ["coulomb_friction"], at=["shaft"], colour=False).candidates
    refitter = Refitter(base, base.parameters(), (record,), ce.Noise(speed=LEVEL), base=fit)
    friction = addition(one, 0.8)
    motion = ce.simulate(fit, record)["speed"].values
    assert refitter.widest(friction) == pytest.approx(0.2 * np.sqrt(np.mean(motion**2)), rel=0.05)
    rounded = [replace(friction, width=0.05)]
    wide = refitter.parameters_of(refitter.extended(rounded), rounded)
    own = wide["shaft.coulomb_friction.width"]
    assert (own.vary, own.value, own.max) == (True, 0.05, pytest.approx(refitter.widest(friction)))
    (drift,) = screen(fit, ["sensor_offset"], colour=False).candidates
    assert refitter.widest(addition(drift, 0.1)) == 0.0


@pytest.mark.slow
def test_friction_that_is_sharp_has_no_width():
    found = ce.repair(shaft(), run("a", 0, 1e-3), fresh=run("b", 1, 1e-3), progress=False)
    assert [one.key for one in found.effects] == ["shaft.coulomb_friction"]
    assert "shaft.coulomb_friction.width" not in found.fit.free
    torque = found.effects[0].amplitude
    assert abs(torque.value - 0.8) < 3 * torque.stderr


@pytest.mark.parametrize("width", [0.5, 0.1, 0.03])
def test_a_fit_estimates_the_width_that_the_data_ask_for(width):
    """Friction was 3 to 4 standard errors off with corners as sharp as the motion can tell."""
    model = shaft().with_effect(ce.effects.CoulombFriction(), at="shaft")
    fit = ce.estimate(model, run("a", 0, width), progress=False)
    for name, truth in (
        ("shaft.coulomb_friction.torque", 0.8),
        ("shaft.coulomb_friction.width", width),
        ("J", 0.5),
    ):
        own = fit.estimates[name]
        assert abs(own.value - truth) < 3 * own.stderr, name
    assert any("the data ask for rounded corners: shaft.coulomb_friction.width" in m for m in fit.messages)


def test_beside_what_is_missing_the_width_of_a_friction_that_the_model_has_is_another_one():
    """Held where the model without the drag had it, it asked for Stribeck friction with a width of its own."""
    model = shaft().with_effect(ce.effects.CoulombFriction(), at="shaft", values={"torque": 0.5})
    found = ce.repair(
        model, run("a", 0, 0.2, 600, drag=0.05), fresh=run("b", 1, 0.2, 600, drag=0.05), progress=False,
        effects=["quadratic_drag", "stribeck_friction", "asymmetric_friction"],
    )  # fmt: skip
    assert [one.key for one in found.effects] == ["shaft.quadratic_drag"]
    assert (found.verdict, found.confirmed) == ("named", True)
    truth = {"shaft.quadratic_drag.coefficient": 0.05, "shaft.coulomb_friction.torque": 0.8}
    for name, value in {**truth, "shaft.coulomb_friction.width": 0.2}.items():
        own = found.fit.estimates[name]
        assert abs(own.value - value) < 3 * own.stderr, name


def test_a_fit_keeps_a_width_that_was_stated_and_sharp_laws_sharp():
    model = shaft().with_effect(ce.effects.CoulombFriction(width=0.01), at="shaft")
    fit = ce.estimate(model, run("a", 0, 0.3), progress=False)
    assert "shaft.coulomb_friction.width" not in fit.estimates
    model = shaft().with_effect(ce.effects.CoulombFriction(), at="shaft")
    fit = ce.estimate(model, run("a", 0, 1e-3), progress=False)
    assert "shaft.coulomb_friction.width" not in fit.free
    assert not any("rounded corners: " in m for m in fit.messages)


def test_a_fit_with_sharp_corners_stays_where_wider_ones_cannot_be_simulated(monkeypatch):
    model = shaft().with_effect(ce.effects.CoulombFriction(), at="shaft")
    plain = ce.estimate(model, run("a", 0, 1e-3), progress=False)
    real, width = Motion.cost, plain.parameters["shaft.coulomb_friction.width"].value

    def cost(self, widths):
        if max(widths.values()) > 3 * width:
            raise FloatingPointError("the model's state is not finite here")
        return real(self, widths)

    monkeypatch.setattr(Motion, "cost", cost)
    motion = Motion(plain, {"shaft.coulomb_friction.width": width})
    assert _as_rounded(motion, model.parameters(), lambda *_: pytest.fail("no refit is asked for")) is None
