"""One deadline for all that runs under it: by the clock, by the processor's time, by work, and inside each other."""

import math
import threading

import pytest

from casadi_engine.deadline import (
    Deadline,
    TimeUp,
    ask,
    best_wanted,
    ending_before,
    is_set,
    late,
    left,
    lifted,
    unmetered,
    was_stopped,
    work_left,
)


class Hands:
    """A clock that is put forward by hand."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Hands()


@pytest.fixture
def effort():
    return Hands()


def is_up():
    try:
        ask()
    except TimeUp:
        return True
    return False


def test_without_one_there_is_time_for_ever():
    ask(1e9)
    assert (late(), left(), best_wanted()) == (False, math.inf, True)


def test_whether_there_is_one():
    assert not is_set()
    with Deadline():
        assert is_set()
        with lifted():
            assert not is_set()
    assert not is_set()


def test_time_is_up_at_the_end_and_not_before(clock):
    with Deadline(5.0, clock=clock):
        assert left() == 5.0
        clock.now += 4.999
        assert not is_up()
        assert not late()
        clock.now += 0.001
        assert is_up()
        assert late()
        assert left() == pytest.approx(0.0)
    assert not is_up()


def test_it_runs_from_when_it_is_made(clock):
    deadline = Deadline(5.0, clock=clock)
    clock.now += 6.0
    with deadline:
        assert is_up()


def test_it_is_no_exception_that_a_failing_model_raises():
    assert not issubclass(TimeUp, Exception)


def test_of_two_inside_each_other_the_first_to_end_counts(clock):
    with Deadline(5.0, clock=clock) as outer:
        with Deadline(9.0, clock=clock) as inner:
            assert left() == 5.0
            clock.now += 6.0
            assert is_up()
            assert (inner.over, inner.late, outer.over) == (False, True, True)
        assert late()
    with Deadline(5.0, clock=clock):
        with Deadline(1.0, clock=clock) as inner:
            clock.now += 2.0
            assert is_up()
            assert inner.over
        assert not late()  # what ended alone was what was inside


def test_work_ends_it_whatever_the_clock_says(clock):
    with Deadline(work=10.0, clock=clock) as own:
        ask(4.0)
        ask(6.0)
        assert own.done == 10.0
        assert not late()
        with pytest.raises(TimeUp):
            ask(1.0)
        assert late()


def test_work_counts_in_all_that_are_around():
    with Deadline() as outer, Deadline() as inner:
        ask(3.0)
        with Deadline(work=1.0), pytest.raises(TimeUp):
            ask(2.0)
        assert (outer.done, inner.done) == (5.0, 5.0)
        assert (outer.late, inner.late) == (False, False)


def test_work_that_is_left_is_the_least_of_all_around():
    assert work_left() == math.inf
    with Deadline(work=10.0), Deadline(work=8.0):
        ask(3.0)
        assert work_left() == 5.0
        with Deadline():
            ask(4.0)
            assert work_left() == 1.0
    with Deadline(work=1.0), pytest.raises(TimeUp):
        ask(2.0)
    with Deadline(work=1.0) as own:
        own.done = 2.0
        assert work_left() == 0.0


def test_a_stop_ends_it_now_and_cannot_be_taken_back(clock):
    with Deadline(clock=clock) as deadline:
        assert not is_up()
        assert not was_stopped()
        deadline.stop()
        assert is_up()
        with Deadline(clock=clock):
            assert was_stopped()
        deadline.stop()
        clock.now -= 50.0  # a clock that runs back revives nothing
        assert is_up()


def test_spare_time_is_the_processors_and_begins_at_the_end(clock, effort):
    """A machine that is busy with other things takes nothing of it."""
    with Deadline(5.0, spare=2.0, clock=clock, effort=effort) as deadline:
        effort.now += 70.0
        clock.now += 5.0
        assert is_up()
        clock.now += 1000.0
        with deadline.spared(0.5):
            assert not is_up()
            effort.now += 0.999
            assert not is_up()
            effort.now += 0.001
            assert is_up()
            with deadline.spared(1.0):
                assert not is_up()
                effort.now += 1.0
                assert is_up()
            assert is_up()
        assert is_up()


def test_spare_time_is_none_before_the_end(clock, effort):
    with Deadline(5.0, spare=2.0, clock=clock, effort=effort) as deadline, deadline.spared(1.0):
        effort.now += 30.0
        assert not is_up()
        assert left() == 7.0
        clock.now += 5.0
        assert not is_up()
        effort.now += 2.0
        assert is_up()


def test_spare_time_behind_a_stop(clock, effort):
    with Deadline(spare=2.0, clock=clock, effort=effort) as deadline:
        effort.now += 1.0
        deadline.stop()
        effort.now += 1.5
        assert is_up()
        with deadline.spared(1.0):
            assert not is_up()
            effort.now += 0.5
            assert is_up()


def test_time_that_is_kept_ends_what_runs_now_earlier(clock, effort):
    """By a share of the spare time; outside of it nothing has ended, and all of the spare time is left."""
    with Deadline(5.0, spare=2.0, clock=clock, effort=effort) as deadline:
        with deadline.spared(-0.5):
            assert left() == 4.0
            clock.now += 3.999
            assert not is_up()
            clock.now += 0.001
            assert is_up()
            assert (deadline.over, left()) == (True, pytest.approx(0.0))
        assert not is_up()
        assert left() == pytest.approx(1.0)
        with deadline.spared(-1.0):
            assert is_up()
        clock.now += 1.0
        assert is_up()
        with deadline.spared(1.0):
            assert not is_up()
            effort.now += 1.999
            assert not is_up()
            effort.now += 0.001
            assert is_up()


def test_spare_time_begins_when_what_kept_it_is_over(clock, effort):
    """What went on beyond the end, as it asked late, takes nothing of it."""
    with Deadline(5.0, spare=2.0, clock=clock, effort=effort) as deadline:
        with deadline.spared(-0.5):
            clock.now += 50.0
            effort.now += 50.0
            assert is_up()
        with deadline.spared(0.5):
            assert not is_up()
            effort.now += 1.0
            assert is_up()
        assert is_up()


def test_more_time_is_kept_than_there_is(clock):
    with Deadline(1.0, spare=2.0, clock=clock) as deadline:
        with deadline.spared(-1.0):
            assert is_up()
        assert not is_up()


def test_without_an_end_no_time_is_kept(clock):
    with Deadline(spare=2.0, clock=clock) as deadline, deadline.spared(-1.0):
        clock.now += 1e6
        assert not is_up()
        assert left() == math.inf


def test_a_stop_holds_where_time_is_kept_too(clock, effort):
    with Deadline(5.0, spare=2.0, clock=clock, effort=effort) as deadline:
        with deadline.spared(-0.5):
            deadline.stop()
            assert is_up()
        assert is_up()
        with deadline.spared(0.5):
            assert not is_up()
            effort.now += 1.0
            assert is_up()


def test_kept_time_of_one_ends_what_is_inside_it(clock):
    with (
        Deadline(5.0, spare=2.0, clock=clock) as outer,
        Deadline(9.0, clock=clock) as inner,
        outer.spared(-0.5),
    ):
        clock.now += 4.0
        assert is_up()
        assert (inner.over, inner.late) == (False, True)


def test_spare_time_of_one_is_none_of_another(clock, effort):
    with (
        Deadline(5.0, spare=2.0, clock=clock, effort=effort) as outer,
        Deadline(1.0, clock=clock, effort=effort),
    ):
        clock.now += 2.0
        with outer.spared(1.0):
            assert is_up()


def test_lifted_no_deadline_holds(clock):
    with Deadline(0.0, clock=clock):
        assert is_up()
        with lifted():
            ask(5.0)
            assert (late(), left()) == (False, math.inf)
        assert is_up()


def test_what_ends_before_it_leaves_so_many_seconds_or_a_share():
    with ending_before(3.0, 0.25):
        assert left() == math.inf
    for seconds, remaining in ((3.0, 17.0), (8.0, 15.0)):
        with Deadline(20.0), ending_before(seconds, 0.25):
            assert left() == pytest.approx(remaining, abs=0.5)


def test_the_best_is_wanted_by_the_nearest_one_alone():
    with Deadline():
        assert not best_wanted()
        with Deadline(best=True):
            assert best_wanted()
            with Deadline():
                assert not best_wanted()
        assert not best_wanted()
    assert best_wanted()


def test_an_error_leaves_nothing_behind():
    with pytest.raises(ValueError, match="the model"), Deadline(0.0) as deadline, deadline.spared(1.0):
        raise ValueError("the model")
    assert not late()


def test_another_thread_has_a_time_of_its_own():
    found = []
    with Deadline(0.0):
        thread = threading.Thread(target=lambda: found.append(is_up()))
        thread.start()
        thread.join()
        assert is_up()
    assert found == [False]


def test_unmetered_work_is_not_counted_and_time_is(clock):
    with Deadline(5.0, work=10.0, clock=clock) as own:
        ask(8.0)
        with unmetered():
            ask(1000.0)
            clock.now += 6.0
            assert is_up()
        assert own.work == 10.0
    with Deadline(work=1.0):
        with unmetered():
            ask(0.5)
        assert not is_up()
        with pytest.raises(TimeUp):
            ask(1.0)
    with unmetered():  # where no deadline holds
        ask(5.0)
