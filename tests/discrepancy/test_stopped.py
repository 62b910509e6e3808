"""Ctrl-C and the time budget: the best structure so far, and what was not searched."""

import os
import signal
import threading
import time
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.deadline import ask
from casadi_engine.discrepancy.additions import Additions
from casadi_engine.discrepancy.choice import Choice
from casadi_engine.errors import EstimationError
from casadi_engine.estimation import estimate
from casadi_engine.estimation.record import RecordTerm


def rubbing(t, angle, rate):
    return -0.6 * np.tanh(rate / 0.02)


@pytest.fixture
def repaired(pendulum):
    """A repair of a decay with dry friction, in which a key is pressed when a step begins."""
    record = pendulum.decay(rubbing, samples=300)

    def of(press="", *, times=1, **options):
        def told(text):
            if press and press in text and len(pressed) < times:
                pressed.append(text)
                os.kill(os.getpid(), signal.SIGINT)

        pressed = []
        effects = ["coulomb_friction", "quadratic_drag", "constant_torque"]
        noise = ce.Noise(y=pendulum.level)
        return ce.repair(
            pendulum.model, record, effects=effects, noise=noise, starts=1, progress=told, **options
        )

    return of


def test_ctrl_c_in_the_search_gives_the_best_so_far(repaired, monkeypatch):
    # every effect is worth a refit, so that some are left when the key is pressed
    monkeypatch.setattr(Additions, "_promising", lambda self, best, step, keys, **_: list(keys))
    before = signal.getsignal(signal.SIGINT)
    found = repaired("refit 2 of 3")
    assert (found.status, found.stopped) == ("answered", "the user")
    assert [one.key for one in found.effects] == ["pivot.coulomb_friction"]
    assert found.not_searched
    # within the two seconds that are left fresh data may not be judged to their end, which is said too
    rest = set(found.not_searched) - {"the fresh data"}
    assert rest <= {"quadratic_drag at pivot", "constant_torque at pivot"}
    text = str(found)
    assert "Stopped by the user; not searched: " in text
    assert "what was not searched is not excluded" in " ".join(text.split("Next:")[1].split())
    assert not any(note.startswith("no answer for") for note in found.messages)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow  # the budget says it below
def test_ctrl_c_before_the_first_refit_says_that_nothing_was_searched(repaired):
    found = repaired("scores")
    assert (found.status, found.stopped, found.effects) == ("answered", "the user", ())
    assert "Stopped by the user; not searched: any effect" in str(found)
    assert found.verdict == "unnamed"
    assert "no refit" not in found.unknown.sentence


@pytest.mark.slow
def test_ctrl_c_in_the_fit_of_a_structure_leaves_what_was_kept_before(repaired, monkeypatch):
    def station(self, tried):
        self.tell("fit of all data")
        ask()

    monkeypatch.setattr(Choice, "station_of", station)
    found = repaired("fit of all data")
    assert (found.status, found.stopped, found.effects) == ("answered", "the user", ())
    # on a slow processor the structure whose fit was ended is listed too
    assert found.not_searched[0] == "any effect"
    assert set(found.not_searched) <= {"any effect", "coulomb_friction at pivot"}


def test_a_second_ctrl_c_ends_at_once(repaired):
    found = repaired(" of ", times=2)
    assert (found.status, found.verdict, found.stopped) == ("interrupted", None, "the user")
    assert str(found).startswith("Repair of pendulum: no answer: interrupted")


def test_ctrl_c_in_the_fit_without_effects(repaired, monkeypatch):
    """The fit takes it, and ends with its best point."""

    def pressed(*arguments, **options):
        fit = estimate(*arguments, **options)
        return replace(fit, status="interrupted")

    monkeypatch.setattr(import_module("casadi_engine.discrepancy.first_fit"), "estimate", pressed)
    found = repaired()
    assert (found.status, found.verdict) == ("interrupted", None)
    (said,) = found.messages
    assert said.startswith("interrupted in the fit without effects: nothing was searched. Give it more time")
    assert 'ce.estimate(model, data, approach="prediction")' in said


def test_the_budget_is_said_at_the_top(repaired):
    found = repaired(budget=1e-3)
    lines = str(found).splitlines()
    assert found.stopped == "the time budget"
    # on a slow processor the fresh data are not reached either
    assert any(line.startswith("Stopped by the time budget; not searched: any effect") for line in lines[1:4])
    assert "give it more time, budget=..." in str(found)


@pytest.mark.slow
def test_a_search_that_ends_by_itself_says_nothing_of_it(repaired):
    found = repaired()
    assert (found.stopped, found.not_searched) == ("", ())
    assert "not searched" not in str(found)


# ---- a model that is slow on purpose: the whole repair would take minutes


def busy(seconds):
    """Keep the processor busy, in steps as an integration has them."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        ask()


@pytest.fixture
def slow(monkeypatch):
    """Every evaluation of a record takes so long more."""
    real = RecordTerm.evaluate

    def of(seconds):
        def evaluate(self, *arguments, **options):
            busy(seconds)
            return real(self, *arguments, **options)

        monkeypatch.setattr(RecordTerm, "evaluate", evaluate)

    return of


@pytest.mark.slow  # the next one meets the same limit
def test_behind_its_budget_a_slow_repair_answers_within_two_seconds_of_the_processor(repaired, slow):
    slow(0.02)
    begun = time.process_time()
    found = repaired(budget=0.5)
    assert time.process_time() - begun < 0.5 + 2.0 + 0.5
    assert found.stopped == "the time budget"
    assert found.not_searched
    assert "give it more time, budget=..." in str(found)


def test_a_slow_fit_without_effects_gives_its_best_point(repaired, slow):
    """There is no verdict then, and a fit to go on from."""
    slow(0.15)
    begun = time.process_time()
    found = repaired(budget=0.5)
    assert time.process_time() - begun < 0.5 + 2.0 + 0.5
    assert (found.status, found.verdict, found.stopped) == ("interrupted", None, "the time budget")
    assert np.isfinite(list(found.fit.values.values())).all()


def test_without_time_for_one_evaluation_there_is_nothing_to_answer(repaired, slow):
    slow(3.0)
    begun = time.process_time()
    with pytest.raises(EstimationError, match="the time was up before the model could be evaluated") as told:
        repaired(budget=0.2)
    assert "seen: budget=0.2" in str(told.value)
    assert "do: give more time, or fewer samples" in str(told.value)
    assert time.process_time() - begun < 0.2 + 1.0 + 0.5


@pytest.mark.slow
def test_ctrl_c_within_an_evaluation_is_answered_within_two_seconds(repaired, slow):
    """No step of the search has to come to its end first."""

    def press():
        pressed.append(time.process_time())
        os.kill(os.getpid(), signal.SIGINT)

    slow(0.025)
    pressed = []
    timer = threading.Timer(1.0, press)
    timer.start()
    found = repaired()
    timer.join()
    assert time.process_time() - pressed[0] < 2.5
    assert found.stopped == "the user"
