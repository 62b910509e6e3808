"""The study of the posterior's calibration, small: what it draws, and what its table says."""

import json

import doubt_study
import numpy as np
import posterior_referee
import posterior_study
import pytest

from casadi_engine.posterior.target import Target


def row(rank, **more):
    return {"rank": {"J1": rank}, "z": {"J1": 3.0}, "seconds": 2.0, "why": "few smooth optima", "modes": 1,
            "evaluations": 4000, **more}  # fmt: skip


def test_truths_are_drawn_within_the_bounds_of_the_fit():
    case, truth = posterior_study.drawn("A", 0)
    width = posterior_study.VARIANTS["A"].width
    assert (np.abs(np.log(truth / case.true_values)) <= np.log(width)).all()
    assert not np.array_equal(truth, posterior_study.drawn("A", 1)[1])
    (record,) = case.records
    assert record.speed.std() > 10 * case.sigma


def test_an_engine_that_has_been_running_goes_on_as_it_began():
    """From the state of a later cycle a record without noise comes back to where it was; from another it does not."""
    case = posterior_study.VARIANTS["B6"].nominal("B6")
    source = posterior_study.kept_channels("crankshaft/misfire_1400rpm.csv.gz")
    values = case.full(1.1 * case.true_values)
    thesis = np.array(json.loads(posterior_study.STARTS_FILE.read_text())["misfire_1400rpm"])
    start = posterior_study.running(case.shape, values, thesis, source, np.random.default_rng(0))
    cycle = int(np.searchsorted(source.channels["theta"] - source.channels["theta"][0], 4 * np.pi))

    def apart(first):
        speed, _ = posterior_study.simulate(case.shape, values, first, source, np.zeros(source.samples))
        return np.abs(speed[cycle : cycle + 100] - speed[:100]).max()

    assert apart(start) < 0.08 < apart(thesis)


def test_records_may_begin_with_the_same_states_whatever_the_parameters_are():
    starts = []
    for seed in (100, 101):
        case, _ = posterior_study.drawn("B6_fixed", seed)
        starts.append([record.speed[0] for record in case.records])
    np.testing.assert_allclose(*starts, atol=6 * case.sigma)


def test_one_simulation_gives_a_rank_of_every_parameter():
    found = posterior_study.row({"variant": "A", "seed": 0})
    assert found["status"] == "converged"
    assert set(found["rank"]) == {"J1", "J2", "K21", "C21", "C1"}
    assert all(0 < one < 1 for one in found["rank"].values())
    assert found["size"] > 400


def test_uniform_ranks_keep_their_levels_and_others_do_not():
    even = [row((k + 0.5) / 200) for k in range(200)]
    lines = posterior_study.table({"A": even}).splitlines()
    assert "| J1 | 200 | 50.0 % | 80.0 % | 95.0 % |" in lines[2]
    assert lines[2].endswith("| 0.0 % |")
    low = np.array([0.3 * (k + 0.5) / 200 for k in range(200)])
    assert posterior_study.uniform(low) < 1e-6 < 0.9 < posterior_study.uniform(low / 0.3)


def test_what_was_refused_is_counted():
    words = posterior_study.joint("A", [row(0.5), {"refused": "no", "seconds": 9.0, "z": {}}])
    assert "1 of 2 answered" in words
    assert "9.0 s at most" in words


def test_the_page_keeps_what_is_said_around_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(posterior_study, "HERE", tmp_path)
    posterior_study.write("first")
    page = tmp_path / "POSTERIOR.md"
    page.write_text(page.read_text("utf-8") + "\nkept\n", "utf-8")
    posterior_study.write("second")
    assert "second" in page.read_text("utf-8")
    assert "first" not in page.read_text("utf-8")
    assert page.read_text("utf-8").endswith("kept\n")


def test_the_referee_is_put_into_words():
    one = {"log_evidence": -1.0, "error": 0.01, "seconds": 3.0, "evaluations": 6000, "masses": [0.8, 0.2]}
    other = one | {"log_evidence": -1.25, "error": 0.08, "evaluations": 70_000, "masses": [0.79, 0.21]}
    line = posterior_referee.table({"A": {"ours": one, "dynesty": other}}).splitlines()[-1]
    assert "| -1.00 ± 0.01 | -1.25 ± 0.08 | 0.25 | 0.800, 0.200 | 0.790, 0.210 | 6000 | 70000 |" in line


def test_masses_are_those_of_the_nearest_modes():
    x = np.array([[0.0, 0.1], [0.2, 0.0], [5.0, 4.0], [6.0, 6.0]])
    tops = np.array([[0.0, 0.0], [5.0, 5.0]])
    assert posterior_referee._masses(x, np.array([1.0, 1.0, 1.0, 5.0]), tops) == pytest.approx([0.25, 0.75])


def test_the_referee_draws_from_the_same_prior():
    case, _ = posterior_study.drawn("A", 0)
    fit = posterior_study.fit_of(case, 0)
    target = Target(fit)
    from_unit = posterior_referee._prior_of(fit, target)
    u = np.array([from_unit(one) for one in np.random.default_rng(0).random((200, len(target.names)))])
    assert (u >= target.low).all()
    assert (u <= target.high).all()
    np.testing.assert_allclose(
        u.mean(axis=0), (target.low + target.high) / 2, atol=0.2 * (target.high - target.low).max()
    )


def test_doubts_are_counted():
    sure, doubted = (
        {"z": z, "doubted": word, "held": held} for z, word, held in ((1.0, False, None), (3.0, True, True))
    )
    rows = [{"status": "converged", "check": 0.1, "seconds": 1.1, "of": {"a": sure, "b": doubted}}] * 4
    (line,) = doubt_study.table({("A", 0.1): rows}).splitlines()[2:]
    assert line.startswith(
        "| A | 0.1 | 4 | 50 % | 1.000 ± 0.109 | 50 % | 0.000 ± 0.109 | 50 % | 1.000 ± 0.109 | 10 % |"
    )


def test_a_pendulum_is_checked_as_it_is_fitted():
    found = doubt_study.row({"problem": "pendulum", "sigma": 0.01, "seed": 0})
    assert found["status"] == "converged"
    assert set(found["of"]) == {"g_l", "c"}
    assert not any(one["doubted"] for one in found["of"].values())
    assert all(abs(one["z"]) < 4 for one in found["of"].values())
    assert 0 < found["check"] < found["seconds"]


@pytest.mark.slow
def test_dampers_with_a_normal_prior_are_drawn_from_it():
    case, _ = posterior_study.drawn("B21", 0)
    assert len(case.free) == 18
    low, high = posterior_study.VARIANTS["B21"].bounds(case)
    normal = np.array([name in case.priors for name in case.free])
    assert normal.sum() == 4
    np.testing.assert_allclose((high / low)[~normal], 1.3**2)
    assert ((high / low)[normal] > 1000).all()
    draws = np.array([posterior_study.drawn("B21", seed)[1][normal] for seed in (1, 2, 3)])
    assert (draws > 0).all()
    assert 0.5 < draws.std() < 2.0


def test_intervals_that_go_together_count_as_few():
    apart = [[True, False], [False, True], [True, True], [True, True]]
    together = [[True, True], [False, False], [True, True], [True, True]]
    assert doubt_study._share(apart) == "0.750 ± 0.063"
    assert doubt_study._share(together) == "0.750 ± 0.109"
    assert doubt_study._share([[True, True]] * 4) == "1.000 ± 0.109"
    assert doubt_study._share([[], []]) == "-"
