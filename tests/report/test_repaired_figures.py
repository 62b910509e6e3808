"""Figures of a repair: the numbers that they show, and that each can be drawn for every verdict."""

import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from matplotlib.figure import Figure

import casadi_engine as ce
from casadi_engine.errors import ResultError
from casadi_engine.estimation.fit import Estimate
from casadi_engine.model.declarations import Port, Ports
from casadi_engine.report import repaired_gap, repaired_latent, repaired_scores
from casadi_engine.report.figures import figures
from casadi_engine.report.repaired_gap import Pair, folded, inside_share, noise_level, order_amplitudes, pairs


def texts(figure):
    """Everything written in a figure."""
    found = [text.get_text() for text in figure.findobj(lambda one: hasattr(one, "get_text"))]
    return "\n".join(found)


def shaft(n=3000, gap=0.3, order=2.0, cycles=5, sigma=0.1, seed=0):
    """A pair whose gap is one engine order before, and noise alone after."""
    theta = np.arange(n) * cycles * 4 * np.pi / n
    noise = sigma * np.random.default_rng(seed).standard_normal(n)
    before = gap * np.cos(order * theta) + noise
    return Pair("run", "omega", "rad/s", sigma, theta / 120, before, noise, theta, False, True)


# ---- numbers


def test_the_mean_cycle_is_that_of_the_gap_and_its_noise_falls_with_the_cycles():
    pair = shaft(n=9000)
    place, mean, count = folded(pair, pair.before)
    assert (len(place), count.sum()) == (180, 9000)
    np.testing.assert_allclose(mean, 0.3 * np.cos(2 * np.deg2rad(place)), atol=5 * 0.1 / np.sqrt(count.min()))
    _, after, _ = folded(pair, pair.after)
    assert after.std() == pytest.approx(0.1 / np.sqrt(50), rel=0.25)


def test_missing_samples_do_not_count_in_the_mean():
    pair = shaft()
    lost = pair.before.copy()
    lost[100:400] = np.nan
    assert folded(pair, lost)[2].sum() == 2700


def test_without_a_crank_angle_the_mean_is_in_pieces_of_time():
    pair = replace(shaft(), theta=None)
    place, mean, count = folded(pair, pair.time)
    assert (len(place), count.min()) == (120, 25)
    np.testing.assert_allclose(mean, place, atol=np.diff(pair.time).max())
    assert order_amplitudes(pair, pair.before) is None


@pytest.mark.parametrize("order", [0.5, 2.0, 5.5])
def test_amplitudes_are_those_of_the_orders(order):
    pair = shaft(order=order, sigma=1e-3)
    orders, amplitude, _ = order_amplitudes(pair, pair.before)
    assert orders[np.argmax(amplitude)] == order
    assert amplitude.max() == pytest.approx(0.3, rel=0.01)


def test_white_noise_exceeds_its_level_at_one_percent_of_the_orders():
    above = 0
    for seed in range(100):
        pair = shaft(n=600, cycles=3, seed=seed)
        _, amplitude, level = order_amplitudes(pair, pair.after)
        above += (amplitude > level).sum()
    share = above / (100 * 32)
    assert 0.005 < share < 0.016  # 3200 draws of 1 %


def test_a_record_shorter_than_a_cycle_has_no_orders():
    pair = shaft(cycles=1)
    short = replace(pair, theta=pair.theta[:1500], time=pair.time[:1500], before=pair.before[:1500])
    assert order_amplitudes(short, short.before) is None


def test_the_share_within_two_sigma_is_that_of_the_normal_distribution():
    pair = shaft(n=40000)
    assert inside_share(pair, pair.after) == pytest.approx(0.9545, abs=0.004)
    assert inside_share(pair, pair.before) < 0.7


def test_pairs_hold_the_residuals_of_both_models(repaired, nothing_missing, no_answer):
    old, fresh = pairs(repaired)
    assert (old.record, old.fresh, fresh.record, fresh.fresh) == (
        "misfire_1200rpm",
        False,
        "normal_1400rpm",
        True,
    )
    assert (old.unit, old.sigma, old.cycles) == ("rad/s", 0.1, 6)
    good = np.isfinite(old.before)
    assert good.sum() == 1170
    np.testing.assert_allclose((old.before - old.after)[good], 0.15 * np.cos(2 * old.theta[good]), atol=1e-12)
    assert [label for label, _, _ in old.shown] == ["before", "after"]
    assert [label for label, _, _ in pairs(nothing_missing)[0].shown] == ["without any addition"]
    assert pairs(no_answer) == ()


def test_the_noise_is_that_of_the_scores_or_else_of_the_fit(repaired):
    assert noise_level(repaired, "omega") == 0.1
    assert noise_level(replace(repaired, noise=None), "omega") == 0.1001
    assert np.isnan(noise_level(repaired, "torque"))


def test_what_parameters_can_take_over_is_given_back_to_the_latent_torque(repaired):
    """The hand-made course lacks 1.5 times the twist rate; the law brings it back."""
    latent = repaired_latent.latent_at(repaired)
    assert latent.port == "coupling"
    (one,) = repaired_latent.seen(repaired, latent)
    assert set(one.signals) == {"twist", "twist_rate", "crank_angle"}  # the stiffness does not change
    rate = one.signals["twist_rate"]
    inside = np.abs(one.law) > 8  # where the law, a mean over the piece around a knot, is not at its jump
    assert inside.sum() > 25
    np.testing.assert_allclose(one.law[inside], 8.05 * np.sign(rate[inside]), atol=1e-9)
    raw = latent.courses["misfire_1200rpm"].mean
    assert np.sqrt(np.mean((one.mean - one.law)[inside] ** 2)) < 0.5 * np.sqrt(
        np.mean((raw - one.law)[inside] ** 2)
    )
    # least squares: nothing linear in the signals is left between the course and the law, and no more was changed
    columns = np.column_stack([np.ones(60), one.signals["twist"], rate])
    np.testing.assert_allclose(columns.T @ (one.mean - one.law), 0.0, atol=1e-8)
    assert np.linalg.matrix_rank(np.column_stack([columns, one.mean - raw]), tol=1e-8) == 3


def test_a_latent_torque_without_a_law_is_drawn_as_it_is(repaired, nothing_missing):
    (one,) = repaired_latent.seen(nothing_missing, nothing_missing.latent[0])
    assert one.law is None
    np.testing.assert_array_equal(one.mean, nothing_missing.latent[0].courses["misfire_1200rpm"].mean)
    assert repaired_latent.latent_at(repaired, "load") is None
    assert repaired_latent.latent_at(replace(repaired, latent=())) is None
    assert repaired_latent.law_words(()) == "no law was found here"


def test_an_effect_of_another_record_adds_nothing_here(repaired):
    effect = replace(repaired.effects[0], course={"another": np.zeros((2, 5))})
    (one,) = repaired_latent.seen(replace(repaired, effects=(effect,)), repaired.latent[0])
    np.testing.assert_array_equal(one.law, 0.0)


def test_scores_are_sorted_and_each_effect_and_port_stands_once(repaired):
    rows, rest = repaired_scores.chart_rows(repaired)
    assert [(row.effect, row.statistic) for row in rows] == [
        ("coulomb_friction", 95.0), ("backlash", 50.0), ("load_step", 3.0), ("viscous_friction", 0.0),
    ]  # fmt: skip
    assert rest == 0
    kinds = [repaired_scores.standing(repaired, row) for row in rows]
    assert kinds == ["found", "above", "below", "not testable"]


def test_found_effects_stay_in_a_short_chart(repaired):
    effect = replace(repaired.effects[0], name="load_step", at="load")
    rows, rest = repaired_scores.chart_rows(replace(repaired, effects=(effect,)), 2)
    assert ([row.effect for row in rows], rest) == (["coulomb_friction", "load_step"], 2)


# ---- figures


def test_the_figures_of_a_named_effect(repaired):
    assert list(figures(repaired)) == [
        "overview", "gap misfire_1200rpm omega", "fresh gap normal_1400rpm omega", "latent coupling", "scores",
        "classes", "shift coupling.coulomb_friction",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["repaired", "nothing_missing", "unnamed", "no_answer"])
def test_every_figure_can_be_drawn(kind, request):
    result = request.getfixturevalue(kind)
    for name in figures(result):
        figure = ce.plot(result, what=name)
        assert isinstance(figure, Figure), name
        figure.canvas.draw()


def test_the_overview_shows_the_gap_its_orders_and_the_law(repaired):
    figure = ce.plot(repaired)
    words = texts(figure)
    assert "misfire_1200rpm: omega" in words
    assert "normal_1400rpm (fresh): omega" in words
    assert "crank angle [deg], mean of 6 cycles" in words
    assert "measured − simulated [rad/s]" in words
    assert "amplitude of the gap [rad/s]" in words
    assert "torque at coupling over twist rate" in words
    assert "coulomb_friction" in words
    tops = figure.axes[:2]
    assert len({axes.get_ylim() for axes in tops}) == 1  # one scale, so that the eye may compare


def test_every_axis_has_a_label_with_its_unit(repaired):
    for name in figures(repaired):
        figure = ce.plot(repaired, what=name)
        for axes in figure.axes:
            if not axes.get_visible():
                continue
            for label in (axes.get_xlabel(), axes.get_ylabel()):
                assert label == "" or re.search(r"\[.+\]", label), f"{name}: {label}"


def test_a_gap_says_what_share_lies_inside_the_band(repaired):
    words = texts(ce.plot(repaired, what="gap misfire_1200rpm omega"))
    pair = pairs(repaired)[0]
    for which, residual in (("before", pair.before), ("after", pair.after)):
        share = 100 * inside_share(pair, residual)
        assert f"{which}: {share:.1f} % inside ±2σ (noise: 95.4 %)" in words
    assert "noise alone exceeds this at 1 % of orders" in words
    assert "residual / σ of the noise [1], σ = 0.1 rad/s" in words


def test_records_without_crank_angle_are_drawn_over_time(repaired, factory):
    bare, _ = factory.experiment(theta=False)
    changed = replace(repaired, data=(bare,))
    figure = ce.plot(changed, what="gap misfire_1200rpm omega")
    figure.canvas.draw()
    words = texts(figure)
    assert "time [s], mean of pieces" in words
    assert "order" not in words
    overview = ce.plot(changed)
    overview.canvas.draw()
    assert "residual [rad/s]" in texts(overview)
    assert "engine order" not in texts(overview)


def test_a_machine_that_is_none_has_its_own_quantities(unnamed):
    """The axes of an unknown course say what acts at the port, and over what."""
    ports = unnamed.model.ports
    room = Port("coupling", "coupling", "", {"twist": ca.SX.sym("T")}, None, "W", units={"twist": "K"})
    model = replace(unnamed.model, ports=Ports([room if one.name == "coupling" else one for one in ports]))
    figure = ce.plot(replace(unnamed, fit=replace(unnamed.fit, model=model)), what="unknown")
    figure.canvas.draw()
    words = texts(figure)
    assert "unknown power at coupling" in words
    assert "power [W]" in words
    assert "T [K]" in words


def test_scores_say_threshold_and_what_is_not_testable(repaired):
    words = texts(ce.plot(repaired, what="scores"))
    assert "threshold 3.8" in words
    assert "not testable" in words
    assert "α = 0.01 over 380 candidates" in words
    assert "linear up to the threshold and logarithmic above" in words
    low = replace(repaired, scores=repaired.scores[3:], effects=())
    assert "logarithmic" not in texts(ce.plot(low, what="scores"))


def test_an_unknown_torque_says_what_it_looks_like(unnamed):
    words = texts(ce.plot(unnamed, what="unknown"))
    assert "unknown torque at coupling: looks cubic (97 % of its variance)" in words
    assert "twist [rad]" in words


def test_a_law_over_a_signal_it_is_no_function_of_is_a_mean(repaired):
    words = texts(ce.plot(repaired, what="latent coupling"))
    assert "over crank angle" in words
    assert repaired_latent._single_valued(np.sign(np.linspace(-1, 1, 50)))
    assert not repaired_latent._single_valued(np.tile([1.0, -1.0], 20))


def test_parameters_that_moved_stand_with_their_intervals(repaired):
    words = texts(ce.plot(repaired, what="shift coupling.coulomb_friction"))
    assert "J_load = 0.17 kg m2" in words
    assert "found by the refit, with its 95 % interval" in words
    assert "what the model without coupling.coulomb_friction had wrong" in words


def test_a_parameter_at_a_bound_has_no_interval(repaired):
    found = dict(repaired.fit.estimates) | {"J_load": Estimate(0.02, None, "kg m2", at_bound="min")}
    figure = ce.plot(
        replace(repaired, fit=replace(repaired.fit, estimates=found)), what="shift coupling.coulomb_friction"
    )
    figure.canvas.draw()


def test_a_figure_that_is_not_there(repaired):
    with pytest.raises(
        ResultError, match="no such figure of this result; seen: 'waterfall'; allowed: 'overview'"
    ):
        ce.plot(repaired, what="waterfall")


def test_bands_and_colours_are_those_of_the_other_figures():
    assert repaired_gap.AFTER == repaired_scores.FOUND


def test_a_course_that_hardly_spreads_has_errors_that_are_numbers():
    # equal but for rounding: the difference of squares would be below zero
    x, value = np.repeat([0.0, 1.0], 7), np.full(14, 0.1) * (1 + 1e-16)
    _, mean, error = repaired_latent.binned(x, 1e8 * value, np.zeros(14))
    assert mean == pytest.approx([1e7, 1e7])
    assert np.isfinite(error).all()
    spread = np.array([1.0, 2.0, 3.0, 6.0])
    _, _, error = repaired_latent.binned(np.zeros(4), spread, np.zeros(4))
    assert error == pytest.approx([spread.std() / 2])


def test_long_names_are_cut_at_their_end_beside_other_panels(nothing_missing):
    row = replace(nothing_missing.scores[0], effect="asymmetric_friction", at="a_port_of_a_long_name")
    changed = replace(nothing_missing, scores=(row,))
    beside, own = ce.plot(changed), ce.plot(changed, what="scores")
    for figure in (beside, own):
        figure.canvas.draw()
    assert "asymmetric_friction at …" in texts(beside)
    assert "asymmetric_friction at a_port_of_a_long_name" in texts(own)
