"""Products of jets against polynomials that are differentiated by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.simulation import jets


def random_jet(rng, d, order, rows, columns):
    return rng.normal(size=(jets.count(d, order), rows, columns))


def at(jet, d, p):
    """The second-order Taylor polynomial of a jet."""
    i, j = jets.pairs(d)
    share = np.where(i == j, 0.5, 1.0)
    return jet[0] + np.tensordot(p, jet[1 : 1 + d], 1) + np.tensordot(share * p[i] * p[j], jet[1 + d :], 1)


def test_the_numbers_of_matrices():
    assert [jets.count(3, order) for order in (0, 1, 2)] == [1, 4, 10]
    assert [jets.count(0, order) for order in (0, 1, 2)] == [1, 1, 1]
    assert [part.tolist() for part in jets.pairs(2)] == [[0, 0, 1], [0, 1, 1]]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 4), st.integers(0, 10**6))
def test_a_product_is_the_product_of_the_taylor_polynomials(d, seed):
    rng = np.random.default_rng(seed)
    x, y = random_jet(rng, d, 2, 2, 3), random_jet(rng, d, 2, 3, 4)
    found = jets.product(x, y, d)
    direction = rng.normal(size=d)
    e = 1e-3  # the third order is left over
    for sign in (-1, 1):
        p = sign * e * direction
        np.testing.assert_allclose(at(found, d, p), at(x, d, p) @ at(y, d, p), atol=3e-6)


@pytest.mark.parametrize("d", [0, 1, 3])
def test_lower_orders_are_the_beginning_of_higher_ones(d):
    rng = np.random.default_rng(d)
    x, y = random_jet(rng, d, 2, 3, 3), random_jet(rng, d, 2, 3, 3)
    whole = jets.product(x, y, d)
    for order in (0, 1):
        k = jets.count(d, order)
        np.testing.assert_allclose(jets.product(x[:k], y[:k], d), whole[:k], rtol=1e-13)


def test_second_derivatives_of_a_square():
    # X = p A + q B: X^2 has the second derivatives 2 A^2, AB + BA, 2 B^2
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 3, 3))
    jet = np.concatenate([[0 * a, a, b], np.zeros((3, 3, 3))])
    found = jets.product(jet, jet, 2)
    np.testing.assert_allclose(found[3:], [2 * a @ a, a @ b + b @ a, 2 * b @ b], rtol=1e-13)
    assert not found[:3].any()


def test_a_constant_has_no_derivatives():
    jet = jets.constant(np.eye(2), 3, 2)
    assert jet.shape == (10, 2, 2)
    assert not jet[1:].any()
    np.testing.assert_array_equal(jet[0], np.eye(2))


def test_the_norm_is_the_largest_column_sum():
    assert jets.norm(np.array([[[1.0, -4.0], [2.0, 3.0]]])) == 7.0
    assert jets.norm(np.zeros((1, 0, 0))) == 0.0
