"""repair and screen asked for particular effects and ports, on few data, and with input that cannot be used."""

from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy import screen
from casadi_engine.errors import EffectError, EstimationError, ExperimentError

FEW = ["coulomb_friction", "cubic_stiffness", "load_step"]
NOISE = ce.Noise(omega=0.05, omega_load=0.1)


class FanTorque(ce.Effect):
    name, attaches, kin = "fan_torque", ("inertia",), ("quadratic_drag", "coulomb_friction")
    sentence = "a fan on {port} that engages above a speed"
    amplitude = ce.effects.Amplitude("coefficient", unit="N m s2/rad2", min=0)  # one-sided
    nuisance = {"engage": ce.effects.Grid(80, 180, steps=11, unit="rad/s")}  # noqa: RUF012

    def law(self, port, p, math):
        on = math.step(port.speed - p.engage, width=2.0)
        return -p.coefficient * on * port.speed**2


@pytest.fixture(scope="module")
def friction(shaft):
    return shaft.data(hidden=lambda t, x: 0.8 * np.sign(x[1] - x[0]) * np.array([1, -1]), n=400)


@pytest.fixture(scope="module")
def repaired(shaft, friction):
    """Friction looked for at two ports, and a load that comes on at any."""
    request = [("coulomb_friction", "coupling"), ("coulomb_friction", "load"), "load_step"]
    return ce.repair(shaft.model, friction, effects=request, noise=NOISE, starts=1, progress=False)


@pytest.fixture(scope="module")
def alone(shaft, friction):
    """Friction alone, looked for with nothing held out: the answer, what was said, and the parameters given."""
    said, pars = [], shaft.model.parameters()
    found = ce.repair(
        shaft.model, friction, parameters=pars, effects=FEW[:1], noise=NOISE, holdout=0, starts=1,
        progress=said.append,
    )  # fmt: skip
    return found, said, pars


@pytest.fixture(scope="module")
def fitted(shaft, friction):
    """The fit without effects."""
    return ce.estimate(shaft.model, friction, noise=NOISE, progress=False)


def test_an_effect_of_ones_own_is_found_beside_the_library():
    """A fan that engages at 104 rad/s, sharp, on an inertia that runs up and down several times."""
    size, engage = 5e-5, 104.0
    time = np.arange(1200) * 0.01
    torque = 55 + 45 * np.sin(2.2 * time)
    model = ce.one_inertia()
    drive = ce.Experiment.from_arrays("fan", time=time, units={"T": "N m"}, T=torque)
    plant = model.with_effect(
        FanTorque(), at="engine", values={"coefficient": size, "engage": engage}, sharp=True
    )
    run = ce.simulate(plant, drive, initial={"omega_eng": 60.0})["omega"].values
    noisy = run + 0.1 * np.random.default_rng(0).standard_normal(len(time))
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays("fan", time=time, units=units, T=torque, omega=noisy)
    effects = ["quadratic_drag", ce.effects.CoulombFriction(), FanTorque()]
    found = ce.repair(model, data, effects=effects, noise=ce.Noise(omega=0.1), starts=1, progress=False)
    one = found.effects[0]
    assert one.key == "engine.fan_torque"
    assert one.sentence == "a fan on engine that engages above a speed"
    from_speed = one.parameters["engine.fan_torque.engage"]
    low, high = from_speed.interval  # the law bends over some 5 rad/s: no symmetric error
    assert low < engage < high < low + 15
    assert one.amplitude.value == pytest.approx(size, rel=0.1)


def test_effects_are_asked_for_by_name_and_port(repaired):
    assert {(row.effect, row.at) for row in repaired.scores} == {
        ("coulomb_friction", "coupling"),
        ("coulomb_friction", "load"),
        ("load_step", "engine"),
        ("load_step", "load"),
    }
    assert repaired.effects[0].key == "coupling.coulomb_friction"


def test_an_effect_stands_alone_at_its_place(repaired):
    (one,) = repaired.effects
    assert one.sentence == "dry friction at coupling"
    assert one.p_value < 1e-10
    assert one.share_explained > 0.9
    assert [m.name for m in one.members] == ["coulomb_friction"]
    assert abs(one.amplitude.value - 0.8) < 4 * one.amplitude.stderr
    assert repaired.confirmed is True
    assert repaired.where.location == "coupling"
    assert repaired.latent[0].port == "coupling"


def test_the_repaired_model_is_as_good_as_noise_on_what_was_held_out(repaired):
    gaps = repaired.gaps
    assert gaps.gain_per_cycle.mean > 2 * gaps.gain_per_cycle.se
    assert gaps.validation_before.gap.chi2_per_sample > 1.2
    assert gaps.validation_after.gap.chi2_per_sample == pytest.approx(1.0, abs=4 * np.sqrt(2 / 240))


def test_the_shift_of_the_damping_was_predicted(repaired):
    """The damper had stood for the friction."""
    (one,) = repaired.effects
    assert one.found_shift["C_el"] < -0.1  # of 0.2 N m s/rad
    assert one.predicted_shift["C_el"] == pytest.approx(one.found_shift["C_el"], rel=0.5)


def test_the_equations_of_the_repaired_model_show_the_term(repaired):
    assert any("coupling.coulomb_friction.torque" in line for line in repaired.equation.terms)
    assert repaired.equation.text == repaired.model.equations()
    assert "coupling.coulomb_friction.torque" in repaired.parameters


def test_what_was_not_found_comes_with_the_size_that_would_have_been(repaired):
    missed = {(m.name, m.at): m for m in repaired.not_found}
    assert ("coulomb_friction", "coupling") not in missed
    step = missed["load_step", "load"]
    assert step.testable
    assert 0.01 < step.smallest_detectable < 5
    assert step.unit == "N m"


def test_the_law_is_there_over_time(repaired):
    time, law = repaired.effects[0].course["shaft"]
    assert time[0] == repaired.latent[0].courses["shaft"].time[0]
    assert np.abs(law).max() == pytest.approx(repaired.effects[0].amplitude.value, rel=0.01)
    assert law.min() < 0 < law.max()


def test_the_summary_fits_one_screen_and_says_what_was_found(repaired):
    text = str(repaired)
    lines = text.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith(("Next: ", "      "))
    assert text.startswith("Repair of shaft: coulomb_friction at coupling is missing, confirmed on ")
    assert "coupling.coulomb_friction.torque = " in text


def test_the_answer_is_the_same_every_time():
    data = _swing(0.01)
    first, again = (
        ce.repair(ce.one_inertia(), data, effects=["quadratic_drag"], starts=2, progress=False)
        for _ in range(2)
    )
    assert [one.key for one in first.effects] == ["engine.quadratic_drag"]
    assert again.fit.values == first.fit.values
    assert again.threshold == first.threshold
    assert [row.z for row in again.scores] == [row.z for row in first.scores]
    assert str(again).split("; ")[0] == str(first).split("; ")[0]


def test_pieces_stand_for_cycles_where_there_is_no_crank_angle(repaired):
    assert repaired.effects[0].key == "coupling.coulomb_friction"
    assert repaired.gaps.source == "cycles"
    assert repaired.gaps.gain_per_cycle.mean > 0
    assert repaired.effects[0].selection_frequency > 0.9
    assert repaired.options["alpha"] == 0.01
    assert repaired.timing["total"] > 0


def test_what_the_user_gives_is_not_changed(shaft, alone):
    _, _, pars = alone
    assert pars.to_dict() == shaft.model.parameters().to_dict()


def test_nothing_held_out_leaves_the_claim_unconfirmed(alone):
    found, _, _ = alone
    assert found.effects
    assert found.confirmed is None
    assert found.gaps.validation_after is None
    assert "no fresh data and nothing held out: nothing confirms what was found" in found.messages
    assert "fresh=other_record" in str(found)


def test_effects_are_looked_for_from_where_a_fit_without_end_was_left(shaft, friction):
    found = ce.repair(
        shaft.model, friction, effects=FEW[:1], noise=NOISE, holdout=0, starts=1, max_iterations=3, progress=False
    )  # fmt: skip
    assert not found.null_fit.converged
    assert [one.key for one in found.effects] == ["coupling.coulomb_friction"]
    assert any("effects were looked for from where it ended" in note for note in found.messages)


def test_a_fit_that_does_not_converge_and_lacks_nothing_is_no_answer(shaft):
    data = shaft.data(n=600)
    found = ce.repair(shaft.model, data, effects=FEW, noise=NOISE, starts=1, max_iterations=1, progress=False)
    assert found.verdict is None
    assert found.status.startswith("the fit without effects has not converged: ")
    assert found.effects == ()
    assert found.scores == ()
    assert "fix the baseline fit first" in str(found)
    assert "a wrong optimum looks like missing physics" in found.messages[0]


def test_progress_is_told_in_words(alone):
    _, said, _ = alone
    assert said[0] == "fit without effects, 1 starts"
    assert "refit 1 of 3: coulomb_friction at coupling" in said
    assert "fit with coulomb_friction at coupling" in said


def test_screening_alone_scores_without_refits(shaft, friction, fitted):
    screened = screen(fitted, FEW)
    assert screened.candidates[screened.order[0]].label == "coulomb_friction at coupling"
    assert screened.alarm
    said = str(screened).splitlines()
    assert said[0].startswith(f"Scores of {len(screened.candidates)} candidates: ")
    assert said[1].split()[:3] == ["coulomb_friction", "at", "coupling"]
    assert len(said) < 20
    assert screened.significant[0] == screened.order[0]
    assert screened.pooled(screened.order[0]) < 1e-6
    # rounded as the motion passes it, friction leaves no more at first order than the noise that was stated
    assert screened.noise.source == "known"
    assert screened.noise.sigma == {"omega": 0.05, "omega_load": 0.1}
    free = screen(ce.estimate(shaft.model, friction, progress=False), FEW)
    assert free.noise.source == "estimated"
    assert free.noise.sigma["omega"] == pytest.approx(0.05, rel=0.1)


def test_a_stated_noise_that_is_too_small_is_not_believed(shaft):
    fit = ce.estimate(shaft.model, shaft.data(), noise=ce.Noise(omega=0.02, omega_load=0.1), progress=False)
    screened = screen(fit, FEW)
    assert screened.noise.sigma["omega"] == pytest.approx(0.05, rel=0.1)
    assert "the noise of omega is larger than stated" in screened.choice.messages[0]
    assert not screened.significant


def test_a_stated_noise_that_is_too_large_counts_and_is_said(shaft):
    fit = ce.estimate(shaft.model, shaft.data(), noise=ce.Noise(omega=5.0, omega_load=0.1), progress=False)
    screened = screen(fit, FEW)
    assert screened.noise.sigma["omega"] == 5.0
    assert "the noise of omega is smaller than stated: 0.0" in screened.choice.messages[0]
    assert "5 was given, which counts, and hides what is smaller" in screened.choice.messages[0]


MESSAGES = [
    (
        {"effects": [("backlash", "engine")]},
        EffectError,
        "backlash cannot act at the port engine; seen: a port of the kind inertia; allowed: coupling; "
        "do: choose one of these ports (coupling)",
    ),
    (
        {"effects": [("coulomb_friction", "gearbox")]},
        EffectError,
        "coulomb_friction is to act at a port that the model shaft does not have; seen: 'gearbox'; "
        "allowed: engine, load, coupling; do: print(model.ports) lists all ports",
    ),
    (
        {"at": "gearbox"},
        EffectError,
        "invalid `at`: the model shaft has no such port; seen: 'gearbox'",
    ),
    (
        {"effects": ["misfire"]},
        EffectError,
        "none of these effects can act anywhere in the model shaft; seen: misfire",
    ),
    (
        {"effects": []},
        EffectError,
        "none of these effects can act anywhere in the model shaft; seen: no effects",
    ),
    (
        {"effects": ["coulomb_friction", "coulomb_friction"]},
        EffectError,
        "two effects have the same name; seen: coulomb_friction; allowed: each effect once",
    ),
    ({"effects": [FanTorque]}, EffectError, "an effect is needed, not its class; seen: FanTorque"),
    ({"effects": ["magic"]}, EffectError, "the library has no such effect; seen: 'magic'"),
    (
        {"alpha": 1.5},
        EstimationError,
        "invalid `alpha`; seen: 1.5; allowed: a number between 0 and 1",
    ),
    ({"holdout": 1}, EstimationError, "invalid `holdout`; seen: 1; allowed: a share of the cycles"),
    ({"budget": 0}, EstimationError, "invalid `budget`; seen: 0; allowed: seconds > 0, or None"),
    (
        {"without": "coulomb"},
        EffectError,
        "invalid `without`: an effect that is not looked for; seen: 'coulomb'; ",
    ),
    ({"most": 0}, EstimationError, "most is not acceptable; seen: 0; allowed: a whole number >= 1"),
    ({"colour": "red"}, EstimationError, "colour is not acceptable; seen: 'red'; allowed: True, False or"),
    (
        {"scatter": "all"},
        EstimationError,
        "scatter is not acceptable; seen: 'all'; allowed: \"assumed\", None",
    ),
    ({"scatter": 3}, EstimationError, 'scatter is not acceptable; seen: 3; allowed: "assumed", None'),
    ({"progress": "loud"}, EstimationError, "invalid `progress`; seen: 'loud'"),
    (
        {"noise": ce.Noise(omega="innovations")},
        EstimationError,
        "effects are looked for in simulations, and this noise asks for a one-step predictor",
    ),
]


@pytest.mark.parametrize(("options", "error", "message"), MESSAGES, ids=[str(list(m[0])) for m in MESSAGES])
def test_input_that_cannot_be_used_is_refused_before_any_fit(shaft, friction, options, error, message):
    with pytest.raises(error) as caught:
        ce.repair(shaft.model, friction, **options)
    assert str(caught.value).startswith(message)


def test_a_screen_has_a_rate_of_false_alarms_too(fitted):
    with pytest.raises(EstimationError, match="invalid `alpha`"):
        screen(fitted, FEW, alpha=0.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"alpha": "a"}, "invalid `alpha`; seen: a"),
        ({"noise": NOISE}, "the noise to score with is not acceptable; seen: Noise("),
        ({"seed": "x"}, "seed is not acceptable; seen: 'x'; allowed: a whole number >= 0"),
    ],
)
def test_a_screen_asked_for_what_cannot_be_is_refused(fitted, options, message):
    with pytest.raises(EstimationError) as caught:
        screen(fitted, FEW, **options)
    assert str(caught.value).startswith(message)


def test_a_screen_needs_a_fit(repaired):
    with pytest.raises(EstimationError, match=r"there is no fit to score effects against; seen: Repair;"):
        screen(repaired)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (lambda c, w: -c * w * float("nan"), "^the law of root at engine is not a number"),
        (
            lambda c, w: -c * (w - 1e4) ** 0.5,
            "^the law of root at engine has no finite derivative along record",
        ),
    ],
)
def test_a_law_without_a_finite_derivative_is_named(shaft, friction, fitted, law, message):
    class Root(FanTorque):
        name, nuisance = "root", {}

        def law(self, port, p, math):
            return law(p.coefficient, port.speed)

    with pytest.raises(EffectError, match=message):
        ce.repair(shaft.model, friction, effects=[Root()], noise=NOISE, starts=1, progress=False)
    screened = screen(fitted, ["coulomb_friction", Root()])
    assert {one.effect for one in screened.candidates} == {"coulomb_friction"}
    assert {one.at for one in screened.not_applicable if one.effect == "root"} == {"engine", "load"}


def test_fresh_data_must_suit_the_model(shaft, friction):
    with pytest.raises(ExperimentError, match="T_load"):
        ce.repair(shaft.model, friction, fresh=friction.only("T", "omega"), effects=FEW[:1], noise=NOISE)
    with pytest.raises(
        ExperimentError, match="has nothing to confirm on; seen: T, T_load; allowed: a record with"
    ):
        ce.repair(shaft.model, friction, fresh=friction.only("T", "T_load"), effects=FEW[:1], noise=NOISE)


@pytest.mark.parametrize("at", [3, []])
def test_ports_that_are_no_names_are_refused(shaft, friction, at):
    with pytest.raises(EffectError, match=r"invalid `at`: the ports at which effects are looked for") as e:
        ce.repair(shaft.model, friction, effects=FEW, at=at, progress=False)
    assert "coupling" in str(e.value)


def test_effects_that_are_no_sequence_are_refused(shaft, friction):
    with pytest.raises(EffectError, match=r"invalid `effects`; seen: 7"):
        ce.repair(shaft.model, friction, effects=7, progress=False)


def test_data_cannot_confirm_what_is_found_in_them(shaft, friction):
    with pytest.raises(ExperimentError, match=r"is to confirm what is found in the same data"):
        ce.repair(shaft.model, friction, fresh=friction, effects=FEW, progress=False)


def test_a_record_that_is_given_twice_is_refused():
    one, two = _swing(0.0), _swing(0.0, name="again")
    with pytest.raises(ExperimentError, match=r"'again' is given twice; seen: the measurements of .*swing"):
        ce.repair(ce.one_inertia(), [one, two], effects=FEW, starts=1, progress=False)


@pytest.mark.parametrize(
    ("effects", "message"),
    [
        ([("coulomb_friction", "load", "engine")], "invalid pair in `effects`; seen: "),
        ({"coulomb_friction": "load"}, "invalid `effects`; seen: "),
    ],
)
def test_effects_at_ports_that_are_no_pairs_are_refused(shaft, friction, effects, message):
    with pytest.raises(EffectError) as caught:
        ce.repair(shaft.model, friction, effects=effects, progress=False)
    assert str(caught.value).startswith(message)


def _swing(drag, *, seed=0, name="swing"):
    """One inertia with a drag that nobody told of, and white noise."""
    time = np.arange(300) * 0.02
    drive = 80 * np.sin(1.5 * time) + 20 * np.sin(7 * time)
    data = ce.Experiment.from_arrays(name, time=time, units={"T": "N m"}, T=drive)
    plant = ce.one_inertia().with_effect(
        ce.effects.QuadraticDrag(), at="engine", values={"coefficient": drag}
    )
    speed = ce.simulate(plant, data, initial={"omega_eng": 0.0})["omega"].values
    speed = speed + 0.1 * np.random.default_rng(seed).standard_normal(len(time))
    return ce.Experiment.from_arrays(
        name, time=time, units={"T": "N m", "omega": "rad/s"}, T=drive, omega=speed
    )


def test_an_effect_in_the_fresh_data_alone_is_not_passed_over():
    data, fresh = _swing(0.0), _swing(0.01, seed=1, name="later")
    found = ce.repair(
        ce.one_inertia(), data, fresh=fresh, effects=["quadratic_drag"], starts=1, progress=False
    )
    assert found.verdict == "unnamed"
    assert found.unknown.sentence.startswith("the fresh data do not fit: chi2/N is ")
    assert "look for what is missing in the fresh records" in str(found)
    same = ce.repair(
        ce.one_inertia(),
        data,
        fresh=_swing(0.0, seed=1),
        effects=["quadratic_drag"],
        starts=1,
        progress=False,
    )
    assert not any("do not fit" in text for text in same.messages)


def test_a_record_of_nothing_has_no_noise_to_judge_by():
    time, zero = np.arange(60) * 0.01, np.zeros(60)
    data = ce.Experiment.from_arrays(
        "still", time=time, units={"T": "N m", "omega": "rad/s"}, T=zero, omega=zero
    )
    with pytest.raises(
        EstimationError, match=r"no level of the noise of omega can be told from the residual"
    ):
        screen(ce.estimate(ce.one_inertia(), data, progress=False), ["coulomb_friction"])


def test_a_record_that_an_effect_explains_to_the_last_digit_is_searched_to_the_end(monkeypatch):
    """A speed that stays: a load at the start leaves residuals of exactly nothing."""
    monkeypatch.setattr(import_module("casadi_engine.discrepancy.repair"), "refuse_still", lambda *_: None)
    time, one = np.arange(50) * 0.01, np.ones(50)
    data = ce.Experiment.from_arrays(
        "steady", time=time, units={"T": "N m", "omega": "rad/s"}, T=one, omega=one
    )
    found = ce.repair(ce.one_inertia(), data, effects=["load_step"], starts=1, progress=False)
    assert found.status == "answered"


def test_effects_are_left_out_by_name():
    from casadi_engine.discrepancy.requests import left_out

    names = [one.name for one in left_out(None, ["load_step"])]
    assert "coulomb_friction" in names
    assert "load_step" not in names
    assert left_out(["coulomb_friction", "load_step"], "load_step") == ["coulomb_friction"]
    assert left_out(None, ()) is None


def test_a_class_in_place_of_an_effect_is_told_so(shaft, friction):
    with pytest.raises(EffectError, match="an effect is needed, not its class; seen: CoulombFriction"):
        ce.repair(shaft.model, friction, effects=ce.effects.CoulombFriction)


def test_an_effect_that_fits_nowhere_is_told_what_it_needs(shaft, friction):
    with pytest.raises(EffectError, match="seen: misfire: the model has no port of the kind cylinder"):
        ce.repair(shaft.model, friction, effects="misfire")


def test_initial_states_of_fresh_records_are_no_fault():
    """They are found there; those of a record that is nowhere are refused by the fit."""
    portion = SimpleNamespace(data=[SimpleNamespace(name="a")], fresh=[SimpleNamespace(name="b")])
    first = {"x": 0.0}
    of_data = import_module("casadi_engine.discrepancy.repair")._of_data
    assert of_data({"a": first, "b": first, "c": first}, portion) == {"a": first, "c": first}
    assert of_data(first, portion) is first
    assert of_data(None, portion) is None


@pytest.mark.parametrize("effect", ["input_lag", "input_delay"])
def test_one_effect_may_be_all_that_can_act(effect):
    """Once an input acts late nothing more is to be tested: "none of these effects can act anywhere", and no answer."""
    b = ce.Blueprint("pot")
    capacity, loss = b.parameter("C", 1.2, unit="J/K", min=0.1), b.parameter("G", 2.2, unit="W/K", min=0)
    t, q = b.state("T", unit="K"), b.input("Q", unit="W")
    b.ode("T", (q - loss * t + b.port("pot", "inertia", {"speed": t})) / capacity)
    b.output("seen", t, unit="K")
    rng, time = np.random.default_rng(1), np.arange(300) * 0.05
    heat = np.repeat(rng.choice([0.0, 1.0, 2.0, 3.0], 15), 20)
    fine = np.repeat(heat, 10)  # held; in steps of a tenth of a sample
    acts, y, share = np.zeros_like(fine), np.zeros_like(fine), 1 - np.exp(-0.005 / 0.15)
    for k in range(1, len(fine)):
        lagging = acts[k - 1] + (fine[k - 1] - acts[k - 1]) * share
        acts[k] = fine[max(k - 30, 0)] if effect == "input_delay" else lagging
        y[k] = acts[k - 1] / 2 + (y[k - 1] - acts[k - 1] / 2) * np.exp(-2 * 0.005)
    seen = y[::10] + 0.01 * rng.standard_normal(300)
    data = ce.Experiment.from_arrays(
        "a", time=time, units={"Q": "W", "seen": "K"}, hold={"Q": "zero"}, Q=heat, seen=seen
    )
    found = ce.repair(b.model(), data, effects=[effect], progress=False)
    assert [one.key for one in found.effects] == [f"input_Q.{effect}"]
    time_constant = found.effects[0].parameters[f"input_Q.{effect}.time"].value
    assert time_constant == pytest.approx(0.15, abs=0.02)
