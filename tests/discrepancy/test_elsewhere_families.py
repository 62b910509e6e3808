"""Functions where no effect of the library acts: a parameter that is not constant is named, with what it depends on."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import elsewhere_families as module
from casadi_engine.discrepancy.certificate import law_words
from casadi_engine.discrepancy.elsewhere_families import elsewhere
from casadi_engine.discrepancy.evidence import Levels
from casadi_engine.discrepancy.null_model import null_model
from casadi_engine.report.repaired_latent import acting, axis_of

NOISE = 0.4


def vessel():
    """A vessel that fills through a pipe and empties through a leak: C dp/dt = Q - p/R."""
    b = ce.Blueprint("vessel")
    c = b.parameter("C", 1.0, unit="m3/Pa", min=0.1, max=10)
    r = b.parameter("R", 2.0, unit="Pa s/m3", min=0.1, max=10)
    flow = b.input("Q", unit="m3/s")
    p = b.state("p", unit="Pa", scale=50)
    missing = b.port("vessel", "inertia", {"speed": p})
    b.ode("p", (flow - p / r + missing) / c)
    b.output("P", p, unit="Pa")
    return b.model()


def run(seed, *, bend=0.0, drift=0.0):
    """By an integrator of its own: C exp(-bend (p - 60)); the sensor drifts, slower and slower."""
    time = np.arange(500) * 0.04
    rng = np.random.default_rng(seed)
    tones = 2 * np.pi * np.array([0.13, 0.31, 0.77])
    flow = 60 + 40 * np.sin(tones[:, None] * time + rng.uniform(0, 6, (3, 1))).sum(axis=0)

    def rate(t, p):
        return (np.interp(t, time, flow) - p / 1.0) / (1.4 * np.exp(-bend * (p - 60)))

    p = solve_ivp(rate, (0, time[-1]), [40.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=0.04).y[0]
    shown = p + drift * np.sqrt(time / time[-1]) + NOISE * rng.standard_normal(len(time))
    return ce.Experiment.from_arrays(
        f"run {seed}", time=time, units={"Q": "m3/s", "P": "Pa"}, Q=flow, P=shown
    )


def repaired(**options):
    own = {"effects": ["quadratic_drag", "constant_torque"], "noise": ce.Noise(P=NOISE), "starts": 1}
    return ce.repair(
        vessel(), run(1, **options), fresh=run(2, **options), at=["vessel"], progress=False, **own
    )


@pytest.fixture(scope="module")
def bent():
    return repaired(bend=0.01)


def test_a_parameter_that_is_not_constant_is_named_with_what_it_depends_on(bent, tmp_path):
    """A vessel that is stiffer the fuller it is was "a sensor that shows another function of its value"."""
    assert bent.verdict == "unnamed"
    assert bent.effects == ()
    unknown = bent.unknown
    assert (unknown.port, unknown.signal) == ("parameter_C", "p")
    words = "the parameter C seems not to be constant: it depends on p, and falls with it: far more probable than "
    assert unknown.sentence.startswith(words)
    assert unknown.tests
    ce.report(bent, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "the parameter C seems not to be constant" in page
    assert "unknown change of parameter C" in page
    assert "look at the curve of the unknown change of parameter C" in " ".join(str(bent).split())


def test_its_figure_has_the_units_of_the_parameter_and_of_what_it_depends_on(bent):
    """It was called a torque in N m."""
    assert acting(bent, "parameter_C") == "change of parameter C [m3/Pa]"
    assert axis_of(bent, "parameter_C", "p") == "p [Pa]"


def test_its_course_is_that_of_the_truth(bent):
    """But for a level, which is the parameter's own."""
    course = bent.unknown.course
    seen = course.family.visited > 0
    truth = 1.4 * np.exp(-0.01 * (course.signal - 60))
    off = (course.mean - truth)[seen]
    weight = course.family.visited[seen]
    off = off - weight @ off / weight.sum()
    assert np.sqrt(weight @ off**2 / weight.sum()) < 0.3 * np.std(truth[seen])


def test_nothing_is_looked_for_elsewhere_where_nothing_is_known_to_be_missing(monkeypatch):
    monkeypatch.setattr("casadi_engine.discrepancy.unknown_law.elsewhere", None)
    assert repaired().verdict == "nothing missing"


def test_what_a_port_can_do_as_well_is_looked_for_there_alone():
    """p/R with R a function of p is a function of p at the vessel; of C, or of the flow, it is not."""
    model = vessel()
    every = [("p", model.x[0]), ("Q", model.u[0])]
    assert module._said_at_ports(model, model.ports["parameter_R"], every) == {"p"}
    assert module._said_at_ports(model, model.ports["parameter_C"], every) == set()


def test_an_offset_that_acts_as_its_port_does_is_looked_for_there_alone():
    """The mass divides both, and cancels: a spring with an offset had ended in a bare error of CasADi."""
    b = ce.Blueprint("spring")
    m, offset = b.parameter("m", 2.0, unit="kg", min=0.1), b.parameter("offset", 0.1, unit="N")
    x, v = b.state("x", unit="m"), b.state("v", unit="m/s")
    b.ode("x", v)
    b.ode("v", (b.input("F", unit="N") + offset - x + b.port("mass", "inertia", {"speed": v})) / m)
    b.output("y", x, unit="m")
    model = b.model()
    every = [("x", model.x[0]), ("v", model.x[1]), ("F", model.u[0])]
    assert module._said_at_ports(model, model.ports["parameter_offset"], every) == {"v"}
    assert module._said_at_ports(model, model.ports["parameter_m"], every) == set()


def test_the_functions_that_serve_best_at_a_look_are_kept(monkeypatch):
    fit = ce.estimate(vessel(), run(1, bend=0.01), noise=ce.Noise(P=NOISE), progress=False)
    monkeypatch.setattr(module, "_KEPT", 2)
    monkeypatch.setattr(module, "_AT_ONCE", 1)  # function by function
    candidates, families, among = elsewhere(null_model(fit), Levels({"P": NOISE}))
    # C by p, Q and time; R by Q and time; the vessel by Q; the sensor by time
    assert among == 7
    assert families[0].name == "a function of p at parameter_C"
    assert len(families) == 2
    assert len(candidates) == 2 * module._TERMS
    assert [one.port for one in candidates[: module._TERMS]] == ["parameter_C"] * module._TERMS


def test_a_sensor_that_drifts_is_named_and_no_effects_that_imitate_it():
    """An offset, a constant and a wrong value that bend together to a drift were "missing, confirmed"."""
    data = [run(1, drift=6.0)]
    found = ce.repair(
        vessel(), data, fresh=run(2, drift=6.0), effects=["sensor_offset", "constant_torque", "load_step"],
        at=["vessel", "sensor_P"], progress=False, noise=ce.Noise(P=NOISE), starts=1,
    )  # fmt: skip
    assert found.verdict == "unnamed"
    assert (found.unknown.port, found.unknown.signal) == ("sensor_P", "time")
    assert "the sensor P drifts with time" in found.unknown.sentence


def test_a_signal_of_the_name_of_a_turn_is_one_function():
    """A state "turn" was looked at by every order of a shaft, and the answer ended in an IndexError."""
    values = np.linspace(0.0, 3.0, 50)
    made = module.families_of("drum", module.Signal("turn", ca.SX.sym("turn"), values), 4)
    assert len(made) == 1
    assert made[0][1].order == 0


def test_a_state_that_an_effect_brings_is_no_signal_of_a_law():
    """ "The parameter L depends on sensor_i_sensor_lag_behind" names nothing that a user has."""
    model = vessel().with_effect(ce.effects.SensorLag(), at="sensor_P")
    fit = ce.estimate(model, run(1), noise=ce.Noise(P=NOISE), errors="quadratic", progress=False)
    signals = {signal.name for _, signal in module._places(null_model(fit))}
    assert len(fit.model.states) == 2
    assert signals == {"p", "Q", "time"}


def test_parameters_that_the_equations_have_in_one_product_alone_are_named_together():
    """Of a well that fills through an orifice the data tell the orifice's area over the well's: a growth in the orifice
    had been called a change of the well."""
    b = ce.Blueprint("well")
    area, hole = b.parameter("A", 0.3, unit="m2"), b.parameter("a", 1e-3, unit="m2")
    gravity, loss = b.parameter("g", 9.81, unit="m/s2"), b.parameter("loss", 1e-4, unit="m2/s")
    h, sea = b.state("h", unit="m"), b.input("sea", unit="m")
    missing = b.port("well", "inertia", {"speed": h}, unit="m3/s")
    b.ode("h", (hole * ca.sqrt(2 * gravity * (sea - h)) + missing) / area)
    b.output("level", h - loss, unit="m")
    model = b.model()

    def alike(name):
        return set(module.same_parameters(model, model.ports[f"parameter_{name}"]))

    assert alike("a") == {"A", "g"}
    assert alike("g") == {"A", "a"}
    assert alike("loss") == set()
    family = module.smooth_family("parameter_a", "time", np.array([0.0, 1.0]))
    assert law_words(model, family) == (
        "the parameter a, or A or g, which no data tell from it, seems not to be constant: it depends on time"
    )
    assert set(module.same_parameters(vessel(), vessel().ports["parameter_C"])) == set()


def test_what_acts_as_an_input_may_depend_on_another_one_that_was_recorded():
    b = ce.Blueprint("well")
    h, sea = b.state("h", unit="m"), b.input("sea", unit="m")
    b.input("wind", unit="m/s")
    b.ode("h", b.parameter("k", 0.1, unit="1/s") * (sea - h))
    b.output("level", h, unit="m")
    model = b.model()
    time = np.arange(50) * 1.0
    record = ce.Experiment.from_arrays(
        "run",
        time=time,
        units={"sea": "m", "wind": "m/s", "level": "m"},
        sea=np.sin(0.3 * time),
        wind=np.cos(0.2 * time),
        level=0.5 * np.sin(0.3 * time),
    )
    places = [
        (p.name, s.name) for p, s in module._places(null_model(ce.estimate(model, record, progress=False)))
    ]
    assert ("input_sea", "wind") in places
    assert not any(port == "input_wind" for port, _ in places)
    family = module.smooth_family("input_sea", "wind", np.array([0.0, 1.0]))
    assert law_words(model, family) == "what acts as the input sea depends on wind too"


def reaches(gated):
    """Two reaches of a canal and a gate between them; its flow is by the drop, times its opening where it has one."""
    b = ce.Blueprint("canal")
    k, A = b.parameter("k", 0.4, unit="m2/s", min=0.01), b.parameter("A", 500.0, unit="m2", min=10)
    upper, lower = b.state("upper", unit="m"), b.state("lower", unit="m")
    opening, inflow = b.input("opening", unit="1"), b.input("inflow", unit="m3/s")
    first, second = (b.port(s, "inertia", {"level": x}) for s, x in (("one", upper), ("two", lower)))
    through = k * (opening if gated else 1) * (upper - lower)
    b.ode("upper", (inflow - through + first) / A)
    b.ode("lower", (through + second) / A)
    b.output("seen", upper, unit="m")
    return b.model()


def test_a_parameter_may_depend_on_the_drop_that_its_term_has_beside_an_input():
    """A gate's flow by the root of the drop was "k depends on time", or a flow between both, which no opening moves."""
    model = reaches(gated=True)
    found = module.drops_of(model, model.ports["parameter_k"])
    assert list(found) == ["difference_at_one_and_two"]
    family = SimpleNamespace(port="parameter_k", signal="difference_at_one_and_two", order=0)
    assert (
        law_words(model, family)
        == "the parameter k seems not to be constant: it depends on the difference between one and two"
    )
    # a law between both does what any function of the drop does
    plain = reaches(gated=False)
    assert module.drops_of(plain, plain.ports["parameter_k"]) == {}


def winding(extra=0):
    """A motor whose winding is heated by its current, in a room of a recorded temperature."""
    b = ce.Blueprint("bike")
    v, t = b.state("v", unit="m/s"), b.state("Tw", unit="K")
    i, room = b.input("i", unit="A"), b.input("Ta", unit="K")
    kt, g = b.parameter("kt", 7.0, unit="N/A", min=0.1), b.parameter("G", 3.0, unit="W/K", min=0)
    road = b.port("road", "inertia", {"speed": v})
    at = b.port("winding", "inertia", {"speed": t - room})
    again = b.port("case", "inertia", {"speed": t - room}) if extra else 0
    b.ode("v", (kt * i - 6 * v + road) / 95)
    b.ode("Tw", (0.25 * i * i - g * (t - room) + at + again) / 900)
    b.output("v", v, unit="m/s")
    b.output("Tw", t, unit="K")
    return b.model()


def test_a_parameter_may_depend_on_what_a_port_shows_of_several_states():
    """A motor constant that falls with how warm the winding is was "not constant: it depends on time"."""
    model = winding()
    assert list(module.shown_at_ports(model)) == ["shown_at_winding"]
    assert list(module.shown_at_ports(winding(1))) == ["shown_at_winding"]  # the same once
    every = [*((s.name, model.x[k]) for k, s in enumerate(model.states)),
             *((u.name, model.u[k]) for k, u in enumerate(model.inputs))]  # fmt: skip
    # a loss of the winding by it is a function at the port; the motor's constant is none
    assert "shown_at_winding" in module._said_at_ports(model, model.ports["parameter_G"], every)
    assert "shown_at_winding" not in module._said_at_ports(model, model.ports["parameter_kt"], every)
    family = module.smooth_family("parameter_kt", "shown_at_winding", np.array([0.0, 1.0]))
    assert law_words(model, family) == "the parameter kt seems not to be constant: it depends on Tw - Ta"
