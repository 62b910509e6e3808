"""Units and their conversion."""

import math

import numpy as np
import pytest

from casadi_engine.errors import UnitError
from casadi_engine.experiment import ALLOWED_UNITS, si_unit, split_header, to_si


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


@pytest.mark.parametrize(
    ("unit", "cure"),
    [
        ("RPM", "did you mean 'rpm'?"),
        ("Nm", "did you mean 'N m'?"),
        ("N*m", "did you mean 'N m'?"),
        ("kg m²", "did you mean 'kg m2'?"),
        ("kgm2", "did you mean 'kg m2'?"),
        ("mbar", "did you mean 'bar'? Otherwise convert the data"),
        ("", "write 1 for a dimensionless quantity"),
        ("-", "write 1 for a dimensionless quantity"),
        ("%", "write 1 for a dimensionless quantity"),
        ("parsec", "convert the data to an SI unit"),
        (None, "give the unit as text"),
        (3, "give the unit as text"),
    ],
)
def test_an_unknown_unit_is_named_with_the_nearest_one(refused, unit, cure):
    for call in (si_unit, lambda u, **where: to_si([1.0], u, **where)):
        message = refused(UnitError, ["here: unknown unit", "rpm, deg, bar", cure], call, unit, where="here")
        assert (unit if isinstance(unit, str) and unit else repr(unit)) in message


def test_headers():
    assert split_header(" p1 [bar] ") == ("p1", "bar")
    assert split_header("p1[bar]") == ("p1", "bar")
    assert split_header("p1") == ("p1", None)
    assert split_header("p1 [bar] x") == ("p1 [bar] x", None)
    assert split_header("[1]") == ("", "1")
