"""Confirmation on fresh cycles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from casadi_engine.discrepancy.confirmation import (
    CHANCE,
    Residuals,
    gains,
    gap,
    hold_out,
    is_foretold,
    paired_gain,
    share_closed,
    share_explained,
    signed_rank_sf,
)
from casadi_engine.distributions import t_sf


def residuals(shift, *, cycles=8, seed=0, sigma=0.1, n=100, record="fresh"):
    rng = np.random.default_rng(seed)
    cycle = np.repeat(np.arange(cycles), n)
    e = sigma * rng.standard_normal(cycles * n) + shift
    measured = 100 + np.sin(np.arange(cycles * n) / 9)
    return Residuals(record, "omega", e, measured, cycle, sigma)


def test_a_real_gain_is_confirmed():
    """Twice the gain of log likelihood at the level that each model leaves: 100 samples of a variance halved."""
    before, after = residuals(0.1), residuals(0.0)
    found = paired_gain([before], [after])
    assert found.confirmed is True
    assert found.refused is False
    assert found.cycles == 8
    assert found.mean == pytest.approx(100 * np.log(2), rel=0.1)
    power = [[(one.e[100 * k : 100 * k + 100] ** 2).sum() for k in range(8)] for one in (before, after)]
    wanted = 100 * np.log(np.array(power[0]) / power[1])
    np.testing.assert_allclose(gains([before], [after]), wanted, rtol=1e-6)
    assert found.mean == pytest.approx(np.mean(wanted))
    assert found.se == pytest.approx(np.std(wanted, ddof=1) / np.sqrt(8))


def test_a_loss_is_refused_and_chance_is_neither():
    chance = paired_gain([residuals(0.0)], [residuals(0.0, seed=1)])
    assert chance.confirmed is False
    assert chance.refused is False
    loss = paired_gain([residuals(0.0)], [residuals(0.1)])
    assert loss.confirmed is False
    assert loss.refused is True


def test_one_large_gain_does_not_hide_that_all_are_gains():
    """A sensor's gain that a start from rest shows: 282 +- 155 per piece, of which none is less than 42."""
    shift = np.repeat(np.array([4.0, *[0.06] * 9]), 100)
    before, after = residuals(0.0, cycles=10), residuals(0.0, cycles=10)
    found = paired_gain([replace(before, e=before.e + shift)], [after])
    assert t_sf(found.mean / found.se, 9) > CHANCE
    assert found.confirmed is True
    # as large a gain alone, between losses, says nothing
    shift[100:] = 0.0
    worse = replace(after, e=after.e + np.where(shift > 0, 0.0, 0.03))
    assert paired_gain([replace(before, e=before.e + shift)], [worse]).confirmed is False


def test_few_pieces_that_hold_all_of_a_gain_confirm_it_where_noise_alone_is_left():
    """An effect that acts in two of ten pieces alone: the others are noise with it and without."""
    shift = np.repeat([0.5, 0.4, *[0.0] * 8], 100)
    before, after = residuals(0.0, cycles=10), residuals(0.0, cycles=10)
    first = replace(before, e=before.e + shift)
    assert paired_gain([first], [replace(after, e=0.999 * after.e[::-1])]).confirmed is False
    assert is_foretold([first], [after])
    # where what is left is more than the noise, whatever it explains of it
    assert not is_foretold([first], [replace(after, e=1.2 * after.e)])
    # and where nothing was missing; or in one output of two alone
    assert not is_foretold([before], [after])
    other = replace(after, output="theta", e=1.2 * after.e)
    assert not is_foretold([first, other], [after, other])


def test_what_is_too_small_for_the_level_of_the_noise_is_foretold_along_what_an_effect_does():
    """5 standard errors along the effect are a hundredth of chi-squared, which its own scatter hides; chance makes as
    much along it no more often than it may."""
    shape = np.sin(np.arange(3000) / 7) * np.repeat([1.0, 0.3, 1.2, 0.2, 0.6, 1.5, 0.1, 0.4, 0.9, 0.3], 300)
    after = replace(residuals(0.0, cycles=10), cycle=np.repeat(np.arange(10), 300))
    random, found, false = np.random.default_rng(5), 0, 0
    for _ in range(400):
        noise = 0.97 * random.standard_normal(3000)  # a level that the search found a little too large
        own = replace(after, e=noise, measured=noise, sigma=1.0)
        law = 6.0 * shape / np.sqrt(shape @ shape)
        found += is_foretold([replace(own, e=noise + law)], [own])
        false += is_foretold([own], [replace(own, e=noise - law)])
    assert found > 380
    assert false == 0


def test_a_time_that_fresh_data_chose_is_paid_for():
    """The best step of all in noise alone, and one of 12 standard errors."""
    random, count = np.random.default_rng(3), 500
    after = replace(residuals(0.0, cycles=10), cycle=np.repeat(np.arange(10), count // 10))

    def asked(law, found):
        e = 0.97 * random.standard_normal(count) + law
        left = np.cumsum(e[::-1])[::-1]
        lengths = np.arange(count, 0, -1)
        begin = int(np.argmax(left**2 / lengths))
        step = np.where(np.arange(count) >= begin, left[begin] / lengths[begin], 0.0)
        own = replace(after, e=e, measured=e, sigma=1.0)
        return is_foretold([own], [replace(own, e=e - step)], found)

    by_chance = [asked(0.0, found=1) for _ in range(2000)]
    assert sum(by_chance) == 0
    assert sum(asked(np.repeat([0.0, 12 / np.sqrt(200)], [300, 200]), found=1) for _ in range(100)) > 90


@pytest.mark.parametrize("count", [3, 10])
def test_ranks_are_those_of_wilcoxon(count):
    for seed in range(5):
        values = np.random.default_rng(seed).standard_normal(count) + 0.3
        order = np.argsort(np.argsort(np.abs(values))) + 1
        wanted = stats.wilcoxon(values, alternative="greater", method="exact").pvalue
        assert signed_rank_sf(int(order[values > 0].sum()), count) == pytest.approx(wanted, rel=1e-9)
    middle = 70 * 71 // 4
    exact = stats.wilcoxon(np.arange(1, 71) * np.resize([1, -1], 70), alternative="greater", method="exact")
    assert signed_rank_sf(int(exact.statistic), 70) == pytest.approx(exact.pvalue, rel=0.02)
    assert signed_rank_sf(middle, 70) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("cycles", [3, 20])
def test_models_that_are_as_good_are_confirmed_and_refused_as_rarely_as_stated(cycles):
    """2.3 % each, whatever the number of cycles: Student's t."""
    runs, sure, gone = 1000, 0, 0
    for seed in range(runs):
        first, then = (residuals(0.0, cycles=cycles, seed=(k, seed, cycles), n=40) for k in (0, 1))
        found = paired_gain([first], [then])
        sure += found.confirmed
        gone += found.refused
    spread = 3.3 * np.sqrt(0.02275 * 0.97725 / runs)
    assert sure / runs == pytest.approx(0.02275, abs=spread)
    assert gone / runs == pytest.approx(0.02275, abs=spread)


def test_one_cycle_in_which_the_first_model_is_lost_does_not_outweigh_the_others():
    before, after = residuals(0.0, seed=1), residuals(0.2)
    before.e[:100] += 100.0
    found = paired_gain([before], [after])
    assert found.confirmed is False
    assert gains([before], [after])[0] > 500
    assert (gains([before], [after])[1:] < 0).all()


def test_outputs_of_a_cycle_are_counted_together():
    speed, torque = residuals(0.1), replace(residuals(0.0, seed=2), output="torque")
    then = residuals(0.0), residuals(0.0, seed=3)
    both = gains([speed, torque], [then[0], replace(then[1], output="torque")])
    alone = gains([speed], [then[0]]) + gains([torque], [replace(then[1], output="torque")])
    np.testing.assert_allclose(both, alone)


def test_models_without_any_residual_are_as_good():
    exact = replace(residuals(0.0), e=np.zeros(800))
    found = paired_gain([exact], [exact])
    assert (found.mean, found.confirmed, found.refused) == (0.0, False, False)


def test_cycles_of_several_records_and_outputs_are_paired():
    before = [residuals(0.1, cycles=2, record="a"), residuals(0.1, cycles=2, record="b")]
    after = [residuals(0.0, cycles=2, record="a"), residuals(0.0, cycles=2, record="b")]
    assert paired_gain(before, after).cycles == 4


def test_too_few_cycles_say_so():
    found = paired_gain([residuals(0.1, cycles=2)], [residuals(0.0, cycles=2)])
    assert found.confirmed is None
    assert found.refused is False
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


def test_what_is_coloured_is_not_called_closed():
    before, after = gap([residuals(0.2, cycles=50)]), gap([residuals(0.1, cycles=50)])
    white = share_closed(before, after, {"omega": 0.1}, coloured=False)
    assert white == share_explained(before, after)
    assert share_closed(before, after, {"omega": 0.1}, coloured=True) == pytest.approx(white)
    # innovations of half the size: three of four parts of what is left have a past that foretells them
    rest = share_closed(before, after, {"omega": 0.05}, coloured=True)
    left = (after.rmse["omega"] / 0.05) ** 2 - 1
    assert rest == pytest.approx(1 - left / ((before.rmse["omega"] / 0.05) ** 2 - 1))


def test_the_last_cycles_are_held_out():
    assert hold_out(range(10)) == (list(range(7)), [7, 8, 9])
    assert hold_out([0, 1]) == ([0], [1])
    assert hold_out([4]) == ([4], [])
    assert hold_out(range(10), share=0.95) == ([0], list(range(1, 10)))
