"""report.html of a repair: one page to hand on, for every verdict."""

import re
from dataclasses import replace

from casadi_engine.discrepancy.repaired import Member, NextExperiment
from casadi_engine.estimation.fit import Estimate
from casadi_engine.report import as_html, report, text


def page(result, folder, **options):
    return report(result, folder / "report.html", **options).read_text(encoding="utf-8")


def headings(html):
    return re.findall(r"<h2>(.*?)</h2>", html)


def test_a_named_effect_on_one_page(repaired, tmp_path):
    html = page(repaired, tmp_path, arguments={"problem": "p.py"})
    assert headings(html) == [
        "Verdict", "The equations with the new term", "The effects", "Certificate: the gap before and after",
        "Parameters before and after", "Where the gap sits", "What was looked for",
        "Not found, and how small it would have to be", "Data", "How it was made",
    ]  # fmt: skip
    assert 'class="verdict good"' in html
    assert not re.search(r"https?:|@import|url\(|<link|<img", html)
    assert html.count("<figure>") == 7
    # the verdict and the picture of the gap come first
    assert (
        html.index("Something is missing: dry friction") < html.index("<figure>") < html.index("<h2>The eq")
    )
    for words in (
        "torque 8.050 ± 0.070 N m", "Confirmed by fresh records", "w_coupling = torque*tanh(rate/0.02)",
        "&lt; 1e-16", "backlash at coupling", "0.0003", "not testable: the free parameters explain all that it does",
        "4739", "cycles</td><td>2, 3, 4", "1.5 per revolution", "Fixed: ", "Written by casadi-engine",
    ):  # fmt: skip
        assert words in html, words


def test_nothing_missing_says_what_could_hide(nothing_missing, tmp_path):
    html = page(nothing_missing, tmp_path)
    assert "No effect of the library is missing that these data can show" in html  # its noise is coloured
    assert "The equations with the new term" not in headings(html)
    assert "No part of the data stands out of the noise." in html
    assert "Not found is not absent" in html
    assert 'class="verdict good"' in html
    assert "Model" in headings(html)


def test_an_unnamed_effect_shows_its_curve(unnamed, tmp_path):
    html = page(unnamed, tmp_path)
    assert "What no effect of the library explains" in headings(html)
    assert "The unknown torque that explains most of it" in html
    assert "No fresh data: the repair is not confirmed." in html
    assert "misfire_1200rpm/omega/whiteness" in html


def test_no_answer_shows_the_fit_that_failed(no_answer, tmp_path):
    html = page(no_answer, tmp_path)
    assert headings(html) == ["Verdict", "The fit without effects", "Model", "Data", "How it was made"]
    assert "No answer: the fit without effects has not converged" in html
    assert 'class="verdict poor"' in html


def test_a_class_has_its_table_and_the_next_experiment(repaired, tmp_path):
    members = (Member("coulomb_friction", "coupling", 1.0, 0.7), Member("backlash", "coupling", 0.98, 0.3))
    effect = replace(repaired.effects[0], members=members, selection_frequency=None)
    split = NextExperiment("a run-up to 1800 RPM", ("coulomb_friction and backlash",), 6.1, 1.2)
    found = dict(repaired.fit.estimates) | {"C_el": Estimate(0.0, None, "N m s/rad", at_bound="min")}
    changed = replace(
        repaired, verdict="class", effects=(effect,), next_experiment=split, fit=replace(repaired.fit, estimates=found),
        gaps=replace(repaired.gaps, source="cycles"), latent=(),
    )  # fmt: skip
    html = page(changed, tmp_path)
    assert "The class of coupling.coulomb_friction: these data do not exclude any of them" in html
    assert "+0.980" in html
    assert (
        "Next experiment: a run-up to 1800 RPM; expected separation 6.1, now 1.2 (3.3 is right in 95 %)."
        in html
    )
    assert "each record kept its last cycles for confirmation" in html
    assert "at its min bound" in html


def test_what_a_user_wrote_is_escaped(repaired, tmp_path):
    effect = replace(repaired.effects[0], sentence="<b>friction</b> & more")
    html = page(replace(repaired, effects=(effect,)), tmp_path)
    assert "<b>friction</b>" not in html
    assert "&lt;b&gt;friction&lt;/b&gt; &amp; more" in html


def test_more_records_than_are_drawn_are_counted(repaired, tmp_path):
    before, after = repaired.gaps.estimation_before, repaired.gaps.estimation_after
    trace, new = (next(iter(side.traces.values())) for side in (before, after))
    names = [f"run {k}" for k in range(5)]
    gaps = replace(
        repaired.gaps,
        estimation_before=replace(before, traces=dict.fromkeys(names, trace)),
        estimation_after=replace(after, traces=dict.fromkeys(names, new)),
    )
    html = page(replace(repaired, gaps=gaps), tmp_path)
    assert "2 more outputs are in the tables, but not drawn here." in html


def test_as_text_and_as_tables(repaired, no_answer):
    assert text(repaired) == str(repaired)
    html = as_html(repaired)
    assert html.startswith("<p><b>Something is missing: dry friction at coupling")
    assert html.count("<table>") == 2
    assert as_html(no_answer).count("<table>") == 0
