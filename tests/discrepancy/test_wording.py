"""Words for numbers of a repair: in the units and with the names of the system that is told of."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy import wording
from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.discrepancy.clocks import Clock, clock_of
from casadi_engine.discrepancy.verdict_words import headline
from casadi_engine.discrepancy.wording import acts_as, told
from casadi_engine.estimation import Estimate
from casadi_engine.report.figures import figures
from casadi_engine.report.repaired_gap import pairs


@pytest.fixture(scope="module")
def cart():
    """A mass of 3 kg stated as 2 kg, damped by 1 N s/m and, unsaid, by dry friction of 0.5 N; time in minutes."""
    b = ce.Blueprint("cart", time_unit="min")
    m, c = b.parameter("m", 2.0, unit="kg", vary=False), b.parameter("c", 0.5, unit="N s/m", min=0)
    v, force = b.state("v", unit="m/s"), b.input("F", unit="N")
    mass = b.port("cart", "inertia", {"speed": v}, unit="N")
    b.ode("v", 60 * (force - c * v + mass) / m)
    b.output("speed", v, unit="m/s")
    return b.model()


@pytest.fixture(scope="module")
def record():
    t = 0.02 * np.arange(800)
    force = 4 * np.sin(0.9 * t) + 3 * np.sin(2.3 * t + 1) + 2 * np.sin(5.1 * t)
    v, seen = 0.0, []
    for k in range(len(t)):
        seen.append(v)
        for part in np.linspace(t[k], t[k] + 0.02, 100, endpoint=False):
            v += 2e-4 * (np.interp(part + 1e-4, t, force) - 1.0 * v) / 3.0
    speed = np.array(seen) + 0.01 * np.random.default_rng(2).standard_normal(len(t))
    return ce.Experiment.from_arrays("run", time=t, units={"F": "N", "speed": "m/s"}, F=force, speed=speed)


@pytest.fixture(scope="module")
def heavier(cart, record):
    asked = ["wrong_value", "coulomb_friction"]
    return ce.repair(cart, record, effects=asked, noise=ce.Noise(speed=0.01), starts=1, progress=False)


def joined(found):
    return " ".join(str(found).split())


def test_a_wrong_value_is_told_in_its_own_unit(heavier):
    assert headline(heavier) == (
        "the value of m is wrong (wrong_value at parameter_m), confirmed on fresh data"
    )
    words = joined(heavier)
    size = heavier.effects[0].amplitude
    assert 2 * (1 + size.value) == pytest.approx(3.0, abs=0.05)
    told_mass = words.partition(" m = ")[2].partition(" kg, stated 2 ")[0]
    value, error = (float(part) for part in told_mass.split(" ± "))
    assert value == pytest.approx(2 * (1 + size.value), rel=1e-2)
    assert error == pytest.approx(2 * size.stderr, rel=0.1)


def test_time_is_told_as_the_model_has_it(cart, heavier):
    assert clock_of(cart).span(60.0, 90.0) == "from 1 to 1.5 min"
    assert clock_of(ce.one_inertia()).span(2.0, 2.0) == "at 2 s"
    assert " min" in joined(heavier).partition("Gap widest in record run from ")[2][:40]


def test_a_force_is_no_torque(cart, heavier):
    one = replace(heavier.effects[0], at="cart")
    assert acts_as(one, "cart.coulomb_friction.torque", cart) == " (a force)"
    assert wording._with_article("angular acceleration") == "an angular acceleration"
    assert acts_as(one, "cart.viscous_friction.coefficient", cart) == ""
    assert acts_as(replace(one, at="engine"), "engine.coulomb_friction.torque", ce.one_inertia()) == ""


def test_what_was_stated_is_not_said_to_be_estimated(heavier):
    assert "noise speed sigma 0.01 m/s (stated) tested" in joined(heavier)
    found = replace(heavier.noise, sigma={"speed": (0.02, True)})
    larger = joined(replace(heavier, noise=found))
    assert "noise speed sigma 0.01 m/s (stated), sigma 0.02 m/s (estimated)" in larger
    coloured = joined(replace(heavier, noise=replace(found, colour={"run/speed": 2}, is_coloured=True)))
    assert "speed sigma 0.01 m/s (stated), coloured, with innovations of sigma 0.02 m/s" in coloured
    free = replace(heavier.null_fit, noise={"speed": (0.01, True)})
    own = joined(replace(heavier, noise=found, null_fit=free))
    assert "noise speed sigma 0.02 m/s (estimated) tested" in own


@pytest.mark.parametrize(
    ("estimate", "words"),
    [
        (Estimate(2.0, 0.1, "kg"), "2.00 ± 0.10"),
        (Estimate(2.0, None, "kg", at_bound="max"), "2 (upper bound)"),
        (Estimate(2.0, None, "kg", interval=(1.5, 4.0)), "2 (1.5 to 4)"),
        (Estimate(2.0, None, "kg"), "2 (error not known)"),
        (Estimate(2.0, None, "kg", fixed=True), "2 (held)"),
    ],
)
def test_an_estimate_says_why_it_has_no_error(estimate, words):
    assert told(estimate) == words
    number, _, why = words.partition(" (")
    assert told(estimate, " kg") == f"{number} kg{' (' if why else ''}{why}"


@pytest.mark.parametrize(
    ("unit", "gain", "error", "words"),
    [
        ("m/s", 2.6, 0.005, "in km/h labelled m/s"),
        ("kPa", -0.99, 1e-4, "in bar labelled kPa"),
        ("m/s", 2.6, 0.5, ""),  # not known well enough
        ("m/s", 2.5, 0.005, ""),  # no ratio of units
        ("-", 2.6, 0.005, ""),
        ("m/s", 2.6, None, ""),
    ],
)
def test_a_gain_tells_units_where_it_is_their_ratio_within_its_error(unit, gain, error, words):
    output = SimpleNamespace(name="y", unit=unit)
    one = SimpleNamespace(at="sensor_y", amplitude=SimpleNamespace(value=gain, stderr=error))
    found = wording._other_unit(one, SimpleNamespace(outputs=[output]))
    assert (words in found) if words else found == ""


@pytest.mark.parametrize(
    ("delay", "stderr", "said"), [(-7.6e-5, 5e-6, True), (-7.6e-5, 5e-5, False), (7.6e-5, 5e-6, False)]
)
def test_a_sensor_that_is_early_is_told_what_it_may_be(delay, stderr, said):
    one = SimpleNamespace(
        name="sensor_delay", at="sensor_u", amplitude=SimpleNamespace(value=delay, stderr=stderr)
    )
    repair = SimpleNamespace(model=SimpleNamespace(ports=SimpleNamespace(names=())))
    assert ("no sensor is early" in wording.right_value(one, repair)) == said


def test_times_are_told_in_the_unit_of_the_models_time():
    hours, seconds = Clock("h"), Clock()
    late, more = hours.told(Estimate(170_280.0, 180.0, "s", interval=(169_920.0, 170_640.0)))
    assert (late.value, late.stderr, late.unit, more) == (pytest.approx(47.3), 0.05, "h", "")
    assert late.interval == pytest.approx((47.2, 47.4))
    # a delay of a moment stays in s, a speed what it is; long times in s are said in hours too
    moment, speed = Estimate(0.2, 0.01, "s"), Estimate(170_280.0, None, "rad/s")
    assert hours.told(moment, always=False) == (moment, "")
    assert hours.told(moment)[0].unit == "h"
    assert hours.told(speed) == (speed, "")
    assert seconds.told(Estimate(170_280.0, 180.0, "s"))[1] == " (47.3 h)"
    assert seconds.span(311_400.0, 345_000.0) == "from 311400 to 345000 s (86.5 to 95.83 h)"
    assert (hours.axis, seconds.axis) == ("time [h]", "time [s]")
    assert hours.of(np.array([3600.0, 7200.0])).tolist() == [1.0, 2.0]


def test_an_event_is_told_in_minutes_on_the_screen_and_in_figures(heavier):
    step = Estimate(9.0, 0.3, "s")
    amplitude = Estimate(0.5, 0.1, "N")
    one = replace(
        heavier.effects[0], name="load_step", at="cart", sentence="a force",
        parameters={"cart.load_step.torque": amplitude, "cart.load_step.time": step},
    )  # fmt: skip
    changed = replace(heavier, effects=(one,))
    assert "cart.load_step.time = 0.1500 ± 0.0050 min" in joined(changed)
    assert pairs(changed)[0].clock.unit == "min"
    sketch = figures(changed)["gap run speed"]()
    assert {panel.x for panel in sketch.panels if panel.x.startswith("time")} == {
        "time [min]", "time [min], mean of pieces"
    }  # fmt: skip
    course = next(panel for panel in sketch.panels if panel.x == "time [min]")
    assert course.limits("x")[1] < 1.0  # 16 s


def test_candidates_of_events_are_named_with_their_time(cart):
    for clock, model in (("min", cart), ("s", ce.one_inertia())):
        made = SimpleNamespace(effect=ce.effects.LoadStep(), model=model)
        one = Candidate("load_step", "cart", {}, {"time": 9.0}, source=made)
        assert one.label == f"load_step at cart (time {'0.15 min' if clock == 'min' else '9'})"


def test_a_slot_that_acts_the_other_way_round_is_said_where_nothing_could_be_looked_for():
    b = ce.Blueprint("sledge")
    c, force = b.parameter("c", 3.0, unit="kg/s", min=1e-3), b.input("F", unit="N")
    v, mass = b.state("v", unit="m/s"), b.parameter("m", 2.0, unit="kg", vary=False)
    b.ode("v", (force - c * v - b.port("runner", "inertia", {"speed": v})) / mass)
    b.output("v_m", v, unit="m/s")
    t = np.arange(0, 4, 0.02)
    pushed = 20 * np.sin(3 * t) + 5 * np.sin(7.1 * t)
    seen = 0.3 * np.sin(2 * t) + 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    record = ce.Experiment.from_arrays("push", time=t, units={"F": "N", "v_m": "m/s"}, F=pushed, v_m=seen)
    found = ce.repair(b.model(), record, budget=10, progress=False)
    said = " ".join(str(found).split())
    assert "No effect can act at runner, as friction would drive there" in said
    assert "exchange the sign of the slot of runner in the ode, or of the signal" in said
