"""Right-hand sides of the classical test problems in CasADi, as a user would write them into `b.ode`.

Each function takes the time t and the list of states y (CasADi symbols) and returns the list of derivatives.
Sources of the equations: T. E. Hull, W. H. Enright, B. M. Fellen, A. E. Sedgwick, SIAM J. Numer. Anal. 9 (1972) 603
(classes A to E); E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, and the Test Set for IVP Solvers
(VDPOL, ROBER, OREGO, HIRES, E5, POLLU). `classical_numpy` writes them a second time, independently.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

Terms = list[Any]


def a1(t: Any, y: Terms) -> Terms:
    return [-y[0]]


def a2(t: Any, y: Terms) -> Terms:
    return [-(y[0] ** 3) / 2]


def a3(t: Any, y: Terms) -> Terms:
    return [y[0] * ca.cos(t)]


def a4(t: Any, y: Terms) -> Terms:
    return [y[0] / 4 * (1 - y[0] / 20)]


def a5(t: Any, y: Terms) -> Terms:
    return [(y[0] - t) / (y[0] + t)]


def b1(t: Any, y: Terms) -> Terms:
    return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]


def b2(t: Any, y: Terms) -> Terms:
    return [-y[0] + y[1], y[0] - 2 * y[1] + y[2], y[1] - y[2]]


def b3(t: Any, y: Terms) -> Terms:
    return [-y[0], y[0] - y[1] ** 2, y[1] ** 2]


def b4(t: Any, y: Terms) -> Terms:
    radius = ca.sqrt(y[0] ** 2 + y[1] ** 2)
    return [-y[1] - y[0] * y[2] / radius, y[0] - y[1] * y[2] / radius, y[0] / radius]


def b5(t: Any, y: Terms) -> Terms:
    return [y[1] * y[2], -y[0] * y[2], -0.51 * y[0] * y[1]]


def c1(t: Any, y: Terms) -> Terms:
    return [-y[0], *[y[k - 1] - y[k] for k in range(1, 9)], y[8]]


def c2(t: Any, y: Terms) -> Terms:
    return [-y[0], *[k * y[k - 1] - (k + 1) * y[k] for k in range(1, 9)], 9 * y[8]]


def heat(t: Any, y: Terms) -> Terms:
    """C3 (10 states) and C4 (51): second differences, zero beyond both ends."""
    n = len(y)
    return [(y[k - 1] if k else 0) - 2 * y[k] + (y[k + 1] if k < n - 1 else 0) for k in range(n)]


GRAVITY, SUN = 2.95912208286, 1.00000597682
PLANETS = (0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449, 0.00000277777777778)


def c5(t: Any, y: Terms) -> Terms:
    """Five outer planets: states are x, y, z of each planet in turn, then their speeds."""
    place = [y[3 * j : 3 * j + 3] for j in range(5)]
    cube = [(q[0] ** 2 + q[1] ** 2 + q[2] ** 2) ** 1.5 for q in place]
    pull = []
    for j in range(5):
        for i in range(3):
            total = -(SUN + PLANETS[j]) * place[j][i] / cube[j]
            for k in range(5):
                if k != j:
                    apart = sum((place[k][r] - place[j][r]) ** 2 for r in range(3)) ** 1.5
                    total += PLANETS[k] * ((place[k][i] - place[j][i]) / apart - place[k][i] / cube[k])
            pull.append(GRAVITY * total)
    return [*y[15:], *pull]


def orbit(t: Any, y: Terms) -> Terms:
    """D1 to D5: two bodies, eccentricity by the start."""
    cube = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / cube, -y[1] / cube]


def e1(t: Any, y: Terms) -> Terms:
    return [y[1], -(y[1] / (t + 1) + (1 - 0.25 / (t + 1) ** 2) * y[0])]


def e2(t: Any, y: Terms) -> Terms:
    return [y[1], (1 - y[0] ** 2) * y[1] - y[0]]


def e3(t: Any, y: Terms) -> Terms:
    return [y[1], y[0] ** 3 / 6 - y[0] + 2 * ca.sin(2.78535 * t)]


def e4(t: Any, y: Terms) -> Terms:
    return [y[1], 0.032 - 0.4 * y[1] ** 2]


def e5(t: Any, y: Terms) -> Terms:
    return [y[1], ca.sqrt(1 + y[1] ** 2) / (25 - t)]


def vdpol(t: Any, y: Terms) -> Terms:
    return [y[1], 1000 * (1 - y[0] ** 2) * y[1] - y[0]]


def rober(t: Any, y: Terms) -> Terms:
    slow, back, fast = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    return [-slow + back, slow - back - fast, fast]


def orego(t: Any, y: Terms) -> Terms:
    return [
        77.27 * (y[1] + y[0] * (1 - 8.375e-6 * y[0] - y[1])),
        (y[2] - (1 + y[0]) * y[1]) / 77.27,
        0.161 * (y[0] - y[2]),
    ]


def hires(t: Any, y: Terms) -> Terms:
    bound = 280 * y[5] * y[7]
    return [
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
        1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
        8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
        -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        bound - 1.81 * y[6],
        -bound + 1.81 * y[6],
    ]


def pyrolysis(t: Any, y: Terms) -> Terms:
    """E5 of the stiff set."""
    a, b, c, m = 7.89e-10, 1.1e7, 1.13e3, 1e6
    second = a * y[0] - m * c * y[1] * y[2]
    fourth = b * y[0] * y[2] - c * y[3]
    return [-a * y[0] - b * y[0] * y[2], second, second - fourth, fourth]


# Reactions of the air pollution problem: rate constant, then the species that react (counted from 1).
REACTIONS: tuple[tuple[float, tuple[int, ...]], ...] = (
    (0.35, (1,)), (26.6, (2, 4)), (12300.0, (5, 2)), (0.86e-3, (7,)), (0.82e-3, (7,)), (15000.0, (7, 6)),
    (0.13e-3, (9,)), (24000.0, (9, 6)), (16500.0, (11, 2)), (9000.0, (11, 1)), (0.022, (13,)), (12000.0, (10, 2)),
    (1.88, (14,)), (16300.0, (1, 6)), (4.8e6, (3,)), (0.35e-3, (4,)), (0.0175, (4,)), (1e8, (16,)),
    (4.44e11, (16,)), (1240.0, (17, 6)), (2.1, (19,)), (5.78, (19,)), (0.0474, (1, 4)), (1780.0, (19, 1)),
    (3.12, (20,)),
)  # fmt: skip
# For each species the reactions (from 1) that make it, positive, and those that take it, negative.
BALANCE: tuple[tuple[int, ...], ...] = (
    (-1, -10, -14, -23, -24, 2, 3, 9, 11, 12, 22, 25), (-2, -3, -9, -12, 1, 21), (-15, 1, 17, 19, 22),
    (-2, -16, -17, -23, 15), (-3, 4, 4, 6, 7, 13, 20), (-6, -8, -14, -20, 3, 18, 18), (-4, -5, -6, 13),
    (4, 5, 6, 7), (-7, -8), (-12, 7, 9), (-9, -10, 8, 11), (9,), (-11, 10), (-13, 12), (14,), (-18, -19, 16),
    (-20,), (20,), (-21, -22, -24, 23, 25), (-25, 24),
)  # fmt: skip


def pollu(t: Any, y: Terms) -> Terms:
    speed = []
    for constant, species in REACTIONS:
        product: Any = constant
        for number in species:
            product = product * y[number - 1]
        speed.append(product)
    return [sum((1 if k > 0 else -1) * speed[abs(k) - 1] for k in row) for row in BALANCE]
