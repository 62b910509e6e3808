"""Two capacitors and a coil with a nonlinear resistor, as in Chua's circuit, but damped and driven."""

from __future__ import annotations

import numpy as np

import casadi_engine as ce
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate


class CubicConductance(ce.Effect):
    """A resistor whose current grows with the cube of its voltage too."""

    name, attaches = "cubic_conductance", ("inertia",)
    sentence = "a current at {port} that grows with the cube of voltage"
    amplitude = ce.effects.Amplitude("coefficient", unit="A/V3")

    def law(self, port, p, math):
        return -p.coefficient * port.voltage**3


def model(outputs):
    b = ce.Blueprint("chua")
    c1 = b.parameter("C1", 10.0, unit="1", min=0.5, max=200, description="in microfarad")
    c2 = b.parameter("C2", 47.0, unit="1", min=2, max=1000, description="in microfarad")
    coil = b.parameter("L", 0.05, unit="H", min=2e-3, max=1)
    between = b.parameter("R", 100.0, unit="ohm", min=5, max=2000)
    winding = b.parameter("RL", 10.0, unit="ohm", vary=False)
    shunt = b.parameter("g", 2e-3, unit="1", min=0, max=0.1, description="in 1/ohm")
    v1, v2 = (b.state(name, unit="V", scale=5) for name in ("v1", "v2"))
    current = b.state("i", unit="A", scale=0.1)
    source = b.input("U", unit="V", scale=10)
    node = b.port("node", "inertia", {"voltage": v1}, unit="A")
    branch = b.port("branch", "inertia", {"speed": current}, unit="V")
    b.ode("v1", ((v2 - v1) / between - shunt * v1 + node) / (1e-6 * c1))
    b.ode("v2", ((v1 - v2) / between + current) / (1e-6 * c2))
    b.ode("i", (source - v2 - winding * current + branch) / coil)
    for name, value in (("V1", v1), ("V2", v2)):
        if name in outputs:
            b.output(name, value, unit="V", scale=5)
    return b.model()


def course(v, run):
    cubic, bias = v.get("node.cubic_conductance", 0.0), v.get("node.constant_torque", 0.0)
    drop, offset = v.get("branch.coulomb_friction", 0.0), v.get("branch.constant_torque", 0.0)
    diode, lamp = v.get("node.diode", 0.0), v.get("branch.quadratic_drag", 0.0)

    def rate(t, x, u):
        v1, v2, i = x
        into = (v2 - v1) / v["R"] - v["g"] * v1 - cubic * np.clip(v1, -100, 100) ** 3 + bias
        into -= diode * (np.exp(np.clip(v1, -20, 20) / 2.5) - 1)
        around = u["U"] - v2 - v["RL"] * i + offset - lamp * i * abs(i)
        return into / (1e-6 * v["C1"]), ((v1 - v2) / v["R"] + i) / (1e-6 * v["C2"]), around / v["L"]

    held = [Dry((0, 0, 1), (0, 0, 1 / v["L"]), lambda x: drop)] if drop else []
    x = simulate(rate, run.start, run.time, run.inputs, dry=held)
    return {"V1": x[:, 0] + v.get("sensor_V1.sensor_offset", 0.0), "V2": x[:, 1], "states": x}


def switched(rng):
    time = 2.5e-4 * np.arange(800)
    return Manoeuvre.of(rng, time, {"U": levels(rng, 800, 40, -10.0, 10.0)}, (0.0, 0.0, 0.0))


def swept(rng):
    time = 2.5e-4 * np.arange(800)
    return Manoeuvre.of(rng, time, {"U": sines(rng, time, 12.0, (31.0, 67.0, 113.0, 171.0))}, (0.0, 0.0, 0.0))


def rung(rng):
    time = 2.5e-4 * np.arange(600)
    start = (float(rng.uniform(5, 9)), float(rng.uniform(4, 7)), 0.0)
    return Manoeuvre.of(rng, time, {"U": levels(rng, 600, 120, -6.0, 6.0)}, start)


KIND = Kind(
    name="chua",
    sentence="a circuit with a nonlinear resistor",
    truth={"C1": 10.0, "C2": 47.0, "L": 0.05, "R": 100.0, "RL": 10.0, "g": 2e-3},
    terms={
        "node.cubic_conductance": Hidden(8e-5, CubicConductance(), "node"),
        "node.constant_torque": Hidden(0.015, ce.effects.ConstantTorque(), "node"),
        "branch.coulomb_friction": Hidden(1.0, ce.effects.CoulombFriction(), "branch"),
        "branch.quadratic_drag": Hidden(60.0, ce.effects.QuadraticDrag(), "branch"),
        "sensor_V1.sensor_offset": Hidden(0.8, ce.effects.SensorOffset(), "sensor_V1"),
        "node.diode": Hidden(5e-3),
    },
    choices=(
        "node.cubic_conductance",
        "branch.coulomb_friction",
        "branch.quadratic_drag",
        "node.diode",
        "node.constant_torque",
        "node.cubic_conductance+branch.coulomb_friction",
        "sensor_V1.sensor_offset",
    ),
    model=model,
    outputs=(("V1", "V2"), ("V2",)),
    course=course,
    manoeuvres={"switched": switched, "swept": swept, "rung": rung},
    pairs=(("switched", "swept"), ("swept", "rung"), ("rung", "switched")),
    units={"U": "V", "V1": "V", "V2": "V"},
    effects=lambda: with_own(CubicConductance()),
    absent=("g",),
)
