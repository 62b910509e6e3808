"""Modes: the published frequencies, shapes, numbering, and analytic derivatives against differences."""

import json
import math

import casadi as ca
import numpy as np
import pytest

from casadi_engine.errors import ModelError
from casadi_engine.model import Blueprint, matrix_derivatives, natural_frequency_derivatives, two_mass
from casadi_engine.model.modes import displacement_states, modes_of


def oscillator(zeta=0.1, omega=2 * math.pi):
    b = Blueprint("oscillator")
    w, z = b.parameter("w", omega), b.parameter("z", zeta)
    q, v = b.state("q", unit="m"), b.state("v", unit="m/s")
    b.ode("q", v)
    b.ode("v", -2 * z * w * v - w**2 * q)
    b.output("q", q, unit="m")
    return b.model()


def test_published_frequencies_of_the_two_mass_system():
    modes = two_mass().modes()
    assert modes.numbers == (0, 1)
    np.testing.assert_allclose(modes.frequencies_hz, [0.0432, 20.345], atol=5e-4)
    assert two_mass().natural_frequency(1) == pytest.approx(20.345, abs=5e-4)
    # the rigid body: both speeds fall together at about C_eng/(J_eng + J_load)
    assert modes.eigenvalues[0].real == pytest.approx(-0.1541 / (1 / 2.557 + 1 / 5.646), rel=1e-2)


def test_parameters_move_the_frequency():
    model = two_mass()
    parameters = model.parameters()
    parameters["K_el"].set(4 * 1992)
    assert model.natural_frequency(1, parameters) == pytest.approx(2 * 20.345, rel=1e-3)
    assert model.natural_frequency(1, {"K_el": 4 * 1992}) == model.natural_frequency(1, parameters)


def test_oscillator_by_its_formulas():
    modes = oscillator(zeta=0.3).modes()
    assert modes.frequencies_hz == pytest.approx([1.0])
    assert modes.undamped_hz == pytest.approx([1.0])
    assert modes.damping_ratios == pytest.approx([0.3])
    assert modes.displacements.tolist() == [True, False]
    assert modes.shapes[0, 0] == pytest.approx(1.0)
    assert modes.shapes[1, 0] == pytest.approx(modes.eigenvalues[0])


def test_undamped_shape_and_frequency_of_two_inertias():
    model = two_mass()
    modes = model.modes({"C_el": 0.0, "C_eng": 0.0})
    exact = math.sqrt(1992 * (2.557 + 5.646)) / (2 * math.pi)
    assert modes.undamped_hz == pytest.approx([exact])
    assert modes.frequency(1) == pytest.approx(exact)
    speeds = modes.shapes[:2, -1]
    assert speeds[0] / speeds[1] == pytest.approx(-2.557 / 5.646)  # they swing against each other
    assert modes.damping_ratios[-1] == pytest.approx(0, abs=1e-12)


def test_overdamped_oscillator_has_no_numbered_mode():
    model = oscillator(zeta=2.0)
    modes = model.modes()
    assert modes.numbers == (0, 0)
    assert modes.undamped_hz == pytest.approx([1.0])
    with pytest.raises(ModelError, match="there is no such oscillatory mode; seen: 1") as caught:
        modes.frequency(1)
    assert "allowed: none: all modes are aperiodic" in str(caught.value)


@pytest.mark.parametrize("number", [0, 2, -1, 1.5, True, None, "1", math.nan])
def test_modes_are_numbered_from_one(number):
    with pytest.raises(ModelError, match="there is no such oscillatory mode") as caught:
        two_mass().natural_frequency(number)
    assert f"seen: {number!r}; allowed: 1 to 1; do: print(model.modes()) lists them" in str(caught.value)


@pytest.mark.parametrize(
    ("given", "texts"),
    [
        (
            5,
            (
                "the parameters are of the wrong kind",
                "seen: int",
                "Parameters, a mapping of names to numbers",
            ),
        ),
        (
            {"J_eng": math.nan},
            (
                "the value of the parameter J_eng",
                "seen: nan",
                "a finite number",
                "in the unit of the parameter",
            ),
        ),
        ({"J_eng": "heavy"}, ("the value of the parameter J_eng", "seen: 'heavy'")),
    ],
)
def test_modes_refuse_what_are_no_parameters(given, texts):
    with pytest.raises(ModelError) as caught:
        two_mass().modes(given)
    for text in texts:
        assert text in str(caught.value)


def test_shapes_are_eigenvectors_and_largest_deformation_is_one():
    model = two_mass()
    a = ca.Function("a", [model.p], [model.linear.A])(model.parameter_vector()).full()
    modes = model.modes()
    np.testing.assert_allclose(a @ modes.shapes, modes.shapes * modes.eigenvalues, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(modes.deformations.max(axis=0), 1.0)


def test_first_order_system_has_no_displacements():
    b = Blueprint("lag")
    x, tau = b.state("x"), b.parameter("tau", 0.5)
    b.ode("x", -x / tau)
    b.output("y", x)
    modes = b.model().modes()
    assert modes.eigenvalues == pytest.approx([-2.0])
    assert modes.undamped_hz.size == 0
    assert modes.numbers == (0,)
    assert "|x|" in str(modes)


def test_displacements_are_found_with_numbers_in_the_matrix_too():
    a = ca.densify(ca.SX([[0, 1], [-4, -0.1]]))
    assert displacement_states(ca.sparsify(a)).tolist() == [True, False]


def test_a_mode_at_zero():
    modes = modes_of(np.zeros((1, 1)), states=("x",), displacements=np.array([False]))
    assert modes.damping_ratios.tolist() == [0.0]
    assert modes.frequencies_hz.tolist() == [0.0]


def test_a_displacement_free_mode_is_scaled_by_its_speeds():
    """Without absolute damping the rigid body turns without any twist."""
    modes = two_mass().modes({"C_eng": 0.0})
    np.testing.assert_allclose(np.abs(modes.shapes[:, 0]), [1, 1, 0], atol=1e-6)


def test_modes_print_and_serialise():
    modes = two_mass().modes()
    assert str(modes).splitlines() == [
        "     mode  frequency [Hz]  undamped [Hz]  damping ratio  |twist|",
        "aperiodic          0.0432              -         1.0000   1.0000",
        "        1         20.3447        20.3447         0.0807   1.0000",
    ]
    assert "<th>frequency [Hz]</th>" in modes._repr_html_()
    stored = json.loads(json.dumps(modes.to_dict(), allow_nan=False))
    assert stored["numbers"] == [0, 1]
    assert stored["frequencies_hz"][1] == modes.frequency(1)
    with pytest.raises(ValueError, match="read-only"):
        modes.eigenvalues[0] = 0


# ---- derivatives


def random_family(seed, size=5, count=3):
    """A(z) = A0 + Σ z A1 + ½ Σ z z A2, with its exact derivatives at z."""
    rng = np.random.default_rng(seed)
    a0 = rng.normal(size=(size, size))
    a1 = rng.normal(size=(size, size, count))
    a2 = rng.normal(size=(size, size, count, count))
    a2 = a2 + np.swapaxes(a2, 2, 3)

    def at(z):
        a = a0 + a1 @ z + 0.5 * np.einsum("ijkl,k,l->ij", a2, z, z)
        return a, a1 + np.einsum("ijkl,l->ijk", a2, z), a2

    return at, rng.normal(size=count) * 0.1


@pytest.mark.parametrize("seed", range(6))
def test_derivatives_against_differences(seed):
    at, z = random_family(seed)
    available = np.sum(np.linalg.eigvals(at(z)[0]).imag > 1e-6)
    assert available >= 1
    for k in range(1, available + 1):
        value, gradient, hessian = natural_frequency_derivatives(*at(z), k)
        assert value > 0
        h = 1e-6
        for j, step in enumerate(h * np.eye(3)):
            above, above_gradient, _ = natural_frequency_derivatives(*at(z + step), k)
            below, below_gradient, _ = natural_frequency_derivatives(*at(z - step), k)
            assert gradient[j] == pytest.approx((above - below) / (2 * h), rel=1e-5, abs=1e-6)
            slope = (above_gradient - below_gradient) / (2 * h)
            np.testing.assert_allclose(hessian[j], slope, rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(hessian, hessian.T)


def test_derivatives_of_the_oscillator_are_exact():
    model = oscillator(zeta=0.2, omega=3.0)
    jet = matrix_derivatives(model.linear.A, model.p)
    value, gradient, hessian = natural_frequency_derivatives(*jet([3.0, 0.2]), 1)
    assert value == pytest.approx(3 / (2 * math.pi))
    np.testing.assert_allclose(gradient, [1 / (2 * math.pi), 0], atol=1e-13)  # |λ| = w whatever the damping
    np.testing.assert_allclose(hessian, np.zeros((2, 2)), atol=1e-12)


def test_without_second_derivatives_there_is_no_hessian():
    at, z = random_family(0)
    a, da, d2a = at(z)
    value, gradient, hessian = natural_frequency_derivatives(a, da)
    full = natural_frequency_derivatives(a, da, d2a)
    assert hessian is None
    assert value == full[0]
    np.testing.assert_array_equal(gradient, full[1])


def test_derivatives_of_the_two_mass_frequency_in_all_parameters():
    model = two_mass()
    jet = matrix_derivatives(model.linear.A, model.p)
    p = model.parameter_vector()
    value, gradient, hessian = natural_frequency_derivatives(*jet(p), 1)
    assert value == pytest.approx(model.natural_frequency(1))
    scale = p[:5] * gradient[:5] / value  # relative sensitivities
    assert scale[2] == pytest.approx(0.5, abs=0.01)  # f ~ sqrt(K)
    assert scale[0] + scale[1] == pytest.approx(-0.5, abs=0.01)  # f ~ 1/sqrt(J) in all inertias together
    np.testing.assert_array_equal(gradient[5:], 0)
    for j in range(5):
        h = np.zeros_like(p)
        h[j] = 1e-5 * p[j]
        above, below = (natural_frequency_derivatives(*jet(p + s), 1) for s in (h, -h))
        assert gradient[j] == pytest.approx(
            (above[0] - below[0]) / (2 * h[j]), rel=1e-6, abs=1e-8 * value / p[j]
        )
        slope = (above[1] - below[1]) / (2 * h[j])
        relative = np.outer(p, p)[j] / value
        np.testing.assert_allclose(relative * hessian[j], relative * slope, rtol=1e-5, atol=1e-6)


def test_derivatives_hold_beside_a_defective_part():
    """A Jordan block elsewhere in A has too few eigenvectors; the bordered system does not need them."""
    a = np.zeros((4, 4))
    a[:2, :2] = [[0, 1], [-9, -0.6]]
    a[2:, 2:] = [[-1, 1], [0, -1]]
    da = np.zeros((4, 4, 1))
    da[1, 0, 0] = -1.0
    _, gradient, hessian = natural_frequency_derivatives(a, da, np.zeros((4, 4, 1, 1)), 1)
    assert gradient[0] == pytest.approx(1 / (2 * 3) / (2 * math.pi))  # f = sqrt(k)/2π
    assert hessian[0, 0] == pytest.approx(-1 / (4 * 27) / (2 * math.pi))


@pytest.mark.parametrize("coupled", [0.0, 1.0])  # two alike apart from each other, or a defective double pair
def test_multiple_eigenvalue_is_an_error(coupled):
    block = np.array([[0.0, 1.0], [-4.0, 0.0]])
    a = np.zeros((4, 4))
    a[:2, :2] = a[2:, 2:] = block
    a[:2, 2:] = coupled * np.eye(2)
    with pytest.raises(ModelError, match="its eigenvalue is not simple") as caught:
        natural_frequency_derivatives(a, np.zeros((4, 4, 1)), None, 1)
    assert "allowed: an eigenvalue apart from all others; do: move the parameters" in str(caught.value)


def test_missing_mode_in_derivatives():
    with pytest.raises(ModelError, match="no such oscillatory mode; seen: 1; allowed: none"):
        natural_frequency_derivatives(-np.eye(2), np.zeros((2, 2, 1)), None, 1)


def beside_a_fast_pole(fast, *, coupled=True):
    """A suspension of 1 Hz whose force is told by a fast first-order actuator."""
    b = Blueprint("fast")
    q, v, f = b.state("q", unit="m"), b.state("v", unit="m/s"), b.state("f")
    b.ode("q", v)
    b.ode("v", -((2 * math.pi) ** 2) * q - 0.4 * v + f)
    b.ode("f", -fast * (f - (0.1 * v if coupled else 0)))
    b.output("q", q)
    return b.model()


@pytest.mark.parametrize("fast", [1e3, 1e9, 1e12])
@pytest.mark.parametrize("coupled", [False, True])
def test_a_slow_mode_beside_a_fast_pole_is_a_mode(fast, coupled):
    modes = beside_a_fast_pole(fast, coupled=coupled).modes()
    assert modes.numbers == (0, 1)
    # with a fast actuator its force is 0.1 v: a damper of 0.4 - 0.1
    assert modes.frequency(1) == pytest.approx(1.0, rel=1e-3)
    assert modes.damping_ratios[1] == pytest.approx((0.3 if coupled else 0.4) / (4 * math.pi), rel=2e-2)
    assert modes.undamped_hz == pytest.approx([1.0])


def test_undamped_frequencies_far_apart():
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 0], a[3, 2] = -((2 * math.pi * 1e8) ** 2), -((2 * math.pi) ** 2)
    modes = modes_of(a, states=tuple("abcd"), displacements=np.array([True, False, True, False]))
    np.testing.assert_allclose(modes.undamped_hz, [1.0, 1e8], rtol=1e-9)


@pytest.mark.parametrize("shift", [0.0, 1e-12, 1e-3, 1.0])
@pytest.mark.parametrize("fast", [1.0, 1e6])
def test_a_critically_damped_pair_is_aperiodic(shift, fast):
    """Rounding splits a double eigenvalue into a pair; similar matrices, so that nothing is exact."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    a = (
        turn @ np.diag([0.0, 0.0, -fast]) @ turn.T
        + turn @ np.array([[-1, 1, 0], [0, -1, 0], [0, 0, 0]]) @ turn.T
    )
    a += shift * 1e-15 * fast * np.random.default_rng(1).normal(size=(3, 3))
    assert modes_of(a, states=tuple("abc"), displacements=np.zeros(3, dtype=bool)).numbers == (0, 0, 0)


def geared(*, unit="1", lever=False, twist_unit="rad", speed_unit="rad/s", loss=True):
    """An engine and a load over a gear and an elastic shaft: twist' = ratio·omega_1 − omega_2."""
    b = Blueprint("geared")
    r, k = b.parameter("ratio", 2.5, unit=unit), b.parameter("K", 300.0, unit="N m/rad")
    j1, j2 = b.parameter("J1", 0.2, unit="kg m2"), b.parameter("J2", 1.5, unit="kg m2")
    w1, w2 = b.state("omega_1", unit=speed_unit), b.state("omega_2", unit=speed_unit)
    twist = b.state("twist", unit=twist_unit)
    torque = k * twist
    c = 0.1 if loss else 0.0
    b.ode("omega_1", (-r * torque - c * w1) / j1)
    b.ode("omega_2", torque / j2)
    b.ode("twist", r * w1 - w2 * (r / 2.5 if lever else 1))
    b.output("y", w1)
    return b.model()


@pytest.mark.parametrize(
    "options",
    [{}, {"loss": False}, {"twist_unit": "m", "unit": "m/rad", "lever": True}, {"speed_unit": "1"}],
)
def test_a_ratio_may_be_a_parameter(options):
    modes = geared(**options).modes()
    assert modes.displacements.tolist() == [False, False, True]
    exact = math.sqrt(300 * (2.5**2 / 0.2 + 1 / 1.5)) / (2 * math.pi)
    assert modes.undamped_hz == pytest.approx([exact])


def test_a_factor_with_time_in_it_is_no_ratio():
    """q' = v/T with a time T: the equation of a filter could be written like this."""
    modes = geared(unit="1/s").modes()
    assert not modes.displacements.any()
    assert modes.undamped_hz.size == 0
    assert modes.oscillatory == 1


def test_numbers_go_before_ratios():
    """w and z have no unit: v' = -w² q alone could be geometry too."""
    modes = oscillator(zeta=0.0).modes()
    assert modes.displacements.tolist() == [True, False]
    assert modes.undamped_hz == pytest.approx([1.0])


def ring(unit):
    """q' = g v, v' = -g q: which one is the displacement, the units alone can tell."""
    b = Blueprint("ring")
    g, q, v = b.parameter("g", 3.0), b.state("q"), b.state("v", unit=unit)
    b.ode("q", g * v)
    b.ode("v", -g * q)
    b.output("q", q)
    return b.model().modes()


def test_of_two_that_could_be_displacements_the_units_decide_or_nothing():
    assert ring("1/s").displacements.tolist() == [True, False]
    assert ring("1/s").undamped_hz == pytest.approx([3 / (2 * math.pi)])
    assert not ring("1").displacements.any()
