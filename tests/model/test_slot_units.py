"""Units of slots in equations that convert units by bare numbers.

The oracle is the same system in SI: a slot that is worth 1 in the unit that was told, converted to SI, must move the
states as much as it does there.
"""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.answer_words import open_units
from casadi_engine.experiment.units import converted, read_unit


class System:
    """Symbols of a model in units of choice, and in SI: ``s(name)`` is a symbol times the number that makes it SI."""

    def __init__(self, units):
        self.b, self.units, self.numbers = ce.Blueprint("system", time_unit="s"), units, {}

    def unit(self, name, si):
        return self.units.get(name, si)

    def parameter(self, name, value, si):
        own = float(converted([value], si, self.unit(name, si))[0])
        return self.b.parameter(name, own, unit=self.unit(name, si)) * self._number(name, si)

    def state(self, name, si):
        return self.b.state(name, unit=self.unit(name, si)) * self._number(name, si)

    def _number(self, name, si):
        unit = self.unit(name, si)
        return 1 if unit == si else float(converted([1.0], unit, si)[0])

    def ode(self, name, si, rate):
        number = self._number(name, si)
        self.b.ode(name, rate if number == 1 else rate / number)
        if name not in self.numbers:
            self.b.output(f"y_{name}", self.b._states[name][1], unit=self.unit(name, si))
        self.numbers[name] = number


def speaker(units):
    s = System(units)
    resistance, coil, force = (
        s.parameter("Re", 5.6, "Ohm"),
        s.parameter("Le", 9e-4, "H"),
        s.parameter("Bl", 6.8, "N/A"),
    )
    mass, loss, spring = (
        s.parameter(*one) for one in (("M", 0.014, "kg"), ("R", 1.6, "N s/m"), ("K", 2400.0, "N/m"))
    )
    i, q, v, u = s.state("i", "A"), s.state("q", "m"), s.state("v", "m/s"), s.b.input("u", unit="V")
    winding, cone = s.b.port("winding", "inertia", {"speed": i}), s.b.port("cone", "inertia", {"speed": v})
    rim = s.b.port("rim", "coupling", {"twist": q, "twist_rate": v})
    s.ode("i", "A", (u - resistance * i - force * v + winding) / coil)
    s.ode("q", "m", v)
    s.ode("v", "m/s", (force * i - loss * v - spring * q + cone - rim) / mass)
    return s.b.model()


def cell(units):
    s = System(units)
    first, tau, load = (
        s.parameter("R1", 0.016, "Ohm"),
        s.parameter("t1", 35.0, "s"),
        s.parameter("R0", 0.02, "Ohm"),
    )
    u1, current = s.state("u1", "V"), s.b.input("I", unit="A")
    beside, alone = s.b.port("beside", "inertia", {"speed": u1}), s.b.port("alone", "inertia", {"speed": u1})
    s.ode("u1", "V", (first * (current + beside) - u1) / tau + load * alone / tau)
    return s.b.model()


def car(units):
    s = System(units)
    front, rear = s.parameter("Cf", 85e3, "N/rad"), s.parameter("Cr", 110e3, "N/rad")
    mass, inertia, lag = (
        s.parameter("m", 1480.0, "kg"),
        s.parameter("Iz", 2400.0, "kg m2"),
        s.parameter("lag", 0.01, "s"),
    )
    ahead, behind = s.parameter("lf", 1.15, "m"), s.parameter("lr", 1.5, "m")
    vy, r, felt = s.state("vy", "m/s"), s.state("r", "rad/s"), s.state("acc", "m/s2")
    steer, speed = s.b.input("steer", unit="rad"), s.b.input("vx", unit="m/s")
    body, yaw = s.b.port("body", "inertia", {"speed": vy}), s.b.port("yaw", "inertia", {"speed": r})
    one, two = front * (steer - (vy + ahead * r) / speed), -rear * (vy - behind * r) / speed
    s.ode("vy", "m/s", (one + two + body) / mass - speed * r)
    s.ode("r", "rad/s", (ahead * one - behind * two + yaw) / inertia)
    s.ode("acc", "m/s2", ((one + two + body) / mass - felt) / lag)
    return s.b.model()


def buck(units):
    s = System(units)
    coil, loss = s.parameter("L", 33e-6, "H"), s.parameter("RL", 0.045, "Ohm")
    store, series, load = (
        s.parameter("C", 220e-6, "F"),
        s.parameter("esr", 0.018, "Ohm"),
        s.parameter("R", 2.2, "Ohm"),
    )
    i, v, duty, feed = (
        s.state("i", "A"),
        s.state("v", "V"),
        s.b.input("duty", unit="1"),
        s.b.input("vin", unit="V"),
    )
    choke, node = s.b.port("choke", "inertia", {"speed": i}), s.b.port("node", "inertia", {"speed": v})
    out = (v + series * (i + node)) / (1 + series / load)
    s.ode("i", "A", (duty * feed - loss * i - out + choke) / coil)
    s.ode("v", "V", (i - out / load + node) / store)
    return s.b.model()


def shaft(units):
    s = System(units)
    inertia, damping = s.parameter("J", 0.2, "kg m2"), s.parameter("c", 0.01, "N m s/rad")
    w, torque = s.state("w", "rad/s"), s.b.input("T", unit="N m")
    s.ode("w", "rad/s", (torque - damping * w + s.b.port("rotor", "inertia", {"speed": w})) / inertia)
    return s.b.model()


def tank(units):
    s = System(units)
    area, leak, level = s.parameter("A", 0.3, "m2"), s.parameter("k", 1e-3, "m2/s"), s.state("h", "m")
    s.ode("h", "m", (s.b.port("tank", "inertia", {"speed": level}) - leak * level) / area)
    return s.b.model()


def slopes(model):
    """How fast the states change by one SI unit of each slot, in SI, at parameters of the model and fixed numbers."""
    size = {name: _factor(unit) for name, unit in ((one.name, one.unit) for one in model.states)}
    x = np.array([(0.3 + 0.1 * k) / size[one.name] for k, one in enumerate(model.states)])
    symbols = [model.x, model.u, model.d, model.w, model.t, model.p]
    function = ca.Function("slopes", symbols, [ca.jacobian(model.ode, model.w)])
    p = [one.value for one in model.declarations]
    found = np.array(function(x, 0.7, 0.7, 0.0, 0.0, p))
    units = np.array([_factor(port.unit) for port in model.ports.with_slot])
    return found * np.array([*size.values()])[:, None] / units


def _factor(unit):
    own = read_unit(unit)
    return float(own.factor) * np.pi ** float(own.pi)


MIXED = [
    (speaker, {"Le": "mH", "M": "g", "K": "N/mm"}), (speaker, {"q": "mm", "v": "mm/s", "M": "g"}),
    (speaker, {"i": "mA", "K": "kN/m", "Le": "uH"}), (cell, {"R1": "mOhm", "R0": "mOhm"}),
    (cell, {"u1": "mV", "R1": "mOhm", "R0": "mOhm"}), (cell, {"t1": "min"}), (car, {"Cf": "kN/rad", "Cr": "kN/rad"}),
    (car, {"Cf": "kN/deg", "m": "t", "lf": "mm"}), (buck, {"L": "uH", "RL": "mOhm", "C": "uF", "esr": "mOhm"}),
    (shaft, {"w": "rpm"}), (shaft, {"w": "deg/s", "J": "g m2", "c": "N mm s/rad"}), (tank, {"h": "mm", "A": "cm2"}),
    (tank, {"h": "cm", "k": "cm2/s"}),
]  # fmt: skip


@pytest.mark.parametrize(("build", "units"), MIXED, ids=lambda one: getattr(one, "__name__", str(one)))
def test_a_slot_is_worth_what_its_unit_says_in_any_units(build, units):
    plain, mixed = build({}), build(units)
    assert "-" not in [port.unit for port in mixed.ports.with_slot]
    assert [_factor(port.unit) for port in plain.ports.with_slot] == [1.0] * len(plain.ports.with_slot)
    np.testing.assert_allclose(slopes(mixed), slopes(plain), rtol=1e-9)


@pytest.mark.parametrize(("build", "units"), [
    (speaker, ("V", "N", "N")), (cell, ("A", "A")), (car, ("N", "N m")), (buck, ("V", "A")), (shaft, ("N m",)),
    (tank, ("m3/s",)),
])  # fmt: skip
def test_systems_in_si_have_slots_in_si(build, units):
    assert tuple(port.unit for port in build({}).ports.with_slot) == units


def one_slot(rate, *, state=("v", "m/s"), unit=None, **symbols):
    """The port of a model d(state)/dt = rate(symbols, state, slot)."""
    b = ce.Blueprint("one", time_unit="s")
    x = b.state(state[0], unit=state[1])
    made = {name: b.parameter(name, 2.0, unit=own) for name, own in symbols.items()}
    slot = b.port("here", "inertia", {"speed": x}, unit=unit)
    b.ode(state[0], rate(x, slot, **made))
    b.output("y", x, unit=state[1])
    return b.model().ports["here"]


def test_where_a_bare_number_may_convert_units_none_is_told():
    port = one_slot(lambda v, slot, m: 1e3 * slot / m, m="kg")
    assert (port.unit, port.quantity) == ("-", "term")
    assert "the number 1000 stands between it and d(v)/dt" in port.why_no_unit
    assert 'b.port("here", ..., unit="...")' in port.unit_cure
    assert port.in_its_unit("N m s/rad") == "-"  # and so of an amplitude there
    assert one_slot(lambda v, slot, m, c: (1e3 * slot - c * v) / m, m="kg", c="N s/m").unit == "-"
    assert one_slot(lambda v, slot, m: slot / m * 0.05, m="kg").unit == "-"


def test_what_is_stated_wins_and_asks_nothing():
    port = one_slot(lambda v, slot, m: 1e3 * slot / m, m="kg", unit="kN")
    assert (port.unit, port.unit_cure) == ("kN", "")


def test_another_slot_of_a_stated_unit_tells_what_is_added_to_it():
    b = ce.Blueprint("two", time_unit="s")
    v = b.state("v", unit="m/s")
    known, open_ = (
        b.port("known", "inertia", {"speed": v}, unit="kN"),
        b.port("open", "inertia", {"speed": v}),
    )
    b.ode("v", 1e3 * (known + open_) / b.parameter("m", 3.0, unit="kg"))
    b.output("y", v, unit="m/s")
    assert b.model().ports["open"].unit == "kN"


@pytest.mark.parametrize("number", [0.5, 2, 1.5, 4 / 3, 0.75, 1 / 6, -3, 2**0.5, 3**0.5 / 2])
def test_numbers_by_which_no_unit_converts_are_none(number):
    assert one_slot(lambda v, slot, m: number * slot / m, m="kg").unit == "N"
    assert one_slot(lambda v, slot, m, F: number * (slot + 5 * F) / m, m="kg", F="kN").unit == "N"
    assert one_slot(lambda v, slot, m, F: 7.3 * (slot + number * F) / m, m="kg", F="kN").unit == "kN"


def test_what_a_slot_is_added_to_is_asked_first():
    def driven(number):
        return one_slot(lambda v, slot, m, F: number * (F + slot) / m, m="kg", F="kN").unit

    assert [driven(number) for number in (1e3, 1, 17.0)] == ["kN", "kN", "kN"]
    apart = one_slot(lambda v, slot, m, F: 17 * F / m + 17 * slot / m, m="kg", F="kN")
    assert apart.unit == "kN"  # the same number, whatever it is


def test_neighbours_of_two_sizes_contradict_each_other():
    port = one_slot(lambda v, slot, m, F, G: (F + G + slot) / m, m="t", F="kN", G="N")
    assert (port.unit, port.why_no_unit) == ("-", "what it is added to is in kN and in N")
    # a number takes the one into the other, and nothing is contradicted
    assert one_slot(lambda v, slot, m, F, G: (F + 1e-3 * G + slot) / m, m="t", F="kN", G="N").unit == "kN"


def test_a_sum_and_a_rate_of_two_kinds_contradict_each_other():
    port = one_slot(lambda v, slot, m, x: (slot - x) / m, m="kg", x="m")
    assert (port.unit, port.why_no_unit) == ("-", "what it is added to is in m, and d(v)/dt asks for N")
    assert one_slot(lambda v, slot, m, x, F: (slot - x + F) / m, m="kg", x="m", F="N").unit == "N"
    # a spring of 2 N/m, whose unit nobody said
    assert one_slot(lambda v, slot, m, x: (slot - 2 * x) / m, m="kg", x="m").unit == "N"
    assert (
        one_slot(lambda v, slot, m, x, r: (slot - (2 * x + 3 * x) * r) / m, m="kg", x="m", r="1/m").unit
        == "N"
    )


def test_what_is_added_to_a_rate_is_one_whatever_number_stands_in_it():
    """(2*pi*f)**2*x is an acceleration, so that the slot beside it is no force."""
    turns = (2 * np.pi) ** 2
    assert one_slot(lambda v, slot, f, x: slot - turns * f**2 * x, f="Hz", x="m").unit == "m/s2"
    assert one_slot(lambda v, slot, f, x: slot - f**2 * x, f="Hz", x="m").unit == "m/s2"
    assert one_slot(lambda v, slot, k, x: slot - turns * k * x, k="N/m", x="m").unit == "N"  # on 1 kg


def test_what_a_slot_is_added_to_tells_behind_anything():
    b = ce.Blueprint("cell", time_unit="s")
    u, gain = b.state("u", unit="V"), b.state("gain")
    slot = b.port("here", "inertia", {"speed": u})
    b.ode("u", gain * (b.input("I", unit="mA") + slot))
    b.ode("gain", -gain)
    b.output("y", u, unit="V")
    assert b.model().ports["here"].unit == "mA"
    assert one_slot(lambda v, slot, k: ca.sin(slot + k), k="deg").unit == "deg"
    assert one_slot(lambda v, slot, k: ca.fmin(slot, k) / 8.3, k="kN").unit == "kN"
    assert (
        one_slot(lambda v, slot, m: ca.if_else(v > 0, slot, 0) / m, m="g", state=("v", "mm/s")).unit
        == "mm g/s2"
    )


def test_huge_powers_and_numbers_are_survived():
    port = one_slot(lambda v, slot, k: k**40 * v**300 * 1e300 * 1e300 * (slot + k**30), k="km")
    assert port.unit in ("-", "N")
    assert one_slot(lambda v, slot, k: slot * (1e200 * k) ** 2, k="km").unit in ("-", "N")


def test_odes_of_two_sizes_contradict_each_other():
    b = ce.Blueprint("two", time_unit="s")
    v, _ = b.state("v", unit="m/s"), b.state("w", unit="m/s")
    slot = b.port("here", "inertia", {"speed": v})
    b.ode("v", slot / b.parameter("m", 3.0, unit="kg"))
    b.ode("w", -slot / b.parameter("M", 3.0, unit="t"))
    b.output("y", v, unit="m/s")
    port = b.model().ports["here"]
    assert (port.unit, port.why_no_unit) == ("-", "it enters odes in m t/s2 and in N")


def test_tables_say_that_a_unit_is_not_stated():
    b = ce.Blueprint("one", time_unit="s")
    v = b.state("v", unit="m/s")
    b.ode("v", 1e3 * b.port("here", "inertia", {"speed": v}) / b.parameter("m", 3.0, unit="kg"))
    b.output("y", v, unit="m/s")
    model = b.model()
    lines = str(model.ports).splitlines()
    assert lines[1].split() == ["here", "inertia", "not", "stated", "speed"]
    assert lines[-1] == model.ports["here"].unit_cure != ""
    made = model.with_effect(ce.effects.ConstantTorque(), at="here")
    row = next(
        line for line in str(made.parameters()).splitlines() if line.startswith("here.constant_torque.torque")
    )
    assert "not stated" in row
    assert "[not stated]" in str(made)
    assert open_units(made, ["here", "parameter_m", "here"]) == [model.ports["here"].unit_cure]
    assert open_units(speaker({}), ["cone"]) == []


def test_a_builder_of_many_cylinders_knows_its_torques():
    assert {port.unit for port in ce.crankshaft(cylinders=5).ports.with_slot} == {"N m"}
