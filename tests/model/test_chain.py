"""Torsional chains: the thesis's seven inertias, its appendix A (misprints mended) and Table 4.13."""

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import ModelError
from casadi_engine.model import Blueprint, Coupling, Inertia, declare_chain, two_mass, write_chain

# Table 4.12 with the fixed values of the appendix's listing.
J = np.array([1 / 33.39, *[1 / 22.3] * 4, 1 / 5.968, 1 / 5.646])
K = np.array([241.8e3, 1270e3, 1270e3, 1270e3, 1427e3, 1992.0])
C = np.array([15.0, 2.5, 2.5, 2.5, 2.5, 2.5])
C_ABSOLUTE = np.array([0, *[0.1541 / 4] * 4, 0, 0])

# Table 4.13: frequency [Hz], then |deformation| of the six couplings.
TABLE = np.array(
    [
        [20.45, 0.0007, 0.0003, 0.0005, 0.0007, 0.0008, 1],
        [335.2, 1, 0.3229, 0.4038, 0.4216, 0.3322, 0.6414],
        [548.0, 1, 0.0692, 0.1030, 0.2109, 0.2085, 0.1501],
        [936.7, 1, 0.7600, 0.7693, 0.1636, 0.7937, 0.1953],
        [1340.9, 0.4898, 1, 0.4202, 0.7870, 0.7273, 0.0873],
        [1604.4, 0.2091, 0.6531, 1, 0.9355, 0.4324, 0.0363],
    ]
)
UNDAMPED = [334.4, 547.9, 938.4, 1341.6, 1604.6]


@pytest.fixture(scope="module")
def seven():
    """The crankshaft of Figure 3.6 with cylinder torques on inertias 2 to 5 and a load on the last."""
    b = Blueprint("seven")
    inertias = []
    for i in range(7):
        damping = b.parameter(f"C{i + 1}", C_ABSOLUTE[i]) if C_ABSOLUTE[i] else None
        inertias.append(
            Inertia(f"inertia_{i + 1}", f"omega_{i + 1}", b.parameter(f"J{i + 1}", J[i]), damping)
        )
    couplings = [
        Coupling(f"coupling_{i + 2}{i + 1}", f"twist_{i + 2}{i + 1}",
                 b.parameter(f"K{i + 2}{i + 1}", K[i]), b.parameter(f"C{i + 2}{i + 1}", C[i]))
        for i in range(6)
    ]  # fmt: skip
    chain = declare_chain(b, inertias, couplings)
    torques = [b.input(f"T{i}", unit="N m") for i in range(1, 5)]
    write_chain(b, chain, [0, *torques, 0, -b.input("T_load", unit="N m")])
    b.output("omega", chain.speeds[0], unit="rad/s")
    return b.model()


def appendix():
    """A and B of appendix A, written independently from mass, stiffness and damping matrices."""
    incidence = np.zeros((6, 7))
    for i in range(6):
        incidence[i, i : i + 2] = -1, 1
    damping = incidence.T @ np.diag(C) @ incidence + np.diag(C_ABSOLUTE)
    order = [0] + [k for i in range(6) for k in (i + 1, 7 + i)]  # speeds and twists interleaved
    a = np.zeros((13, 13))
    a[:7, :7] = -damping / J[:, None]
    a[:7, 7:] = -incidence.T @ np.diag(K) / J[:, None]
    a[7:, :7] = incidence
    b = np.zeros((13, 5))
    b[[1, 2, 3, 4], [0, 1, 2, 3]] = 1 / J[1:5]
    b[6, 4] = -1 / J[6]
    return a[np.ix_(order, order)], b[order]


def test_matrices_are_those_of_the_appendix(seven):
    core = ca.Function("core", [seven.p], [seven.linear.A, seven.linear.B])
    a, b = (part.full() for part in core(seven.parameter_vector()))
    expected_a, expected_b = appendix()
    np.testing.assert_allclose(a, expected_a, rtol=1e-13, atol=1e-9)
    np.testing.assert_allclose(b, expected_b, rtol=1e-13)
    assert [variable.name for variable in seven.states][:4] == ["omega_1", "omega_2", "twist_21", "omega_3"]
    assert a[11, 11] == pytest.approx(-C[5] / J[6])  # printed with J6 in the thesis


def test_modes_are_table_4_13(seven):
    modes = seven.modes()
    oscillatory = np.array(modes.numbers) > 0
    np.testing.assert_allclose(modes.frequencies_hz[oscillatory], TABLE[:, 0], atol=0.06)
    np.testing.assert_allclose(modes.deformations[:, oscillatory].T, TABLE[:, 1:], atol=6e-4)
    np.testing.assert_allclose(modes.undamped_hz[1:], UNDAMPED, atol=0.06)
    assert modes.oscillatory == 6
    assert seven.natural_frequency(2) == pytest.approx(335.2, abs=0.06)


def test_coupling_slots_act_on_both_sides(seven):
    g = ca.Function("g", [seven.p], [seven.linear.G])(seven.parameter_vector()).full()
    slots = dict(zip((port.name for port in seven.ports.with_slot), g.T, strict=True))
    speeds = slots["coupling_43"][[0, 1, 3, 5, 7, 9, 11]]
    np.testing.assert_allclose(speeds, [0, 0, 1 / J[2], -1 / J[3], 0, 0, 0])
    np.testing.assert_allclose(slots["inertia_6"][9], 1 / J[5])


def test_torques_inside_a_chain_are_in_balance(seven):
    """Without absolute dampers the momentum changes by the outer torques alone, whatever the state."""
    changes = {f"C{i}": 0.0 for i in range(2, 6)}
    a = ca.Function("a", [seven.p], [seven.linear.A])(seven.parameter_vector(changes)).full()
    rows = [0, 1, 3, 5, 7, 9, 11]
    np.testing.assert_allclose(J @ a[rows], np.zeros(13), atol=1e-8)


def test_two_mass_is_the_chain_of_two():
    b = Blueprint("two")
    names = ("J_eng", "J_load", "K_el", "C_el", "C_eng")
    j1, j2, k, c, c1 = (b.parameter(name, 1.0) for name in names)
    chain = declare_chain(
        b,
        [Inertia("one", "omega_1", j1, c1), Inertia("two", "omega_2", j2)],
        [Coupling("link", "twist", k, c)],
    )
    write_chain(b, chain, [0, 0])
    b.output("omega", chain.speeds[0])
    expected = two_mass().linear.A
    assert str(b.model().linear.A) == str(expected)


def test_couplings_must_fit():
    b = Blueprint("bad")
    with pytest.raises(ModelError, match="the chain's couplings do not fit its inertias") as caught:
        declare_chain(b, [Inertia("one", "omega", 1.0)], [Coupling("link", "twist", 1.0, 0.0)])
    assert "seen: 1 inertias, 1 couplings; allowed: one coupling fewer than inertias" in str(caught.value)
    assert "do: give the coupling between each inertia and the next" in str(caught.value)


def test_angles_become_signals():
    b = Blueprint("angles")
    theta = b.input("theta", unit="rad")
    chain = declare_chain(b, [Inertia("one", "omega", 1.0, 0.1, theta)], [])
    write_chain(b, chain, [0])
    b.output("omega", chain.speeds[0])
    assert str(b.model().ports["one"].signals["angle"]) == "theta"
