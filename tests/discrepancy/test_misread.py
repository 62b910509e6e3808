"""Data that are stated wrong are told before a search; what a model lacks is no fault of the data."""

import re
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import misread as module
from casadi_engine.discrepancy.misread import Misread, followed, misread, readings, unexplained, with_hint
from casadi_engine.discrepancy.ways_to_read import Reading
from casadi_engine.discrepancy.wording import HINT

STEP, COUNT = 0.02, 700
UNITS = {"F": "N", "pos": "m", "vel": "m/s"}
WORK = 1e8


def cart(*, both=True, stiffest=60.0):
    """A mass on a spring; its mass is known."""
    b = ce.Blueprint("cart")
    c = b.parameter("c", 1.0, unit="N s/m", min=0.01, max=20)
    k = b.parameter("k", 30.0, unit="N/m", min=1, max=stiffest)
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    force = b.input("F", unit="N")
    b.ode("x", v)
    acting = force - c * v - k * x + b.port("cart", "inertia", {"speed": v, "angle": x})
    b.ode("v", acting / b.parameter("m", 2.0, unit="kg", vary=False))
    b.output("pos", x, unit="m")
    if both:
        b.output("vel", v, unit="m/s")
    return b.model()


def run(law=lambda t, x, v: 0.0, *, seed=0, k=25.0, c=1.6, push=True):
    """name -> (N,) of time, force and what is measured, with noise of two per cent."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(COUNT)
    force = np.repeat(rng.uniform(-8, 8, COUNT // 35), 35) * push

    def rates(s, y):
        return [y[1], (force[min(int(s / STEP), COUNT - 1)] - c * y[1] - k * y[0] + law(s, *y)) / 2.0]

    made = solve_ivp(rates, (0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=STEP)
    shown = {
        name: y + 0.02 * np.std(y) * rng.standard_normal(COUNT)
        for name, y in zip(("pos", "vel"), made.y, strict=True)
    }
    return {"time": t, "F": force, **shown}


def recorded(made, **factors):
    """A record in which channels, or the time, are shown times a factor."""
    shown = {name: factors.get(name, 1.0) * values for name, values in made.items()}
    return ce.Experiment.from_arrays(
        "run", units=UNITS, hold={"F": "zero", "pos": "first", "vel": "first"}, **shown
    )


def asked(model, record):
    fit = ce.estimate(model, record, starts=2, progress=False)
    return fit, misread(fit, model.parameters(), None, {}, WORK)


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ({"F": -1.0}, "with the input F reversed the fit explains"),
        ({"F": 1e3}, "with the input F times 0.001 (numbers in N labelled kN)"),
        ({"F": 1e-3}, "with the input F times 1000 (numbers in kN labelled N)"),
        ({"time": 1e3}, "with the time times 0.001 (milliseconds stated as seconds)"),
        ({"time": 1e-3}, "with the time times 1000 (seconds stated as milliseconds)"),
    ],
)
def test_what_is_stated_wrong_is_told(factors, words):
    fit, found = asked(cart(), recorded(run(), **factors))
    assert unexplained(fit)
    assert found.certain
    assert words in found.words
    shares = re.search(r"explains (\d+) % of pos and (\d+) % of vel: look", found.words).groups()
    assert min(map(int, shares)) >= 90


def tank():
    """A field that fades by itself, seen twice, in a unit that is taken for no other."""
    b = ce.Blueprint("tank")
    level = b.state("level", unit="T")
    inflow = b.input("q", unit="T/s") + b.port("tank", "inertia", {"speed": level}, unit="T/s")
    b.ode("level", inflow - b.parameter("a", 0.3, unit="1/s", min=0.01, max=3) * level)
    b.output("seen", level, unit="T")
    b.output("rate", 0.5 * level, unit="T")
    return b.model()


def filled(*, seen=1.0, q_shown=1.0):
    rng, t = np.random.default_rng(2), 0.05 * np.arange(600)
    q = np.repeat(rng.uniform(0, 2, 30), 20)
    made = solve_ivp(lambda s, y: np.interp(s, t, q) - 0.4 * y, (0, t[-1]), [0.0], t_eval=t, max_step=0.05).y[
        0
    ]
    shown = {"seen": seen * made, "rate": 0.5 * made}
    shown = {name: y + 0.01 * np.std(y) * rng.standard_normal(600) for name, y in shown.items()}
    units = {"q": "T/s", "seen": "T", "rate": "T"}
    return ce.Experiment.from_arrays("run", time=t, units=units, q=q_shown * q, **shown)


def test_a_prefix_of_an_output_is_told():
    """Of a unit that is taken for no other; where one is, a search names the units."""
    _, found = asked(tank(), filled(seen=1e3))
    assert found.certain
    assert "with the output seen times 0.001" in found.words


def test_what_a_gain_of_the_sensor_tells_is_left_to_the_search():
    """One output of a linear model reversed is the same as the input reversed."""
    record = recorded(run(), pos=-1.0)
    _, found = asked(cart(both=False), record)
    assert not found.certain
    assert found.words.count("reversed") == 2
    assert "; as much with the " in found.words


@pytest.mark.parametrize(
    "law",
    [
        lambda t, x, v: 6.0,
        lambda t, x, v: 40.0,
        lambda t, x, v: -25.0 * x,
        lambda t, x, v: -150.0 * x,
        lambda t, x, v: -3e4 * x**3,
        lambda t, x, v: -6 * np.tanh(v / 0.01),
        lambda t, x, v: 15 * np.sin(3.4 * t),
        lambda t, x, v: -20 * v,
        lambda t, x, v: 30.0 * (t > 7),
    ],
    ids=["load", "large load", "stiffness", "large stiffness", "hardening", "friction", "drive", "damping", "step"],
)  # fmt: skip
@pytest.mark.parametrize("both", [True, False])
def test_what_the_model_lacks_is_no_fault_of_the_data(law, both):
    _, found = asked(cart(both=both), recorded(run(law, seed=4)))
    assert found is None or not found.certain


def test_a_good_fit_is_not_asked_for_another_reading():
    fit, found = asked(cart(), recorded(run()))
    assert found is None
    assert min(followed(fit).values()) > 90
    assert unexplained(fit) == {}


def test_an_input_that_never_moves_is_pointed_at():
    _, found = asked(tank(), filled(q_shown=0.0))
    assert not found.certain
    assert found.words.startswith("q is 0 in all samples, and no fit explains more than next to nothing of")


def test_an_input_that_never_moves_is_read_in_no_other_way():
    still = recorded(run() | {"F": np.zeros(COUNT)})
    assert {one.what for one in readings(cart(), [still])} == {"time"}
    assert {one.what for one in readings(cart(), [recorded(run())])} == {"time", "input"}


def test_what_one_sensor_of_several_shows_is_no_fault_of_an_input():
    """Its gain, which a search tells: no other way to read the data is tried."""
    fit, found = asked(cart(), recorded(run(), vel=-1.0))
    assert unexplained(fit)
    assert found is None


def test_a_repair_ends_with_what_is_wrong_with_the_data():
    found = ce.repair(cart(), recorded(run(), F=-1.0), starts=1, progress=False)
    assert (found.status, found.verdict) == ("the data are at fault", None)
    text = " ".join(str(found).split())
    assert "Note: with the input F reversed the fit explains" in text
    assert "look at its sign" in text
    assert "Next: look at the data, as said above, and repair again" in text


def test_a_doubt_about_the_data_leads_an_answer_without_a_name():
    record = filled(q_shown=0.0)
    found = ce.repair(tank(), record, effects=["coulomb_friction"], starts=1, progress=False)
    assert found.verdict == "unnamed"
    text = str(found)
    assert " q is 0 in all samples, and no fit explains more than" in " ".join(
        text.split("  data ", maxsplit=1)[0].split()
    )
    assert "Next: look at the data first, as said above" in text


@dataclass(frozen=True)
class _Asked:
    verdict: str
    effects: tuple
    options: dict
    model: object


@pytest.mark.parametrize(
    ("verdict", "kind", "error", "said"),
    [
        ("named", "input", 0.01, False),
        ("named", "input", None, True),
        ("named", "inertia", None, False),
        ("class", "parameter", None, True),
        ("unnamed", "input", None, True),
    ],
)
def test_a_doubt_stays_beside_a_gain_of_no_known_size(verdict, kind, error, said):
    """An input that is reversed was named a gain of -1.53, as inertia and stiffness took the rest; drag that explains
    all, with a likelihood that no error describes, is no doubt about a load that is constant."""
    one = SimpleNamespace(amplitude=SimpleNamespace(stderr=error), at="here")
    model = SimpleNamespace(ports={"here": SimpleNamespace(kind=kind)})
    effects = () if verdict == "unnamed" else (one,)
    found = with_hint(
        _Asked(verdict, effects, {}, model), Misread("with the input F reversed", certain=False)
    )
    assert (HINT in found.options) is said


def test_a_reading_that_drives_a_parameter_to_its_bound_is_none():
    """An escalator whose load comes during the record was "seconds stated as minutes", with a damper a hundred times
    too large. A damper that is 0 is no such thing."""

    def bent(value, at_bound):
        return module._bent(
            SimpleNamespace(
                free=("c",), values={"c": value}, estimates={"c": SimpleNamespace(at_bound=at_bound)}
            )
        )

    assert bent(500.0, "max")
    assert not bent(0.0, "min")
    assert not bent(4.0, False)


def oven(*, seen=("wall", "load")):
    """Two heated masses, in kelvin."""
    b = ce.Blueprint("oven")
    wall, load = (b.state(name, unit="K", scale=100) for name in ("T_wall", "T_load"))
    power, room = b.input("P", unit="W"), b.input("T_room", unit="K")
    loss = b.parameter("G", 6.0, unit="W/K", min=0.1, max=500) * (wall - room)
    across = b.parameter("H", 9.0, unit="W/K", min=0.1, max=500) * (wall - load)
    extra = b.port("wall", "inertia", {"speed": wall - room})
    b.ode("T_wall", (power - loss - across + extra) / b.parameter("C_w", 8e3, unit="J/K", min=100, max=1e6))
    b.ode("T_load", across / b.parameter("C_l", 3e3, unit="J/K", min=10, max=1e6))
    for name, state in (("wall", wall), ("load", load)):
        if name in seen:
            b.output(name, state, unit="K")
    return b.model()


def heated(*, law=0.0, **shown):
    """A record of the oven; shown : channel -> values from those of (time, power, room, wall, load)."""
    rng, t = np.random.default_rng(3), 20.0 * np.arange(400)
    power = np.repeat(rng.uniform(0, 2500, 10), 40)
    room = 293.0 + 2 * np.sin(t / 1500)

    def rates(s, y):
        k = min(int(s / 20.0), 399)
        d = y[0] - 293.0 - 2 * np.sin(s / 1500)
        across = 11.0 * (y[0] - y[1])
        return [(power[k] - 7.0 * d - law * d * abs(d) - across) / 9000.0, across / 2600.0]

    made = solve_ivp(rates, (0, t[-1]), [293.0, 293.0], t_eval=t, rtol=1e-8, max_step=20.0).y
    wall, load = made + 0.3 * rng.standard_normal((2, 400))
    own = {"P": power, "T_room": room, "wall": wall, "load": load}
    own |= {name: change(own) for name, change in shown.items()}
    units = {"P": "W", "T_room": "K", "wall": "K", "load": "K"}
    hold = {"P": "zero", "T_room": "first", "wall": "first", "load": "first"}
    return ce.Experiment.from_arrays("run", time=t, units=units, hold=hold, **own)


def test_temperatures_of_the_other_scale_are_told():
    wrong = heated(wall=lambda own: own["wall"] - 273.15, load=lambda own: own["load"] - 273.15)
    _, found = asked(oven(), wrong)
    assert found.certain
    assert "the outputs wall and load plus 273.15 (numbers in degC labelled K)" in found.words
    assert "the input T_room minus 273.15 (numbers in K labelled degC)" in found.words


def test_a_scale_of_one_sensor_of_several_is_left_to_its_offset():
    ways = readings(oven(), [heated()])
    shifted = [one.names for one in ways if one.plus]
    assert ("wall",) not in shifted
    assert {("wall", "load"), ("T_room",)} <= set(shifted)
    assert {one.names for one in readings(oven(seen=("load",)), [heated()]) if one.plus > 0} == {
        ("T_room",),
        ("load",),
    }


def test_exchanged_columns_lead_an_answer_that_explains_less():
    """Both are followed to four fifths as they are: a search is made, and the columns are pointed at."""
    wrong = heated(law=0.02, wall=lambda own: own["load"], load=lambda own: own["wall"])
    fit = ce.estimate(oven(), wrong, starts=1, progress=False)
    assert not unexplained(fit)
    unnamed = ce.repair(oven(), wrong, effects=["coulomb_friction"], starts=1, progress=False)
    assert unnamed.verdict == "unnamed"
    text = " ".join(str(unnamed).split("  data ", maxsplit=1)[0].split())
    assert "With wall and load exchanged the fit without any effect explains" in text
    assert "look which column is which. As the records are, it explains" in text


def test_a_record_as_it_is_needs_no_other_reading():
    found = ce.repair(oven(), heated(law=0.02), effects=["coulomb_friction"], starts=1, progress=False)
    assert found.verdict != "nothing missing"
    assert HINT not in found.options


def thrown(name, *, vx=1.5, vy=4.0, scale=1.0, swapped=False):
    """A ball of 0.1 kg that is thrown, filmed at 60 Hz."""
    rng, t = np.random.default_rng(len(name)), np.arange(45) / 60
    x = vx * t + 1e-3 * rng.standard_normal(45)
    y = (vy * t - 9.81 * t**2 / 2 + 1e-3 * rng.standard_normal(45)) * scale
    x, y = (y, x) if swapped else (x, y)
    return ce.Experiment.from_arrays(name, time=t, units={"x": "m", "y": "m"}, x=x, y=y)


def ball():
    b = ce.Blueprint("ball")
    m = b.parameter("m", 0.1, unit="kg", vary=False)
    g = b.parameter("g", 9.81, unit="m/s2", vary=False)
    for name, fall in (("x", 0.0), ("y", g)):
        place, speed = b.state(name, unit="m"), b.state(f"v{name}", unit="m/s")
        b.ode(name, speed)
        b.ode(f"v{name}", (b.port(f"along_{name}", "inertia", {"speed": speed}) - m * fall) / m)
        b.output(name, place, unit="m")
    return b.model()


def test_another_reading_is_told_beside_a_confirmed_effect_that_does_as_much():
    """Heights in cm labelled m: a constant force of 99 times the weight, "confirmed", as fresh data are read alike."""
    found = ce.repair(
        ball(), thrown("first", scale=100.0), fresh=thrown("another", vx=1.0, vy=3.5, scale=100.0), starts=1,
        effects=["constant_torque", "viscous_friction"], progress=False,
    )  # fmt: skip
    assert found.confirmed
    assert [one.key for one in found.effects] == ["along_y.constant_torque"]
    assert "the output y times 0.01 (numbers in cm labelled m)" in found.options[HINT]


def test_a_confirmed_effect_of_data_as_they_are_has_no_other_reading():
    found = ce.repair(
        ball(), thrown("first"), fresh=thrown("another", vx=1.0, vy=3.5), starts=1, progress=False,
        effects=["constant_torque", "viscous_friction"],
    )  # fmt: skip
    assert found.verdict == "nothing missing"
    assert HINT not in found.options


def alone(model, record):
    """What is said of a fit that no search for effects follows."""
    fit = ce.estimate(model, record, progress=False)
    return misread(fit, model.parameters(), None, {}, WORK, every=True)


def test_numbers_under_each_others_headings_are_told_where_units_differ():
    made = run()
    swapped = recorded({**made, "F": made["pos"], "pos": made["F"]})
    found = alone(cart(both=False), swapped)
    assert "with the numbers of F and pos exchanged the fit explains" in found.words
    record = recorded(made)
    (way,) = [one for one in readings(cart(both=False), (record,), every=True) if one.what == "numbers"]
    other = way.of(record)
    assert (other["F"].unit, other["pos"].unit) == ("N", "m")
    np.testing.assert_array_equal(other["F"].values, record["pos"].values)
    assert not [one for one in readings(cart(), (record,)) if one.what == "numbers"]


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("degC", 1.0), ("-", 1.0)])
def test_numbers_under_each_others_headings_are_exchanged_as_they_were_recorded(unit, factor):
    """A column of degrees under the heading of a torque: its numbers are degrees, whatever unit was read."""
    made = run()
    right = ce.Experiment.from_arrays(
        "right",
        units={"time": "s", "F": "N", "pos": unit},
        time=made["time"],
        F=made["F"],
        pos=factor * made["pos"],
    )
    wrong = ce.Experiment.from_arrays(
        "wrong",
        units={"time": "s", "F": "N", "pos": unit},
        time=made["time"],
        F=factor * made["pos"],
        pos=made["F"],
    )
    back = Reading("numbers", ("F", "pos"), "", "").of(wrong)
    assert (back["F"].unit, back["pos"].unit) == (right["F"].unit, right["pos"].unit)
    np.testing.assert_allclose(back["F"].values, right["F"].values, rtol=1e-12)
    np.testing.assert_allclose(back["pos"].values, right["pos"].values, rtol=1e-12, atol=1e-12)


def test_inputs_of_unlike_units_under_each_others_headings_are_tried():
    b = ce.Blueprint("heater")
    t = b.state("T", unit="K")
    power, outside, other = b.input("P", unit="W"), b.input("To", unit="K"), b.input("Ta", unit="K")
    b.ode("T", (power - b.parameter("G", 1.5, unit="W/K") * (t - outside - other)) / 400)
    b.output("shown", t, unit="K")
    moving = np.arange(9.0)
    record = ce.Experiment.from_arrays(
        "a", time=moving, units={"P": "W", "To": "degC", "Ta": "K", "shown": "K"},
        P=moving, To=moving, Ta=moving, shown=moving,
    )  # fmt: skip
    ways = [
        one.names for one in readings(b.model(), [record], every=True) if one.what in ("exchange", "numbers")
    ]
    assert ways == [("To", "Ta"), ("P", "shown"), ("P", "To"), ("P", "Ta")]


def test_all_ways_are_fitted_where_nothing_else_would_tell_them():
    """Far from the parameters' start the right way does not look the best at first sight."""
    found = alone(cart(both=False), recorded(run(k=25.0), time=1e-3))
    assert "with the time times 1000 (seconds stated as milliseconds)" in found.words


def test_a_limited_time_is_kept_for_what_looked_well(monkeypatch):
    """A look at nonsense takes no end; on the command line none of the ways was fitted then."""
    ways = readings(cart(both=False), (recorded(run()),), every=True)
    order = [one.what for one in ways]
    scaled = [k for k, one in enumerate(ways) if one.what in ("input", "output") and one.factor != -1.0]
    assert order.index("numbers") < min(scaled)
    looked = []
    monkeypatch.setattr(module, "seconds_left", lambda: 8.0 - len(looked))
    monkeypatch.setattr(
        module._Readings, "_fit",
        lambda self, records, parameters, work, seconds=None: looked.append(seconds),
    )  # fmt: skip
    record = recorded(run())
    job = module._Readings(cart(both=False), (record,), cart(both=False).parameters(), None, {}, len(ways))
    assert job.good(ways, 1.0, lambda shares: True) == []
    assert looked == [0.5] * 5  # an eighth of half of the time each, and no more after that half


def test_what_is_noise_already_is_no_sign_of_another_reading():
    """The ways were looked at for a tenth of a repair's time where no reading could have halved what is left."""
    noise = np.random.default_rng(1).standard_normal(4000)
    assert module._floor(noise) > 0.8
    assert module._floor(noise + 3 * np.sin(0.05 * np.arange(4000))) < 0.25
    assert module._floor(np.cumsum(noise)) < 0.02
    assert module._floor(noise[:100]) == 0.0  # too few to tell
    fit = ce.estimate(oven(), heated(), starts=1, progress=False)
    assert module._mostly_noise(fit)
    assert not module._mostly_noise(ce.estimate(oven(), heated(law=0.02), starts=1, progress=False))
