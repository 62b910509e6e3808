"""Sensors that are all late by one time are where an input acts late, and this is said."""

import dataclasses
from types import SimpleNamespace

import casadi as ca
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.common_delay import (
    as_an_input,
    common_delay,
    late_input,
    other_cause,
    with_other_cause,
)
from casadi_engine.effects import LoadStep
from casadi_engine.effects.protocol import Attachment
from casadi_engine.estimation.fit import Estimate
from casadi_engine.model.term import NotApplicable


def late(*delays, inputs=("u",), outputs=2, timed=None):
    """A repair that found delays (value, standard error) of the first of so many sensors.

    timed(t, p) : what the equations have of the time, and of a parameter that is the time of an event
    """
    ports = [SimpleNamespace(kind="sensor", name=f"sensor_y{k}") for k in range(outputs)]
    x, t, p, none = ca.SX.sym("x"), ca.SX.sym("t"), ca.SX.sym("p"), ca.SX(0, 1)
    model = SimpleNamespace(
        ports=ports, inputs=[SimpleNamespace(name=name) for name in inputs], x=x, u=none, d=none, w=none, t=t, p=p,
        closed_ode=-x + (timed(t, p) if timed else 0.0), output_expressions=x, time_unit="s",
        parameter_names=("hull.load_step.time",), effects=[Attachment(LoadStep(), "hull", False, {})] if timed else [],
    )  # fmt: skip
    effects = [
        SimpleNamespace(
            name="sensor_delay", at=f"sensor_y{k}",
            amplitude=SimpleNamespace(value=value, stderr=error, quadratic=None),
            members=(SimpleNamespace(name="sensor_delay", at=f"sensor_y{k}"),),
        )
        for k, (value, error) in enumerate(delays)
    ]  # fmt: skip
    return SimpleNamespace(model=model, effects=effects)


def test_one_time_of_all_sensors_is_said_to_be_that_of_the_input():
    said = common_delay(late((0.0193, 0.0003), (0.0194, 0.0003)))
    assert said == (
        "All 2 sensors are late by one time: where the input u acts 0.01935 ± 0.00021 s later than recorded (an "
        "actuator, another clock), the data are the same, and one cause does it"
    )
    assert "where the inputs act" in common_delay(late((0.02, 0.001), (0.02, 0.001), inputs=("u", "v")))


def test_a_delay_of_the_only_sensor_may_be_that_of_the_input():
    said = common_delay(late((0.0193, 0.0003), outputs=1))
    assert said.startswith(
        "The only sensor is late: where the input u acts 0.01930 ± 0.00030 s later than recorded"
    )


@pytest.mark.parametrize(
    "other",
    [
        late((0.0193, 0.0003)),  # the second sensor is in time
        late((0.0193, 0.0003), (0.025, 0.0003)),
        late((0.0193, 0.0003), (0.0193, None)),
        late((0.0193, 0.0003), (0.0193, 0.0003), inputs=()),
        late((0.0193, 0.0003), (0.0193, 0.0003), timed=lambda t, p: ca.sin(t)),
        late(),
    ],
)
def test_nothing_is_said_of_other_delays(other):
    assert common_delay(other) == ""


def test_an_event_whose_time_is_found_comes_later_by_the_delay():
    """The data are the same: a thrust 0.12 s late, and a load at 13.48 s, were a late sensor and a load at 13.37 s."""
    said = common_delay(late((0.0193, 0.0003), outputs=1, timed=lambda t, p: ca.tanh((t - p) / 0.3)))
    assert "(an actuator, another clock), and hull.load_step later by that, the data are the same" in said


@pytest.mark.parametrize(("at", "said"), [("air", True), ("food", False)])
def test_a_constant_may_be_an_offset_of_an_input(at, said):
    """Where it stands at the place at which the input acts, in the class of what was found."""
    why = [
        NotApplicable("input_offset", "input_Tamb", (), (), "constant_torque at air does the same"),
        NotApplicable(
            "asymmetric_friction", "air", (), (), "the simulation of the records moves in one direction alone"
        ),
    ]
    members = [
        SimpleNamespace(name="coulomb_friction", at="air"),
        SimpleNamespace(name="constant_torque", at=at),
    ]
    repair = SimpleNamespace(not_applicable=why, effects=[SimpleNamespace(members=members)])
    words = "A constant at air is what an offset of the input Tamb does: no data tell them apart"
    assert as_an_input(repair) == ([words] if said else [])


@pytest.mark.parametrize("drag", [False, True])
def test_a_lag_of_the_sensor_is_one_of_the_input_in_linear_equations_alone(drag):
    """Said of the model without effects, it was told of a repaired one with a cubic spring, which tells them apart."""
    b = ce.Blueprint("mass")
    k = b.parameter("k", 3.0, unit="N/m", min=0.1)
    z, v, force = b.state("z", unit="m"), b.state("v", unit="m/s"), b.input("F", unit="N")
    b.ode("z", v)
    b.ode("v", force - k * z - 0.2 * v + b.port("spring", "inertia", {"speed": v, "angle": z}))
    b.output("z_seen", z, unit="m")
    model = b.model().with_effect(ce.effects.SensorLag(), at="sensor_z_seen")
    if drag:
        model = model.with_effect(ce.effects.QuadraticDrag(), at="spring")
    one = SimpleNamespace(
        name="sensor_lag",
        at="sensor_z_seen",
        amplitude=SimpleNamespace(value=1.0, stderr=0.01, quadratic=None),
        parameters={"sensor_z_seen.sensor_lag.time": Estimate(0.06, 0.001, "s")},
        members=(SimpleNamespace(name="sensor_lag", at="sensor_z_seen"),),
    )
    said = common_delay(SimpleNamespace(model=model, effects=[one]))
    assert said == (
        ""
        if drag
        else "The only sensor is behind: where the input F acts through a lag of 0.0600 ± 0.0010 s (an actuator), the "
        "data are the same"
    )


def acting_late(effect, value=0.25, *, share=(1.0, None), bends=False, sensors=1, beside=()):
    """A repair in which all of the only input, or a share of it, acts late."""
    x, u, none = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX(0, 1)
    ports = [SimpleNamespace(kind="sensor", name=f"sensor_y{k}") for k in range(sensors)]
    model = SimpleNamespace(
        ports=ports, inputs=[SimpleNamespace(name="p")], x=x, u=u, d=none, w=none, t=ca.SX.sym("t"), p=none,
        closed_ode=u - x**2 if bends else u - x, output_expressions=x, closed_outputs=x, time_unit="s",
        parameter_names=(), effects=[],
    )  # fmt: skip
    amplitude = SimpleNamespace(value=share[0], stderr=share[1], quadratic=None)
    members = [SimpleNamespace(name=name) for name in (effect, *beside)]
    found = SimpleNamespace(
        name=effect, at="input_p", amplitude=amplitude, members=members,
        parameters={f"input_p.{effect}.time": Estimate(value, 0.003, "s")},
    )  # fmt: skip
    return SimpleNamespace(model=model, effects=[found])


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (acting_late("input_lag"), "the only sensor is behind by 0.2500 ± 0.0030 s, the data are the same"),
        (acting_late("input_delay", bends=True), "the only sensor is late by 0.2500 ± 0.0030 s"),
        (acting_late("input_lag", sensors=2), "all 2 sensors are behind by 0.2500 ± 0.0030 s"),
        (acting_late("input_lag", bends=True), ""),  # a law that bends shows it
        (acting_late("input_lag", share=(0.5, 0.01)), ""),
        (acting_late("input_lag", beside=("sensor_lag",)), ""),  # it is in the class
    ],
)
def test_an_input_that_acts_late_is_a_sensor_that_is_behind(found, said):
    """A lag of a tachometer was named as one of the pressure, confirmed, without a word: one noise of six does that."""
    assert said in late_input(found)
    assert bool(late_input(found)) == bool(said)


@pytest.mark.parametrize(
    ("found", "verdict", "kept"),
    [
        (late((0.0193, 0.0003), outputs=1), "class", False),
        (acting_late("input_delay", bends=True), "class", False),
        (late((0.0193, 0.0003)), "named", True),  # the second sensor is in time
    ],
)
def test_what_another_cause_shows_as_well_is_a_class(found, verdict, kept):
    """ "The data are the same" stood above "fresh data tell sensor_delay from input_delay: 36 times as probable"."""
    told = "fresh data tell sensor_delay at sensor_y0 from input_delay at input_u: with them it is 36 times as probable"
    other = "fresh data tell sensor_delay at sensor_y0 from sensor_lag at sensor_y0: with them it is 9 times"
    made = dataclasses.make_dataclass("Found", ["model", "effects", "verdict", "messages"])
    again = with_other_cause(made(found.model, found.effects, "named", (told, other)))
    assert again.verdict == verdict
    assert again.messages == ((told, other) if kept else (other,))


def test_which_other_cause_is_said_in_a_clause():
    assert other_cause(late((0.0193, 0.0003), outputs=1)) == "u acts late"
    assert other_cause(acting_late("input_delay", bends=True)) == "the sensors are late"
    assert other_cause(late((0.0193, 0.0003))) == ""
    assert other_cause(acting_late("input_lag")) == "the sensors are behind"
