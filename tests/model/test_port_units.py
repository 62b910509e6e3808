"""Units of slots and signals, as the equations and the declared units tell them."""

import casadi as ca
import pytest

import casadi_engine as ce
from casadi_engine.model.declarations import Port


def port_of(state, slope, *, speed=None, time_unit=None, extra=None, stated=None):
    """The port of a model dx/dt = (in + slot) * slope in which the state has a unit; slope : value, unit."""
    b = ce.Blueprint("one", time_unit=time_unit)
    x = b.state("x", unit=state)
    factor = b.parameter("a", 2.0, unit=slope) if isinstance(slope, str) else slope
    slot = b.port("here", "inertia", {"speed": x if speed is None else speed(b, x)}, unit=stated)
    b.ode("x", slot * factor + (0 if extra is None else extra(b, x)))
    b.output("y", x, unit=state)
    return b.model().ports["here"]


@pytest.mark.parametrize(
    ("state", "slope", "unit", "leak"),
    [
        ("m", "1/m2", "m3/s", "m2/s"),
        ("K", "K/J", "W", "W/K"),
        ("V", "V/(A s)", "A", "A/V"),
        ("rad/s", "1/(kg m2)", "N m", "N m s/rad"),
        ("m/s", "1/kg", "N", "N s/m"),
    ],
)
def test_a_slot_has_the_unit_that_its_ode_asks_for(state, slope, unit, leak):
    port = port_of(state, slope)
    assert port.unit == unit
    assert port.in_its_unit("N m s/rad") == leak
    assert port.in_its_unit("N m") == unit
    assert port.in_its_unit("s") == "s"


def test_time_in_hours():
    port = port_of("mg/L", 1.0, time_unit="h", extra=lambda b, x: -b.parameter("k", 1.0, unit="1/h") * x)
    assert (port.unit, port.in_its_unit("N m s/rad")) == ("mg/(L h)", "1/h")


def test_an_ode_per_inertia_has_slots_per_inertia():
    def falls(b, x):
        return -b.parameter("c", 1.0, unit="1/s") * x

    assert port_of("rad/s", 1.0, extra=falls).unit == "rad/s2"
    assert port_of("rad/s", 8.0, extra=falls).unit == "N m"  # the number may be one over an inertia
    assert port_of("rad/s", 1.0, extra=lambda b, x: -9.81 * x).unit == "N m"  # and so may this one
    assert port_of("m/s", "1").unit == "N"  # a unit that may have been left out
    assert port_of("K", "1").unit == "-"
    assert port_of("kg m/s", 1.0).unit == "-"  # nothing beside the slot tells
    assert port_of("K", "K/J", stated="kW").unit == "kW"


def test_signals_of_several_symbols():
    def over_radius(b, x):
        return x / b.parameter("r", 0.1, unit="m")

    port = port_of("m/s", "1/kg", speed=over_radius)
    assert (port.units["speed"], port.in_its_unit("N m s/rad")) == ("1/s", "N s")
    assert "speed" not in port_of("K", "K/J", speed=lambda b, x: x - 293).units
    assert port_of("K", "K/J", speed=lambda b, x: x - 293).in_its_unit("N m s/rad") == "-"
    difference = port_of("K", "K/J", speed=lambda b, x: x - b.input("T_a", unit="K"))
    assert difference.in_its_unit("N m s2/rad2") == "W/K2"


def test_a_spring_counts_by_its_stretch():
    port = Port("spring", "coupling", unit="N", units={"twist": "m", "twist_rate": "m/s"})
    assert [port.in_its_unit(text) for text in ("N m/rad3", "N m s/rad", "rad", "rad/s")] == [
        "N/m3", "N s/m", "m", "m/s",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("unit", "speed", "quantity", "mechanical"),
    [
        ("kN", "m/s", "force", True), ("rad/s2", "rad/s", "angular acceleration", True), ("-", "m/s", "term", True),
        ("-", "K", "term", False), ("L/min", "m", "volume flow", False), ("mg/(L h)", "mg/L", "rate", False),
    ],
)  # fmt: skip
def test_what_acts_at_a_port(unit, speed, quantity, mechanical):
    port = Port("here", "inertia", {"speed": ca.SX.sym("x")}, unit=unit, units={"speed": speed})
    assert (port.quantity, port.is_mechanical) == (quantity, mechanical)


def test_links_of_what_turns_and_pipes_of_the_rest():
    def both(unit):
        b = ce.Blueprint("two")
        for k in (1, 2):
            h = b.state(f"h_{k}", unit="m")
            b.ode(f"h_{k}", b.port(f"tank_{k}", "inertia", {"level": h}, unit=unit))
        b.output("level", h, unit="m")
        return b.model().ports["tank_1_and_tank_2"]

    assert (both("m3/s").kind, both("m3/s").in_its_unit("N m s/rad")) == ("pipe", "m2/s")
    assert both("m/s2").kind == "link"


@pytest.mark.parametrize("written", ["T - outside", "T", "T * T - outside"])
def test_heat_flows_by_the_difference_of_two_temperatures_whatever_is_around_each(written):
    b = ce.Blueprint("collector_and_tank")
    collector, tank = b.state("T_c", unit="K"), b.state("T_t", unit="K")
    outside, room = b.input("T_out", unit="K"), b.parameter("T_room", 293.0, unit="K")
    size = b.parameter("C", 2e5, unit="J/K")
    above = {"T - outside": collector - outside, "T": collector, "T * T - outside": collector**2 - outside}[
        written
    ]
    for name, temperature, signal in (("collector", collector, above), ("tank", tank, tank - room)):
        b.ode(temperature.name(), b.port(name, "inertia", {"speed": signal}) / size)
        b.output(f"{name}_temperature", temperature, unit="K")
    if written == "T * T - outside":  # of which there is no difference from a temperature
        assert not b.model().ports.links
        return
    link = b.model().ports["collector_and_tank"]
    value = ca.Function("f", [collector, tank, outside, room], [link.signals["difference"]])(
        350, 310, 280, 293
    )
    assert float(value) == pytest.approx(40.0)


def test_a_drive_that_an_effect_adds_has_the_unit_of_its_port():
    b = ce.Blueprint("room")
    temperature = b.state("T", unit="K")
    b.ode("T", b.port("room", "inertia", {"speed": temperature}) / b.parameter("C", 2e5, unit="J/K"))
    b.output("T_room", temperature, unit="K")
    made = b.model().with_effect(ce.effects.LoadStep(), at="room")
    assert [(drive.name, drive.unit) for drive in made.drives] == [("T_room_load_step", "W")]
    assert made.parameters()["room.load_step.torque"].unit == "W"


@pytest.mark.parametrize(
    ("speed", "mass", "acts", "factor"),
    [("deg/s", "kg m2", "N m", 57.2958), ("rpm", "kg m2", "N m", 9.5493), ("mm/s", "kg", "N", 1e3)],
)
def test_a_number_that_converts_units_is_seen_by_what_is_added_to_the_slot(speed, mass, acts, factor):
    def port(loss):
        b = ce.Blueprint("one", time_unit="s")
        w, inertia = b.state("w", unit=speed), b.parameter("J", 2.0, unit=mass)
        slot = b.port("here", "inertia", {"speed": w})
        b.ode("w", (b.input("T", unit=acts) + slot - loss(b, w)) * factor / inertia)
        b.output("y", w, unit=speed)
        return b.model().ports["here"]

    assert port(lambda b, w: 0).unit == acts
    assert (
        port(lambda b, w: b.port("other", "internal") + w * b.parameter("c", 1.0, unit=f"{acts} s/m")).unit
        != acts
    )


@pytest.mark.parametrize(("speed", "factor", "unit"), [
    ("rpm", 9.5493, "N m"), ("rpm", 60 / (2 * 3.141592653589793), "N m"), ("deg/s", 57.29578, "N m"),
    ("rpm", 5.0, "-"), ("rad/s", 9.5493, "-"),
])  # fmt: skip
def test_a_number_that_converts_units_is_seen_where_nothing_is_added_to_the_slot(speed, factor, unit):
    b = ce.Blueprint("one")
    w, inertia = b.state("w", unit=speed), b.parameter("J", 2.0, unit="kg m2")
    b.ode("w", factor * b.port("here", "inertia", {"speed": w}) / inertia)
    b.output("y", w, unit=speed)
    assert b.model().ports["here"].unit == unit


def test_a_head_of_water_is_no_rate():
    """What is added to heads in m in the ode of a flow is a term, and what is added to a rate is a rate."""
    b = ce.Blueprint("penstock")
    g, length = b.parameter("g", 9.81, unit="m/s2"), b.parameter("L", 400.0, unit="m")
    area, head = b.parameter("A", 0.8, unit="m2"), b.parameter("H_0", 60.0, unit="m")
    flow, level = b.state("Q", unit="m3/s"), b.state("c", unit="mol/L")
    water = b.port("penstock", "inertia", {"speed": flow})
    made = b.port("species", "inertia", {"speed": level})
    b.ode("Q", g * area / length * (head - flow**2 + water))
    b.ode("c", made - b.parameter("k", 0.1, unit="1/s") * level)
    b.output("Q_m", flow, unit="m3/s")
    ports = b.model().ports
    assert (ports["penstock"].unit, ports["penstock"].quantity) == ("m", "term")
    assert (ports["species"].unit, ports["species"].quantity) == ("mol/(L s)", "rate")
    assert ce.effects.ConstantTorque().worded(ports["penstock"]) == "a constant term into penstock"


@pytest.mark.parametrize(
    ("state", "factor", "unit"),
    [
        ("deg/s", ca.pi / 180, "rad/s"),
        ("rpm", 2 * ca.pi / 60, "rad/s"),
        ("rad/s", 180 / ca.pi, "deg/s"),
        ("mm/s", 1e-3, "m/s"),
        ("deg/s", 2.0, "deg/s"),  # a gear, say
        ("deg/s", -ca.pi / 180, "deg/s"),
    ],
)
def test_a_signal_that_converts_its_unit_has_the_other_one(state, factor, unit):
    """A fading speed in rad/s was called one in deg/s."""
    port = port_of(state, 1.0, speed=lambda b, x: factor * x, stated="N m")
    assert port.units["speed"] == unit
