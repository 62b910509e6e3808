"""A repair on one screen: what does not fit is left out whole, and counted."""

import re
from dataclasses import replace

import pytest

from casadi_engine.discrepancy.repaired import Equation, Member, NotFound
from casadi_engine.discrepancy.summary import LINES
from casadi_engine.estimation.fit import Estimate

NOTES = tuple(
    f"fresh data tell the structure of number {k} from another one of as many effects: with them it is more than a "
    f"million times as probable, and without them {k} times as probable"
    for k in range(5)
)


def joined(found):
    return " ".join(str(found).split())


@pytest.fixture(scope="module")
def crowded(repaired):
    """Two effects of large classes, five long notes, many sizes, long equations, eight outputs."""
    members = tuple(Member(f"effect_{k}", "a_rather_long_port", 0.5, 0.05) for k in range(16))
    lead = replace(repaired.effects[0], members=members)
    sizes = tuple(NotFound(f"effect_{k}", "coupling", 0.1 * (k + 1), "N m", True) for k in range(12))
    term = "d(w)/dt = " + " + ".join(f"coefficient_{k}*signal_{k}" for k in range(9))
    long = "d(z)/dt = " + " + ".join(f"coefficient_{k}*signal_{k}" for k in range(40))
    names = ["omega", *(f"a_channel_of_a_long_name_{k}" for k in range(7))]
    gaps = repaired.gaps

    def wide(side):
        gap = replace(side.gap, rmse=dict.fromkeys(names, 0.1234), fit_percent=dict.fromkeys(names, 91.234))
        return replace(side, gap=gap)

    gaps = replace(
        gaps, estimation_before=wide(gaps.estimation_before), estimation_after=wide(gaps.estimation_after),
        validation_before=wide(gaps.validation_before), validation_after=wide(gaps.validation_after),
    )  # fmt: skip
    return replace(
        repaired, verdict="class", effects=(lead, lead), not_found=sizes, messages=NOTES, gaps=gaps,
        equation=Equation("...", "...", (term, term, long)),
    )  # fmt: skip


def test_a_full_screen_leaves_out_whole_items_and_counts_them(crowded):
    lines = str(crowded).splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= 100
    words = joined(crowded)
    shown = [
        note for note in NOTES if f"Note: {note} N" in words
    ]  # whole, and another note or the next step behind
    assert f"Note: {len(NOTES) - len(shown)} more in repair.messages Next: " in words
    assert words.count("Note: ") == len(shown) + 1
    assert "and 12 more z = " not in words
    assert words.count("effect_1 at a_rather_long_port (5 %, +0.500)") == 2
    assert words.count(" more ") >= 3
    told, more = (
        len(re.findall(r"effect_\d+ at coupling [\d.]+ N m;", words)),
        re.findall(r"; and (\d+) more ", words),
    )
    assert told + int(more[0]) == 12
    # a table is there with its rows, or neither is
    head = next(k for k, line in enumerate(lines) if line.startswith("Gap   "))
    assert lines[head + 1].startswith("  found on  omega ")
    assert "more outputs in repair.gaps" in words
    assert not any(line.startswith("Parameters  ") for line in lines) or "1992" in words


def test_nothing_is_left_out_of_a_screen_with_room(repaired):
    several = replace(repaired, messages=NOTES[:3])
    words = joined(several)
    assert all(f"Note: {note}" in words for note in NOTES[:3])
    known = ("more than", "more may hide in it", "and 1 more")  # the last of parameters that are fixed
    assert " more" not in re.sub("|".join(known), "", words)
    assert "Parameters without with" in words


def test_a_table_without_rows_has_no_head(repaired):
    fixed = replace(repaired, null_fit=replace(repaired.null_fit, free=()))
    assert "Parameters" not in str(fixed)


def test_a_long_equation_is_named_and_not_cut(crowded, repaired):
    roomy = replace(repaired, equation=crowded.equation)
    words = joined(roomy)
    assert "d(z)/dt = (long: print(repair.equation.text))" in words
    assert "+ coefficient_8*signal_8" in words


def test_long_names_of_outputs_do_not_cost_the_numbers(crowded):
    rows = [line for line in str(crowded).splitlines() if line.split()[:1] == ["omega"] or "found on" in line]
    assert all(line.split()[-1] == line.split()[-1].strip("…") for line in rows)
    roomy = str(replace(crowded, effects=(), messages=(), not_found=(), equation=None))
    other = [line for line in roomy.splitlines() if line.lstrip().startswith("a_channel_of_a")]
    assert other
    assert all(line.endswith("91.234") and len(line) <= 100 for line in other)


def test_what_a_sensor_that_is_early_may_be_is_said_to_its_end(repaired):
    early = replace(
        repaired.effects[0], name="sensor_delay", at="sensor_omega",
        parameters={"sensor_omega.sensor_delay.delay": Estimate(-0.0045, 0.0006, "s")},
    )  # fmt: skip
    words = joined(replace(repaired, effects=(early,)))
    assert (
        "no sensor is early: clocks differ, it shows a share of the rate too, as behind a series resistance, or what "
        "acts has a memory that the model lacks" in words
    )
