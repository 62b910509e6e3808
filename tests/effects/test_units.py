"""Units of effects' parameters are those of the numbers that the law reads, whatever units the port is in."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.effects import Amplitude, Grid
from casadi_engine.errors import EffectError
from casadi_engine.experiment.units import converted, read_unit, unit_product

ANGLES = [("rad", "rad/s"), ("deg", "deg/s"), ("deg", "rpm"), ("mrad", "mrad/s"), ("rad", "rpm")]
LENGTHS = [("m", "m/s"), ("mm", "mm/s"), ("mm", "m/min"), ("m", "km/h")]
SYSTEMS = [(acts, *one) for acts in ("N m", "kN m", "N mm") for one in ANGLES] + [
    (acts, *one) for acts in ("N", "kN") for one in LENGTHS
]


def body_on_a_spring(acts, place, speed):
    """One inertia and one coupling, with everything in these units."""
    b = ce.Blueprint("body", time_unit="s")
    hard, base = f"{acts}/{place}", "N m/rad" if read_unit(place).dimension == "rad" else "N/m"
    stiffness = b.parameter("k", float(converted([40.0], base, hard)[0]), unit=hard)
    x, v = b.state("x", unit=place), b.state("v", unit=speed)
    body = b.port("body", "inertia", {"speed": v}, unit=acts)
    spring = b.port("spring", "coupling", {"twist": x, "twist_rate": v, "stiffness": stiffness}, unit=acts)
    b.ode("x", v * float(converted([1.0], speed, unit_product((place, 1), ("s", -1)))[0]))
    b.ode("v", body - spring)  # so that the rate of v is what acts
    b.output("y", x, unit=place)
    return b.model()


_AT = 0.4  # s
EFFECTS = [
    effect
    for effect in (*ce.effects.library(), ce.effects.Impulse())
    if set(effect.attaches) & {"inertia", "coupling"}
]


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
@pytest.mark.parametrize(
    "system",
    [pytest.param(one, marks=pytest.mark.slow if k % 4 else ()) for k, one in enumerate(SYSTEMS)],
    ids=lambda system: ", ".join(system),
)
def test_a_law_gives_the_same_in_any_units_when_its_parameters_are_converted_as_labelled(effect, system):
    acts, place, _ = system
    turns = read_unit(place).dimension == "rad"
    base = ("N m", "rad", "rad/s") if turns else ("N", "m", "m/s")
    rng = np.random.default_rng(3)
    state = rng.uniform(0.3, 1.0, 2)
    moved = [float(converted([state[k]], base[1 + k], system[1 + k])[0]) for k in (0, 1)]
    for port in ("body", "spring"):
        if ("inertia" if port == "body" else "coupling") not in effect.attaches:
            continue
        plain, other = (body_on_a_spring(*one).with_effect(effect, at=port) for one in (base, system))
        names = plain.parameter_names[1:]
        values = {n: _AT - 5e-3 if n.endswith(".time") else float(rng.uniform(0.2, 0.8)) for n in names}
        units = [plain.parameters(), other.parameters()]
        same = {n: float(converted([values[n]], units[0][n].unit, units[1][n].unit)[0]) for n in names}
        stored = system[2] if port == "body" else system[1]  # what a storage holds has the unit of its signal
        own = float(converted([0.15], base[2] if port == "body" else base[1], stored)[0])
        pairs = ((plain, [*state, 0.15], values), (other, [*moved, own], same))
        acting = [_acting(model, x[: model.x.numel()], p) for model, x, p in pairs]
        assert float(converted(acting[1], acts, base[0])) == pytest.approx(acting[0], rel=1e-9)
        assert abs(acting[0]) > 1e-6


def _acting(model, x, values):
    rates = ca.Function("rates", [model.x, model.u, model.t, model.p], [model.closed_ode])
    return float(rates(x, 0, _AT, model.parameter_vector(values))[1])


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda system: ", ".join(system))
def test_a_coefficient_times_its_signal_is_in_the_unit_of_the_port(system):
    acts, place, speed = system
    model = body_on_a_spring(*system)

    def product(effect, at, *signals):
        made = model.with_effect(ce.effects.library(effect)[0], at=at)
        found = read_unit(unit_product((made.parameters()[made.effects[-1].amplitude].unit, 1), *signals))
        return found.exponents, found.factor, found.pi

    port = read_unit(acts)
    own = (port.exponents, port.factor, port.pi)
    assert product("viscous_friction", "body", (speed, 1)) == own
    assert product("viscous_friction", "spring", (speed, 1)) == own
    assert product("quadratic_drag", "body", (speed, 2)) == own
    assert product("cubic_stiffness", "spring", (place, 3)) == own
    assert product("coulomb_friction", "spring") == own


class Stop(ce.Effect):
    """A one-sided spring with clearance."""

    name, attaches = "stop", ("coupling",)

    def __init__(self, rate, clearance="rad"):
        self.amplitude = Amplitude("rate", unit=rate, min=0)
        self.nuisance = {"clearance": Grid(5.0, 45.0, unit=clearance)}

    def law(self, port, p, math):
        return -p.rate * math.positive(-port.twist - p.clearance, width=0.1)


@pytest.mark.parametrize(
    ("system", "rate", "clearance", "labels"),
    [
        (("N", "mm", "mm/s"), "N/mm", "mm", ("N/mm", "mm")),
        (("N", "mm", "mm/s"), "kN/m", "rad", ("kN/m", "mm")),  # the same size
        (("N", "mm", "mm/s"), "N m/rad", "mm", ("N/mm", "mm")),  # follows the port
        (("N", "m", "m/s"), "N/m", "m", ("N/m", "m")),
        (("N", "m", "m/s"), "kg", "1", ("kg", "1")),  # nothing that the port's units are made of
        (("N m", "deg", "deg/s"), "N m/deg", "deg", ("N m/deg", "deg")),
        (("N m", "deg", "deg/s"), "N m/rad", "rad", ("N m/deg", "deg")),
    ],
)
def test_a_unit_that_a_user_states_is_kept(system, rate, clearance, labels):
    made = body_on_a_spring(*system).with_effect(Stop(rate, clearance), at="spring")
    parameters = made.parameters()
    assert tuple(parameters[f"spring.stop.{name}"].unit for name in ("rate", "clearance")) == labels


@pytest.mark.parametrize(
    ("system", "rate", "clearance", "words"),
    [
        (("N", "mm", "mm/s"), "N/m", "mm", ("stop.rate", "rate in N/m;", "allowed: N/mm:")),
        (("N", "m", "m/s"), "N/mm", "m", ("stop.rate", "rate in N/mm;", "allowed: N/m:")),
        (("kN", "m", "m/s"), "N", "m", ("stop.rate", "rate in N;", "allowed: kN:")),
        (("N", "mm", "m/min"), "N s/m", "mm", ("stop.rate", "rate in N s/m;", "allowed: N min/m:")),
        (("N", "m", "m/s"), "N/m", "mm", ("stop.clearance", "clearance in mm;", "allowed: m:")),
        (("N m", "rad", "rad/s"), "N m/deg", "rad", ("stop.rate", "rate in N m/deg;", "allowed: N m/rad:")),
    ],
)
def test_a_unit_of_another_size_than_the_ports_is_refused(system, rate, clearance, words):
    with pytest.raises(EffectError) as caught:
        body_on_a_spring(*system).with_effect(Stop(rate, clearance), at="spring")
    for word in words:
        assert word in str(caught.value)
    assert f"what acts at spring in {system[0]}, twist in {system[1]}, twist_rate in {system[2]}" in str(
        caught.value
    )
    assert "do: state unit=" in str(caught.value)


def test_sensors_and_inputs_convert_as_they_like():
    class Turned(ce.Effect):
        name, attaches, amplitude = "turned", ("sensor",), Amplitude("speed", unit="rpm")

        def law(self, port, p, math):
            return p.speed * 0.1

    made = body_on_a_spring("N m", "rad", "rad/s").with_effect(Turned(), at="sensor_y")
    assert made.parameters()["sensor_y.turned.speed"].unit == "rpm"


def test_printed_and_screened_labels_are_those_of_the_port():
    model = body_on_a_spring("N m", "deg", "deg/s").with_effect(ce.effects.ViscousFriction(), at="body")
    assert "N m s/deg" in str(model)
    assert "N m s/deg" in str(model.parameters())
