"""Heat that is radiated: the law in the unit of its port, against that of Stefan and Boltzmann, and by a repair."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import Radiation, library, ports_for

TIME = np.arange(400) * 2.0
FILAMENT = 5.670e-8 * 0.9 * 0.02


def heater(unit="degC", signal=lambda hot, room: hot - room):
    """An element that an electric power heats; the room's temperature is recorded."""
    b = ce.Blueprint("heater")
    loss = b.parameter("G", 0.3, unit="W/K", min=0.01, max=5)
    store = b.parameter("C", 30, unit="J/K", min=1, max=900)
    hot = b.state("T", unit=unit)
    room, power = b.input("T_room", unit=unit), b.input("P", unit="W")
    slot = b.port("element", "inertia", {"speed": signal(hot, room)}, unit="W")
    b.ode("T", (power - loss * (hot - room) + slot) / store)
    b.output("T_el", hot, unit=unit)
    return b.model()


def record(name, seed, radiates=FILAMENT):
    """By SciPy, in degC."""
    rng = np.random.default_rng(seed)
    room = 20 + 3 * np.sin(TIME / 150 + seed)
    power = np.repeat(rng.uniform(0, 150, 20), 20)

    def rate(t, x):
        out, heat = np.interp(t, TIME, room), np.interp(t, TIME, power)
        lost = radiates * ((x + 273.15) ** 4 - (out + 273.15) ** 4)
        return (heat - 0.25 * (x - out) - lost) / 40

    hot = solve_ivp(rate, (0, TIME[-1]), [60.0], t_eval=TIME, rtol=1e-9, atol=1e-9, max_step=2).y[0]
    shown = hot + 0.5 * rng.standard_normal(len(TIME))
    units = {"T_room": "degC", "P": "W", "T_el": "degC"}
    return ce.Experiment.from_arrays(name, time=TIME, units=units, T_room=room, P=power, T_el=shown)


@pytest.mark.parametrize(("unit", "zero"), [("degC", -273.15), ("K", 0.0), ("degF", -459.67)])
def test_the_law_counts_from_absolute_zero(unit, zero):
    model = heater(unit).with_effect(Radiation(), at="element", values={"coefficient": 1e-9})
    assert model.declarations[-1].unit == f"W/{unit}4"
    assert not [one for one in model.parameter_names if one.endswith("surroundings")]
    given = {"T": 400.0, "T_room": 25.0, "P": 0.0}
    p = [{"G": 0.0, "C": 1.0}.get(name, 1e-9) for name in model.parameter_names]
    function = ca.Function("rate", [model.x, model.u, model.p], [model.closed_ode])
    u = [given[one.name] for one in model.inputs]
    rate = float(function([given["T"]], u, p))
    assert rate == pytest.approx(-1e-9 * ((400 - zero) ** 4 - (25 - zero) ** 4), rel=1e-12)


def lamp(shown=0):
    """A body of which the model knows the heat alone; or with so many temperatures that act on it."""
    b = ce.Blueprint("lamp")
    hot, power = b.state("T", unit="degC"), b.input("P", unit="W")
    rooms = [b.input(f"T_{k}", unit="degC") for k in range(shown)]
    slot = b.port("wire", "inertia", {"speed": hot}, unit="W")
    b.ode("T", power + slot - sum(0.1 * (hot - room) for room in rooms))
    b.output("T_out", hot, unit="degC")
    return b.model()


@pytest.mark.parametrize(("shown", "known"), [(0, False), (1, True), (2, False)])
def test_the_surroundings_are_what_the_model_has_there_or_a_number(shown, known):
    assert "radiation" in [one.name for one in library()]
    values = {"coefficient": 1e-9} | ({} if known else {"surroundings": 20.0})
    model = lamp(shown).with_effect(Radiation(), at="wire", values=values)
    own = [(one.name, one.unit) for one in model.declarations if one.name.startswith("wire.")]
    surroundings = [] if known else [("wire.radiation.surroundings", "degC")]
    assert own == [("wire.radiation.coefficient", "W/degC4"), *surroundings]
    assert ("T_0 + 273.15" in model.equations()) == known


def test_a_shaft_radiates_nothing():
    b = ce.Blueprint("shaft")
    w = b.state("w", unit="rad/s")
    b.ode("w", b.port("rotor", "inertia", {"speed": w}, unit="N m") - w)
    b.output("n", w, unit="rad/s")
    model = b.model()
    assert [one.name for one in ports_for(model, Radiation())] == ["rotor"]
    time = np.arange(50) * 0.1
    run = ce.Experiment.from_arrays("run", time=time, units={"n": "rad/s"}, n=np.exp(-time))
    skipped = []
    assert ce.effects.candidates(model, [Radiation()], run, skipped=skipped) == ()
    assert skipped[0].why == "what is no temperature loses no heat"


@pytest.mark.parametrize("signal", [lambda hot, room: hot - room, lambda hot, _: hot])
def test_a_repair_names_it_and_not_several_losses_that_add_up_to_its_curve(signal):
    """Two or three losses, linear and by the square, had been named together for it, confirmed."""
    found = ce.repair(heater(signal=signal), record("run", 1), fresh=record("fresh", 2), progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == "element.radiation"
    size = one.amplitude
    assert abs(size.value - FILAMENT) < 3 * size.stderr


def test_nothing_radiates_where_nothing_does():
    found = ce.repair(heater(), record("run", 1, 0.0), fresh=record("fresh", 2, 0.0), progress=False)
    assert found.verdict == "nothing missing"
