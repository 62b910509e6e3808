"""A repair in sentences."""

from dataclasses import replace

import numpy as np
import pytest

from casadi_engine.discrepancy import by_chance
from casadi_engine.discrepancy.by_chance import held_to_chance
from casadi_engine.discrepancy.confirmation import PairedGain
from casadi_engine.discrepancy.fresh_misfit import fresh_misfit, held_to_fresh_data
from casadi_engine.discrepancy.repaired import LAWS_CUT, REFUSED, UNCONFIRMED, Member, NextExperiment, Unknown
from casadi_engine.discrepancy.verdict_words import headline, next_step
from casadi_engine.discrepancy.withdrawal import withdrawn
from casadi_engine.effects import LoadStep
from casadi_engine.estimation.fit import Estimate
from casadi_engine.report.repaired_words import (
    effect_words,
    gap_sentence,
    mood,
    moved_parameters,
    verdict_lines,
)


def test_a_named_and_confirmed_effect(repaired):
    lines = verdict_lines(repaired)
    assert lines[0] == (
        "Something is missing: dry friction at coupling (coulomb_friction at coupling), torque 8.050 ± 0.070 N m."
    )
    assert lines[1] == (
        "The gap is widest in misfire_1200rpm from 0.1 to 0.3 s, cycles 2 to 4, crank angles 705 to 138 deg, engine "
        "order 1.5; a torque at coupling explains most of it."
    )
    assert lines[2] == ("Confirmed by fresh records, gain of chi-squared 339 ± 36 per cycle over 10 cycles.")
    assert lines[3] == (
        "Rms gap: omega 0.1458 to 0.1 rad/s on data of the search, omega 0.1458 to 0.1 rad/s on fresh data; 100 % of "
        "the gap above the noise is closed."
    )
    assert lines[4] == "Without it the model had these wrong: J_load 0.1771, now 0.1700 ± 0.0020 kg m2."
    assert lines[-1] == (
        "Next: go on with repair.fit, the repaired model: print(repair.fit); its values count on what is fixed: r, L, "
        "A_p, m_eq and 1 more."
    )
    assert mood(repaired) == "good"


@pytest.fixture
def white(nothing_missing):
    return replace(
        nothing_missing, noise=replace(nothing_missing.noise, colour={}, scatter={}, is_coloured=False)
    )


def test_nothing_missing(white):
    lines = verdict_lines(white)
    assert lines[0] == (
        "Nothing is missing that these data can show: 380 candidates at α = 0.01, and the residuals are white."
    )
    assert lines[1] == "Rms gap: omega 0.1 rad/s on data of the search, omega 0.1 rad/s on fresh data."
    assert lines[-1].startswith("Next: use the model; larger effects than those listed are excluded")
    assert (len(lines), mood(white)) == (3, "good")


def test_no_name_in_the_library(unnamed):
    lines = verdict_lines(unnamed)
    assert lines[0] == (
        "Something is missing that no effect of the library names: a torque at the coupling that depends on its twist "
        "and looks cubic."
    )
    assert "on fresh data" not in gap_sentence(unnamed)
    assert next_step(unnamed).startswith("look at the curve of the unknown torque")
    assert mood(unnamed) == "poor"


def test_no_answer(no_answer):
    lines = verdict_lines(no_answer)
    assert lines[0] == "No answer: the fit without effects has not converged: Maximum_Iterations_Exceeded."
    assert lines[-1] == "Next: fix the baseline fit first: other start values, wider bounds, or more starts."
    assert mood(no_answer) == "poor"
    assert gap_sentence(no_answer) == ""


def test_a_class_names_its_members_and_what_would_split_it(repaired):
    members = (Member("coulomb_friction", "coupling", 1.0, 0.7), Member("backlash", "coupling", 0.98, 0.3))
    effect = replace(repaired.effects[0], members=members)
    changed = replace(repaired, verdict="class", effects=(effect,))
    lines = verdict_lines(changed)
    assert lines[1] == (
        "These data do not tell apart 2 effects that explain it as well: coulomb_friction at coupling (70 %), backlash "
        "at coupling (30 %)."
    )
    assert next_step(changed) == (
        "no other input or sensor and no longer record that could be tried by simulation tells them apart; a record of "
        "another kind may, or decide by what you know of the system, and leave out what it cannot have: "
        'ce.repair(..., without=["backlash"])'
    )
    assert mood(changed) == "poor"
    split = NextExperiment("a run-up to 1800 RPM", ("coulomb_friction and backlash",), 6.1, 1.2)
    assert next_step(replace(changed, next_experiment=split)) == (
        "to split coulomb_friction and backlash: a run-up to 1800 RPM (separation 6.1, now 1.2; 3.3 is enough)"
    )


@pytest.mark.parametrize(
    ("confirmed", "gain", "source", "words"),
    [
        (None, None, None, "Not confirmed: there are no fresh data."),
        (None, PairedGain(2.0, None, 2, None, "2 cycles: at least 3 are needed"), "records",
         "Not confirmed: 2 cycles: at least 3 are needed."),
        (False, PairedGain(-40.0, 3.0, 5, False), "cycles",
         "Contradicted by cycles that were held out, gain of chi-squared -40 ± 3 per cycle over 5 cycles."),
        (False, PairedGain(-4.0, 3.0, 5, False), "cycles",
         "Not confirmed by cycles that were held out, gain of chi-squared -4 ± 3 per cycle over 5 cycles."),
    ],
)  # fmt: skip
def test_what_fresh_data_say(repaired, confirmed, gain, source, words):
    gaps = replace(repaired.gaps, gain_per_cycle=gain, source=source)
    fresh = repaired.fresh if source == "records" else ()
    changed = replace(repaired, confirmed=confirmed, gaps=gaps, fresh=fresh)
    assert words in verdict_lines(changed)
    assert mood(changed) == ("poor" if confirmed is False else "good")
    if confirmed is None and not fresh:
        assert next_step(changed) == (
            "test it on data it has not seen: --validate FILE, or ce.repair(..., fresh=other_record)"
        )


def test_fresh_data_that_were_given_and_decide_nothing_are_named_and_not_asked_for(repaired):
    """A gain beyond chance, and more of the gap left than closed, in colour: neither confirmed nor refused."""
    words = "what is left of the fresh data is coloured, and more than what was closed"
    changed = replace(repaired, confirmed=None, messages=(words,))
    assert next_step(changed) == (
        "test it on more fresh data: those that were given (normal_1400rpm) neither confirm nor refuse it, as the "
        "notes say"
    )
    said = verdict_lines(changed)
    assert (
        "Neither confirmed nor refused by fresh records, gain of chi-squared 339 ± 36 per cycle over 10 cycles, as "
        "said below."
    ) in said
    assert "there are no fresh data" not in " ".join(said)
    lost = replace(changed, gaps=replace(changed.gaps, gain_per_cycle=None))
    assert "Not confirmed: the fresh data that were given (normal_1400rpm) were not judged." in verdict_lines(
        lost
    )
    # what was held out of the data was not given
    held = replace(changed, fresh=changed.data, gaps=replace(changed.gaps, source="cycles"))
    assert next_step(held).startswith("test it on data it has not seen: ")


def test_more_than_the_effects_explain_is_said(repaired, unnamed):
    gone = tuple(replace(one, why_withdrawn=REFUSED) for one in repaired.effects)
    changed = replace(repaired, unknown=unnamed.unknown, withdrawn=gone, messages=("a note",))
    lines = verdict_lines(changed)
    assert (
        "The residuals still hold more: a torque at the coupling that depends on its twist and looks cubic."
        in lines
    )
    assert "Found first and withdrawn, contradicted by fresh data: coulomb_friction at coupling." in lines
    assert "A note." in lines
    # at the port of the effect, which is a part of it
    assert next_step(changed).startswith("look at the curve of the unknown torque")
    elsewhere = replace(changed, unknown=replace(unnamed.unknown, port="load"))
    assert next_step(elsewhere).startswith("look at the figures of the residuals after the repair")


def test_an_amplitude_without_error_and_parameters_that_stayed(repaired):
    key = next(iter(repaired.effects[0].parameters))
    bare = replace(repaired.effects[0], parameters={key: Estimate(0.004, None, "1")})
    assert effect_words(bare, repaired).endswith("(coulomb_friction at coupling), torque 0.004")
    still = replace(repaired, fit=replace(repaired.fit, estimates=dict(repaired.null_fit.estimates)))
    assert moved_parameters(still) == ""


def test_coloured_noise_is_not_called_white(nothing_missing):
    noise = replace(nothing_missing.noise, colour={"misfire_1200rpm/omega": 2}, is_coloured=True)
    line = verdict_lines(replace(nothing_missing, noise=noise))[0]
    left = "what an autoregression of the coloured noise leaves is white; others may hide in it"
    assert line.startswith("No effect of the library is missing")
    assert line.endswith(f"at α = 0.01, and {left}.")


def test_a_gain_that_is_no_more_than_chance_is_not_a_refusal(repaired):
    gain = PairedGain(4.0, 3.0, 5, False)
    changed = replace(repaired, confirmed=False, gaps=replace(repaired.gaps, gain_per_cycle=gain))
    lines = verdict_lines(changed)
    assert "Not confirmed by fresh records, gain of chi-squared 4 ± 3 per cycle over 5 cycles." in lines
    assert lines[-1] == (
        "Next: test it on more fresh data before you use it: those that were given do not confirm it."
    )


def test_fresh_data_that_do_not_fit_are_no_reason_to_go_on(white):
    gaps = white.gaps
    own = replace(gaps.estimation_after, gap=replace(gaps.estimation_after.gap, samples=400))
    wide = replace(own, gap=replace(own.gap, chi2_per_sample=9.0), whiteness_p={"fresh": {"omega": 1e-9}})
    changed = replace(white, gaps=replace(gaps, estimation_after=own, validation_after=wide))
    assert fresh_misfit(white) is None
    assert fresh_misfit(changed).startswith("the fresh data do not fit: chi2/N is 9 there and ")
    assert verdict_lines(changed)[-1] == (
        "Next: look for what is missing in the fresh records: give them as data of the search."
    )
    assert mood(changed) == "poor"
    # a white residual is louder noise, unless it is more than any sensor's would be
    louder = replace(wide, whiteness_p={"fresh": {"omega": 0.3}})
    noisier = replace(white, gaps=replace(gaps, estimation_after=own, validation_after=louder))
    assert fresh_misfit(noisier).startswith("the fresh data are noisier: chi2/N is 9 there and ")
    assert headline(noisier).endswith(", but fresh data are noisier: chi2/N 9")
    assert not verdict_lines(noisier)[-1].startswith("Next: look for what is missing in the fresh records")
    far = replace(louder, gap=replace(own.gap, chi2_per_sample=100.0))
    lost = replace(white, gaps=replace(gaps, estimation_after=own, validation_after=far))
    assert fresh_misfit(lost).startswith("the fresh data do not fit")
    # no noise of the same sensors is so much louder: what is so far off is missing, white or not
    told = held_to_fresh_data(lost)
    assert (told.verdict, *told.unknown.tests) == ("unnamed", "fresh data")
    assert held_to_fresh_data(noisier).verdict == "nothing missing"


def test_one_output_that_does_not_fit_is_not_made_up_for_by_others(white):
    """Four of five outputs within their noise, and the fifth at four times: 1.6 of all together."""
    gaps, names = white.gaps, ["omega", "a", "b", "c", "d"]
    known = {"omega": white.noise.sigma["omega"], **dict.fromkeys(names[1:], (1.0, True))}
    sigma = {name: level for name, (level, _) in known.items()}
    first = replace(gaps.estimation_after.gap, chi2_per_sample=1.0, samples=2000, rmse=sigma)
    own = replace(gaps.estimation_after, gap=first)
    rmse = {**sigma, "d": 2.0}
    coloured = {"fresh": {"d": 1e-9}}
    wide = replace(own, gap=replace(first, chi2_per_sample=1.4, rmse=rmse), whiteness_p=coloured)
    noise = replace(white.noise, sigma=known, colour={}, scatter={}, is_coloured=False)
    changed = replace(white, noise=noise, gaps=replace(gaps, estimation_after=own, validation_after=wide))
    assert fresh_misfit(changed).startswith(
        "the fresh data do not fit: chi2/N of d is 4 there and 1 on the data"
    )
    within = replace(wide, left={"d": 0.26})
    explained = replace(changed, gaps=replace(changed.gaps, validation_after=within))
    assert fresh_misfit(explained) is None


def test_nothing_is_called_missing_no_longer_where_fresh_data_swing(white):
    gaps = white.gaps
    own = replace(gaps.estimation_after, gap=replace(gaps.estimation_after.gap, samples=400))

    def on_fresh(p):
        wide = replace(own, gap=replace(own.gap, chi2_per_sample=9.0), whiteness_p={"fresh": {"omega": p}})
        return held_to_fresh_data(
            replace(white, gaps=replace(gaps, estimation_after=own, validation_after=wide))
        )

    louder = on_fresh(0.3)
    assert louder.verdict == "nothing missing"
    assert louder.messages[0].startswith("the fresh data are noisier")
    swings = on_fresh(1e-9)
    assert swings.verdict == "unnamed"
    assert dict(swings.unknown.tests) == {"fresh data": 1e-9}
    assert swings.unknown.sentence.startswith("the fresh data do not fit: chi2/N is 9 there and ")
    assert headline(swings) == (
        "something is missing that the data of the search do not show: the fresh data do not fit"
    )
    assert next_step(swings).startswith("look for what is missing in the fresh records")


@pytest.mark.parametrize(("p", "confirmed"), [(0.3, True), (1e-9, False)])
def test_louder_fresh_noise_takes_no_confirmation_back(white, p, confirmed):
    """A lag that closed chi2/N from 5.8 to 2.35 was not confirmed, as noise 1.5 times as loud counted as a gap."""
    gaps = white.gaps
    own = replace(
        gaps.estimation_after, gap=replace(gaps.estimation_after.gap, chi2_per_sample=1.0, samples=400)
    )
    before = replace(own, gap=replace(own.gap, chi2_per_sample=5.8))
    after = replace(own, gap=replace(own.gap, chi2_per_sample=2.35), whiteness_p={"fresh": {"omega": p}})
    sides = replace(gaps, estimation_after=own, validation_before=before, validation_after=after)
    found = held_to_fresh_data(replace(white, verdict="named", confirmed=True, gaps=sides))
    assert found.confirmed is confirmed


def test_fresh_data_that_errors_of_the_parameters_explain_promise_no_more(white):
    gaps = white.gaps
    own = replace(gaps.estimation_after, gap=replace(gaps.estimation_after.gap, samples=28))
    wide = replace(own.gap, chi2_per_sample=11.3, samples=12)
    vague = replace(own, gap=wide, within_errors=0.7, parameters_p=0.2)
    changed = replace(white, gaps=replace(gaps, estimation_after=own, validation_after=vague))
    assert fresh_misfit(changed) is None
    assert headline(changed) == (
        "nothing is missing that these data could show, but fresh data agree only within the errors of its parameters: "
        "chi2/N 11.3"
    )
    assert (
        held_to_fresh_data(changed)
        .messages[0]
        .startswith("on the fresh data chi2/N is 11.3, and 0.7 within the errors of the parameters")
    )
    assert next_step(changed).startswith(
        "record more before you use the model, or give the fresh records as data"
    )
    assert mood(changed) == "poor"
    near = replace(vague, gap=replace(wide, chi2_per_sample=1.4))
    said = replace(white, gaps=replace(gaps, estimation_after=own, validation_after=near))
    assert headline(said) == "nothing is missing that these data could show"
    assert mood(said) == "good"


def _on_fresh(repaired, found, before=100.0, p=1e-9, **changes):
    """The repair where the data of the search are described, and chi-squared per sample of the fresh ones is so."""
    gaps = repaired.gaps
    own = replace(
        gaps.estimation_after, gap=replace(gaps.estimation_after.gap, chi2_per_sample=1.0, samples=400)
    )
    sides = {
        "validation_before": replace(own, gap=replace(own.gap, chi2_per_sample=before)),
        "validation_after": replace(
            own, gap=replace(own.gap, chi2_per_sample=found), whiteness_p={"fresh": {"omega": p}}
        ),
    }
    coloured = changes.pop("coloured", False)
    colour = repaired.noise.colour if coloured else {}
    noise = replace(repaired.noise, colour=colour, scatter={}, is_coloured=coloured)
    return replace(repaired, gaps=replace(gaps, estimation_after=own, **sides), noise=noise, **changes)


@pytest.mark.parametrize("words", LAWS_CUT)
def test_what_fresh_data_do_not_fit_is_no_name_where_laws_were_not_tried(repaired, words):
    """A loss that grows with S^2 was "missing, confirmed" of one that saturates, at chi2/N 4.9 on fresh data, the time
    being up before a law was tried."""
    kept = held_to_fresh_data(_on_fresh(repaired, 4.9))
    assert (kept.verdict, kept.confirmed) == ("named", True)
    cut = held_to_fresh_data(_on_fresh(repaired, 4.9, messages=(words,)))
    assert cut.verdict == "unnamed"
    assert "the time was up before laws that no effect names were tried" in cut.unknown.sentence
    fits = held_to_fresh_data(_on_fresh(repaired, 1.0, p=0.5, messages=(words,)))
    assert (fits.verdict, fits.confirmed) == ("named", True)
    more = _on_fresh(repaired, 1.0, p=0.5, messages=(words,), unknown=Unknown("something else acts", {}))
    told = held_to_fresh_data(more)
    assert (told.verdict, told.confirmed) == ("named", None)
    assert ", or a law that the library lacks, which was not tried, unconfirmed" in headline(told)


def test_an_event_of_one_record_is_no_name_where_fresh_data_do_not_fit(repaired):
    """Two load steps of opposite signs were "missing, confirmed" of steam that is lost above 99 degrees."""
    model = repaired.fit.model.with_effect(LoadStep(), at="load")
    fit = replace(repaired.fit, model=model)
    held = held_to_fresh_data(_on_fresh(repaired, 4.9, fit=fit))
    assert held.verdict == "unnamed"
    assert "an event that happens in one record may imitate what is missing" in held.unknown.sentence
    assert held_to_fresh_data(_on_fresh(repaired, 1.0, p=0.5, fit=fit)).verdict == "named"
    louder = held_to_fresh_data(_on_fresh(repaired, 2.0, p=0.5, fit=fit))
    assert louder.verdict == "named"


def test_several_effects_that_leave_a_coloured_tenth_beside_more_are_no_name(repaired):
    """A drum's radius that grows was "a lag of the sensor and a spring, confirmed", and colour was what they left."""
    more = Unknown("the parameter r is not constant", {})
    two = (*repaired.effects, replace(repaired.effects[0], at="engine"))
    left = _on_fresh(repaired, 1.2, before=5.0, coloured=True, effects=two, unknown=more)
    held = held_to_fresh_data(left)
    assert held.verdict == "unnamed"
    assert held.unknown.sentence == "the parameter r is not constant"
    for changes in ({"effects": repaired.effects}, {"unknown": None}):
        assert held_to_fresh_data(replace(left, **changes)).verdict == "named"


def test_a_gain_confirms_nothing_where_the_fresh_data_do_not_fit(repaired):
    gaps = repaired.gaps
    own = replace(
        gaps.estimation_after, gap=replace(gaps.estimation_after.gap, chi2_per_sample=1.0, samples=400)
    )

    def on_fresh(chi2, within=None, chance=None, before=60.0, effects=repaired.effects):
        first = replace(own, gap=replace(own.gap, chi2_per_sample=before))
        fresh = replace(
            own, gap=replace(own.gap, chi2_per_sample=chi2), within_errors=within, parameters_p=chance
        )
        noise = replace(repaired.noise, scatter={}, colour={}, is_coloured=False)
        return held_to_fresh_data(
            replace(
                repaired,
                confirmed=True,
                noise=noise,
                effects=effects,
                gaps=replace(gaps, estimation_after=own, validation_before=first, validation_after=fresh),
            )
        )

    far = on_fresh(3.6e5)
    assert far.confirmed is False
    assert far.messages[0].startswith(
        "the fresh data do not fit: chi2/N is 3.6e+05 there and 1 on the data of the search"
    )
    assert "not confirmed by fresh data, which the repaired model does not fit: chi2/N 3.6e+05" in headline(
        far
    )
    assert on_fresh(1.1).confirmed is True
    # errors of the parameters explain it: no promise where most of the gap is left, 7 of 7.7 times the noise
    vague = on_fresh(50.0, 1.05, 0.3)
    assert vague.confirmed is None
    assert ", unconfirmed: fresh data agree only within the errors of its parameters: chi2/N 50" in headline(
        vague
    )
    closed = on_fresh(50.0, 1.05, 0.3, before=5000.0)
    assert closed.confirmed is True
    assert "confirmed on fresh data, but fresh data agree only within the errors" in headline(closed)
    # an error of a sensor bends to what a missing law does to one record
    sensor = (replace(repaired.effects[0], name="sensor_offset", at="sensor_omega"),)
    assert on_fresh(50.0, 1.05, 0.3, before=5000.0, effects=sensor).confirmed is None
    assert on_fresh(1.1, effects=sensor).confirmed is True
    # or they would have to be larger than they are
    moved = on_fresh(50.0, 1.05, 1e-9)
    assert moved.confirmed is False
    assert "they ask for other parameters than the fit's, beyond their errors (p 1e-09)" in moved.messages[0]


def test_what_fresh_data_do_not_confirm_may_be_chance(repaired, monkeypatch):
    """A finding of p = 0.003 that fresh data do not confirm is none, unless it is as improbable as one that they do."""
    gaps, noise = repaired.gaps, replace(repaired.noise, scatter={}, colour={}, is_coloured=False)
    calm = replace(gaps.estimation_before.gap, chi2_per_sample=1.0, samples=400)
    own = replace(gaps.estimation_before, gap=calm, whiteness_p={"fresh": {"omega": 0.4}})
    gaps = replace(
        gaps, estimation_before=own, validation_before=own, validation_after=own, gain_per_cycle=None
    )

    def judged(p, *, confirmed=False, tests=None, odds=-np.inf, **changed):
        effects = tuple(replace(one, p_value=p) for one in repaired.effects)
        unknown = None if tests is None else Unknown("a law", tests)
        given = {"noise": noise, "gaps": gaps, "stopped": "", **changed}
        return held_to_chance(
            replace(repaired, effects=effects, confirmed=confirmed, unknown=unknown, **given), odds
        )

    chance = judged(3e-3)
    assert (chance.verdict, chance.effects, chance.confirmed) == ("nothing missing", (), None)
    assert chance.fit is repaired.null_fit
    assert [one.key for one in chance.withdrawn] == [one.key for one in repaired.effects]
    assert chance.messages[0].endswith("it has to be as improbable as what they confirm, p < 0.00023")
    assert judged(3e-3, odds=8.0).verdict == "nothing missing"
    for kept in (
        judged(1e-4),
        judged(3e-3, confirmed=True),
        judged(3e-3, tests={"whiteness": 1e-5}),
        judged(0.95, odds=9.0),  # by Markov's inequality e^-9 of chance, whatever its score
        judged(3e-3, stopped="the time budget"),
        judged(3e-3, gaps=replace(gaps, validation_before=None)),
        judged(
            3e-3, gaps=replace(gaps, validation_before=replace(own, whiteness_p={"fresh": {"omega": 1e-9}}))
        ),
        judged(
            3e-3, gaps=replace(gaps, validation_before=replace(own, gap=replace(calm, chi2_per_sample=3.0)))
        ),
    ):
        assert kept.verdict == repaired.verdict
        assert kept.effects
    # fresh data that show nothing of it, and such as nearly confirm it: both together count
    for mean, verdict in ((-2.0, "nothing missing"), (5.0, repaired.verdict)):
        paired = replace(gaps, gain_per_cycle=PairedGain(mean, 4.0, 12, confirmed=False))
        assert judged(7e-5, gaps=paired).verdict == verdict
    # tests beside the library have a false-alarm rate of their own
    alone = replace(
        repaired, noise=noise, confirmed=None, stopped="", effects=(), withdrawn=(), verdict="unnamed"
    )
    asked = replace(alone, gaps=gaps, unknown=Unknown("a law", {"a function of speed at load": 3e-3}))
    assert held_to_chance(asked) is asked
    # colour of the noise says nothing of fresh whiteness
    colour = replace(noise, colour={"misfire_1200rpm/omega": 2}, is_coloured=True)
    swings = replace(own, whiteness_p={"fresh": {"omega": 1e-9}})
    coloured = judged(3e-3, noise=colour, gaps=replace(gaps, validation_before=swings))
    assert coloured.verdict == "nothing missing"
    # unless what is left is no noise of a sensor, whatever names it
    monkeypatch.setattr(by_chance, "why_no_noise", lambda *_: "the rest is predicted from its own past")
    assert judged(3e-3, noise=colour).verdict == repaired.verdict
    assert judged(3e-3).verdict == "nothing missing"  # it is white


def test_an_interrupted_search_blames_no_fit(no_answer):
    stopped = replace(no_answer, status="interrupted")
    assert next_step(stopped) == "run it again and let it end; repair.fit is the best model so far"
    assert verdict_lines(stopped)[0] == "No answer: interrupted."


def test_fresh_data_that_were_not_judged_are_not_asked_for_again(repaired):
    words = "it was not judged on the fresh data: looking for its initial states there had cost too much"
    changed = replace(repaired, confirmed=None, messages=(words,))
    assert next_step(changed).startswith("give it more time, budget=..., or shorter fresh records")


@pytest.mark.parametrize(
    ("before", "coloured", "confirmed"), [(0.2, True, None), (0.2, False, True), (1.0, True, True)]
)
def test_what_is_closed_confirms_nothing_where_more_is_left_that_may_be_noise_or_not(
    repaired, before, coloured, confirmed
):
    gaps, colour = repaired.gaps, {"fresh/omega": 3} if coloured else {}
    sides = [
        replace(
            gaps.estimation_after, gap=replace(gaps.estimation_after.gap, chi2_per_sample=chi2, rmse=rmse)
        )
        for chi2, rmse in ((9.0, {"omega": before}), (1.0, {"omega": 0.17}))
    ]
    own = replace(gaps.estimation_after, gap=sides[1].gap)
    noise = replace(
        repaired.noise, scatter={}, colour=colour, sigma={"omega": (0.1, True)}, is_coloured=bool(colour)
    )
    gaps = replace(gaps, estimation_after=own, validation_before=sides[0], validation_after=sides[1])
    found = held_to_fresh_data(replace(repaired, confirmed=True, noise=noise, gaps=gaps))
    assert found.confirmed is confirmed
    assert ("what is left of the fresh data is coloured" in " ".join(found.messages)) == (confirmed is None)


def test_what_is_still_unexplained_stands_in_the_headline(repaired):
    more = replace(
        repaired, unknown=Unknown("the residual of omega in run is not white", {"run/omega": 1e-9})
    )
    assert ", and more that no effect of the library names, confirmed on fresh data" in headline(more)
    assert "and more that" not in headline(replace(repaired, unknown=None))


@pytest.mark.parametrize(("chi2", "p", "more"), [(4.26, 1e-9, True), (4.26, 0.3, False), (1.0, 0.3, False)])
def test_what_fresh_data_hold_beside_what_is_named_has_no_name(repaired, chi2, p, more):
    """A hidden wall was a lag, a gain and a step, "confirmed on fresh data" of which 4.26 of chi2/N was left; what is
    white is noisier data."""
    gaps = repaired.gaps
    gap = replace(gaps.estimation_after.gap, chi2_per_sample=1.0, samples=400)
    own = replace(gaps.estimation_after, gap=gap)
    before = replace(own, gap=replace(gap, chi2_per_sample=157.0))
    after = replace(own, gap=replace(gap, chi2_per_sample=chi2), whiteness_p={"fresh": {"omega": p}})
    gaps = replace(gaps, estimation_after=own, validation_before=before, validation_after=after)
    noise = replace(repaired.noise, scatter={}, colour={}, is_coloured=False, sigma={"omega": (0.1, True)})
    first = replace(
        repaired, unknown=None, confirmed=True, gaps=gaps, noise=noise, effects=repaired.effects[:1]
    )
    found = held_to_fresh_data(first)
    assert (found.unknown is not None) == more
    assert ("and more that no effect of the library names" in headline(found)) == more


def test_what_is_named_in_coloured_noise_says_that_more_may_hide(repaired):
    plain = replace(repaired, unknown=None, noise=replace(repaired.noise, is_coloured=False))
    coloured = replace(plain, noise=replace(plain.noise, colour={"run/omega": 3}, is_coloured=True))
    hidden = "; the residual is coloured, and more may hide in it"
    assert headline(coloured) == headline(plain) + hidden
    known = replace(
        coloured, unknown=Unknown("the residual of omega in run is not white", {"run/omega": 1e-9})
    )
    assert hidden not in headline(known)


@pytest.mark.parametrize(("at", "confirmed", "named"), [
    ("sensor_omega", True, True), ("sensor_omega", False, False), ("coupling", False, True)
])  # fmt: skip
def test_errors_of_sensors_are_named_where_fresh_data_confirm_them(repaired, at, confirmed, named):
    one = replace(
        repaired.effects[0], at=at, name="sensor_offset" if at != "coupling" else "coulomb_friction"
    )
    gaps = replace(repaired.gaps, gain_per_cycle=replace(repaired.gaps.gain_per_cycle, confirmed=confirmed))
    found = held_to_fresh_data(
        replace(repaired, effects=(one,), confirmed=confirmed, unknown=None, gaps=gaps)
    )
    assert (found.verdict == repaired.verdict) == named
    if not named:
        assert (found.verdict, found.effects) == ("unnamed", ())
        assert [e.key for e in found.withdrawn] == [one.key]
        assert found.withdrawn[0].why_withdrawn == "not confirmed by fresh data"
        assert found.fit is repaired.null_fit
        assert found.gaps.validation_after is repaired.gaps.validation_before
        assert "fresh data do not confirm that a sensor is at fault" in found.unknown.sentence


def test_errors_of_the_parameters_that_explain_little_are_not_blamed(white):
    gaps = white.gaps
    own = replace(
        gaps.estimation_after, gap=replace(gaps.estimation_after.gap, chi2_per_sample=0.93, samples=400)
    )
    wide = replace(own.gap, chi2_per_sample=1.43, samples=400)
    for within, said in ((1.39, False), (1.0, True)):
        fresh = replace(own, gap=wide, within_errors=within, parameters_p=0.2)
        changed = replace(white, gaps=replace(gaps, estimation_after=own, validation_after=fresh))
        assert ("within the errors of its parameters" in headline(changed)) == said


@pytest.mark.parametrize(
    ("gain", "words"),
    [
        (PairedGain(1.8, 1.3, 10, False), "not confirmed by fresh data"),
        (PairedGain(-2.0, 1.3, 10, False), "not confirmed by fresh data"),
        (PairedGain(-20.0, 1.3, 10, False), "contradicted by fresh data"),
    ],
)
def test_only_a_loss_beyond_chance_contradicts_what_is_withdrawn(repaired, gain, words):
    one = replace(repaired.effects[0], at="sensor_omega", name="sensor_offset")
    gaps = replace(repaired.gaps, gain_per_cycle=gain)
    found = held_to_fresh_data(replace(repaired, effects=(one,), confirmed=False, unknown=None, gaps=gaps))
    assert f"Withdrawn: {words}" in str(found).splitlines()
    assert f"Found first and withdrawn, {words}: sensor_offset at sensor_omega." in verdict_lines(found)


def test_a_change_of_likelihood_is_that_of_what_was_withdrawn(repaired):
    """It stands below a gap that is the same before and after."""
    assert "with what was withdrawn" not in " ".join(str(repaired).split())
    found = withdrawn(repaired, UNCONFIRMED, None)
    (line,) = [own for own in str(found).splitlines() if "2 ln(likelihood)" in own]
    assert "per cycle with what was withdrawn, over 10 cycles" in line
    assert len(line) <= 100


def test_effects_that_were_withdrawn_for_other_reasons_stand_apart(repaired):
    first, then = (
        replace(repaired.effects[0], name=name, why_withdrawn=why)
        for name, why in (("backlash", REFUSED), ("load_step", UNCONFIRMED))
    )
    lines = str(replace(repaired, withdrawn=(first, then))).splitlines()
    titles = [line for line in lines if line.startswith(("Found", "Withdrawn"))]
    assert titles == [
        "Found",
        "Withdrawn: contradicted by fresh data",
        "Withdrawn: not confirmed by fresh data",
    ]


@pytest.mark.parametrize(
    ("lead", "words"),
    [
        (0.7, ""),
        (0.4, "within a factor of e the data tell none apart: the simplest leads, or the one found first"),
        (
            0.1,
            "what is more probable does not lead where its fit did not end, its size is within its errors, or",
        ),
    ],
)
def test_a_lead_that_is_not_the_most_probable_is_explained(repaired, lead, words):
    members = (
        Member("coulomb_friction", "coupling", 1.0, lead),
        Member("backlash", "coupling", 0.98, 1 - lead),
    )
    changed = replace(repaired, verdict="class", effects=(replace(repaired.effects[0], members=members),))
    for text in (" ".join(str(changed).split()), verdict_lines(changed)[1]):
        assert (f"; {words}" in text) if words else " lead" not in text


def test_what_chance_may_have_made_asks_for_more_records(nothing_missing, repaired):
    gone = tuple(replace(one, why_withdrawn=UNCONFIRMED, p_value=1e-3) for one in repaired.effects)
    words = "record more before you rely on it: what may be missing was not told from chance"
    assert next_step(replace(nothing_missing, withdrawn=gone)) == words
    assert next_step(nothing_missing) != words
