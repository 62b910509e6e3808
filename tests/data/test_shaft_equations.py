"""The shaft's matrices against the thesis's equations written out, and its natural frequencies."""

import numpy as np
from simulator import crankshaft_shaft, two_mass_shaft


def test_two_mass_matrix_is_equation_4_5():
    a, c_el, k, c_eng, b = 2.557, 2.5, 1992.0, 0.1541, 5.646
    expected = [[-a * (c_el + c_eng), a * c_el, a * k], [b * c_el, -b * c_el, -b * k], [-1.0, 1.0, 0.0]]
    np.testing.assert_allclose(two_mass_shaft().matrix()[1:, 1:], expected, rtol=1e-14)


def test_chain_equals_the_seven_equations_written_out():
    shaft = crankshaft_shaft()
    j = dict(zip(range(1, 8), 1 / np.array([33.39, 22.3, 22.3, 22.3, 22.3, 5.968, 5.646]), strict=True))
    k = {2: 241.8e3, 3: 1270e3, 4: 1270e3, 5: 1270e3, 6: 1427e3, 7: 1992.0}
    c = {2: 15.0, 3: 2.5, 4: 2.5, 5: 2.5, 6: 2.5, 7: 2.5}
    c_abs = {i: 0.1541 / 4 if 2 <= i <= 5 else 0.0 for i in range(1, 8)}
    generator = np.random.default_rng(0)
    angle = dict(zip(range(1, 8), generator.normal(0, 1e-3, 7), strict=True))
    speed = dict(zip(range(1, 8), generator.normal(120, 1, 7), strict=True))
    torque = dict(zip(range(2, 6), generator.normal(0, 100, 4), strict=True))
    acceleration = []
    for i in range(1, 8):
        total = torque.get(i, 0.0) - c_abs[i] * speed[i]
        if i > 1:
            total -= k[i] * (angle[i] - angle[i - 1]) + c[i] * (speed[i] - speed[i - 1])
        if i < 7:
            total += k[i + 1] * (angle[i + 1] - angle[i]) + c[i + 1] * (speed[i + 1] - speed[i])
        acceleration.append(total / j[i])
    twists = np.diff(list(angle.values()))
    state = np.concatenate([[angle[1]], list(speed.values()), twists])
    rate = shaft.matrix() @ state + shaft.torque_columns() @ np.array(list(torque.values()))
    np.testing.assert_allclose(rate[1:8], acceleration, rtol=1e-9)
    np.testing.assert_allclose(rate[8:], np.diff(list(speed.values())), rtol=1e-10)
    assert rate[0] == speed[1]
    np.testing.assert_allclose(shaft.angle_rows() @ state, list(angle.values()), atol=1e-15)


def test_natural_frequencies_of_table_4_13():
    published = [20.45, 335.2, 548.0, 936.7, 1340.9, 1604.4]
    np.testing.assert_allclose(crankshaft_shaft().natural_frequencies(), published, atol=0.05)
    np.testing.assert_allclose(two_mass_shaft().natural_frequencies(), [20.34], atol=0.01)


def test_steady_state_carries_the_load_through_every_coupling():
    shaft = crankshaft_shaft()
    friction = shaft.absolute_damping.sum() * 125.0
    state = shaft.steady_state(125.0, 57.0 + friction)
    torque = np.full(4, (57.0 + friction) / 4)
    rate = shaft.matrix() @ state + shaft.torque_columns() @ torque
    rate[7] -= 57.0 / shaft.inertia[-1]
    np.testing.assert_allclose(rate[1:], 0.0, atol=1e-9)
