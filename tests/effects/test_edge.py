"""What acts beyond an edge alone: an end stop of a slide, a weir of a tank, by SciPy with sharp edges."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import EndStop, LowerEndStop, Relief, library
from casadi_engine.errors import EffectError

TIME = np.arange(600) * 0.02


def slide(signals=None):
    b = ce.Blueprint("slide")
    spring, damping = b.parameter("k", 30.0, unit="N/m", min=1), b.parameter("c", 2.0, unit="N s/m", min=0)
    mass = b.parameter("m", 1.0, unit="kg", vary=False)
    place, speed = b.state("x", unit="m"), b.state("v", unit="m/s")
    force = b.input("F", unit="N")
    slot = b.port(
        "carriage", "inertia", {"speed": speed} if signals is None else signals(place, speed), unit="N"
    )
    b.ode("x", speed)
    b.ode("v", (force - spring * place - damping * speed + slot) / mass)
    b.output("shown", place, unit="m")
    return b.model()


def moved(name, seed, side=1, stiffness=400.0, lost=0.0):
    """A stop at 0.12 m of the way, up or down, with so many N s/m on the way in."""
    rng = np.random.default_rng(seed)
    knots = np.linspace(0, TIME[-1], 40)
    force = np.interp(TIME, knots, rng.uniform(-8, 8, 40))

    def rate(t, y):
        beyond = max(side * y[0] - 0.12, 0.0)
        pushed = side * (stiffness * beyond + (lost * max(side * y[1], 0.0) if beyond > 0 else 0.0))
        return [y[1], np.interp(t, TIME, force) - 40 * y[0] - 3 * y[1] - pushed]

    x = solve_ivp(rate, (0, TIME[-1]), [0, 0], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=0.01).y[0]
    shown = x + 5e-4 * rng.standard_normal(len(x))
    return ce.Experiment.from_arrays(name, time=TIME, units={"F": "N", "shown": "m"}, F=force, shown=shown)


@pytest.mark.parametrize("side", [1, -1])
def test_a_repair_names_the_stop_its_edge_and_its_end(side):
    found = ce.repair(slide(), moved("run", 1, side), fresh=moved("fresh", 2, side), progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == ("carriage.end_stop" if side > 0 else "carriage.lower_end_stop")
    stiffness, edge = list(one.parameters.values())[:2]
    assert stiffness.value == pytest.approx(400, rel=0.1)
    assert edge.value == pytest.approx(side * 0.12, abs=2e-3)
    assert "an end stop at " in str(found)


def test_a_stop_that_takes_up_speed_is_one_too():
    """An elastic one alone was far too hard, its edge four errors off."""
    records = [moved(name, seed, 1, 1500.0, 15.0) for name, seed in (("run", 1), ("fresh", 2))]
    found = ce.repair(slide(), records[0], fresh=records[1], effects=["end_stop"], progress=False)
    (one,) = found.effects
    _, edge, damping = list(one.parameters.values())[:3]
    assert edge.value == pytest.approx(0.12, abs=4e-3)
    assert damping.value > 3 * damping.stderr > 0


def test_nothing_is_met_where_no_stop_is():
    found = ce.repair(slide(), moved("run", 1, 1, 0.0), fresh=moved("fresh", 2, 1, 0.0), progress=False)
    assert found.verdict == "nothing missing"


@pytest.mark.parametrize(
    "signals", [None, lambda x, v: {"speed": v, "position": x}, lambda x, v: {"speed": v, "angle": x}]
)
@pytest.mark.parametrize("effect", [EndStop(), LowerEndStop()])
def test_the_place_is_a_signal_or_the_state_that_the_speed_moves(signals, effect):
    model = slide(signals).with_effect(effect, at="carriage", values={"stiffness": 9.0, "edge": 0.1})
    own = {one.name: one.unit for one in model.declarations if one.name.startswith("carriage.")}
    assert own[f"carriage.{effect.name}.stiffness"] == "N/m"
    assert own[f"carriage.{effect.name}.edge"] == "m"
    made = ca.Function("rate", [model.x, model.u, model.p], [model.closed_ode[1]])
    p = [
        {f"carriage.{effect.name}.stiffness": 9.0, f"carriage.{effect.name}.edge": 0.1, "m": 1.0}.get(n, 0.0)
        for n in model.parameter_names
    ]
    inside, beyond = (0.05, 0.3) if effect.name == "end_stop" else (0.3, 0.05)
    assert float(made([inside, 0], [0], p)) == pytest.approx(0.0, abs=1e-9)
    assert float(made([beyond, 0], [0], p)) == pytest.approx(-9 * (beyond - 0.1))


def test_what_turns_on_and_on_meets_no_stop():
    run, skipped = moved("run", 1), []
    onward = ce.Experiment.from_arrays(
        "onward",
        time=TIME,
        units={"F": "N", "shown": "m"},
        F=np.full(600, 9.0),
        shown=0.3 * (1 - np.exp(-TIME)),
    )
    model = slide()
    assert len(ce.effects.candidates(model, [EndStop()], run, skipped=skipped)) == 8
    assert ce.effects.candidates(model, [EndStop()], onward, skipped=skipped) != ()  # nothing was simulated

    class Turning:
        is_mechanical = True

        @staticmethod
        def courses(signal):
            assert signal == "speed"
            return np.array([2.0, 5.0]), np.array([0.0, 3.0])

    assert EndStop().idle(Turning()) == "what moves in one direction alone meets no stop"


@pytest.mark.parametrize("fast", [0.0, -1.0, np.inf, np.nan])
def test_a_stop_is_met_at_some_speed(fast):
    with pytest.raises(
        EffectError, match=r"the largest speed at which a stop is met is not acceptable; seen: fast="
    ):
        LowerEndStop(fast=fast)


def test_where_no_place_is_shown_there_is_no_stop():
    b = ce.Blueprint("shaft")
    w = b.state("w", unit="rad/s")
    b.ode("w", b.port("rotor", "inertia", {"speed": w}, unit="N m") - w)
    b.output("n", w, unit="rad/s")
    time = np.arange(50) * 0.1
    run = ce.Experiment.from_arrays("run", time=time, units={"n": "rad/s"}, n=np.exp(-time))
    skipped = []
    assert ce.effects.candidates(b.model(), [EndStop(), Relief()], run, skipped=skipped) == ()
    assert [(one.effect, one.why) for one in skipped] == [
        ("relief", "no pressure, level or concentration is read there that could be above an edge")
    ]
    with pytest.raises(EffectError, match="end_stop cannot act at the port rotor, which has no signal angle"):
        b.model().with_effect(EndStop(), at="rotor")


def tank():
    b = ce.Blueprint("tank")
    area, drain = b.parameter("A", 0.5, unit="m2", min=0.01), b.parameter("c", 0.02, unit="m2/s", min=0)
    level, inflow = b.state("h", unit="m", scale=1.0), b.input("q", unit="m3/s")
    slot = b.port("sump", "inertia", {"speed": level}, unit="m3/s")
    b.ode("h", (inflow - drain * level + slot) / area)
    b.output("h_seen", level, unit="m")
    return b.model()


def filled(name, seed, rate=0.2):
    """A weir at 1.2 m."""
    rng = np.random.default_rng(seed)
    time = np.arange(500) * 1.0
    inflow = np.repeat(rng.uniform(0.0, 0.06, 25), 20)

    def change(t, y):
        out = rate * max(y[0] - 1.2, 0.0)
        return [(np.interp(t, time, inflow) - 0.025 * y[0] - out) / 0.4]

    h = solve_ivp(change, (0, time[-1]), [0.8], t_eval=time, rtol=1e-9, atol=1e-11, max_step=0.5).y[0]
    shown = h + 2e-3 * rng.standard_normal(len(h))
    units = {"q": "m3/s", "h_seen": "m"}
    return ce.Experiment.from_arrays(name, time=time, units=units, q=inflow, h_seen=shown)


def test_a_repair_names_the_weir():
    assert {"relief", "end_stop"} <= {one.name for one in library()}
    found = ce.repair(tank(), filled("run", 1), fresh=filled("fresh", 2), progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == "sump.relief"
    rate, edge = list(one.parameters.values())[:2]
    assert rate.value == pytest.approx(0.2, rel=0.1)
    assert edge.value == pytest.approx(1.2, abs=5e-3)


def test_nothing_runs_over_where_no_weir_is():
    found = ce.repair(tank(), filled("run", 1, 0.0), fresh=filled("fresh", 2, 0.0), progress=False)
    assert found.verdict == "nothing missing"


@pytest.mark.parametrize(("unit", "is_there"), [("mg/dL", True), ("mmol/L", True), ("V", False)])
def test_what_runs_off_is_looked_for_at_concentrations(unit, is_there):
    b = ce.Blueprint("plasma", time_unit="min")
    level, rate = b.state("G", unit=unit, scale=100), b.parameter("k", 0.02, unit="1/min", min=0)
    b.ode("G", b.port("plasma", "inertia", {"speed": level}) - rate * level)
    b.output("seen", level, unit=unit)
    time = np.arange(50) * 60.0
    run = ce.Experiment.from_arrays("run", time=time, units={"seen": unit}, seen=200 * np.exp(-time / 3000))
    assert bool(ce.effects.candidates(b.model(), [Relief()], run)) is is_there
