"""A fixed parameter that is wrong: found by a fit of data that SciPy simulated, and offered where it can matter."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.effects import WrongValue, candidates, port_view
from casadi_engine.errors import EffectError

TIME = 0.01 * np.arange(400)


def drive(t):
    return 3 * np.sin(2 * t) + 2 * np.sin(5.3 * t)


def cart(mass=2.0, bias=0.0, spare=0.0):
    b = ce.Blueprint("cart")
    m = b.parameter("m", mass, unit="kg", min=1e-3, vary=False)
    c = b.parameter("c", 0.8, unit="N s/m", min=0)
    pull = b.parameter("pull", bias, unit="N", min=-5, max=5, vary=False)
    gain = b.parameter("gain", spare, vary=False)
    deaf = b.parameter("deaf", 3.0, vary=False)
    v, force = b.state("v", unit="m/s"), b.input("F", unit="N")
    slot = b.port("body", "inertia", {"speed": v})
    b.ode("v", (force + pull + slot - c * v + gain * deaf * v**3) / m)
    b.output("speed", v, unit="m/s")
    return b.model()


def measured(seed=0):
    """SciPy's run of 2.5 kg with 0.8 N s/m and a steady 0.7 N."""
    run = solve_ivp(
        lambda t, v: (drive(t) + 0.7 - 0.8 * v) / 2.5,
        (0, TIME[-1]),
        [0.4],
        t_eval=TIME,
        rtol=1e-9,
        atol=1e-11,
    )
    speed = run.y[0] + 0.01 * np.random.default_rng(seed).standard_normal(len(TIME))
    units = {"F": "N", "speed": "m/s"}
    return ce.Experiment.from_arrays("run", time=TIME, units=units, F=drive(TIME), speed=speed)


def test_a_wrong_mass_and_a_wrong_zero_are_found():
    model = cart().with_effect(WrongValue(), at="parameter_m").with_effect(WrongValue(), at="parameter_pull")
    fit = ce.estimate(model, measured(), noise=ce.Noise(speed=0.01), progress=False)
    for name, truth in {
        "parameter_m.wrong_value.share": 0.25,
        "parameter_pull.wrong_value.shift": 0.7,
        "c": 0.8,
    }.items():
        found = fit.estimates[name]
        assert abs(found.value - truth) < 3 * found.stderr < 0.2, name
    assert fit.parameters["parameter_pull.wrong_value.shift"].unit == "N"


def test_every_fixed_parameter_that_matters_is_looked_for_and_no_free_one():
    model, skipped = cart(), []
    found = candidates(model, [WrongValue()], measured(), skipped=skipped)
    assert [one.key for one in found] == [f"parameter_{name}.wrong_value" for name in ("m", "pull", "gain")]
    assert [one.amplitude.name for one in found] == ["share", "shift", "shift"]
    assert [(one.at, one.why) for one in skipped] == [
        ("parameter_deaf", "no equation depends on deaf at these values")
    ]
    assert len(candidates(model, [WrongValue()], measured())) == 3
    pars = model.parameters()
    pars.fix("c")
    pars.free("m")
    pars.tie("gain", "0.1*c")
    keys = [one.at for one in candidates(model, [WrongValue()], measured(), parameters=pars)]
    assert keys == ["parameter_c", "parameter_pull", "parameter_deaf"]
    keys = [one.at for one in candidates(model, [WrongValue()], measured(), free=("m", "gain"))]
    assert keys == ["parameter_c", "parameter_pull"]


def test_widths_of_effects_are_not_looked_for():
    model = cart().with_effect(ce.effects.CoulombFriction(), at="body")
    assert "body.coulomb_friction.width" in model.parameter_names
    assert {one.at for one in candidates(model, [WrongValue()], measured())} == {
        "parameter_m", "parameter_pull", "parameter_gain",
    }  # fmt: skip


def test_a_parameter_stays_within_its_bounds():
    def bounds(at, value, effect=None):
        view = port_view(cart(), at)
        name = at.removeprefix("parameter_")
        found = (effect or WrongValue()).fitted(view, None, {name: value}).amplitude
        return found.name, found.min, found.max

    assert bounds("parameter_m", 2.0) == ("share", 1e-3 / 2 - 1, np.inf)
    assert bounds("parameter_pull", -2.0) == ("share", -3.5, 1.5)
    assert bounds("parameter_pull", 0.0) == ("shift", -5.0, 5.0)
    assert bounds("parameter_pull", 2.0, WrongValue(absolute=True, high=1.0)) == ("shift", -7.0, 1.0)
    assert bounds("parameter_m", 1e-4) == ("share", 0.0, np.inf)  # fixed below its bound


def test_a_value_of_0_has_no_share():
    with pytest.raises(EffectError, match=r"a parameter of value 0 has no share.*leave `absolute` out"):
        cart().with_effect(WrongValue(absolute=False), at="parameter_pull")


def test_a_screen_scores_the_wrong_mass():
    data = measured()
    model = cart(mass=2.4, bias=0.7)
    found = screen(ce.estimate(model, data, noise=ce.Noise(speed=0.01), progress=False))
    # a gain of the one sensor that there is does the same
    first = [found.candidates[k] for k in found.order if found.candidates[k].effect != "sensor_gain"]
    assert (first[0].effect, first[0].port, first[0].unit) == ("wrong_value", "parameter_m", "1")
    assert found.alarm
    assert WrongValue().describe("parameter_m") == "the value of m is wrong"
