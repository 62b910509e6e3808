"""A counterflow heat exchanger, two cells a side; flows and inlet temperatures are inputs, outlets are measured."""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre
from hidden_terms.records import levels, sines
from hidden_terms.simulator import delayed, simulate

import casadi_engine as ce

# Room [degC]; heat capacities of the fluids per flow [W/K per l/min]: water with glycol, and water. The hot flow at
# which the wall's conductance is stated [l/min].
ROOM, HOT, COLD, STATED = 20.0, 62.0, 69.7, 5.0


def model(outputs):
    b = ce.Blueprint("heat_exchanger", time_unit="s")
    wall = b.parameter("UA", 180.0, unit="W/K", min=10, max=3000, description="of one cell")
    c_hot = b.parameter("Ch", 6.0, unit="kJ/K", min=0.2, max=100, description="of one hot cell")
    c_cold = b.parameter("Cc", 8.0, unit="kJ/K", min=0.2, max=120, description="of one cold cell")
    loss = b.parameter("G", 12.0, unit="W/K", min=0, max=300, description="of one hot cell")
    per_hot = b.parameter("cph", HOT, unit="W min/(K l)", vary=False)
    per_cold = b.parameter("cpc", COLD, unit="W min/(K l)", vary=False)
    h1, h2, c1, c2 = (b.state(name, unit="degC", scale=20) for name in ("h1", "h2", "c1", "c2"))
    q_hot, q_cold = (b.input(name, unit="l/min", scale=5) for name in ("qh", "qc"))
    t_hot, t_cold = (b.input(name, unit="degC", scale=20) for name in ("Thi", "Tci"))
    hot_in, hot_out, cold_in, cold_out = (
        b.port(name, "inertia", {"temperature": t}, unit="W")
        for name, t in (("hot_in", h1), ("hot_out", h2), ("cold_in", c1), ("cold_out", c2))
    )
    hot, cold = per_hot * q_hot, per_cold * q_cold
    b.ode("h1", 1e-3 * (hot * (t_hot - h1) - wall * (h1 - c2) - loss * (h1 - ROOM) + hot_in) / c_hot)
    b.ode("h2", 1e-3 * (hot * (h1 - h2) - wall * (h2 - c1) - loss * (h2 - ROOM) + hot_out) / c_hot)
    b.ode("c1", 1e-3 * (cold * (t_cold - c1) + wall * (h2 - c1) + cold_in) / c_cold)
    b.ode("c2", 1e-3 * (cold * (c1 - c2) + wall * (h1 - c2) + cold_out) / c_cold)
    if "Tho" in outputs:
        b.output("Tho", h2, unit="degC", scale=20)
    if "Tco" in outputs:
        b.output("Tco", c2, unit="degC", scale=20)
    return b.model()


def course(v, run):
    per_hot = v["cph"] * (1 + v.get("parameter_cph.wrong_value", 0.0))
    traced, drawn = v.get("cold_out.constant_torque", 0.0), v.get("hot_in.load_step", 0.0)
    along, fouls = v.get("hot_in_and_hot_out.transfer", 0.0), v.get("wall.fouling", 0.0)
    turbulent = v.get("wall.turbulence", 0.0)

    def rate(t, x, u):
        h1, h2, c1, c2 = x
        wall = v["UA"] * np.exp(-fouls * t / 600) * (u["qh"] / STATED) ** turbulent
        hot, cold, loss = per_hot * u["qh"], v["cpc"] * u["qc"], v["G"]
        led = along * (h1 - h2)
        first = hot * (u["Thi"] - h1) - wall * (h1 - c2) - loss * (h1 - ROOM) - drawn * (t > run.event) - led
        second = hot * (h1 - h2) - wall * (h2 - c1) - loss * (h2 - ROOM) + led
        third = cold * (u["Tci"] - c1) + wall * (h2 - c1)
        fourth = cold * (c1 - c2) + wall * (h1 - c2) + traced
        hot_rates = (1e-3 * first / v["Ch"], 1e-3 * second / v["Ch"])
        return (*hot_rates, 1e-3 * third / v["Cc"], 1e-3 * fourth / v["Cc"])

    x = simulate(rate, run.start, run.time, run.inputs, breaks=[run.event] if drawn else ())
    late = delayed(run.time, x[:, 1], v.get("sensor_Tho.sensor_delay", 0.0))
    return {"Tho": late, "Tco": x[:, 3] + v.get("sensor_Tco.sensor_offset", 0.0), "states": x}


def _set(rng, count, hold, low, high):
    """Levels that a motor-driven valve takes fifteen samples to reach."""
    wide = np.pad(levels(rng, count, hold, low, high), (7, 7), mode="edge")
    return np.convolve(wide, np.full(15, 1 / 15), mode="valid")


def _mains(rng, time):
    return 12 + sines(rng, time, 2.5, (1 / 230, 1 / 97))


def pumped(rng):
    """Flows in steps, the boiler nearly steady."""
    time = 1.0 * np.arange(600)
    boiler = 65 + sines(rng, time, 4.0, (1 / 310,))
    flows = {"qh": _set(rng, 600, 40, 2.0, 9.0), "qc": _set(rng, 600, 60, 2.0, 8.0)}
    return Manoeuvre.of(
        rng, time, flows | {"Thi": boiler, "Tci": _mains(rng, time)}, (52.0, 42.0, 24.0, 36.0)
    )


def waved(rng):
    time = 1.0 * np.arange(600)
    inputs = {
        "qh": 5 + sines(rng, time, 3.0, (1 / 170, 1 / 53)),
        "qc": 5 + sines(rng, time, 3.0, (1 / 130, 1 / 41)),
        "Thi": 60 + sines(rng, time, 12.0, (1 / 210, 1 / 71)),
        "Tci": _mains(rng, time),
    }
    return Manoeuvre.of(rng, time, inputs, (float(rng.uniform(45, 55)), 40.0, 24.0, 34.0))


def heated(rng):
    """From lukewarm, the boiler in steps."""
    time = 1.0 * np.arange(500)
    inputs = {
        "qh": _set(rng, 500, 50, 3.0, 8.0),
        "qc": _set(rng, 500, 100, 3.0, 7.0),
        "Thi": _set(rng, 500, 70, 40.0, 80.0),
        "Tci": _mains(rng, time),
    }
    return Manoeuvre.of(rng, time, inputs, (40.0, 32.0, 18.0, 25.0))


KIND = Kind(
    name="heat_exchanger",
    sentence="a counterflow heat exchanger",
    truth={"UA": 180.0, "Ch": 6.0, "Cc": 8.0, "G": 12.0, "cph": HOT, "cpc": COLD},
    terms={
        "cold_out.constant_torque": Hidden(1100.0, ce.effects.ConstantTorque(), "cold_out"),
        "hot_in.load_step": Hidden(1500.0, ce.effects.LoadStep(), "hot_in", {"time": "event"}),
        "hot_in_and_hot_out.transfer": Hidden(150.0, ce.effects.Transfer(), "hot_in_and_hot_out"),
        "sensor_Tco.sensor_offset": Hidden(3.0, ce.effects.SensorOffset(), "sensor_Tco"),
        "sensor_Tho.sensor_delay": Hidden(3.0, ce.effects.SensorDelay(), "sensor_Tho"),
        # temperatures tell the ratio of both fluids alone
        "parameter_cph.wrong_value": Hidden(
            -0.25, wrong="cph", right=("parameter_cpc.wrong_value",), needs=("Tho", "Tco")
        ),
        "wall.turbulence": Hidden(0.7),
        "wall.fouling": Hidden(0.6),
    },
    choices=(
        "cold_out.constant_torque",
        "wall.turbulence",
        "hot_in.load_step",
        "sensor_Tco.sensor_offset",
        "hot_in.load_step+cold_out.constant_torque",
        "wall.fouling",
        "parameter_cph.wrong_value",
        "hot_in_and_hot_out.transfer",
        "sensor_Tho.sensor_delay",
    ),
    model=model,
    outputs=(("Tho", "Tco"), ("Tco",)),
    course=course,
    manoeuvres={"pumped": pumped, "waved": waved, "heated": heated},
    pairs=(("pumped", "waved"), ("waved", "heated"), ("heated", "pumped")),
    units={"qh": "l/min", "qc": "l/min", "Thi": "degC", "Tci": "degC", "Tho": "degC", "Tco": "degC"},
)
