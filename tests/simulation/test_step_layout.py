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
    layout = lay_steps(grid, plan, counts)
    assert layout.time.shape == layout.length.shape == layout.cell.shape == (layout.steps, plan.m)
    assert int((layout.cell >= 0).sum()) == counts.sum()
    np.testing.assert_array_equal(np.bincount(layout.cell[layout.cell >= 0]), counts)
    assert (layout.length[layout.cell < 0] == 0).all()
    assert (layout.length[layout.cell >= 0] > 0).all()
    for i in range(plan.m):
        own = layout.cell[:, i] >= 0
        begins, lengths = layout.time[own, i], layout.length[own, i]
        np.testing.assert_allclose(begins[1:], begins[:-1] + lengths[:-1], rtol=1e-13)
        # each sample of the interval is where a step begins, or where the last one ends
        for k in range(plan.length + 1):
            sample = i * plan.length + k
            if sample < samples and layout.at[k, i] < own.sum():
                assert begins[layout.at[k, i]] == grid.time[sample]
        if len(begins):
            last = min((i + 1) * plan.length, samples - 1)
            assert begins[-1] + lengths[-1] == pytest.approx(grid.time[last], rel=1e-13)


def test_channels_at_the_ends_of_steps():
    grid = unequal(9)
    layout = lay_steps(grid, cut(grid, 3), np.array([1, 3, 2, 1, 1, 4, 2, 5]))
    real = layout.cell >= 0
    begin, end = layout.time[real], (layout.time + layout.length)[real]
    for places, found in ((begin, layout.low), (end, layout.high)):
        np.testing.assert_allclose(
            found[0][real], np.interp(places, grid.time, grid.channels[0]), rtol=0, atol=1e-12
        )
        np.testing.assert_array_equal(found[1][real], grid.channels[1][layout.cell[real]])


def test_fillers_stand_where_the_model_can_be_evaluated():
    """Behind the record's end there is nothing to evaluate: its last sample stands in."""
    grid = unequal(8)
    layout = lay_steps(grid, cut(grid, 3), np.ones(7, dtype=np.intp))
    fillers = layout.cell < 0
    assert fillers.any()
    np.testing.assert_allclose(layout.time[:, -1][fillers[:, -1]], grid.time[-1])
    np.testing.assert_allclose(layout.low[0, :, -1][fillers[:, -1]], grid.channels[0, -1])
