"""One line that says what is being tried and, after a few refits, how long the others may take."""

import sys

import pytest

from casadi_engine.discrepancy import progress as module
from casadi_engine.discrepancy.progress import Line, Progress, shown


def told(texts, *, step=2.0):
    """What a user reads of texts that come every `step` seconds."""
    said, now = [], [-step]

    def clock():
        now[0] += step
        return now[0]

    progress = Progress(said.append, clock=clock)
    for text in texts:
        progress(text)
    return said


def test_no_time_is_told_before_a_few_refits_are_over():
    texts = ["scores", *(f"refit {k} of 8: e{k} at p" for k in range(1, 9)), "fit with e3 at p"]
    said = told(texts)
    assert said[:4] == texts[:4]
    assert said[4] == "refit 4 of 8: e4 at p (about 10 s more for these refits)"
    assert said[7].endswith("(about 4 s more for these refits)")
    assert said[-1] == texts[-1]


def test_each_round_counts_its_own_refits():
    first = [f"refit {k} of 4: a" for k in range(1, 5)]
    said = told([*first, "scores", *(f"refit {k} of 5: b" for k in range(1, 6))], step=60.0)
    assert said[3].endswith("(about 60 s more for these refits)")
    assert [text for text in said[5:] if "more" in text] == [
        "refit 4 of 5: b (about 2 min more for these refits)",
        "refit 5 of 5: b (about 60 s more for these refits)",
    ]


def test_a_search_that_is_ending_says_so():
    said = []
    progress = Progress(said.append)
    progress.stopping = True
    progress("fresh data")
    assert said == ["stopping, Ctrl-C again ends at once: fresh data"]


def test_a_terminal_has_one_line_that_goes_away():
    written = []
    line = Line(written.append)
    line.clear()
    assert written == []
    line("fit without effects")
    line("x" * 200)
    line.clear()
    assert written[0] == "\r" + "repair: fit without effects".ljust(100)
    assert written[1] == "\r" + ("repair: " + "x" * 200)[:100]
    assert written[2] == "\r" + " " * 100 + "\r"


def test_a_terminal_is_written_to_and_anything_else_is_not(monkeypatch, capsys):
    progress, done = shown(None)
    progress("scores")
    done()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    progress, done = module.shown(None)
    progress("scores")
    done()
    assert capsys.readouterr().err.startswith("\rrepair: scores")


@pytest.mark.parametrize("quiet", [False, None])
def test_nothing_is_said_where_nothing_is_asked_for(quiet, capsys):
    progress, done = shown(quiet)
    progress("scores")
    done()
    assert capsys.readouterr().err == ""
