"""The progress bar: shown on a terminal, with what it says."""

import io
import sys

import pytest

from casadi_engine.estimation import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_no_bar_without_a_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert progress.terminal_bar(1, 10) is None


def test_no_bar_without_rich(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setitem(sys.modules, "rich.console", None)
    assert progress.terminal_bar(1, 10) is None


def test_the_bar_says_iteration_cost_and_fit(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    bar = progress.terminal_bar(2, 10)
    try:
        bar(0, 500.0, 10.0)
        bar(1, 120.0, 55.5)
        bar(0, 300.0, 30.0)
        words = bar._progress.tasks[0].fields["words"]
        assert words == "start 2/2, iteration 0, cost 300 (best 120), fit 30.00 %"
        assert bar._progress.tasks[0].completed == 10
        assert bar._progress.tasks[0].total == 20
    finally:
        bar.close()


def test_the_bar_is_taken_away_when_a_fit_fails(monkeypatch, run_up, refused):
    import casadi_engine as ce

    closed = []

    class Bar:
        def __call__(self, *told):
            raise ZeroDivisionError("mine")

        def close(self):
            closed.append(True)

    with pytest.raises(ZeroDivisionError):
        ce.estimate(ce.one_inertia(), run_up(), progress=Bar())
    assert closed == [True]
