"""Steps between samples: they follow each other without gaps, and carry the channels' values at their ends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.simulation.grid import Grid
from casadi_engine.simulation.intervals import cut
from casadi_engine.simulation.step_layout import lay_steps


def unequal(samples, seed=0, holds=("first", "zero")):
    rng = np.random.default_rng(seed)
    time = 3.0 + np.concatenate([[0.0], np.cumsum(rng.uniform(0.01, 1.0, samples - 1))])
    channels = rng.normal(size=(len(holds), samples))
    return Grid(time[0], 0.5, samples, channels, holds, {}, time)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(2, 40), st.sampled_from([1, 2, 5, 16, None]), st.integers(0, 99))
def test_steps_follow_each_other(samples, length, seed):
    grid = unequal(samples, seed)
    plan = cut(grid, length)
    counts = np.random.default_rng(seed).integers(1, 5, samples - 1)
    shares = np.random.default_rng(seed).uniform(0.1, 1.0, counts.sum())
    cell = np.repeat(np.arange(samples - 1), counts)
    shares /= np.bincount(cell, shares)[cell]
    for parts in (1, 3):
        check_order(grid, plan, counts, lay_steps(grid, plan, counts, parts), parts)
        layout = lay_steps(grid, plan, counts, parts, shares)
        check_order(grid, plan, counts, layout, parts)
        np.testing.assert_allclose(
            layout.length[: layout.steps], (np.diff(grid.time)[cell] * shares)[layout.number], rtol=1e-9
        )


def check_order(grid, plan, counts, layout, parts):
    """All steps of every interval, one after the other, and the parts of each."""
    assert layout.steps == layout.rows[-1] == parts * counts.sum()
    assert len(layout.time) == len(layout.length) == len(layout.part) == layout.steps + plan.m
    np.testing.assert_array_equal(np.bincount(layout.number), parts)
    assert (np.diff(np.diff(layout.rows)) <= 0).all()
    assert (layout.length[layout.steps :] == 0).all()
    assert (layout.length[: layout.steps] > 0).all()
    for (own, after), (same, follows) in zip(layout, list(reversed(layout))[::-1], strict=True):
        assert own == same
        np.testing.assert_array_equal(after, follows)
    for i in range(plan.m):
        own, step = [], layout.at[0, i]
        while step < layout.steps:
            own.append(step)
            step = layout.after[step]
        assert step == layout.steps + i
        assert (layout.interval[own] == i).all()
        assert (layout.part[own] == np.tile(np.arange(parts), len(own) // parts)).all()
        whole = own[::parts]
        for k in range(1, parts):
            np.testing.assert_array_equal(layout.time[own[k::parts]], layout.time[whole])
        begins, lengths = layout.time[whole], layout.length[whole]
        np.testing.assert_allclose(begins[1:], begins[:-1] + lengths[:-1], rtol=1e-13)
        # each sample of the interval is where a step begins, or where the last one ends
        for k in range(plan.length + 1):
            sample = i * plan.length + k
            if sample < len(grid.time) and layout.at[k, i] < layout.steps:
                assert layout.time[layout.at[k, i]] == grid.time[sample]
        if len(begins):
            last = min((i + 1) * plan.length, len(grid.time) - 1)
            assert begins[-1] + lengths[-1] == pytest.approx(grid.time[last], rel=1e-13)


def test_an_interval_with_many_steps_costs_its_own_alone():
    grid = unequal(33)
    counts = np.ones(32, dtype=np.intp)
    counts[9] = 50
    layout = lay_steps(grid, cut(grid, 8), counts)
    assert layout.steps == counts.sum()
    np.testing.assert_array_equal(np.diff(layout.rows)[:8], 4)
    np.testing.assert_array_equal(np.diff(layout.rows)[8:], 1)


def test_channels_at_the_ends_of_steps():
    grid = unequal(9)
    counts = np.array([1, 3, 2, 1, 1, 4, 2, 5])
    layout = lay_steps(grid, cut(grid, 3), counts)
    real = slice(layout.steps)
    begin, end = layout.time[real], (layout.time + layout.length)[real]
    for places, found in ((begin, layout.low), (end, layout.high)):
        np.testing.assert_allclose(
            found[0][real], np.interp(places, grid.time, grid.channels[0]), rtol=0, atol=1e-12
        )
        np.testing.assert_array_equal(
            found[1][real], grid.channels[1][np.repeat(np.arange(len(counts)), counts)[layout.number]]
        )


def test_fillers_stand_where_the_model_can_be_evaluated():
    """At the ends of the intervals; behind the record's end there is nothing to evaluate: its last sample stands in."""
    grid = unequal(8)
    layout = lay_steps(grid, cut(grid, 3), np.ones(7, dtype=np.intp))
    np.testing.assert_array_equal(layout.time[layout.steps :], grid.time[[3, 6, 7]])
    np.testing.assert_array_equal(layout.low[:, layout.steps :], grid.channels[:, [3, 6, 7]])
