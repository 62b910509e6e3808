"""The printed sheet of a model."""

import math
import re

import casadi as ca

from casadi_engine.effects import InputGain, SensorDelay, SensorGain, SensorOffset
from casadi_engine.model import Blueprint, one_inertia, two_mass
from casadi_engine.model.sheets import changed_equations


def test_equations_of_the_two_mass_system():
    lines = two_mass(cylinders=1).equations().splitlines()
    assert lines == [
        "d(omega_eng)/dt = (K_el*twist + C_el*(omega_load - omega_eng) - C_eng*omega_eng"
        " + T_1 + w_cylinder_1)/J_eng",
        "d(omega_load)/dt = -(K_el*twist + C_el*(omega_load - omega_eng) + T_load)/J_load",
        "d(twist)/dt = omega_load - omega_eng",
        "T_1 = (p1 - p_crank)*A_p*r*f_1",
        "w_cylinder_1 = -m_eq*r**2*f_1*df_1*omega_eng**2",
        "omega = omega_eng",
        "with",
        "  f_1 = sin(theta) + r*sin(theta)*cos(theta)/(L*sqrt(1 - (r*sin(theta)/L)**2))",
        "  df_1 = cos(theta) + r*(cos(theta)**2 - sin(theta)**2 + (r*sin(theta)*cos(theta)"
        "/(L*sqrt(1 - (r*sin(theta)/L)**2)))**2)/(L*sqrt(1 - (r*sin(theta)/L)**2))",
    ]


def test_equations_of_four_cylinders_show_their_offsets():
    text = two_mass().equations()
    for number, offset in ((1, ""), (2, " - 3*pi"), (3, " - pi"), (4, " - 2*pi")):
        assert f"f_{number} = sin(theta{offset}) + r*sin(theta{offset})" in text
    assert "@" not in text  # CasADi's own temporaries


def test_linear_form_has_no_slots_in_print():
    text = two_mass(reciprocating_speed="measured").equations()
    assert "w_" not in text
    assert "T_1 = (p1 - p_crank)*A_p*r*f_1 - m_eq*r**2*f_1*df_1*omega**2" in text


def test_latex_of_one_inertia():
    assert one_inertia().latex() == (
        "\\begin{aligned}\n"
        r"\frac{\mathrm{d}}{\mathrm{d}t} \omega_{\mathrm{eng}} &= "
        r"\frac{T - C_{\mathrm{eng}} \, \omega_{\mathrm{eng}}}{J_{\mathrm{eng}}}"
        " \\\\\n"
        r"\omega &= \omega_{\mathrm{eng}}"
        "\n\\end{aligned}"
    )


def test_latex_of_two_mass_is_balanced():
    text = two_mass(reciprocating_inertia="variable").latex()
    assert text.count("{") == text.count("}")
    assert text.count(r"\left") == text.count(r"\right")
    assert two_mass()._repr_latex_().startswith("$$\n\\begin{aligned}")


def test_table_of_one_inertia():
    assert one_inertia(load="constant").table().splitlines() == [
        "states",
        "  omega_eng            [rad/s]      speed of the engine",
        "inputs",
        "  T                    [N m]        torque on the engine",
        "drives",
        "  T                    [N m]        torque on the engine",
        "outputs",
        "  omega                [rad/s]      crank speed",
        "parameters",
        "  J_eng      0.391083  [kg m2]      inertia of the engine",
        "  C_eng        0.1541  [N m s/rad]  absolute damping of the engine",
        "  T_load            0  [N m]        constant load torque, braking",
    ]


def test_sheet_says_what_kind_of_model_it_is():
    assert "\nlinear\n" in str(one_inertia())
    assert "\nlinear core with nonlinear laws in slots\n" in str(two_mass())
    assert str(two_mass()).startswith("two_mass: engine and load as two inertias")
    assert repr(two_mass()) == "Model('two_mass', 3 states, 10 parameters)"


def test_sheet_of_a_general_model_without_parameters_and_inputs():
    b = Blueprint("pendulum")
    q, v = b.state("q", unit="rad"), b.state("v", unit="rad/s")
    b.ode("q", v)
    b.ode("v", -(math.pi**2) * q * q)
    b.output("q", q, unit="rad")
    text = str(b.model())
    assert text.startswith("pendulum\ngeneral (not affine in states and drives)\n")
    assert "parameters" not in text
    assert "inputs" not in text


def test_html_is_escaped():
    b = Blueprint("plain", description="a < b & c")
    x = b.state("x", unit="m", description="<i>")
    b.ode("x", -x)
    b.output("y", x)
    html = b.model()._repr_html_()
    assert "a &lt; b &amp; c" in html
    assert "&lt;i&gt;" in html
    assert "<caption>states</caption>" in html


def test_what_is_made_of_its_own_name_is_told_from_it():
    """The channel T that acts by another gain, and a sensor that has the name of a state."""
    b = Blueprint("rotor")
    inertia, speed = b.parameter("J", 1.0, unit="kg m2"), b.state("w", unit="rad/s")
    torque, port = b.input("T", unit="N m"), b.port("rotor", "inertia", {"speed": speed})
    b.ode("w", (2 * torque + port) / inertia)
    b.output("w", speed, unit="rad/s")
    model = b.model()
    assert model.equations().splitlines() == ["d(w)/dt = 2*T/J", "w = w"]

    def line(effect, at):
        return model.with_effect(effect, at=at).equations().splitlines()[1 if at == "input_T" else -1]

    assert line(InputGain(), "input_T") == "T_acting = T*(1 + input_T.input_gain.gain)"
    assert (
        model.with_effect(InputGain(), at="input_T").equations().splitlines()[0] == "d(w)/dt = 2*T_acting/J"
    )
    assert line(SensorGain(), "sensor_w") == "w (measured) = w*(1 + sensor_w.sensor_gain.gain)"
    assert line(SensorOffset(), "sensor_w") == "w (measured) = w + sensor_w.sensor_offset.offset"
    assert line(SensorDelay(), "sensor_w") == "w(t + sensor_w.sensor_delay.delay) (measured) = w"
    latex = model.with_effect(InputGain(), at="input_T").latex()
    assert r"T_{\mathrm{acting}} &= T \, \left(1 + " in latex


def _long(drag):
    """Equations with a part so long that it has a name of its own, in a drag or not."""
    b = Blueprint("long", time_unit="s")
    k = b.parameter("k", 1.0, min=0)
    x, v, u = b.state("x"), b.state("v"), b.input("u")
    part = ca.exp(-ca.sqrt(x**2 + 2 * v**2 + 3 * x * v + 1) / (1 + ca.tanh(x * v + 0.3) ** 2)) + ca.sin(
        3 * x + v
    )
    b.ode("x", v * part + k * part**2)
    b.ode("v", u - k * x * part + (0.1 * ca.sqrt(part + 2.0) * v if drag else 0.0))
    b.output("y", x)
    return b.model()


def test_changed_equations_have_all_the_parts_that_they_use():
    """A screen ended in "with", and z1 stood in an equation whose part was as before."""
    model, base = _long(True), _long(False)
    assert "\nwith\n" in base.equations()
    lines = changed_equations(model, base)
    assert "with" not in lines
    assert lines[0].startswith("d(v)/dt = ")
    assert not any(line.startswith("d(x)/dt") for line in lines)
    names = {line.partition(" = ")[0] for line in lines}
    used = {word for line in lines for word in re.findall(r"\bz\d+\b", line.partition(" = ")[2])}
    assert used
    assert used <= names
    assert changed_equations(base, base) == ()
