"""A bound on the probability that random numbers in a prime field mislead the test (Schwartz and Zippel)."""

from __future__ import annotations

import casadi as ca

from casadi_engine.identifiability.equations import CONSTANTS
from casadi_engine.identifiability.question import Question
from casadi_engine.identifiability.tape import Tape

_DEGREE_OF_FUNCTION = {ca.OP_EXP, ca.OP_LOG, ca.OP_SIN, ca.OP_COS, ca.OP_TANH, ca.OP_SQRT, ca.OP_POW}


def error_probability(question: Question, orders: int, rank: int) -> float:
    """Bound for one drawing, at most 1.

    A rank is too low only if a nonzero minor vanishes at the random point. With f and h quotients of polynomials of
    degree up to D over a common denominator, coefficient k of the output is one of degree up to D + 2kD, its
    gradient of 2D more; the minor's degree is at most the sum over the rank's rows, and a polynomial of degree Δ
    vanishes at a random point with a probability of at most Δ/P. A function such as exp counts as one more state.
    Random numbers are drawn as squares, which doubles Δ. What the bound leaves out: that P itself divides every
    minor (P is fixed, not drawn). A full rank is not a matter of probability: it proves itself.
    """
    degree = max(_degree(one.derivatives(setting.outputs, setting.unknown).tape)
                 for one, setting in zip(question.equations, question.settings, strict=True))  # fmt: skip
    # the worst case takes the rows of the highest orders
    total = sum(degree * (2 * max(orders - row, 0) + 3) for row in range(max(rank, 1)))
    return float(min(1.0, 2.0 * total / question.field.prime))


def _degree(tape: Tape) -> int:
    """Degree of f and h over a common denominator; functions as further states."""
    above: list[int] = []
    below: list[int] = []
    extra = 0
    needed = _needed(tape)
    for node, (op, a, b, _) in enumerate(tape.code):
        n, m = 0, 0
        if op == ca.OP_INPUT:
            n = 0 if a == CONSTANTS else 1
        elif op in (ca.OP_ADD, ca.OP_SUB):
            n, m = max(above[a] + below[b], above[b] + below[a]), below[a] + below[b]
        elif op == ca.OP_MUL:
            n, m = above[a] + above[b], below[a] + below[b]
        elif op == ca.OP_SQ:
            n, m = 2 * above[a], 2 * below[a]
        elif op == ca.OP_DIV:
            n, m = above[a] + below[b], below[a] + above[b]
        elif op == ca.OP_INV:
            n, m = below[a], above[a]
        elif op in (ca.OP_NEG, ca.OP_TWICE):
            n, m = above[a], below[a]
        elif op in _DEGREE_OF_FUNCTION:
            n = 1
            if node in needed:
                extra += 2 + above[a] + 2 * below[a]
        above.append(n)
        below.append(m)
    ends = tape.outputs[0]
    common = sum(below[node] for node in ends)
    return max([1, common, *(above[node] + common - below[node] for node in ends)]) + extra


def _needed(tape: Tape) -> set[int]:
    """The nodes that f and h themselves are made of."""
    found: set[int] = set()
    stack = list(tape.outputs[0])
    while stack:
        node = stack.pop()
        if node in found:
            continue
        found.add(node)
        op, a, b, _ = tape.code[node]
        if op not in (ca.OP_INPUT, ca.OP_CONST):
            stack.extend(one for one in (a, b) if one >= 0)
    return found
