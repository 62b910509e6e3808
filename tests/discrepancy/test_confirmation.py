"""Confirmation on fresh cycles."""

import numpy as np
import pytest

from casadi_engine.discrepancy.confirmation import Residuals, gap, hold_out, paired_gain, share_explained


def residuals(shift, *, cycles=8, seed=0, sigma=0.1, n=100, record="fresh"):
    rng = np.random.default_rng(seed)
    cycle = np.repeat(np.arange(cycles), n)
    e = sigma * rng.standard_normal(cycles * n) + shift
    measured = 100 + np.sin(np.arange(cycles * n) / 9)
    return Residuals(record, "omega", e, measured, cycle, sigma)


def test_a_real_gain_is_confirmed():
    before, after = residuals(0.1), residuals(0.0)
    found = paired_gain([before], [after])
    assert found.confirmed is True
    assert found.cycles == 8
    assert found.mean == pytest.approx(100, rel=0.3)
    gains = [
        ((before.e[100 * k : 100 * k + 100] ** 2 - after.e[100 * k : 100 * k + 100] ** 2).sum()) / 0.01
        for k in range(8)
    ]
    assert found.mean == pytest.approx(np.mean(gains))
    assert found.se == pytest.approx(np.std(gains, ddof=1) / np.sqrt(8))


def test_no_gain_and_a_loss_are_not():
    assert paired_gain([residuals(0.0)], [residuals(0.0, seed=1)]).confirmed is False
    assert paired_gain([residuals(0.0)], [residuals(0.1)]).confirmed is False


def test_cycles_of_several_records_and_outputs_are_paired():
    before = [residuals(0.1, cycles=2, record="a"), residuals(0.1, cycles=2, record="b")]
    after = [residuals(0.0, cycles=2, record="a"), residuals(0.0, cycles=2, record="b")]
    assert paired_gain(before, after).cycles == 4


def test_too_few_cycles_say_so():
    found = paired_gain([residuals(0.1, cycles=2)], [residuals(0.0, cycles=2)])
    assert found.confirmed is None
    assert found.why == "2 cycles of fresh data: at least 3 are needed to tell a gain from chance"
    nothing = paired_gain([], [])
    assert nothing.confirmed is None
    assert nothing.mean is None


def test_the_gap_in_numbers():
    one = residuals(0.1, cycles=50)
    found = gap([one])
    assert found.chi2_per_sample == pytest.approx(2, rel=0.05)
    assert found.rmse["omega"] == pytest.approx(np.sqrt(np.mean(one.e**2)))
    spread = one.measured - one.measured.mean()
    assert found.fit_percent["omega"] == pytest.approx(
        100 * (1 - np.linalg.norm(one.e) / np.linalg.norm(spread))
    )
    assert found.samples == 5000


def test_the_share_of_the_gap():
    before, after = gap([residuals(0.2, cycles=50)]), gap([residuals(0.1, cycles=50)])
    assert share_explained(before, after) == pytest.approx(0.75, abs=0.05)
    assert share_explained(after, before) == -1.0
    assert share_explained(gap([residuals(0.0, sigma=0.1, seed=3)]), before, floor=5.0) == 0.0


def test_the_last_cycles_are_held_out():
    assert hold_out(range(10)) == (list(range(7)), [7, 8, 9])
    assert hold_out([0, 1]) == ([0], [1])
    assert hold_out([4]) == ([4], [])
    assert hold_out(range(10), share=0.95) == ([0], list(range(1, 10)))
