"""What a repair prints: the sentences of one screen, for systems of any kind."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.repaired import SO_FAR, UNTOLD, Member, NextExperiment, NotFound, Unknown
from casadi_engine.discrepancy.summary import _told_by, noise_of_chi2
from casadi_engine.discrepancy.verdict_words import acts_where, headline, next_step
from casadi_engine.discrepancy.wider_bounds import hedged
from casadi_engine.discrepancy.wording import BOUNDS, STARTS, in_unit, port_cure, twins


def tank_model(port=True):
    b = ce.Blueprint("tank")
    area = b.parameter("A", 0.02, unit="m2", min=1e-3)
    c = b.parameter("c", 2e-4, unit="m2/s", min=0)
    h, q = b.state("h", unit="m", scale=0.5), b.input("q", unit="m3/s", scale=1e-4)
    more = b.port("tank", "inertia", {"speed": h}) if port else 0
    b.ode("h", (q - c * h + more) / area)
    b.output("level", h, unit="m")
    return b.model()


@pytest.fixture(scope="module")
def record():
    """A tank with a constant outflow of 3e-5 m3/s beside the one that is proportional to its level."""
    t = np.arange(300) * 1.0
    q = 1e-4 * (1 + 0.6 * np.sign(np.sin(2 * np.pi * t / 90)))
    run = solve_ivp(
        lambda s, y: (np.interp(s, t, q) - 2e-4 * y - 3e-5) / 0.02, (0, t[-1]), [0.3], t_eval=t, max_step=0.5
    )
    level = run.y[0] + 0.002 * np.random.default_rng(0).standard_normal(len(t))
    return ce.Experiment.from_arrays("run", time=t, units={"q": "m3/s", "level": "m"}, q=q, level=level)


@pytest.fixture(scope="module")
def leaking(record):
    effects = ["coulomb_friction", "constant_torque", "sensor_offset", "sensor_delay"]
    return ce.repair(tank_model(), record, effects=effects, starts=1, progress=False)


@pytest.fixture(scope="module")
def blind(record):
    return ce.repair(tank_model(port=False), record, starts=1, progress=False)


def joined(found):
    """What is printed, on one line."""
    return " ".join(str(found).split())


def test_no_size_is_excluded_beside_what_has_no_name(leaking):
    """Scores along a model that lacks more than was named say nothing of what else could be seen."""
    assert "Smallest detectable sizes" in joined(replace(leaking, unknown=None))
    more = Unknown("what is left is no noise", {})
    assert "Smallest detectable sizes" not in joined(replace(leaking, unknown=more))


def test_a_tank_is_spoken_of_as_a_tank(leaking):
    words = joined(leaking)
    assert "tank.constant_torque.torque = " in words
    assert (
        " %; not excluded in its place (probability, correlation with it): coulomb_friction at tank ("
        in words
    )
    assert (
        "a constant volume flow out of tank, a negative amount into it: z = " in words
    )  # nothing slides there
    assert "a volume flow at tank explains most of it" in words
    assert "Smallest detectable sizes (95 % power): sensor_offset at sensor_level" not in words
    assert (
        "sensor_offset at sensor_level (" in words
    )  # no more probable before the data, and the same in them
    for strange in (" -\n", "a torque at", "N m", "friction at tank:", "cycles", "halves"):
        assert strange not in str(leaking), strange


def test_a_class_that_acts_alike_is_said_to_be_one(leaking):
    assert leaking.verdict == "class"
    assert {m.name for m in twins(leaking.effects[0])} >= {"coulomb_friction"}
    said = "constant_torque at tank (a constant volume flow out of tank, a negative amount into it) is missing, or "
    assert said in joined(leaking)
    assert next_step(leaking).startswith(
        "constant_torque at tank, coulomb_friction at tank and sensor_offset at sensor_level are one and the same in "
        "data of this kind (correlation 1 or -1), and no other input or sensor and no longer record that could be tried"
    )
    assert "record data" not in next_step(leaking)


def test_an_experiment_that_does_not_split_is_not_said_to(leaking):
    weak = NextExperiment("measure q too", (), 1.6, 0.2)
    assert next_step(replace(leaking, next_experiment=weak)) == (
        "measure q too: of what was tried by simulation it helps most, but does not split the class (separation 1.6, "
        "now 0.2; 3.3 is enough)"
    )


def test_a_headline_counts_the_class(leaking):
    one = leaking.effects[0]
    two = replace(one, members=(one.members[0], Member("drag", "tank", 0.9, 0.2)))
    assert " is missing, or drag at tank, " in headline(replace(leaking, effects=(two,)))
    more = replace(two, members=(*two.members, Member("play", "tank", 0.9, 0.2)))
    assert " is missing, or one of 2 others, " in headline(replace(leaking, effects=(more,)))
    lead = replace(one.members[0], probability=0.001)  # the others' fits had not ended
    rest = (
        Member("drag", "tank", 0.9, 0.6),
        Member("play", "tank", 0.9, 0.39),
        Member("gain", "q", 0.9, 0.009),
    )
    said = headline(replace(leaking, effects=(replace(one, members=(lead, *rest)),)))
    assert " is missing, or more probably drag at tank or play at tank, or gain at q, " in said


@pytest.mark.parametrize(
    ("port", "odds", "leads"),
    [("parameter_c", 1e9, True), ("tank", 1e9, False), ("parameter_c", 3.0, False)],
)
def test_a_law_elsewhere_that_is_far_more_probable_leads(leaking, port, odds, leads):
    """A bath's voltage by the logarithm of its current was "a wrong gain of the heater, confirmed", first of all."""
    law = "the parameter c seems not to be constant: it depends on h"
    said = f"{law}: far more probable than {leaking.effects[0].name}"
    found = replace(
        leaking, unknown=Unknown(said, {}, port, "h", course="a curve", odds=odds), confirmed=True
    )
    words = headline(found)
    assert leads is words.startswith(
        f"something is missing, and a law that the library lacks is far more probable: {law}; "
        "the nearest of the library: constant_torque at tank, or one of 2 others, confirmed"
    )
    assert leads is not words.startswith("constant_torque at tank (a constant volume flow out of tank")
    assert leads is ("write an effect of your own" in next_step(found))


def test_the_gap_stands_beside_sigma(leaking):
    head, row = str(leaking).splitlines()[
        [k for k, s in enumerate(str(leaking).splitlines()) if s[:3] == "Gap"][1] :
    ][:2]
    assert head.split() == ["Gap", "output", "sigma", "rmse", "after", "fit", "%", "after", "chi2/N", "after"]
    sigma, before, after = (float(text) for text in row.split()[3:6])
    assert sigma == pytest.approx(0.002, rel=0.1)
    assert before > 1.2 * sigma
    assert after == pytest.approx(sigma, rel=0.1)
    assert noise_of_chi2(leaking) == ""


def test_a_noise_that_is_not_the_stated_one_is_said(leaking):
    """A gap that the noise was made to swallow is seen by rmse beside the stated sigma."""
    stated = replace(leaking, null_fit=replace(leaking.null_fit, noise={"level": (2e-4, False)}))
    assert noise_of_chi2(stated).endswith("larger than stated: judge the gap by rmse beside sigma")
    assert "0.0002" in str(stated)
    coloured = replace(leaking, noise=replace(leaking.noise, colour={"run/level": 2}))
    assert noise_of_chi2(coloured) == (
        "chi2/N counts by coloured noise as the search estimated it: judge the gap by rmse beside sigma"
    )
    assert noise_of_chi2(coloured) in joined(coloured)
    scattered = replace(leaking, noise=replace(leaking.noise, scatter={"combustion": 0.02}))
    assert noise_of_chi2(scattered).startswith("chi2/N counts by the scatter of combustion")


def test_a_model_without_ports_is_told_so_at_the_top(blind):
    lines = str(blind).splitlines()
    assert lines[0].startswith("Repair of tank: ")
    assert "no physical effect could be looked for" in lines[0]
    assert lines[1].startswith(
        "The model has no port at which a physical effect can act: wrong fixed parameters"
    )
    assert (
        'missing = b.port("at_h", "inertia", {"speed": h}), added to what acts in b.ode("h", ...)'
        in joined(blind)
    )
    assert next_step(blind).startswith("give the model its ports as said above")
    assert blind.effects == ()


def test_the_cure_for_a_model_without_ports_works_as_it_is_written():
    """The line is put into the blueprint: then there is a port, and nothing is said."""
    b = ce.Blueprint("tank")
    area, h = b.parameter("A", 0.02, unit="m2", min=1e-3), b.state("h", unit="m")
    q = b.input("q", unit="m3/s")
    assert port_cure(tank_model(port=False)).startswith(
        'missing = b.port("at_h", "inertia", {"speed": h}), added'
    )
    missing = b.port("at_h", "inertia", {"speed": h})  # as it is printed
    b.ode("h", (q + missing) / area)
    b.output("level", h, unit="m")
    model = b.model()
    assert (model.ports["at_h"].unit, port_cure(model)) == ("m3/s", "")


def test_the_cure_takes_a_speed_first():
    b = ce.Blueprint("pendulum")
    a, w = b.state("angle", unit="rad"), b.state("rate", unit="rad/s")
    b.ode("angle", w)
    b.ode("rate", -9.81 * a)
    b.output("phi", a, unit="rad")
    assert port_cure(b.model()).startswith('missing = b.port("at_rate", "inertia", {"speed": rate})')


@pytest.mark.parametrize(("unit", "words"), [("1", ""), ("-", " (unit not stated)"), ("W/K", " W/K")])
def test_units_behind_numbers(unit, words):
    assert in_unit(unit) == words


def test_a_place_is_that_of_the_answer_or_not_said(leaking):
    """Under answers at the yaw of a ship stood "a term at servo explains most of it"."""
    assert acts_where(leaking) == "a volume flow at tank"
    bare = replace(leaking, effects=(), unknown=None)
    assert acts_where(bare) == "a volume flow at tank"
    sensor = replace(bare, unknown=Unknown("the sensor level drifts", {}, "sensor_level"))
    assert acts_where(sensor) == ""
    assert "explains most of it" not in joined(sensor)
    path = replace(bare, unknown=Unknown("the input q acts at tank", {}, "q_to_tank"))
    assert acts_where(path) == "a volume flow at tank"
    assert acts_where(replace(bare, where=None)) == ""


def test_a_unit_that_was_not_stated_is_said_once(leaking):
    missed = tuple(
        replace(one, unit="-", testable=True, smallest_detectable=0.5, note="", twin="")
        for one in leaking.not_found
    )
    words = joined(replace(leaking, not_found=missed, unknown=None))
    assert words.count("not stated") == 1
    assert "Smallest detectable sizes (95 % power) (some in units that were not stated): " in words


def test_a_search_that_was_none_claims_nothing(leaking):
    """With a twentieth of a second, a record from which nothing was missing had been "something is missing"."""
    none = replace(
        leaking,
        status=UNTOLD,
        verdict=None,
        effects=(),
        unknown=Unknown(UNTOLD, {}),
        stopped="the time budget",
    )
    assert headline(none) == f"no answer: {UNTOLD}"
    assert next_step(none) == "give it more time, budget=..., or start values that are nearer"
    near = f"{SO_FAR} drag at tank (chi-squared falls by 100 %), which was not fitted to its end"
    said = headline(replace(none, verdict="unnamed", unknown=Unknown(near, {})))
    assert said == f"something is missing, and the search ended too early for a name: {near}"
    assert f"no answer: {UNTOLD}" in joined(none)


@pytest.mark.parametrize(
    ("p", "share", "said"),
    [
        (1e-9, 0.9, "z = 5.0, p = 1e-09, explains 90 % of the gap"),
        (
            1.0,
            0.94,
            "explains 94 % of the gap, by a refit: one step along the model without it shows nothing of that",
        ),
        (1.0, 0.0, "beyond chance beside the others, and nothing without them"),
        (1e-9, -1.0, "z = 5.0, p = 1e-09, closes nothing of the gap by itself"),
        (1e-9, 4e-13, "z = 5.0, p = 1e-09, closes nothing of the gap by itself"),
    ],
)
def test_a_score_and_a_share_do_not_contradict_each_other(p, share, said):
    """'z = -8.9, p = 1, explains 94 % of the gap', and '-100 %', were printed in one line."""
    assert _told_by(SimpleNamespace(z=5.0, p_value=p, share_explained=share)) == said


def test_a_search_for_other_records_that_was_cut_has_found_none(leaking):
    """ "Not looked for, as the time was up" stood beside "no other input that could be tried tells them apart"."""
    assert "could be tried by simulation tells them apart" in next_step(leaking)
    cut = replace(leaking, messages=("next experiment: not looked for, as the time was up",))
    assert "which other record tells them apart was not looked for" in next_step(cut)
    assert "could be tried" not in next_step(cut)


def test_values_count_on_gains_that_no_data_tell(leaking):
    """A heater gave 15 % less than its input, all masses came out 18 % wrong: "nothing is missing, use the model"."""
    gain = NotFound("input_gain", "input_q", np.inf, "1", testable=False)
    drag = NotFound("quadratic_drag", "tank", 1e-5, "m3/s", testable=True)
    found = replace(leaking, verdict="nothing missing", effects=(), not_found=(drag, gain), stopped="")
    assert next_step(found).endswith("its values count on the gain of q, which these data cannot determine")


@pytest.mark.parametrize(("what", "words"), [(BOUNDS, "a bound"), (STARTS, "a given first state")])
def test_an_effect_that_a_wider_bound_does_without_is_one_of_two_causes(leaking, what, words):
    """An offset of a sensor was named and confirmed where a belt creeps, with its stiffness on its bound."""
    made = hedged(replace(leaking, verdict="named", confirmed=True), what, "c rests on its bound of 1")
    assert made.verdict == "class"
    assert headline(made).startswith(f"{words} may be all that is wrong, or constant_torque at tank")
