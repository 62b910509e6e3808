"""What a repair claims: what is missing beside its effects, and when these are no answer."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from casadi_engine.discrepancy import answer
from casadi_engine.discrepancy import claim as module
from casadi_engine.discrepancy.claim import Claim, reason_to_withdraw
from casadi_engine.discrepancy.confirmation import Gap
from casadi_engine.discrepancy.repaired import TOO_LITTLE, UNTOLD, Unknown
from casadi_engine.discrepancy.unknown_law import UnknownLaw

# narrow noise, whose swings die out after some twenty samples
NARROW = lfilter([1.0], [1.0, -1.9 * np.cos(0.5), 0.9025], np.random.default_rng(1).standard_normal(2000))
NARROW = NARROW / NARROW.std()


def stub(**known):
    """An effect, a station or a screen with what is read of it."""
    return SimpleNamespace(**known)


def left_of(record, noise, explained, *, estimated=True, larger=()):
    """What a model leaves of y in the record ``run``, of which it explains so many per cent."""
    fit = stub(fit_percent={"run": {"y": {"simulation": explained}}}, noise={"y": (1.0, estimated)})
    screened = stub(null=stub(records=(record,)), noise=noise, choice=stub(larger=tuple(larger)))
    return stub(fit=fit, screened=screened)


@pytest.mark.parametrize(
    ("withdrawn", "significant", "words"),
    [
        (
            [stub(name="drag", at="load")],
            [],
            "drag at load explains these data best, but fresh data refuse it",
        ),
        ([], [0], "drag at load scores beyond chance, but no refit with it is better than none"),
        ([], [], None),
    ],
)
def test_what_is_missing_where_nothing_else_tells(monkeypatch, withdrawn, significant, words):
    monkeypatch.setattr(module, "unknown_of", lambda _: None)
    screened = stub(
        significant=significant,
        candidates=[stub(label="drag at load")],
        pooled=lambda k: 0.001,
        leftover=None,
        null=stub(records=()),
        choice=stub(rounded={}),
    )
    fit = stub(noise={"y": (1.0, True)}, traces={})
    station = stub(screened=screened, fit=fit)
    found = module.missing_beside(station, station, (), withdrawn)
    assert (found and found.sentence) == words
    assert module.missing_beside(station, station, [stub()], withdrawn) is None
    if significant:  # a score that no refit bears out has to be rarer where there are fresh data
        assert module.missing_beside(station, stub(screened=screened, fit=fit), (), (), least=1e-4) is None
        assert module.missing_beside(station, station, (), (), least=1e-4, cut=True) is not None


@pytest.mark.parametrize(
    ("turns", "words"),
    [
        (1, "y in run changes as slowly as if"),
        (200, "y in run oscillates without decaying, as if"),
        (None, ""),
    ],
)
def test_a_coloured_residual_of_few_swings_is_not_called_noise(turns, words):
    residual = NARROW if turns is None else np.sign(np.sin(2 * np.pi * turns * np.arange(2000) / 2000 + 0.3))
    record = stub(name="run", residual={"y": residual})
    noise = stub(colour={("run", "y"): object()}, sigma={"y": 0.5})
    found = module.no_noise(left_of(record, noise, 80.0))
    assert (found is not None) == bool(words)
    assert not words or words in found.sentence


@pytest.mark.parametrize(
    ("innovations", "estimated", "larger", "said"),
    [
        (0.5, True, False, True),
        (0.99, True, False, False),  # next to nothing of it has a colour
        (0.5, False, False, False),  # as large as was stated
        (0.5, False, True, True),
    ],
)
def test_a_weak_signal_in_noise_is_no_missing_effect(innovations, estimated, larger, said):
    """Half of a pressure was white noise of the level that was stated, a test of its colour alarmed by chance, and
    "something is missing"."""
    residual = np.random.default_rng(0).standard_normal(500)
    record = stub(name="run", residual={"y": residual})
    noise = stub(colour={("run", "y"): object()}, sigma={"y": innovations})
    station = left_of(record, noise, 40.0, estimated=estimated, larger=[("run", "y")] if larger else [])
    assert (module.no_noise(station) is not None) == said


@pytest.mark.parametrize(
    ("explained", "coloured", "said"), [(-0.5, True, True), (68.0, True, False), (-0.5, False, False)]
)
def test_a_coloured_residual_that_is_most_of_the_motion_is_not_called_noise(explained, coloured, said):
    residual = np.random.default_rng(0).standard_normal(500)
    record = stub(name="run", residual={"y": residual})
    noise = stub(colour={("run", "y"): object()} if coloured else {}, sigma={"y": 0.5})
    found = module.no_noise(left_of(record, noise, explained))
    assert (found is not None) == said
    assert not said or "explains 0 % of y in run, and the rest is coloured" in found.sentence


@pytest.mark.parametrize(
    ("explained", "innovations", "said"), [(73.0, 0.05, True), (92.0, 0.05, False), (73.0, 0.3, False)]
)
def test_what_is_seen_and_foretold_by_its_own_past_is_not_called_noise(explained, innovations, said):
    """The force of magnets in a row left a quarter of the motion of a linear motor, which an autoregression foretold
    to the twenty-fifth part: "nothing missing"."""
    residual = NARROW
    record = stub(name="run", residual={"y": residual})
    noise = stub(colour={("run", "y"): object()}, sigma={"y": innovations})
    found = module.no_noise(left_of(record, noise, explained))
    assert (found is not None) == said
    assert (
        not said
        or "explains 73 % of y in run, and the rest is predicted from its own past to within 5 %"
        in found.sentence
    )


def claimed(monkeypatch, *, before, after, tests, fresh=None, kind="inertia", stated=False, coloured=False):
    """A drag that lowers the rms gap of y from ``before`` to ``after`` standard deviations of the noise.

    fresh : the same two of fresh data, None for those of the search; stated : the noise is known, not estimated;
    coloured : what is left is coloured beyond chance
    """
    sides = {"null": before, "last": after} | dict(zip(("old", "new"), fresh or (before, after), strict=True))
    gaps = {name: Gap(1.0, {"y": size}, {"y": 0.0}, 100) for name, size in sides.items()}
    monkeypatch.setattr(module, "gap_of", lambda nulls, noise: gaps[nulls[0]])
    monkeypatch.setattr(module, "told_by_both", lambda one, other: (one, other))
    noise = stub(sigma={"y": 1.0}, colour={})
    fit = stub(model=stub(ports={"load": stub(kind=kind)}), noise={"y": (1.0, not stated)})
    null, last = (
        stub(fit=fit, screened=stub(null=name, noise=noise, choice=stub(is_coloured=coloured)))
        for name in ("null", "last")
    )
    drag = stub(name="drag", at="load", key="load.drag", share_explained=1.0, p_value=0.0)
    unknown = None if tests is None else Unknown("the residual has a line", tests)
    proof = stub(kept=(null, last), before=[(None, "old")], after=[(None, "new")])
    return Claim(proof, last, (drag,), (), unknown), null


@pytest.mark.parametrize(
    ("after", "tests", "withdrawn"),
    [(2.9, {"line": 1e-9}, True), (1.5, {"line": 1e-9}, False), (2.9, None, False), (2.9, {}, True)],
)
def test_an_effect_that_closes_less_than_it_leaves_is_no_answer_where_that_is_no_noise(
    monkeypatch, after, tests, withdrawn
):
    claim, null = claimed(monkeypatch, before=3.0, after=after, tests=tests)
    found = reason_to_withdraw(claim, null, True)
    assert (found is not None) == withdrawn
    if withdrawn:
        assert "drag at load explains the gap best and closes less of it than is left" in found.sentence
        assert found.tests == tests


@pytest.mark.parametrize(
    ("after", "fresh", "tests", "cut", "withdrawn"),
    [
        (2.0, None, {"line": 1e-9}, False, True),
        (1.04, None, {"line": 1e-9}, False, False),  # a person sees no more of it
        (1.04, (10.0, 2.0), {"line": 1e-9}, False, True),
        (2.0, None, None, False, False),  # nothing says that more is missing
        (2.0, None, {"line": 1e-9}, True, False),  # the search was not at its end
    ],
)
def test_what_is_left_beyond_a_noise_that_is_known_is_missing(
    monkeypatch, after, fresh, tests, cut, withdrawn
):
    """An effect that closes most of a gap of ten standard deviations is no name for all of it."""
    claim, null = claimed(monkeypatch, before=10.0, after=after, tests=tests, fresh=fresh, stated=True)
    found = reason_to_withdraw(claim, null, True, cut=cut)
    assert (found is not None) == withdrawn
    if withdrawn:
        assert "closes not all of it, which is no noise" in found.sentence


@pytest.mark.parametrize(
    ("confirmed", "after", "smooth", "withdrawn"),
    [
        (False, 1.5, False, True),
        (True, 1.5, False, False),
        (False, 1.05, False, False),
        (
            True,
            1.5,
            True,
            True,
        ),  # what they leave is foretold by its own past: each follows it a part of the way
        (True, 1.05, True, False),
    ],
)
def test_several_effects_that_nothing_confirms_are_all_that_is_wrong_or_none_of_it(
    monkeypatch, confirmed, after, smooth, withdrawn
):
    monkeypatch.setattr(module, "no_noise", lambda station: "smooth" if smooth else None)
    claim, null = claimed(monkeypatch, before=3.0, after=after, tests={"line": 1e-9})
    claim = replace(claim, found=(*claim.found, *claim.found))
    assert (reason_to_withdraw(claim, null, confirmed) is not None) == withdrawn


@pytest.mark.parametrize(
    ("confirmed", "several", "far", "withdrawn"),
    [
        (False, True, True, True),
        (True, True, True, False),
        (False, False, True, False),
        (False, True, False, False),
    ],
)
def test_several_with_an_error_that_is_far_too_large_are_no_answer_unless_confirmed(
    monkeypatch, confirmed, several, far, withdrawn
):
    """A gas spring was a spring to the ground and an angle sensor that is off by 123 degrees, by name."""
    claim, null = claimed(monkeypatch, before=3.0, after=1.0, tests=None)
    claim = replace(claim, found=(*claim.found, *claim.found)) if several else claim
    monkeypatch.setattr(module, "_visible", lambda _: True)
    found = reason_to_withdraw(claim, null, confirmed, far=far)
    assert (found is not None) == withdrawn
    assert not withdrawn or "one of them an error far larger than a sensor or an input may" in found.sentence


@pytest.mark.parametrize("confirmed", [True, False])
def test_a_storage_that_begins_beyond_what_is_ever_there_is_no_answer(monkeypatch, confirmed):
    """A membrane whose pores block was a storage behind its cake, "confirmed"."""
    claim, null = claimed(monkeypatch, before=3.0, after=1.0, tests=None)
    found = reason_to_withdraw(claim, null, confirmed, full=True)
    assert (
        "explains the gap best, a storage that would begin far beyond what is ever stored" in found.sentence
    )
    assert replace(claim, found=(), unknown=found).is_bent
    assert not replace(claim, unknown=found).is_bent
    assert not claim.is_bent


@pytest.mark.parametrize(("after", "withdrawn"), [(1.5, True), (1.05, False)])
def test_an_error_of_a_sensor_is_all_that_is_wrong_or_none_of_it(monkeypatch, after, withdrawn):
    claim, null = claimed(monkeypatch, before=3.0, after=after, tests={"line": 1e-9}, kind="sensor")
    found = reason_to_withdraw(claim, null, True)
    assert (found is not None) == withdrawn
    assert not withdrawn or "closes not all of it" in found.sentence


@pytest.mark.parametrize("kind", ["sensor", "input"])
@pytest.mark.parametrize(
    ("after", "fresh", "withdrawn"),
    [(2.9, (20.0, 3.0), True), (1.5, (20.0, 3.0), False), (1.5, (20.0, 19.0), True)],
)
def test_an_error_of_an_instrument_leaves_no_more_than_it_closes_that_may_be_noise(
    monkeypatch, kind, after, fresh, withdrawn
):
    """Hysteresis as a sensor that is early, with the rest called coloured: both records have to say so."""
    claim, null = claimed(
        monkeypatch, before=3.0, after=after, tests=None, fresh=fresh, kind=kind, coloured=True
    )
    found = reason_to_withdraw(claim, null, True)
    assert (found is not None) == withdrawn
    assert not withdrawn or found.sentence.startswith(
        "what is left is coloured; drag at load explains the gap"
    )


@pytest.mark.parametrize(
    ("fresh", "confirmed", "withdrawn"),
    [((20.0, 3.0), True, False), ((20.0, 3.0), False, True), ((20.0, 19.0), True, True)],
)
def test_fresh_data_that_confirm_tell_how_much_is_closed(monkeypatch, fresh, confirmed, withdrawn):
    """A record in which an effect hardly shows leaves a line of a sensor's rounding; the fresh one shows the effect."""
    claim, null = claimed(monkeypatch, before=3.0, after=2.9, tests={"line": 1e-4}, fresh=fresh)
    monkeypatch.setattr(module, "_visible", lambda _: True)
    assert (reason_to_withdraw(claim, null, confirmed) is not None) == withdrawn


def test_what_is_withdrawn_leaves_the_model_without_effects(monkeypatch):
    monkeypatch.setattr(module, "replace", lambda proof, **new: stub(**(vars(proof) | new)))
    claim, null = claimed(monkeypatch, before=3.0, after=2.9, tests={})
    found = claim.withdrawn_for(Unknown("why", {}), null, TOO_LITTLE)
    assert (found.last, found.found, [one.key for one in found.withdrawn]) == (null, (), ["load.drag"])
    assert found.withdrawn[0].why_withdrawn == "closing too little of the gap"
    assert (found.proof.kept, found.proof.after, found.unknown.sentence) == (
        (null,),
        claim.proof.before,
        "why",
    )
    untold = claim.withdrawn_for(Unknown(UNTOLD, {}), null, TOO_LITTLE).unknown
    assert untold.sentence.startswith("more than drag at load explains, and the time was up")


@pytest.mark.parametrize(
    ("left", "stated", "rounded", "said"),
    [(8.6, True, {}, True), (8.1, True, {}, False), (8.6, False, {}, False), (8.6, True, {"y": 8.6}, False)],
)
def test_effects_that_leave_more_than_the_stated_noise_are_not_all(left, stated, rounded, said):
    """A sensor with a lag of the first order came out as late, and the volume of a room as 3.5 % larger, without a word
    of what these left."""
    record = stub(residual={"y": np.zeros(960)})
    screened = stub(noise=stub(sigma={"y": left}), choice=stub(rounded=rounded), null=stub(records=[record]))
    found = module.more_than_stated(stub(fit=stub(noise={"y": (8.0, not stated)}), screened=screened))
    assert (found is not None) is said
    assert not said or found.sentence == "more is left than the noise that was stated: y, 8.6 in place of 8"


@pytest.mark.parametrize(("delay", "withdrawn"), [(-1.2, True), (1.2, False)])
def test_a_sensor_that_would_be_early_leaves_nothing_that_a_person_sees(monkeypatch, delay, withdrawn):
    """Columns that were exchanged: the sensor was 1.2 s early, confirmed, and a third of its motion was left."""
    claim, null = claimed(monkeypatch, before=3.0, after=1.4, tests=None, kind="sensor", coloured=True)
    early = stub(
        **vars(claim.found[0]) | {"name": "sensor_delay", "amplitude": stub(value=delay, stderr=0.2)}
    )
    found = reason_to_withdraw(replace(claim, found=(early,)), null, True)
    assert (found is not None) == withdrawn


def test_what_is_closed_of_the_gap_on_fresh_data(monkeypatch):
    claim, _ = claimed(monkeypatch, before=3.0, after=2.9, tests=None, fresh=(5.0, 2.0))
    noise = stub(sigma={"y": 1.0})
    assert module.closed_on_fresh(claim.proof, noise) == pytest.approx(21 / 24)
    assert module.closed_on_fresh(stub(before=[], after=[]), noise) is None


@pytest.mark.parametrize(
    ("confirmed", "fresh", "near", "kept"),
    [
        (True, (5.0, 1.5), 0.8, True),
        (None, (5.0, 1.5), 0.8, False),
        (True, (5.0, 3.0), 0.8, False),
        (True, (5.0, 1.5), 0.99, False),  # a constant is the mean of any law, of fresh data too
    ],
)
def test_a_law_that_explains_most_of_fresh_data_stays_beside_one_that_is_more_probable(
    monkeypatch, confirmed, fresh, near, kept
):
    """The drag of a pendulum by the square of its speed closed nine tenths of the gap on fresh data, and was withdrawn
    as a curve was more probable."""
    claim, null = claimed(monkeypatch, before=3.0, after=2.9, tests={"line": 1e-9}, fresh=fresh)
    claim = replace(claim, proof=stub(**vars(claim.proof), judgement=stub(confirmed=confirmed)))
    null.screened.request = claim.last.screened.request = stub(blind=False)
    law = UnknownLaw(None, 9.0, 0.1, near=near)
    monkeypatch.setattr(answer, "_said", lambda *_, **__: Unknown("a function of speed", {}))
    monkeypatch.setattr(Claim, "withdrawn_for", lambda *_: "withdrawn")
    own = stub(_law=lambda *_: law, _is_far=lambda _: False, _in_time=lambda _, work: work(), _rare=1e-3)
    own._along_all = lambda *_: None
    own.portion = stub(fresh=())
    claim.last.effects = ()
    own._imitators = lambda *_: 0
    found = answer.Answer._held_to_laws(own, claim, null)
    assert (found != "withdrawn") is kept


@pytest.mark.parametrize(
    ("size", "stated", "rounded", "said"),
    [(2.3, True, (), True), (1.2, True, (), False), (2.3, False, (), False), (2.3, True, ("y",), False)],
)
def test_a_model_that_leaves_more_than_the_stated_noise_lacks_something(size, stated, rounded, said):
    """Fourteen levels of a drug were off by 2.3 times the stated noise, and by chance a second loss might be all of it:
    nothing was missing."""
    signs = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, -1, 1, -1, 1])
    trace = stub(residual=size * signs, mask=np.ones(14, dtype=bool))
    fit = stub(noise={"y": (1.0, not stated)}, traces={"run": {"y": trace}})
    found = module.above_stated(fit, rounded)
    assert (found is not None) is said
    assert not said or found.sentence.startswith("more is left than the noise that was stated: y, 2.")


@pytest.mark.parametrize(
    ("judged", "fresh", "unknown", "coloured", "left", "unjudged"),
    [
        (False, True, None, True, 1.0, True),  # its colour may be what is missing
        (False, True, None, False, 1.0, False),
        # friction alone was named where a load cell had the wrong gain: five times the noise was left of it
        (False, True, None, False, 5.6, True),
        (False, True, Unknown("more is left", {}), False, 1.0, True),
        (True, True, None, True, 5.6, False),
        (False, False, None, True, 5.6, False),
    ],
)
def test_what_fresh_data_were_not_asked_of_is_no_name_beside_a_colour(
    judged, fresh, unknown, coloured, left, unjudged
):
    """A rubber stop was "a load step and an offset of -62 deg", named, as the rest was coloured and the time was up."""
    effects = (stub(),)
    fit = stub(residual_level={"y": 4.6 * left})
    last = stub(screened=stub(choice=stub(is_coloured=coloured)), effects=effects, fit=fit)
    claim = stub(found=effects, unknown=unknown, last=last, proof=stub(judgement=stub() if judged else None))
    made = stub(
        search=stub(failed={"more": answer.TIME_UP}, refits=stub(path=stub(levels={"y": 4.6}))),
        portion=stub(fresh=("b",) if fresh else ()),
        _may_be_rounding=lambda *_: False,
    )
    assert answer.Answer._is_unjudged(made, claim) is unjudged
    made.search.failed = {}
    assert answer.Answer._is_unjudged(made, claim) is False
