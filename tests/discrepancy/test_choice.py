"""Rounds of the choice on small records: what is named, added, exchanged, dropped, and what ends them."""

import math
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.deadline import Deadline, TimeUp
from casadi_engine.discrepancy import choice as module
from casadi_engine.discrepancy import path, refits
from casadi_engine.discrepancy import tried as tried_by
from casadi_engine.discrepancy.additions import Additions
from casadi_engine.discrepancy.choice import Choice
from casadi_engine.discrepancy.fresh import Portions
from casadi_engine.discrepancy.fresh_choice import FreshChoice
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.refits import PART
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.start import Start
from casadi_engine.discrepancy.tried import key_of
from casadi_engine.discrepancy.ways import ranked
from casadi_engine.effects import Amplitude, Effect
from casadi_engine.errors import EstimationError

FEW = ["coulomb_friction", "quadratic_drag", "viscous_friction", "constant_torque"]
DRY, DRAG, CONSTANT = ((name, "pivot") for name in ("coulomb_friction", "quadratic_drag", "constant_torque"))


def rubbing(t, angle, rate):
    return -0.6 * np.tanh(rate / 0.02)


def rubbing_and_pushed(t, angle, rate):
    return 0.8 + rubbing(t, angle, rate)


def everything(self, best, step, keys, **_):
    """In the place of ``_promising``: no effect is left out."""
    return list(keys)


@pytest.fixture(scope="module")
def prepared(pendulum):
    """hidden, effects, most, ... -> a choice, its null fit, and what it told; it has not run."""
    fits = {}

    def of(hidden, effects=FEW, *, most=4, samples=300, **options):
        if (hidden, samples) not in fits:
            data = pendulum.decay(hidden, samples=samples)
            noise = ce.Noise(y=pendulum.level)
            fits[hidden, samples] = data, ce.estimate(pendulum.model, data, noise=noise, progress=False)
        data, fit = fits[hidden, samples]
        said = []
        made = Choice(pendulum.refitter(data), lambda fit: screen(fit, effects), most, said.append, **options)
        return SimpleNamespace(choice=made, fit=fit, said=said)

    return of


@pytest.fixture(scope="module")
def named(prepared):
    """A choice among a few effects for hidden dry friction, at its end."""
    made = prepared(rubbing)
    made.choice.run(made.fit)
    return made


@pytest.mark.slow  # test_next_experiment.py repairs the same pendulum
def test_dry_friction_of_a_pendulum_is_named_and_confirmed(pendulum):
    """A model by Blueprint, two decays, another one to confirm on."""
    data = pendulum.decay(rubbing, samples=300)
    fresh = pendulum.decay(rubbing, samples=300, begun=1.1, seed=5, name="fresh")
    noise = ce.Noise(y=pendulum.level)
    found = ce.repair(pendulum.model, data, fresh=fresh, effects=FEW, noise=noise, starts=1, progress=False)
    assert found.verdict == "named"
    assert found.confirmed is True
    (one,) = found.effects
    assert one.key == "pivot.coulomb_friction"
    assert abs(one.amplitude.value - 0.6) < 4 * one.amplitude.stderr
    assert found.unknown is None


def test_the_best_structure_is_the_truth_beyond_all_rivals(named):
    found = named.choice
    assert found.best == {DRY}
    best = found.pool[found.best]
    assert best.label == "coulomb_friction at pivot"
    assert best.beyond > 3 * module.BEYOND
    # the others need no refit: from the truth one step says that they stay far above
    assert set(found.pool) == {frozenset(), frozenset({DRY})}
    left = dict(found.rounds[0].left_out)
    assert set(left) == {"quadratic_drag at pivot", "constant_torque at pivot"}
    assert min(left.values()) > best.arrived.cost + 20 * math.log(module.FACTOR)
    assert found.chosen.fit.converged
    assert found.null.effects == ()
    assert not found.failed


@pytest.mark.slow  # test_linearised.py holds one step
def test_what_one_step_leaves_out_no_refit_brings_back(named, prepared, monkeypatch):
    made = prepared(rubbing)
    monkeypatch.setattr(Additions, "_promising", everything)
    made.choice.run(made.fit)
    assert made.choice.best == {DRY}
    left = dict(named.choice.rounds[0].left_out)
    best = made.choice.pool[made.choice.best].arrived.cost
    for key in (DRAG, CONSTANT):
        gap = made.choice.pool[frozenset({key})].arrived.cost - best
        assert gap > PART * (left[" at ".join(key)] - best) > 0


def test_rounds_tell_what_was_tried_and_kept(named):
    first = named.choice.rounds[0]
    assert first.kept == "coulomb_friction at pivot"
    # a viscous friction more is one with the model's own damping, and cannot be tested
    seen = [label.partition(" at")[0] for label, _ in (*first.proposals, *first.left_out)]
    assert sorted(seen) == sorted({*FEW} - {"viscous_friction"})
    assert first.proposals[0][0] == first.refits[0][0] == "coulomb_friction at pivot"
    assert first.dropped == ()
    assert named.said[0] == "scores of all effects at all ports"
    assert "fit with coulomb_friction at pivot" in named.said


def test_the_way_to_a_structure_has_its_class(named):
    none, last = named.choice.way(named.choice.best)
    assert none.effects == ()
    assert [one.label for one in last.effects] == ["coulomb_friction at pivot"]
    assert [(m.name, m.at, m.probability) for m in last.members] == [(*DRY, 1.0)]
    assert last.drop > 3 * module.BEYOND**2
    assert none.screened.candidates[last.lead].key == DRY


def test_structures_are_asked_in_the_order_of_their_evidence(named):
    assert list(ranked(named.choice)) == [named.choice.best, frozenset()]


def test_two_effects_are_added_one_after_the_other(prepared):
    made = prepared(rubbing_and_pushed, ["coulomb_friction", "constant_torque"])
    made.choice.run(made.fit)
    assert made.choice.best == {DRY, CONSTANT}
    values = made.choice.chosen.fit.estimates
    for name, truth in (("pivot.coulomb_friction.torque", 0.6), ("pivot.constant_torque.torque", 0.8)):
        assert abs(values[name].value) == pytest.approx(truth, abs=4 * values[name].stderr)
    stations = made.choice.way(made.choice.best)
    assert [len(one.effects) for one in stations] == [0, 1, 2]
    # the parts come after what is chosen, and the model without effects last
    order = list(ranked(made.choice))
    assert order[0] == made.choice.best
    assert order[-1] == frozenset()


def structure(made, *names):
    """The refit of the effects of these names, made before any round."""
    candidates = {c.effect: c for c in made.choice.null.screened.candidates}
    effects = tuple(addition(candidates[name], 0.1) for name in names)
    (found,) = made.choice.refits.tried(effects, Start.of(made.fit))
    return found


@pytest.fixture(scope="module")
def begun(prepared):
    """hidden -> a choice that has scored, and has had no round."""

    def of(hidden):
        made = prepared(hidden, most=0)
        made.choice.run(made.fit)
        return made

    return of


def test_an_effect_that_is_not_worth_a_factor_of_twenty_is_left_out(begun):
    made = begun(rubbing)
    both = structure(made, "quadratic_drag", "coulomb_friction")
    none = made.choice.pool[frozenset()]
    assert made.choice._exchanged(both, none).key == {DRY}


def test_an_effect_that_stands_for_another_is_exchanged(begun):
    made = begun(rubbing_and_pushed)
    wrong = structure(made, "constant_torque", "quadratic_drag")
    assert made.choice._exchanged(wrong, made.choice.pool[frozenset()]).key == {DRY, CONSTANT}


class Alike(Effect):
    """The dry friction's law by another name."""

    name, attaches, kin = "brake", ("inertia",), ()
    sentence = "a brake on {port}"
    amplitude = Amplitude("torque", unit="N m", min=0)

    def law(self, port, p, math):
        return -p.torque * math.tanh(port.speed / 0.05)


class Second(Alike):
    name, sentence = "clutch", "a clutch on {port}"


def test_effects_that_are_the_same_law_share_a_class_in_equal_parts(pendulum):
    data = pendulum.decay(rubbing, samples=300)
    effects = [Alike(), Second()]
    found = ce.repair(
        pendulum.model, data, effects=effects, noise=ce.Noise(y=pendulum.level), starts=1, holdout=0.0, progress=False
    )  # fmt: skip
    assert found.verdict == "class"
    (one,) = found.effects
    assert {m.name for m in one.members} == {"brake", "clutch"}
    assert [m.probability for m in one.members] == pytest.approx([0.5, 0.5], abs=0.01)
    assert [abs(m.rho) for m in one.members] == pytest.approx([1, 1], abs=1e-3)


@pytest.mark.slow
def test_rivals_in_the_library_do_not_unname_an_effect(prepared, named):
    made = prepared(rubbing, ["coulomb_friction", "asymmetric_friction", "sensor_offset"])
    made.choice.run(made.fit)
    assert made.choice.best == named.choice.best
    members = made.choice.way(made.choice.best)[-1].members
    assert members[0].name == "coulomb_friction"


def by_length():
    """The pendulum by its length and a viscous torque."""
    b = ce.Blueprint("pendulum")
    length = b.parameter("length", 0.25, unit="m", min=0.01, max=3)
    viscous = b.parameter("d", 1e-3, unit="N m s/rad")
    angle, rate = b.state("angle", unit="rad"), b.state("rate", unit="rad/s")
    pivot = b.port("pivot", "inertia", {"speed": rate, "angle": angle})
    b.ode("angle", rate)
    b.ode("rate", (pivot - viscous * rate) / (0.3 * length**2) - 9.81 / length * ca.sin(angle))
    b.output("y", angle, unit="rad")
    return b.model(), 1.0


def in_other_units():
    """The pendulum by its frequency, with an output in mrad, a torque of a thousandth and other scales."""
    b = ce.Blueprint("pendulum")
    own = b.parameter("w", 6.3, unit="rad/s", min=1, max=14)
    damping = b.parameter("c", 0.05, unit="1/s", min=0, max=5)
    angle, rate = b.state("angle", unit="rad", scale=0.1), b.state("rate", unit="rad/s", scale=50)
    pivot = b.port("pivot", "inertia", {"speed": rate, "angle": angle})
    b.ode("angle", rate)
    b.ode("rate", 1e-3 * pivot - damping * rate - own**2 * ca.sin(angle))
    b.output("y", 1e3 * angle, unit="mrad")
    return b.model(), 1e3


@pytest.mark.parametrize("way", [pytest.param(by_length, marks=pytest.mark.slow), in_other_units])
def test_no_verdict_depends_on_how_the_model_is_written(pendulum, named, way):
    """Evidence too: of the effect against none, and of its best rival against it."""
    model, unit = way()
    record = pendulum.decay(rubbing, samples=300)
    y = {"y": "rad" if unit == 1 else "mrad"}
    data = ce.Experiment.from_arrays("decay", time=record["y"].time, units=y, y=unit * record["y"].values)
    noise = ce.Noise(y=unit * pendulum.level)
    fit = ce.estimate(model, data, noise=noise, progress=False)
    refitter = Refitter(model, model.parameters(), (data,), noise, {"max_iterations": 100})
    found = Choice(refitter, lambda fit: screen(fit, FEW), 4, lambda _: None)
    found.run(fit)
    assert found.best == named.choice.best
    here, there = (one.pool[one.best].log - one.pool[frozenset()].log for one in (found, named.choice))
    assert here == pytest.approx(there, abs=0.3)
    assert dict(found.rounds[0].left_out) == pytest.approx(dict(named.choice.rounds[0].left_out), rel=0.02)
    assert found.pool[found.best].beyond == pytest.approx(named.choice.pool[found.best].beyond, rel=0.02)


def test_nothing_is_added_where_nothing_is_missing(prepared):
    made = prepared(None)
    made.choice.run(made.fit)
    assert made.choice.best == frozenset()
    assert made.choice.rounds == []
    assert made.choice.way(frozenset()) == [made.choice.null]


# ---- what ends a choice


def test_an_interrupted_choice_has_the_best_fit_so_far(prepared, named):
    assert named.choice.fit is named.choice.chosen.fit
    made = prepared(rubbing)

    def interrupted(fit):
        raise KeyboardInterrupt

    made.choice.screen = interrupted
    with pytest.raises(KeyboardInterrupt):
        made.choice.run(made.fit)
    assert made.choice.fit is made.fit


def test_without_time_there_is_no_round(prepared):
    deadline = Deadline(0.0, spare=600.0)
    made = prepared(rubbing, deadline=deadline)
    with deadline, deadline.spared(0.5):
        made.choice.run(made.fit)
    assert made.choice.best == frozenset()
    assert made.choice.failed == {"any effect": "the time was up"}
    assert made.choice.rounds == []
    assert not any(text.startswith("refit") for text in made.said)


def test_what_the_time_did_not_allow_is_listed(prepared, monkeypatch):
    """The best of what was refitted is kept all the same."""
    deadline = Deadline(spare=600.0)
    made = prepared(rubbing, deadline=deadline)
    real, refits = Additions._try, []

    def once(self, *args):
        real(self, *args)
        refits.append(args)
        if len(refits) == 2:
            deadline.stop()

    monkeypatch.setattr(Additions, "_try", once)
    monkeypatch.setattr(Additions, "_promising", everything)
    with deadline:
        made.choice.run(made.fit)
    assert len(made.choice.rounds) == 1
    late = "the time was up"
    assert made.choice.failed == {
        "constant_torque at pivot": late
    }  # the other laws of the speed come before it
    assert made.choice.best == {DRY}


def test_every_effect_is_refitted_once_before_any_is_refitted_from_elsewhere(prepared, monkeypatch):
    deadline = Deadline(spare=600.0)
    made = prepared(rubbing, deadline=deadline)
    monkeypatch.setattr(Additions, "_promising", everything)
    monkeypatch.setattr(Additions, "_own_step", lambda self, *args: deadline.stop())
    with deadline:
        made.choice.run(made.fit)
    assert made.choice.failed == {"other starts of these effects": "the time was up"}
    assert len([text for text in made.said if text.startswith("refit ")]) == 3
    assert made.choice.best == {DRY}


def test_where_whole_fits_fail_with_sharp_corners_the_wider_ones_count_again(prepared, monkeypatch):
    made = prepared(rubbing, ["coulomb_friction"], most=1)
    real, shares = Choice.station_of, []

    def station(self, tried):
        shares.append(self.refitter.share)
        return None if shares[-1] < 1 else real(self, tried)

    monkeypatch.setattr(Choice, "station_of", station)
    monkeypatch.setattr("casadi_engine.discrepancy.path.FELT", 1e-9)  # whatever the data say
    made.choice.run(made.fit)
    assert shares[0] < 1 == shares[1]
    assert made.choice.failed == {}
    assert made.choice.best
    assert made.choice.refitter.share == 1


def test_where_time_ends_with_sharp_corners_the_fit_with_wide_ones_is_the_answer(prepared, monkeypatch):
    """More time than it takes to name an effect leaves it named."""
    deadline = Deadline(1e6, spare=600.0)
    made = prepared(rubbing, ["coulomb_friction"], most=1, deadline=deadline)
    monkeypatch.setattr(module, "_LONGER", 1e9)
    real, shares = Choice._whole, []

    def whole(self, tried):
        shares.append(self.refitter.share)
        if shares[-1] < 1:
            deadline.stop()
            raise TimeUp
        return real(self, tried)

    monkeypatch.setattr(Choice, "_whole", whole)
    monkeypatch.setattr("casadi_engine.discrepancy.path.FELT", 1e-9)  # whatever the data say
    with deadline:
        made.choice.run(made.fit)
    assert shares[0] == 1 > shares[1]
    assert made.choice.best == {DRY}
    assert made.choice.failed == {"sharper corners of coulomb_friction at pivot": "the time was up"}
    assert made.choice.refitter.share == 1
    assert made.choice.pool[made.choice.best].arrived is made.choice._wide[made.choice.best]


@pytest.mark.slow
def test_sharp_corners_that_a_fit_was_reached_with_are_not_taken_back(prepared, monkeypatch):
    """What is added later is not in the pool from before they were sharpened."""
    made = prepared(rubbing, ["coulomb_friction"], most=1)
    monkeypatch.setattr("casadi_engine.discrepancy.path.FELT", 1e-9)  # whatever the data say
    made.choice.run(made.fit)
    share = made.choice.refitter.share
    assert share < 1
    assert not made.choice.refits.blunted()
    assert made.choice.refitter.share == share


def test_a_structure_that_is_fitted_anew_keeps_its_fit_where_that_is_ended(prepared, monkeypatch):
    made = prepared(rubbing, ["coulomb_friction"], most=1)
    made.choice.run(made.fit)
    choice, kept = made.choice, made.choice.fit

    def ended(self, tried):
        raise KeyboardInterrupt

    assert choice._renewed(choice.pool[choice.best]) is None
    choice.refits.improved.add(choice.best)
    assert choice._renewed(choice.pool[choice.best]) is None  # it is fitted from there already
    choice.refits.improved.add(choice.best)
    choice._fits.clear()
    monkeypatch.setattr(Choice, "station_of", ended)
    with pytest.raises(KeyboardInterrupt):
        choice._renewed(choice.pool[choice.best])
    assert choice.fit is kept


def test_a_structure_whose_whole_fit_fails_gives_way_to_the_next(prepared, monkeypatch):
    """And is said to have failed."""
    made = prepared(rubbing, ["coulomb_friction", Alike()], most=1)
    real, asked = Choice.station_of, []

    def station(self, tried):
        asked.append(tried.key)
        return None if tried.key == asked[0] else real(self, tried)

    monkeypatch.setattr(Choice, "station_of", station)
    monkeypatch.setattr(refits.Refits, "sharpened", lambda self, best: False)
    made.choice.run(made.fit)
    first, then = made.choice.pool[asked[0]], made.choice.best
    assert made.choice.failed == {first.label: "its fit of all data does not converge"}
    assert first.log == -math.inf
    assert {first.key, then} == {frozenset({DRY}), frozenset({("brake", "pivot")})}


@pytest.mark.slow
def test_no_more_effects_than_asked_for(prepared):
    made = prepared(rubbing_and_pushed, ["coulomb_friction", "constant_torque"], most=1)
    made.choice.run(made.fit)
    assert len(made.choice.best) == 1
    assert len(made.choice.rounds) == 1


def test_an_effect_whose_refits_do_not_arrive_is_said_to_have_no_answer(prepared, monkeypatch):
    made = prepared(rubbing, ["coulomb_friction", "quadratic_drag"])
    monkeypatch.setattr(Additions, "_promising", everything)
    for name in ("from_point", "from_windows"):
        real = getattr(refits.Path, name)
        lost = lambda self, effects, *start, real=real: (  # noqa: E731
            None if DRAG in key_of(effects) else real(self, effects, *start)
        )
        monkeypatch.setattr(refits.Path, name, lost)
    made.choice.run(made.fit)
    assert made.choice.failed == {"quadratic_drag at pivot": "no refit of it arrives"}
    assert made.choice.best == {DRY}


def test_a_model_that_cannot_be_simulated_at_its_optimum_is_refused(prepared, monkeypatch):
    made = prepared(rubbing)
    monkeypatch.setattr(refits.Path, "at", lambda *args: None)
    with pytest.raises(
        EstimationError, match=r"the model without effects cannot be simulated at its own optimum"
    ) as caught:
        made.choice.run(made.fit)
    assert "give other start values, bounds, or a shorter record" in str(caught.value)


def test_a_key_has_no_order():
    first, second = (SimpleNamespace(candidate=SimpleNamespace(key=key)) for key in (DRY, DRAG))
    assert key_of([first, second]) == key_of([second, first]) == {DRY, DRAG}


@pytest.mark.slow  # what they may cost is below
def test_fresh_data_that_cost_too_much_are_not_judged_and_that_is_said(pendulum, monkeypatch):
    """What a structure may cost there is known from the first fit."""
    data = pendulum.decay(rubbing, samples=300)
    fresh = pendulum.decay(rubbing, samples=300, begun=1.1, seed=5, name="fresh")
    monkeypatch.setattr(FreshChoice, "_allowed", 100.0)
    found = ce.repair(
        pendulum.model, data, fresh=fresh, effects=["coulomb_friction"], noise=ce.Noise(y=pendulum.level), starts=1,
        progress=False,
    )  # fmt: skip
    assert (found.verdict, found.confirmed, found.stopped) == ("named", None, "")
    said = "the model without effects was not judged on the fresh data: looking for its initial states there had cost"
    assert any(text.startswith(said) for text in found.messages)
    assert not any("cannot be simulated" in text for text in found.messages)


def test_what_fresh_data_may_cost_grows_with_their_samples(pendulum):
    data, fresh = pendulum.decay(rubbing, samples=300), pendulum.decay(rubbing, samples=900, name="fresh")

    def allowed(own, work, usual=0.0):
        search = SimpleNamespace(refits=SimpleNamespace(path=SimpleNamespace(usual=usual)))
        return FreshChoice(search, Portions((data,), own, "records"), print, [], work)._allowed

    grows = [allowed(own, 1e9) for own in ((data,), (fresh,), (fresh, data))]
    assert np.diff(grows) == pytest.approx([2e9, 1e9], rel=0.02)
    assert grows[0] == 1e9
    assert allowed((data,), 0.0) == 5000 * 300  # evaluations of the samples
    # the fit without effects was cheap, and corners are sharp by now
    assert allowed((data,), 0.0, usual=1e7) == 1e9


def test_an_effect_of_which_the_whole_fit_leaves_nothing_is_none():
    play = SimpleNamespace(amplitude="coupling.backlash.gap", start=0.02)

    def fit(**found):
        return SimpleNamespace(
            estimates={n: SimpleNamespace(value=v, at_bound=b) for n, (v, b) in found.items()}
        )

    name = play.amplitude
    assert module.vanished([play], fit(**{name: (0.0, True)}))
    assert module.vanished([play], fit(**{name: (1e-30, False)}))  # made smaller while the data were content
    assert not module.vanished([play], fit(**{name: (1e-3, False)}))
    assert not module.vanished([play], fit(**{name: (0.04, True)}))  # at the other bound
    assert not module.vanished([play], fit(**{f"{name}@a": (0.0, True), f"{name}@b": (0.01, False)}))
    assert not module.vanished([play], fit(K=(0.0, True)))


@pytest.mark.parametrize(
    ("held", "beside", "end", "rival"),
    [
        (True, True, "max", False),
        (False, True, "max", True),
        (True, False, "max", True),
        (True, True, "min", None),
    ],
)
@pytest.mark.parametrize(
    ("law", "case", "resting"),
    [
        (ce.effects.StribeckFriction(), ce.effects.CoulombFriction(), ("fading",)),
        (ce.effects.LoadStep(), ce.effects.ConstantTorque(), ("time@first", "time@second")),
    ],
)
def test_a_law_that_rests_where_it_is_a_simpler_one_is_no_rival_of_that(
    law, case, resting, held, beside, end, rival
):
    """Friction that fades beyond all speeds is dry friction, a load that comes with every record a constant one; what
    fades in an instant is none, and was left out for good where the least fading speed was just too large."""
    rival = law.limit_end == "max" if rival is None else rival

    def tried(effect):
        candidate = SimpleNamespace(key=(effect.name, "load"), source=SimpleNamespace(effect=effect))
        one = SimpleNamespace(candidate=candidate, key=f"load.{effect.name}")
        names = [f"{one.key}.{name}" for name in resting]
        arrived = path.Arrived(
            dict.fromkeys(names, 0.0), {}, 1.0, True, frozenset(names if held else names[1:]), None, {}
        )
        return tried_by.Tried((one,), arrived, None, SimpleNamespace(log=1.0), dict)

    def fails(*_):
        raise FloatingPointError

    more = tried(law)
    every = [more, tried(case)] if beside else [more]
    all_of_them = refits.Refits.__new__(refits.Refits)
    bounds = SimpleNamespace(**{"min": -1.0, "max": 1.0, end: 0.0})
    names = [f"load.{law.name}.{name.partition('@')[0]}" for name in resting]
    all_of_them.null_fit = SimpleNamespace(noise={})
    all_of_them.path = SimpleNamespace(residuals=fails, parameters=lambda _: dict.fromkeys(names, bounds))
    all_of_them.pool = {one.key: one for one in every}
    all_of_them.weigh()
    assert (more.log > -np.inf) == rival


def test_friction_that_differs_by_direction_is_none_beside_a_constant_torque():
    """They took each other back: 11 000 N m of a drawbridge, named and confirmed."""

    def tried(*effects):
        made = []
        for effect in effects:
            candidate = SimpleNamespace(key=(effect.name, "leaf"), source=SimpleNamespace(effect=effect))
            made.append(SimpleNamespace(candidate=candidate, key=f"leaf.{effect.name}"))
        own = {"leaf.asymmetric_friction.torque": 2.0, "leaf.asymmetric_friction.asymmetry": 1.0}
        arrived = path.Arrived(own, {}, 1.0, True, frozenset(), None, {})
        return tried_by.Tried(tuple(made), arrived, None, SimpleNamespace(log=1.0), dict)

    def fails(*_):
        raise FloatingPointError

    asymmetric, constant = ce.effects.AsymmetricFriction(), ce.effects.ConstantTorque()
    every = [tried(asymmetric), tried(asymmetric, constant), tried(ce.effects.CoulombFriction(), constant)]
    all_of_them = refits.Refits.__new__(refits.Refits)
    all_of_them.null_fit, all_of_them.path = SimpleNamespace(noise={}), SimpleNamespace(residuals=fails)
    all_of_them.pool = {one.key: one for one in every}
    all_of_them.weigh()
    assert [one.failed for one in every] == [False, True, False]


def test_what_was_left_out_can_be_refitted_without_its_leader(prepared):
    made = prepared(rubbing)
    made.choice.run(made.fit)
    choice = made.choice
    additions = Additions(choice.refits, choice.pool[frozenset()], choice.null, {}, lambda words: None)
    additions.run()
    assert set(additions.left_out) == {DRAG, CONSTANT}
    assert additions.rest()
    assert additions.refused == {DRY}
    assert {DRAG, CONSTANT} >= set(additions.done) - {DRY} != set()
