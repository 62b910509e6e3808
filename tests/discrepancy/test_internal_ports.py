"""Internal ports: functions of their signals are looked for, effects of the library are not, and the answer says it."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.wording import _of_internal_ports, _of_unknown_units


def around(time):
    return 293.0 + 4 * np.sin(time / 400)


def heated(time):
    return 500 * (1 + np.sin(time / 200) + 0.5 * np.sin(time / 70))


def record():
    """A room that loses heat by the square of its temperature too, by SciPy."""

    def rate(time, y):
        over = y[0] - around(time)
        return [(heated(time) - 5 * over - 0.08 * max(over, 0) ** 2) / 2e4]

    time = np.arange(0, 3000, 10.0)
    made = solve_ivp(rate, (0, time[-1]), [around(0)], t_eval=time, rtol=1e-9, atol=1e-9, max_step=5)
    measured = made.y[0] + 0.05 * np.random.default_rng(1).standard_normal(time.size)
    return ce.Experiment.from_arrays(
        "room",
        time=time,
        P=heated(time),
        T_out=around(time),
        T_room=measured,
        units={"P": "W", "T_out": "K", "T_room": "K"},
        inputs=["P", "T_out"],
    )


def room(signals):
    b = ce.Blueprint("room")
    C, G = b.parameter("C", 2e4, unit="J/K", min=1e3), b.parameter("G", 5.0, unit="W/K", min=0)
    T, power = b.state("T", unit="K", scale=300), b.input("P", unit="W")
    outside = b.input("T_out", unit="K")
    slot = b.port("wall", "internal", {"warmer": T - outside} if signals else None)
    b.ode("T", (power - G * (T - outside) + slot) / C)
    b.output("T_room", T, unit="K")
    return b.model()


def repaired(signals):
    return ce.repair(
        room(signals),
        record(),
        starts=1,
        noise=ce.Noise(T_room=0.05),
        progress=False,
        seed=0,
    )


def words(found):
    return " ".join(str(found).split())


def test_a_law_of_its_signals_is_found_at_an_internal_port():
    found = repaired(signals=True)
    assert (found.verdict, found.unknown.port, found.unknown.signal) == ("unnamed", "wall", "warmer")
    text = words(found)
    assert "something is missing, and no effect of the library names it" in text
    assert "Of internal ports unknown functions of their signals are looked for, and no effect" in text
    assert "wall (warmer)" in text
    assert "lack signals" not in text
    assert "look at the curve of the unknown power" in text


def test_an_internal_port_without_signals_says_that_nothing_is_looked_for_there():
    found = repaired(signals=False)
    assert found.unknown is None or found.unknown.port != "wall"
    text = words(found)
    assert "Nothing is looked for at wall: an internal port without signals." in text
    assert 'b.port("wall", "internal", {"signal": ...})' in text
    assert "Besides, wrong fixed parameters and sensor errors alone were tested" in text


def test_the_internal_port_of_a_builder_needs_no_words():
    model = ce.two_mass(reciprocating_inertia="variable")
    assert any(port.kind == "internal" for port in model.ports)
    assert _of_internal_ports(model) == []


@pytest.mark.parametrize("unit", ["-", "1"])
def test_what_would_pass_between_ports_of_unknown_units_is_said(unit):
    """A mole fraction in "1" has a pipe to its neighbour, one in "-" has none."""
    b = ce.Blueprint("column")
    ports = []
    for name in ("top", "low"):
        x = b.state(f"x_{name}", unit=unit)
        ports.append(b.port(name, "inertia", {"speed": x}))
        b.ode(f"x_{name}", -x + ports[-1])
        b.output(name, x, unit=unit)
    model = b.model()
    said = _of_unknown_units(model)
    assert [port.name for port in model.ports.links] == ([] if unit == "-" else ["top_and_low"])
    assert len(said) == (unit == "-")
    if said:
        assert said[0].startswith("Nothing that passes between top and low is looked for")
        assert 'b.port("top", ..., unit="...")' in said[0]
