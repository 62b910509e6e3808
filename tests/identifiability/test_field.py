"""Arithmetic in the prime field against Python's integers, and the groups that exp, sin and cos live in."""

from __future__ import annotations

from fractions import Fraction
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.identifiability.echelon import Echelon, echelon_of, intersection, null_space
from casadi_engine.identifiability.field import PRIME, WIDE_PRIME, Pole, field_of

FIELDS = [field_of(PRIME), field_of(WIDE_PRIME)]
entries = st.integers(0, WIDE_PRIME - 1)


def matrix(random, rows, columns, *, prime=PRIME):
    """Random entries, with the extremes among them."""
    special = [0, 1, prime - 1, prime - 2, (1 << 42) - 1, (1 << 21) - 1, 1 << 60]
    made = [[random.choice([*special, random.randrange(prime)]) for _ in range(columns)] for _ in range(rows)]
    return np.array(made, dtype=np.int64).reshape(rows, columns)


def exact_product(left, right, prime):
    return [
        [sum(int(a) * int(b) for a, b in zip(row, column, strict=True)) % prime for column in right.T]
        for row in left
    ]


@pytest.mark.parametrize("prime", [PRIME, WIDE_PRIME])
def test_the_prime_is_prime_and_has_the_rotations(prime):
    def passes(base):  # Miller and Rabin; these bases decide for all numbers below 3.3e24
        odd, twos = prime - 1, 0
        while odd % 2 == 0:
            odd, twos = odd // 2, twos + 1
        power = pow(base, odd, prime)
        return power in (1, prime - 1) or any(
            (power := power * power % prime) == prime - 1 for _ in range(twos - 1)
        )

    assert all(passes(base) for base in (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41))
    assert prime % 4 == 3
    assert (prime + 1) % 5760 == 0


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 5, 4), (2, 682, 3), (2, 683, 2), (1, 1500, 2), (7, 0, 3)])
@pytest.mark.parametrize("field", FIELDS, ids=["prime", "wide"])
def test_products_of_matrices_are_exact(field, shape):
    m, k, n = shape
    random = Random(m + 10 * k + n)
    left, right = (matrix(random, *size, prime=field.prime) for size in ((m, k), (k, n)))
    assert field.product(left, right).tolist() == exact_product(left, right, field.prime)


def test_the_largest_entries_do_not_overflow():
    field = FIELDS[0]
    left, right = np.full((2, 682), PRIME - 1, dtype=np.int64), np.full((682, 2), PRIME - 1, dtype=np.int64)
    assert field.product(left, right).tolist() == [[682, 682], [682, 682]]


@given(entries, entries, st.integers(1, WIDE_PRIME - 1))
@settings(max_examples=60, deadline=None)
def test_sums_differences_and_scalings(a, b, factor):
    for field in FIELDS:
        one, other = (np.array([[value % field.prime]], dtype=np.int64) for value in (a, b))
        x, y = int(one[0, 0]), int(other[0, 0])
        assert int(field.sum(one, other)[0, 0]) == (x + y) % field.prime
        assert int(field.difference(one, other)[0, 0]) == (x - y) % field.prime
        scale = factor % field.prime
        assert int(field.scaled(one, scale)[0, 0]) == x * scale % field.prime


@given(st.fractions(min_value=-900, max_value=900, max_denominator=900))
def test_small_fractions_come_back(value):
    field = FIELDS[0]
    found = field.small_fraction(field.fraction(value), 1000 * 900)
    assert found == value
    assert field.small_fraction(field.fraction(Fraction(1, 3)), 2) is None


@given(st.integers(2, PRIME - 1), st.fractions(min_value=-3, max_value=3, max_denominator=9))
@settings(max_examples=40, deadline=None)
def test_powers_with_rational_exponents_obey_their_laws(drawn, exponent):
    field = FIELDS[0]
    base = pow(drawn, 2 * ((PRIME - 1) // 2 // field.root_order), PRIME)
    if base == 1:
        return
    power = field.power(base, exponent)
    assert pow(power, exponent.denominator, PRIME) == field.power(base, Fraction(exponent.numerator))
    assert power * field.power(base, -exponent) % PRIME == 1


def test_roots_are_squares_and_where_there_is_none_it_says_so():
    field, random = FIELDS[0], Random(1)
    for _ in range(20):
        value = random.randrange(2, PRIME)
        square = value * value % PRIME
        assert pow(field.root(square), 2, PRIME) == square
        with pytest.raises(Pole, match="no square root"):
            field.root(-square % PRIME)  # -1 is no square, as P ≡ 3 mod 4
    with pytest.raises(Pole, match="division by zero"):
        field.inverse(0)
    with pytest.raises(Pole, match="no root"):
        field.power(-4 % PRIME, Fraction(1, 2))


@pytest.mark.parametrize("field", FIELDS, ids=["prime", "wide"])
def test_rotations_are_those_of_the_circle(field):
    half = field.inverse(2)
    turn = field.steps
    assert field.rotation(turn // 6)[0] == half  # cos 60°
    assert field.rotation(turn // 12)[1] == half  # sin 30°
    assert field.rotation(turn // 4) == (0, 1)
    assert field.rotation(turn // 2) == (field.prime - 1, 0)
    cosine, sine = field.rotation(turn // 8)
    assert cosine == sine
    assert 2 * cosine * cosine % field.prime == 1
    counts = [2, 3, 4, 5, 6, 8, 9, 10, 12] + ([7, 11, 13] if field is FIELDS[1] else [])
    for count in counts:  # n phases add up to nothing, and not before
        phases = [field.rotation(k * turn // count) for k in range(count)]
        assert sum(cosine for cosine, _ in phases) % field.prime == 0
        assert sum(sine for _, sine in phases) % field.prime == 0
        assert len(set(phases)) == count


@given(st.fractions(min_value=-5, max_value=5, max_denominator=60), st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_drawn_points_stay_on_the_circle_and_multiples_add_up(factor, seed):
    field = FIELDS[0]
    point = field.turn(Random(seed))
    cosine, sine = field.turn_multiple(point, factor)
    assert (cosine * cosine + sine * sine) % field.prime == 1
    rest = field.turn_multiple(point, 1 - factor)
    assert field.turned((cosine, sine), rest) == point


# ---- row spaces


@pytest.mark.parametrize("rank", [0, 1, 4, 6])
def test_rank_and_null_space_of_a_matrix_with_a_known_rank(rank):
    field, random = FIELDS[0], Random(rank)
    rows = field.product(matrix(random, 9, rank), matrix(random, rank, 6)) if rank else np.zeros((9, 6), int)
    made = echelon_of(field, np.ascontiguousarray(rows, dtype=np.int64))
    assert made.rank <= rank
    space = made.null_space()
    assert space.shape == (6, 6 - made.rank)
    assert not field.product(np.ascontiguousarray(rows, dtype=np.int64), space).any()
    assert all(made.contains(np.ascontiguousarray(rows, dtype=np.int64)))


def test_the_echelon_form_does_not_depend_on_the_order_of_rows():
    field, random = FIELDS[0], Random(3)
    rows = matrix(random, 5, 8)
    one, other = Echelon(field, 8), Echelon(field, 8)
    grown = [one.add(rows[[k]]) for k in range(5)]
    other.add(rows[::-1].copy())
    assert sum(grown) == one.rank == other.rank
    assert one.rows.tolist() == other.rows.tolist()


def test_the_intersection_of_two_spaces():
    field, random = FIELDS[0], Random(8)
    shared, left, right = (matrix(random, 7, size) for size in (2, 1, 2))
    common = intersection(field, np.hstack([shared, left]), np.hstack([shared, right]))
    assert common.shape == (7, 2)
    assert all(echelon_of(field, np.ascontiguousarray(shared.T)).contains(np.ascontiguousarray(common.T)))
    assert intersection(field, left, right).shape == (7, 0)
    assert null_space(field, np.eye(4, dtype=np.int64)).shape == (4, 0)
