"""The last word of fresh data: what is kept, withdrawn, taken in its place, and what is said of it."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy import answer as module
from casadi_engine.discrepancy import answer_words as words
from casadi_engine.discrepancy import fresh_choice
from casadi_engine.discrepancy.answer import Answer
from casadi_engine.discrepancy.choice import TIME_UP
from casadi_engine.discrepancy.claim import Claim
from casadi_engine.discrepancy.fresh import Judgement
from casadi_engine.discrepancy.fresh_choice import FreshChoice
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.repaired import BEHIND_LAW
from casadi_engine.effects import Amplitude, Effect


@dataclass
class Found:
    """An effect that was found."""

    name: str
    why_withdrawn: str = ""


@dataclass
class Proof:
    """What fresh data leave."""

    kept: tuple
    judgement: object
    before: list
    after: list


class Brake(Effect):
    """Dry friction by another name."""

    name, attaches, kin = "brake", ("inertia",), ()
    sentence = "a brake on {port}"
    amplitude = Amplitude("torque", unit="N m", min=0)

    def law(self, port, p, math):
        return -p.torque * math.tanh(port.speed / 0.05)


def rubbing(t, angle, rate):
    return -0.6 * np.tanh(rate / 0.02)


@pytest.fixture(scope="module")
def repaired(pendulum):
    """The repair of a decay with dry friction (or what else is hidden), on another decay with what is hidden there."""

    def of(fresh=rubbing, *, hidden=rubbing, effects=("coulomb_friction",)):
        record = pendulum.decay(hidden, samples=300)
        other = pendulum.decay(fresh, samples=300, begun=1.1, seed=5, name="fresh")
        noise = ce.Noise(y=pendulum.level)
        return ce.repair(
            pendulum.model, record, fresh=other, effects=list(effects), noise=noise, starts=1, progress=False
        )

    return of


def test_an_effect_that_fresh_data_refuse_is_withdrawn(repaired):
    """There is none in the fresh record."""
    found = repaired(None)
    assert found.verdict == "unnamed"
    assert found.effects == ()
    assert found.confirmed is None
    assert [one.key for one in found.withdrawn] == ["pivot.coulomb_friction"]
    assert found.unknown.sentence == (
        "an unknown angular acceleration at pivot that depends on its speed: far more probable than noise alone"
    )
    assert any("fresh data refuse it: the gap grows, the gain is -" in text for text in found.messages)
    assert found.fit is found.null_fit


@pytest.mark.slow  # as does this
def test_the_next_structure_by_evidence_stands_where_the_first_is_refused(repaired, monkeypatch):
    real, asked, refused = FreshChoice._of_structure, [], []

    def of_structure(self, stations, before):
        label = stations[-1].effects[-1].label
        asked.extend([label] if label not in asked else [])
        judged, after = real(self, stations, before)
        if label != self.search.pool[self.search.best].label:
            return judged, after
        refused.append(label)
        return Judgement(None, False, True, "refused by hand"), after

    monkeypatch.setattr(FreshChoice, "_of_structure", of_structure)
    found = repaired(effects=["coulomb_friction", Brake()])
    assert sorted(asked) == ["brake at pivot", "coulomb_friction at pivot"]
    (one,) = found.effects
    assert [f"{one.name} at {one.at}"] == [label for label in asked if label != refused[-1]]
    assert found.confirmed is True
    assert [f"{e.name} at {e.at}" for e in found.withdrawn] == [refused[-1]]
    assert found.withdrawn[0].why_withdrawn == "contradicted by fresh data"
    assert f"{refused[-1]}: refused by hand" in found.messages


@pytest.mark.slow
def test_fresh_data_that_the_repaired_model_cannot_be_simulated_on_judge_nothing(repaired, monkeypatch):
    """They neither confirm nor refuse it, and the gap there is told of the model without effects alone."""
    real = fresh_choice.fresh_sides
    monkeypatch.setattr(
        fresh_choice,
        "fresh_sides",
        lambda fit, effects, *rest: None if effects else real(fit, effects, *rest),
    )
    found = repaired()
    assert [one.key for one in found.effects] == ["pivot.coulomb_friction"]
    assert found.confirmed is None
    assert found.gaps.validation_before is not None
    assert found.gaps.validation_after is None
    assert fresh_choice.NO_RUN in found.messages
    assert "neither confirms nor refuses" in str(found)


def test_without_the_first_model_on_fresh_data_nothing_is_confirmed(repaired, monkeypatch):
    monkeypatch.setattr(fresh_choice, "fresh_sides", lambda *_: None)
    found = repaired()
    assert [one.key for one in found.effects] == ["pivot.coulomb_friction"]
    assert found.confirmed is None
    assert found.gaps.validation_before is None
    assert "the model without effects cannot be simulated on the fresh data" in found.messages


@pytest.mark.slow  # test_fresh_choice.py says that it stays
def test_an_event_of_one_record_waits_for_no_confirmation(repaired, monkeypatch):
    """A torque that comes on in the middle of the first record, and not in the fresh one."""

    def pushed(t, angle, rate):
        return 2.0 * (t > 1.5)

    chance = Judgement(None, False, False, "chance")
    monkeypatch.setattr(fresh_choice, "judge", lambda *_: chance)
    found = repaired(None, hidden=pushed, effects=["load_step"])
    (one,) = found.effects
    assert one.name == "load_step"
    assert found.confirmed is None
    words = "it is an event of one record, which no other record can confirm"
    assert found.messages == (f"load_step at pivot: {words}",)


@pytest.mark.slow
def test_an_event_that_is_not_in_the_fresh_data_does_not_spoil_them(repaired):
    """Its size is 0 there, hundreds of standard errors off: that says nothing of the other parameters."""
    found = repaired(None, hidden=lambda t, angle, rate: 2.0 * (t > 1.5), effects=["load_step"])
    after = found.gaps.validation_after
    assert after.gap.chi2_per_sample == pytest.approx(1, abs=0.3)
    assert after.within_errors <= after.gap.chi2_per_sample
    assert after.parameters_p > 1e-3
    assert found.messages == ()


@pytest.mark.slow  # test_fresh_choice.py asks structures in their order
def test_a_structure_without_a_fit_on_its_way_is_passed_over(repaired, monkeypatch):
    real = fresh_choice.Choice.way
    lost = lambda self, key: real(self, key) if not key else None  # noqa: E731
    monkeypatch.setattr(fresh_choice.Choice, "way", lost)
    found = repaired()
    assert found.effects == ()
    assert "coulomb_friction at pivot: its fit of all data does not converge" in found.messages


def stub(**known):
    """An effect, a station or a screen with what ``_unknown`` reads."""
    return SimpleNamespace(**known)


def test_what_was_not_tried_is_told_but_not_of_what_was_chosen():
    chosen = stub(candidate=stub(effect="drag", port="load"))
    failed = {"drag at load": "no refit of it arrives", "play at belt": "no refit of it arrives"}
    failed["step at belt"] = TIME_UP  # said at the top
    search = stub(failed=failed, best="best", pool={"best": stub(effects=(chosen,))})
    assert words.without_answer(search) == [
        "no answer for play at belt: no refit of it arrives; nothing excludes what was not tried"
    ]


def test_what_the_time_left_unfitted_is_told_where_it_is_far_more_probable():
    def tried(label, log, cost, *, beyond=9.0, failed=False):
        own = SimpleNamespace(log=log, cost=cost)
        return SimpleNamespace(
            label=label,
            name=label,
            evidence=own,
            counted=log,
            log=-np.inf if failed else log,
            beyond=beyond,
            failed=failed,
        )

    pool = {
        "none": tried("no effects", -100.0, 3000.0, beyond=np.inf),
        "play": tried("a play", -20.0, 800.0, failed=True),
        "lost": tried("a law whose fit fails", 50.0, 10.0, failed=True),
        "weak": tried("a weak law", 0.0, 20.0, beyond=1.0),
    }
    search = SimpleNamespace(pool=pool, best="none", price=3.0, failed={"a play": TIME_UP})
    assert words.so_far(search) == [
        "the most probable so far is a play (chi-squared falls by 73 %), which was not fitted to its end"
    ]
    assert words.ahead(search) == 80.0
    pool["play"].evidence.cost = 2900.0  # of which a person would see nothing
    assert words.ahead(search) == -np.inf
    search.failed = {"a play": "its fit of all data does not converge"}
    assert words.so_far(search) == []
    search.failed, pool["play"].counted = {"a play": TIME_UP}, -98.0
    assert words.so_far(search) == []


@pytest.mark.parametrize(
    ("felt", "cost", "memory", "may"),
    [
        (0.0, 5000.0, {}, False),
        (float("nan"), 5000.0, {}, True),
        (4.6, 54_000.0, {}, False),  # chi-squared per sample 54, of which sharper corners would change 5
        (30.0, 54_000.0, {}, True),
        (4.6, 54_000.0, {"y": 10.0}, True),
        (4.6, 1100.0, {}, True),
    ],
)
def test_rounded_corners_leave_no_more_than_sharper_ones_would_change(felt, cost, memory, may):
    tried = stub(arrived=stub(cost=cost))
    own = stub(
        rounding_felt=lambda effects: felt,
        pool={frozenset(): tried},
        path=stub(samples=1000),
        levels=stub(memory=memory),
    )
    assert Refits.may_be_rounding(own, ()) is may


@pytest.mark.parametrize(
    ("port", "may", "rounding"), [("trolley", True, True), ("trolley", False, False), ("mass", True, False)]
)
def test_what_rounded_corners_leave_at_their_port_is_no_law_of_no_name(port, may, rounding):
    friction = SimpleNamespace(candidate=SimpleNamespace(port="trolley"))
    path = SimpleNamespace(cornered=lambda effects: True)
    refits = SimpleNamespace(path=path, may_be_rounding=lambda effects: may)
    asked = SimpleNamespace(search=SimpleNamespace(refits=refits))
    unknown = SimpleNamespace(port=port, course=object())
    assert Answer._may_be_rounding(asked, SimpleNamespace(effects=(friction,)), unknown) is rounding


def test_several_that_imitate_a_law_leave_the_one_that_comes_near(monkeypatch):
    """A damper and a load step did nothing beside a function of speed, of which the damper alone explains 99 %; both
    were withdrawn."""
    kept = ("none", "damper", "damper and load")
    found = (Found("damper"), Found("load"))
    claim = Claim(Proof(kept, "judged", ["fresh"], ["after"]), kept[-1], found, (), "a function of speed")
    sure = True
    own = stub(
        fresh=stub(judged=lambda stations, before: (stub(confirmed=sure, count=len(stations)), ["less"]))
    )
    monkeypatch.setattr(module, "_effects", lambda proof: (proof.kept[1:], ()))
    fewer = Answer._without_last(own, claim)
    assert (fewer.last, fewer.found, fewer.proof.judgement.count) == ("damper", ("damper",), 2)
    assert [(one.name, one.why_withdrawn) for one in fewer.withdrawn] == [("load", BEHIND_LAW)]
    assert Answer._without_last(own, fewer) is None  # it is the only one
    sure = False
    assert Answer._without_last(own, claim) is None
    own.fresh.judged = lambda stations, before: (None, None)
    assert Answer._without_last(own, claim) is None
