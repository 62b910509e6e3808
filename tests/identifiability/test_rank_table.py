"""The ranks of the engine-load models: published results and an independent method's table, cell by cell."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from random import Random

import pytest

import casadi_engine as ce
from casadi_engine.identifiability import identifiability
from casadi_engine.model import thesis_ties
from tests.quick import few

ONE_EXCITED = {"T_4": "generic", "*": "zero"}
ROWS = {
    "generic": {},
    "constant": {"inputs": "constant"},
    "zero": {"inputs": "zero"},
    "step from rest": {"inputs": "constant", "start": "rest"},
    "T_4 excited": {"inputs": {"T_4": "generic", "*": "zero"}},
    "T_4 excited, others constant": {"inputs": {"T_4": "generic", "*": "constant"}},
    "T_load excited": {"inputs": {"T_load": "generic", "*": "zero"}},
    "T_load excited, others constant": {"inputs": {"T_load": "generic", "*": "constant"}},
    "T_load unknown constant": {"inputs": {"T_load": "unknown constant"}},
    "T_load unknown": {"inputs": {"T_load": "unknown arbitrary"}},
    "T_load unknown, both ends": {"inputs": {"T_load": "unknown arbitrary"}, "outputs": ("omega", "omega_7")},
}
# (rank, size, directions), None where the source gives the directions alone
TABLE = {
    "2dof 1": {"generic": (4, 4, 1), "constant": (4, 4, 1), "zero": (4, 4, 1), "step from rest": (1, 1, 1)},
    "2dof 5": {"generic": (8, 8, 5), "constant": (7, 8, 4), "zero": (6, 8, 3), "step from rest": (5, 5, 5)},
    "7dof 6": {
        "generic": (19, 19, 6),
        "constant": (19, 19, 6),
        "zero": (19, 19, 6),
        "step from rest": (6, 6, 6),
        "T_4 excited": (19, 19, 6),
        "T_4 excited, others constant": (19, 19, 6),
        "T_load excited": (19, 19, 6),
        "T_load excited, others constant": (19, 19, 6),
        "T_load unknown constant": (None, None, 6),
        "T_load unknown": (None, None, 0),
        "T_load unknown, both ends": (None, None, 6),
    },
    "7dof 21": {
        "generic": (34, 34, 21),
        "constant": (27, 34, 14),
        "zero": (26, 34, 13),
        "step from rest": (21, 21, 21),
        "T_4 excited": (34, 34, 21),
        "T_4 excited, others constant": (34, 34, 21),
        "T_load excited": (33, 34, 20),
        "T_load excited, others constant": (33, 34, 20),
        "T_load unknown constant": (None, None, 21),
        "T_load unknown": (None, None, 0),
        "T_load unknown, both ends": (None, None, 21),
    },
    "7dof 23": {
        "generic": (36, 36, 23),
        "constant": (27, 36, 14),
        "zero": (26, 36, 13),
        "step from rest": (23, 23, 23),
        "T_4 excited": (35, 36, 22),
        "T_4 excited, others constant": (35, 36, 22),
        "T_load excited": (33, 36, 20),
        "T_load excited, others constant": (33, 36, 20),
        "T_load unknown constant": (None, None, 23),
        "T_load unknown": (None, None, 0),
        "T_load unknown, both ends": (None, None, 22),
    },
}


@pytest.fixture(scope="module")
def models():
    return {
        "2dof": ce.two_mass(reciprocating_speed="measured"),
        "7dof": ce.crankshaft(reciprocating_speed="measured"),
    }


def case(models, name):
    kind, number = name.split()
    model = models[kind]
    parameters = model.parameters()
    if number == "1":  # thesis: 1/J_eng alone
        for fixed in ("J_load", "K_el", "C_el", "C_eng"):
            parameters.fix(fixed)
    if number == "6":
        parameters = thesis_ties(parameters)
    if number == "21":
        parameters.fix("J7")
        parameters.fix("K76")
    return model, parameters


CELLS = [(name, row) for name, rows in TABLE.items() for row in rows]


@pytest.mark.parametrize(("name", "row"), few(CELLS, *CELLS[::3]))
def test_every_cell_of_the_rank_table(models, name, row):
    model, parameters = case(models, name)
    found = identifiability(model, parameters=parameters, **ROWS[row])
    rank, size, directions = TABLE[name][row]
    assert found.directions == directions
    if rank is not None:
        assert (found.rank, found.size) == (rank, size)
    assert found.seeds == 2
    assert found.passed == (directions == len(found.free))


@pytest.mark.parametrize(("name", "order"), [("2dof 5", 7), ("7dof 6", 18), ("7dof 23", 35)])
def test_the_parameters_separate_only_at_the_last_derivative(models, name, order):
    model, parameters = case(models, name)
    assert identifiability(model, parameters=parameters).order == order


def test_the_thesis_ranks_4_and_8_and_its_own_start(models):
    model, parameters = case(models, "2dof 1")
    assert identifiability(model, parameters=parameters).rank == 4
    model, parameters = case(models, "2dof 5")
    assert identifiability(model, parameters=parameters).rank == 8
    model, parameters = case(models, "7dof 6")
    assert identifiability(model, parameters=parameters, start="known").rank == 6


def test_with_both_ends_measured_and_the_load_unknown_only_the_load_inertia_is_lost(models):
    found = identifiability(models["7dof"], **ROWS["T_load unknown, both ends"])
    assert found.lost == ("J7",)


def test_zero_drives_lose_the_joint_scaling_of_all_inertias_stiffnesses_and_dampers(models):
    for kind in ("2dof", "7dof"):
        found = identifiability(models[kind], inputs="zero")
        (symmetry,) = found.symmetries
        assert set(symmetry.names) == set(found.free)
        assert {power for _, power in symmetry.exponents} == {Fraction(1)}
        assert not identifiability(models[kind], inputs="constant").symmetries


@pytest.mark.parametrize(("outputs", "directions"), [((0,), 0), ((0, 2), 4)])
def test_an_unknown_load_is_rechecked_by_eliminating_it_by_hand(outputs, directions):
    """An independent oracle for the last rows: three inertias, transfer functions, no power series.

    With zero initial states and one known torque on the first inertia, the outputs are y_i = G_i u + H_i v. One
    output cannot be separated from an arbitrary v at all; of two, the combination N = H_2 y_1 - H_1 y_2 does not
    hold v, so what can be told is the coefficients of (H_2 G_1 - H_1 G_2)/H_1 and H_2/H_1 as rational functions.
    """
    parameters = ["J1", "J2", "J3", "k1", "k2"]
    assert directions_by_transfer_functions(len(outputs)) == directions
    b = ce.model.Blueprint("three")
    J1, J2, J3, k1, k2 = (b.parameter(name, 1.0) for name in parameters)
    w1, w2, w3, a, c = (b.state(name) for name in ("w1", "w2", "w3", "a", "c"))
    u, v = b.input("u"), b.input("v")
    b.ode("w1", (u + k1 * a) / J1)
    b.ode("w2", (-k1 * a + k2 * c) / J2)
    b.ode("w3", (-k2 * c - v) / J3)
    b.ode("a", w2 - w1)
    b.ode("c", w3 - w2)
    b.output("y", w1)
    found = identifiability(b.model(), inputs={"v": "unknown"}, outputs=tuple(f"w{i + 1}" for i in outputs))
    assert found.directions == directions


def test_the_last_row_is_rechecked_on_the_seven_inertias_by_markov_parameters():
    """With both ends measured, ω7 is a known input of the first six inertias, and J7 and T_load drop out.

    Their transfer functions from T_1..T_4 and ω7 to ω1 then have to hold all other 22 parameters. The rank is that
    of the Jacobian of the Markov parameters C A^k B, in plain Python integers modulo another prime: no series, no
    CasADi, none of the package's code.
    """
    assert markov_rank() == 22


def markov_rank() -> int:
    prime, random, free = 2**31 - 1, Random(5), []

    def parameter():
        free.append(random.randrange(1, 2**31 - 1))
        return len(free) - 1

    inverse_J, K, C = ([parameter() for _ in range(6)] for _ in range(3))
    absolute = {i: parameter() for i in range(1, 5)}
    n, inputs, count = 12, 5, len(free)  # 6 speeds, 6 twists; T_1..T_4 and ω7
    A, B = {}, {}  # place -> list of (sign, indices of the factors)

    def add(matrix, row, column, sign, *factors):
        matrix.setdefault((row, column), []).append((sign, factors))

    for i in range(6):
        for side, sign in ((i - 1, 1), (i, -1)):  # couplings side: between inertias side and side + 1
            if side < 0:
                continue
            # the torque of coupling `side` on inertia `side` is K·twist + C·(ω_{side+1} - ω_side)
            add(A, i, 6 + side, -sign, inverse_J[i], K[side])
            add(A, i, side, sign, inverse_J[i], C[side])
            add(*((A, i, side + 1) if side + 1 < 6 else (B, i, 4)), -sign, inverse_J[i], C[side])
        if i in absolute:
            add(A, i, i, -1, inverse_J[i], absolute[i])
            add(B, i, i - 1, 1, inverse_J[i])
        add(A, 6 + i, i, -1)
        add(*((A, 6 + i, i + 1) if i + 1 < 6 else (B, 6 + i, 4)), 1)
    value, slope = zip(*(numeric(matrix, free, prime) for matrix in (A, B)), strict=True)
    # V_k = A^k B, and its derivatives by every parameter
    V = [[value[1].get((i, j), 0) for j in range(inputs)] for i in range(n)]
    dV = [
        [[slope[1].get((i, j), {}).get(q, 0) for j in range(inputs)] for i in range(n)] for q in range(count)
    ]
    rows = []
    for _ in range(2 * n + 2):
        rows += [[dV[q][0][j] for q in range(count)] for j in range(inputs)]
        new = [[0] * inputs for _ in range(n)]
        dnew = [[[0] * inputs for _ in range(n)] for _ in range(count)]
        for (i, m), entry in value[0].items():
            for j in range(inputs):
                new[i][j] = (new[i][j] + entry * V[m][j]) % prime
                for q in range(count):
                    dnew[q][i][j] = (dnew[q][i][j] + entry * dV[q][m][j]) % prime
            for q, part in slope[0].get((i, m), {}).items():
                for j in range(inputs):
                    dnew[q][i][j] = (dnew[q][i][j] + part * V[m][j]) % prime
        V, dV = new, dnew
    return rank_modulo(rows, prime)


def numeric(matrix, free, prime):
    """Entries and their derivatives by the parameters in them."""
    values, slopes = {}, {}
    for place, terms in matrix.items():
        total, parts = 0, {}
        for sign, factors in terms:
            product = sign
            for q in factors:
                product = product * free[q] % prime
            total += product
            for q in factors:
                others = [free[p] for p in factors if p != q]
                parts[q] = (parts.get(q, 0) + sign * (others[0] if others else 1)) % prime
        values[place], slopes[place] = total % prime, parts
    return values, slopes


def rank_modulo(rows, prime) -> int:
    rows, rank = [list(row) for row in rows], 0
    for column in range(len(rows[0])):
        pivot = next((i for i in range(rank, len(rows)) if rows[i][column] % prime), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        inverse = pow(rows[rank][column], -1, prime)
        for i in range(rank + 1, len(rows)):
            share = rows[i][column] * inverse % prime
            if share:
                rows[i] = [(a - share * c) % prime for a, c in zip(rows[i], rows[rank], strict=True)]
        rank += 1
    return rank


def directions_by_transfer_functions(outputs: int) -> int:
    """Rank of the Jacobian of the normalised coefficients, by exact differences of fractions."""
    if outputs == 1:
        return 0
    random = Random(3)
    point = [Fraction(random.randrange(2, 50)) for _ in range(5)]
    # (J1 s² + k1) q1 - k1 q2 = u;  -k1 q1 + (J2 s² + k1 + k2) q2 - k2 q3 = 0;  -k2 q2 + (J3 s² + k2) q3 = -v.
    # With y1 = s q1 and y3 = s q3 measured: q2 from the first row, then the second row holds no v:
    # coefficients of (J2 s² + k1 + k2)(J1 s² + k1) y1 - k1² y1 - k1 k2 y3 = (J2 s² + k1 + k2) s u, made monic.

    def told(J1, J2, J3, k1, k2):
        lead = J1 * J2
        y1 = [J2 * k1 + J1 * (k1 + k2), k1 * k2]
        return [one / lead for one in (*y1, k1 * k2, J2, k1 + k2)]

    step = Fraction(1, 10**12)
    base = told(*point)
    rows = []
    for i in range(5):
        moved = list(point)
        moved[i] += step
        rows.append([(a - c) / step for a, c in zip(told(*moved), base, strict=True)])
    return rank_with_tolerance(rows)


def rank_with_tolerance(rows) -> int:
    """Rank of a matrix of fractions by elimination; what differences leave over is below 1e-6."""
    rows, rank = [list(row) for row in rows], 0
    for column in range(len(rows[0])):
        pivot = max(range(rank, len(rows)), key=lambda i: abs(rows[i][column]), default=None)
        if pivot is None or abs(rows[pivot][column]) < Fraction(1, 10**6):
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for i in range(rank + 1, len(rows)):
            share = rows[i][column] / rows[rank][column]
            rows[i] = [a - share * c for a, c in zip(rows[i], rows[rank], strict=True)]
        rank += 1
        if rank == len(rows):
            break
    return rank


def test_the_crankshaft_with_all_parameters_takes_a_fifth_of_a_second(models):
    seconds = min(identifiability(ce.crankshaft(reciprocating_speed="measured")).seconds for _ in range(3))
    assert seconds <= 0.2


def test_a_chain_of_twenty_inertias_with_98_unknowns_takes_three_seconds():
    driven = [{"inertia": 0.1}] * 6
    model = ce.crankshaft(reciprocating_speed="measured", cylinders=12, driven=driven)
    parameters = model.parameters()
    for number in range(3, 14):
        parameters.fix(f"C{number}")
    found = identifiability(model, parameters=parameters)
    assert (found.rank, found.size, found.order) == (98, 98, 97)
    assert found.seconds <= 3


def test_the_probability_of_an_error_is_bounded_and_small(models):
    found = identifiability(models["7dof"])
    assert 0 < found.error_probability < 4e-10
    shorter = identifiability(models["2dof"])
    assert shorter.error_probability < found.error_probability


def test_the_answer_does_not_depend_on_the_seed(models):
    ranks = {
        identifiability(models["7dof"], inputs={"T_load": "generic", "*": "zero"}, seed=seed, seeds=1).rank
        for seed in range(6)
    }
    assert ranks == {33}


def test_more_that_is_known_never_makes_the_answer_worse(models):
    steps = [{"inputs": "zero"}, {"inputs": "constant"}, {"inputs": ONE_EXCITED}, {"inputs": "generic"}]
    found = [identifiability(models["7dof"], **step).directions for step in steps]
    assert all(one <= other for one, other in pairwise(found))
