"""A quarter of a car on a shaker: body, strut, wheel and tyre; heights in millimetres from where they rest."""

from __future__ import annotations

import numpy as np
from hidden_terms.kind import Hidden, Kind, Manoeuvre, with_own
from hidden_terms.records import levels, sines
from hidden_terms.simulator import Dry, simulate

import casadi_engine as ce

STOP = 20.0


class BumpStop(ce.Effect):
    """A rubber stop that is met when the strut is pressed in by more than its clearance."""

    name, attaches = "bump_stop", ("coupling",)
    sentence = "a bump stop in {port}"
    amplitude = ce.effects.Amplitude("rate", unit="N/mm", min=0)
    nuisance = {"clearance": ce.effects.Grid(5.0, 45.0, steps=9, unit="mm")}  # noqa: RUF012 (read only)

    def law(self, port, p, math):
        return -p.rate * math.positive(-port.twist - p.clearance, width=0.1)


def model(outputs):
    b = ce.Blueprint("quarter_car")
    body = b.parameter("mb", 320.0, unit="kg", vary=False)
    wheel = b.parameter("mw", 40.0, unit="kg", min=2, max=400)
    spring = b.parameter("ks", 22.0, unit="N/mm", min=1, max=400)
    damper = b.parameter("cs", 1.5, unit="N s/mm", min=0.01, max=30)
    tyre = b.parameter("kt", 180.0, unit="N/mm", vary=False)
    zb, zw = (b.state(name, unit="mm", scale=20) for name in ("zb", "zw"))
    vb, vw = (b.state(name, unit="mm/s", scale=200) for name in ("vb", "vw"))
    road = b.input("road", unit="mm", scale=20)
    on_body = b.port("body", "inertia", {"speed": vb}, unit="N")
    on_wheel = b.port("wheel", "inertia", {"speed": vw}, unit="N")
    signals = {"twist": zb - zw, "twist_rate": vb - vw, "stiffness": spring}
    strut = spring * (zb - zw) + damper * (vb - vw) + b.port("strut", "coupling", signals, unit="N")
    b.ode("zb", vb)
    b.ode("zw", vw)
    b.ode("vb", 1e3 * (on_body - strut) / body)
    b.ode("vw", 1e3 * (strut - tyre * (zw - road) + on_wheel) / wheel)
    if "height" in outputs:
        b.output("height", zb, unit="mm", scale=20)
    if "travel" in outputs:
        b.output("travel", zb - zw, unit="mm", scale=20)
    return b.model()


def course(v, run):
    kt = v["kt"] * (1 + v.get("parameter_kt.wrong_value", 0.0))
    cubic, stop = v.get("strut.cubic_stiffness", 0.0), v.get("strut.bump_stop", 0.0)
    dry, rebound = v.get("strut.coulomb_friction", 0.0), v.get("strut.rebound", 0.0)
    load = v.get("body.load_step", 0.0)

    def rate(t, x, u):
        zb, zw, vb, vw = x
        travel, turns = zb - zw, vb - vw
        strut = v["ks"] * travel + cubic * travel**3 - stop * max(-travel - STOP, 0.0)
        strut += v["cs"] * (turns + rebound * abs(turns))
        down = load * (t > run.event)
        return vb, vw, 1e3 * (-strut - down) / v["mb"], 1e3 * (strut - kt * (zw - u["road"])) / v["mw"]

    held = []
    if dry:
        held = [Dry((0, 0, 1, -1), (0, 0, 1e3 / v["mb"], -1e3 / v["mw"]), lambda x: dry)]
    x = simulate(rate, run.start, run.time, run.inputs, dry=held, breaks=[run.event] if load else ())
    travel = x[:, 0] - x[:, 1] + v.get("sensor_travel.sensor_offset", 0.0)
    return {"height": x[:, 0], "travel": travel, "states": x}


def shaken(rng):
    time = 5e-3 * np.arange(900)
    road = sines(rng, time, 24.0, (0.7, 1.3, 2.1)) + sines(rng, time, 5.0, (5.3, 9.7))
    return Manoeuvre.of(rng, time, {"road": road}, (0.0, 0.0, 0.0, 0.0))


def kerbs(rng):
    time = 5e-3 * np.arange(900)
    sharp = np.concatenate([np.zeros(50), levels(rng, 850, 85, -32.0, 32.0)])
    road = np.convolve(sharp, np.full(10, 0.1))[:900]
    return Manoeuvre.of(rng, time, {"road": road}, (0.0, 0.0, 0.0, 0.0))


def released(rng):
    time = 5e-3 * np.arange(800)
    road = sines(rng, time, 18.0, (0.9, 1.7)) + sines(rng, time, 3.0, (6.1, 11.3))
    high = float(rng.choice((-1, 1)) * rng.uniform(35, 50))
    return Manoeuvre.of(rng, time, {"road": road}, (high, 0.1 * high, 0.0, 0.0))


KIND = Kind(
    name="quarter_car",
    sentence="a quarter of a car on a shaker",
    truth={"mb": 320.0, "mw": 40.0, "ks": 22.0, "cs": 1.5, "kt": 180.0},
    terms={
        "strut.coulomb_friction": Hidden(120.0, ce.effects.CoulombFriction(), "strut"),
        "strut.cubic_stiffness": Hidden(0.02, ce.effects.CubicStiffness(), "strut"),
        "strut.bump_stop": Hidden(70.0, BumpStop(), "strut", {"clearance": STOP}),
        "body.load_step": Hidden(250.0, ce.effects.LoadStep(), "body", {"time": "event"}),
        "sensor_travel.sensor_offset": Hidden(6.0, ce.effects.SensorOffset(), "sensor_travel"),
        # motion alone tells ratios of masses and springs
        "parameter_kt.wrong_value": Hidden(
            -0.35, wrong="kt", needs=("height", "travel"), right=("parameter_mb.wrong_value",)
        ),
        "strut.rebound": Hidden(0.45),
    },
    choices=(
        "strut.coulomb_friction",
        "body.load_step",
        "strut.bump_stop",
        "strut.rebound",
        "strut.cubic_stiffness|strut.coulomb_friction",
        "strut.coulomb_friction+strut.bump_stop",
        "parameter_kt.wrong_value",
        "sensor_travel.sensor_offset",
        "strut.cubic_stiffness",
    ),
    model=model,
    outputs=(("height", "travel"), ("travel",)),
    course=course,
    manoeuvres={"shaken": shaken, "kerbs": kerbs, "released": released},
    pairs=(("shaken", "kerbs"), ("kerbs", "released"), ("released", "shaken")),
    units={"road": "mm", "height": "mm", "travel": "mm"},
    effects=lambda: with_own(BumpStop()),
)
