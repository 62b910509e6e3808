"""Units and their conversion."""

import math
import time
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import casadi_engine as ce
from casadi_engine.errors import UnitError
from casadi_engine.experiment import ALLOWED_UNITS, si_unit, split_header, to_si
from casadi_engine.experiment.units import converted, read_unit


@pytest.mark.parametrize(
    ("value", "unit", "expected", "si"),
    [
        (1200, "rpm", 40 * math.pi, "rad/s"),
        (180, "deg", math.pi, "rad"),
        (1.5, "bar", 1.5e5, "Pa"),
        (101.325, "kPa", 101325.0, "Pa"),
        (2.5, "MPa", 2.5e6, "Pa"),
        (57000, "N mm", 57.0, "N m"),
        (390, "g m2", 0.39, "kg m2"),
        (3, "ms", 0.003, "s"),
        (3, "N m", 3.0, "N m"),
        (3, "N  m", 3.0, "N m"),
        (3, "1", 3.0, "1"),
    ],
)
def test_conversion(value, unit, expected, si):
    values, name = to_si([value], unit)
    assert name == si == si_unit(unit)
    assert values[0] == pytest.approx(expected, rel=1e-15)
    if si not in ("rad", "rad/s"):
        assert values[0] == expected


@pytest.mark.parametrize("unit", ALLOWED_UNITS)
def test_the_si_unit_of_every_allowed_unit_is_its_own_si_unit(unit):
    assert si_unit(si_unit(unit)) == si_unit(unit)


def test_the_users_array_is_left_alone():
    mine = np.array([1.0, 2.0])
    values, _ = to_si(mine, "Pa")
    values[0] = 9
    to_si(mine, "bar")
    assert mine.tolist() == [1.0, 2.0]


# Factors by hand, from the definitions of the units: value of one in the SI unit of the text behind.
KNOWN = {
    "km/h": (1 / 3.6, "m/s"), "1/h": (1 / 3600, "1/s"), "mm": (1e-3, "m"), "mV": (1e-3, "V"),
    "L/min": (1e-3 / 60, "m3/s"),
    "l/h": (1e-3 / 3600, "m3/s"), "mol/L": (1e3, "mol/m3"), "g/L": (1.0, "kg/m3"), "mg/L": (1e-3, "kg/m3"),
    "h": (3600.0, "s"), "min": (60.0, "s"), "d": (86400.0, "s"), "rev/min": (math.pi / 30, "rad/s"),
    "rev": (2 * math.pi, "rad"), "uF": (1e-6, "A s/V"), "µF": (1e-6, "A s/V"),
    "mC": (1e-3, "A s"), "Ah": (3600.0, "A s"), "kOhm": (1e3, "Ohm"), "kΩ": (1e3, "Ohm"),
    "W/(m2 K)": (1.0, "W/(m2 K)"), "mW/(cm2 K)": (10.0, "W/(m2 K)"), "%": (0.01, "1"), "m^2": (1.0, "m2"),
    "kg·m²": (1.0, "kg m2"), "kg*m**2": (1.0, "kg m2"), "1/(Pa s)": (1.0, "1/(Pa s)"), "m s⁻¹": (1.0, "m/s"),
    "s^-1": (1.0, "1/s"), "min-1": (1 / 60, "1/s"), "mg/kg/h": (1e-6 / 3600, "1/s"), "kWh": (3.6e6, "J"),
    "cmH2O": (98.0665, "Pa"), "mmH2O": (9.80665, "Pa"), "mL/cmH2O": (1e-6 / 98.0665, "m3/Pa"),
    "psi": (6894.757293168361, "Pa"), "mbar": (100.0, "Pa"), "N.m": (1.0, "N m"), "deg/s": (math.pi / 180, "rad/s"),
    "rad/(rad/s)": (1.0, "s"), "m2.5/s": (1.0, "m2.5/s"), "cm^(1/2)": (0.1, "m0.5"), "nm": (1e-9, "m"),
    "cm3": (1e-6, "m3"), "um2": (1e-12, "m2"), "J/(kg degC)": (1.0, "J/(kg K)"), "ug/mL": (1e-3, "kg/m3"),
    "nM": (1e-6, "mol/m3"), "N m/deg": (180 / math.pi, "N m/rad"), "g": (1e-3, "kg"), "t": (1e3, "kg"),
}  # fmt: skip


@pytest.mark.parametrize("unit", KNOWN)
def test_any_product_of_symbols_is_read(unit):
    factor, si = KNOWN[unit]
    values, name = to_si([1.0, -3.0], unit)
    assert name == si
    assert values == pytest.approx([factor, -3 * factor], rel=4e-16)
    assert read_unit(name).is_si
    assert read_unit(name).dimension == read_unit(unit).dimension
    assert converted(values, si, unit) == pytest.approx([1.0, -3.0], rel=5e-16)


def test_degrees_of_temperature_have_an_offset_alone_and_none_in_a_product():
    assert to_si([-40.0, 0.0, 100.0], "degC")[0].tolist() == [233.14999999999998, 273.15, 373.15]
    assert to_si([-40.0, 32.0, 212.0], "degF")[0] == pytest.approx([233.15, 273.15, 373.15], rel=1e-15)
    assert converted([20.0], "degC", "degF") == pytest.approx([68.0], rel=1e-14)
    assert to_si([2.0], "W/degC")[0].tolist() == [2.0]
    assert to_si([2.0], "degC/s")[0].tolist() == [2.0]


@pytest.mark.parametrize(("unit", "cure"), [("C", "write degC"), ("F", "write degF")])
def test_letters_that_may_be_a_temperature_are_refused_in_data(refused, unit, cure):
    refused(UnitError, ["here: ", "may be meant as a temperature", cure], si_unit, unit, where="here")
    refused(UnitError, ["may be meant as a temperature", cure], to_si, [1.0], f" {unit} ")
    assert read_unit(unit).is_si  # a capacitance of a model may be declared in F


def test_exact_ratios_are_exact():
    for unit, value in (("ms", 3.0), ("N mm", 57.0), ("L/min", 60.0), ("um", 7.0)):
        unit_read = read_unit(unit)
        assert unit_read.factor.denominator > 1
        assert to_si([value], unit)[0][0] == float(Fraction(value) * unit_read.factor)


def test_a_dash_is_what_many_write_for_one(tmp_path):
    """In heads of columns, and in tables of a model whose units nobody stated."""
    path = tmp_path / "r.csv"
    path.write_text("time [s],y [-]\n0,1\n1,2\n2,3\n")
    assert ce.read_experiment(path)["y"].unit == "1"
    time = np.arange(3.0)
    assert ce.Experiment.from_arrays("r", time=time, units={"y": " - "}, y=time)["y"].unit == "1"


@pytest.mark.parametrize(
    ("unit", "cure"),
    [
        ("RPM", "did you mean 'rpm'?"),
        ("Rpm", "did you mean 'rpm'?"),
        ("KPA", "did you mean 'kPa'?"),
        ("MPA", "did you mean 'MPa' or 'mPa'?"),
        ("Kg", "did you mean 'kg'?"),
        ("mm/hh", "did you mean 'mm/h'?"),
        ("lbs", "did you mean 'lb' or 'lb s'?"),
        ("Nm", "did you mean 'N m'?"),
        ("kgm2", "did you mean 'kg m2'?"),
        ("Nms/rad", "did you mean 'N m s/rad'?"),
        ("W/Nm2", "did you mean 'W/(N m2)'?"),
        ("rad/Sec", "did you mean 'rad/s'?"),
        ("kmh", "did you mean 'km/h'?"),
        ("litre/min", "did you mean 'L/min'?"),
        ("", "write 1 for a dimensionless quantity"),
        ("parsec", "convert the data to an SI unit"),
        ("EUR/h", "convert the data to an SI unit"),
        (None, "give the unit as text"),
        (3, "give the unit as text"),
    ],
)
def test_an_unknown_unit_is_named_with_another_spelling_of_the_same_unit(refused, unit, cure):
    for call in (si_unit, lambda u, **where: to_si([1.0], u, **where)):
        message = refused(
            UnitError, ["here: unknown unit", "symbols such as", cure], call, unit, where="here"
        )
        assert (unit if isinstance(unit, str) and unit else repr(unit)) in message


@pytest.mark.parametrize(
    ("unit", "shown", "pieces"),
    [
        ("m EUR/h", "m EUR/h\n    ^^^\n", ["unknown unit 'EUR'"]),
        ("W/m2 K", "W/m2 K\n       ^\n", ["a product behind a slash can be read in two ways", "W/(m2 K)"]),
        ("(m", "(m\n  ^\n", ["a bracket is not closed", "close it"]),
        ("m^(1/2", "m^(1/2\n   ^\n", ["a bracket is not closed"]),
        ("m)", "m)\n   ^\n", ["a unit is missing here"]),
        ("m2/", "m2/\n     ^\n", ["a unit is missing here", "1 for a dimensionless"]),
        ("10 bar", "10 bar\n  ^^\n", ["a number stands where a symbol is needed", "a prefix"]),
        ("N-m", "N-m\n   ^\n", ["a hyphen joins no units", "a space"]),
        ("m^x", "m^x\n    ^\n", ["the power is not a number"]),
        ("m0", "m0\n   ^\n", ["no quantity has such a power", "1 to 12"]),
        ("m99", "m99\n   ^^\n", ["no quantity has such a power"]),
        ("m$", "m$\n   ^\n", ["'$' stands for no unit"]),
    ],
)
def test_a_caret_stands_under_what_cannot_be_read(refused, unit, shown, pieces):
    refused(UnitError, [f"\n  {shown}", *pieces], si_unit, unit)


def test_units_that_no_number_can_hold(refused):
    refused(UnitError, ["too large or too small", "another prefix"], si_unit, " ".join(["Gm12"] * 12))
    refused(UnitError, ["too long to be one"], si_unit, "(" * 5000)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("N m/rad", "N m", True), ("rad", "1", True), ("deg", "%", True), ("rpm", "rad/s", True), ("Hz", "1/s", True),
        ("rad/s", "1/s", False), ("rpm", "1/min", False), ("rpm", "Hz", False), ("rad/s2", "1/s2", False),
        ("mm", "N mm", False), ("1/s", "m/s", False), ("J", "N m", True), ("degC", "K", True), ("Pa", "N/m2", True),
    ],
)  # fmt: skip
def test_angle_counts_as_one_but_for_rates(refused, one, other, same):
    assert read_unit(one).compatible(read_unit(other)) is same
    assert read_unit(other).compatible(read_unit(one)) is same
    if not same:
        pieces = ["of different dimensions", read_unit(one).dimension]
        refused(UnitError, pieces, converted, [1.0], one, other)


@settings(max_examples=40)
@given(st.text(max_size=12) | st.text(st.sampled_from("NmsradkgPaLKh123/()*^ ·²-%°.Hz"), max_size=14))
def test_any_text_is_a_unit_or_a_named_error(text):
    try:
        unit = read_unit(text)
    except UnitError as error:
        told = error.cure
    else:
        told = ""
    if told:
        return
    assert read_unit(unit.si).is_si
    assert read_unit(unit.si).exponents == unit.exponents


def test_reading_a_unit_again_takes_microseconds():
    si_unit("N m s/rad")
    begun = time.process_time()
    for _ in range(1000):
        si_unit("N m s/rad")
    assert time.process_time() - begun < 0.05


def test_headers():
    assert split_header(" p1 [bar] ") == ("p1", "bar")
    assert split_header("p1[bar]") == ("p1", "bar")
    assert split_header("p1") == ("p1", None)
    assert split_header("p1 [bar] x") == ("p1 [bar] x", None)
    assert split_header("[1]") == ("", "1")
