"""Heat that goes to surroundings which the model does not have: the law, where it acts, and that a repair names it."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.effects import AmbientLoss, library, ports_for

TIME = np.arange(300) * 10.0


def vessel(signal=lambda warm, jacket: warm - jacket):
    """A stirred vessel in a jacket whose temperature is recorded."""
    b = ce.Blueprint("vessel")
    exchange = b.parameter("UA", 30.0, unit="W/K", min=1, max=500)
    store = b.parameter("C", 9000, unit="J/K", min=500, max=90000)
    warm = b.state("T", unit="degC")
    jacket, power = b.input("T_j", unit="degC"), b.input("P", unit="W")
    slot = b.port("content", "inertia", {"speed": signal(warm, jacket)}, unit="W")
    b.ode("T", (power - exchange * (warm - jacket) + slot) / store)
    b.output("T_in", warm, unit="degC")
    return b.model()


def record(name, seed, lost=0.0):
    """By SciPy: so many W/K go to a room of 18 degrees."""
    rng = np.random.default_rng(seed)
    jacket = np.interp(TIME, np.linspace(0, TIME[-1], 16), rng.uniform(40, 75, 16))
    power = np.interp(TIME, np.linspace(0, TIME[-1], 24), rng.uniform(0, 800, 24))

    def rate(t, x):
        out, heat = np.interp(t, TIME, jacket), np.interp(t, TIME, power)
        return (heat - 40.0 * (x - out) - lost * (x - 18.0)) / 8000

    warm = solve_ivp(rate, (0, TIME[-1]), [45.0], t_eval=TIME, rtol=1e-9, atol=1e-11, max_step=10).y[0]
    shown = warm + 0.05 * rng.standard_normal(len(TIME))
    units = {"T_j": "degC", "P": "W", "T_in": "degC"}
    return ce.Experiment.from_arrays(name, time=TIME, units=units, T_j=jacket, P=power, T_in=shown)


def test_the_law_is_of_what_is_stored_not_of_the_difference_to_the_jacket():
    assert "ambient_loss" in [one.name for one in library()]
    model = vessel().with_effect(
        AmbientLoss(), at="content", values={"coefficient": 5.0, "surroundings": 20.0}
    )
    coefficient, surroundings = model.declarations[-2:]
    assert (coefficient.unit, surroundings.unit) == ("W/degC", "degC")
    assert "content.ambient_loss.coefficient*(T - content.ambient_loss.surroundings)" in model.equations()


def test_the_surroundings_may_be_about_what_the_records_have():
    class View:
        @staticmethod
        def courses(signal, stored=False):
            assert (signal, stored) == ("speed", True)
            return np.array([40.0, 60.0]), np.array([50.0, 55.0])

    fitted = AmbientLoss().fitted(View(), record("run", 1), {})
    assert fitted.span == (-20.0, 80.0)
    assert fitted.nuisance["surroundings"].values() == pytest.approx((-20.0, 13.333, 46.667, 80.0), abs=1e-3)
    assert AmbientLoss(span=(0.0, 30.0)).fitted(View(), record("run", 1), {}).span == (0.0, 30.0)


def test_a_shaft_has_no_surroundings_that_it_heats():
    b = ce.Blueprint("shaft")
    w = b.state("w", unit="rad/s")
    b.ode("w", b.port("rotor", "inertia", {"speed": w}, unit="N m") - w)
    b.output("n", w, unit="rad/s")
    model = b.model()
    assert [one.name for one in ports_for(model, AmbientLoss())] == ["rotor"]
    time = np.arange(50) * 0.1
    run = ce.Experiment.from_arrays("run", time=time, units={"n": "rad/s"}, n=np.exp(-time))
    skipped = []
    assert ce.effects.candidates(model, [AmbientLoss()], run, skipped=skipped) == ()
    assert skipped[0].why == "what is no temperature loses no heat"


def test_a_repair_names_the_loss_and_the_temperature_of_the_room():
    """It was a gain of the jacket's thermometer and a constant power that took each other back, confirmed."""
    records = [record(name, seed, lost=4.0) for name, seed in (("run", 1), ("fresh", 2))]
    found = ce.repair(vessel(), records[0], fresh=records[1], progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    (one,) = found.effects
    assert one.key == "content.ambient_loss"
    coefficient, surroundings = one.parameters.values()
    assert abs(coefficient.value - 4.0) < 3 * coefficient.stderr
    assert abs(surroundings.value - 18.0) < 3 * surroundings.stderr
    assert "a loss of content to surroundings of a constant temperature" in str(found)


def test_where_the_port_shows_the_temperature_alone_it_is_one_effect_too():
    records = [record(name, seed, lost=4.0) for name, seed in (("run", 1), ("fresh", 2))]
    found = ce.repair(vessel(lambda warm, _: warm), records[0], fresh=records[1], progress=False)
    assert (found.verdict, found.confirmed) == ("named", True)
    assert [one.key for one in found.effects] == ["content.ambient_loss"]


def test_nothing_is_lost_where_nothing_is():
    found = ce.repair(vessel(), record("run", 1), fresh=record("fresh", 2), progress=False)
    assert found.verdict == "nothing missing"
