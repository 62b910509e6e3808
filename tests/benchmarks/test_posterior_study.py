"""The study of the posterior's calibration, small: what it draws, and what its table says."""

import numpy as np
import posterior_study


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
    one = {"log_evidence": -1.0, "error": 0.01, "seconds": 30.0, "evaluations": 6000, "median": {"J1": 1.0},
           "spread": {"J1": 0.1}}  # fmt: skip
    words = posterior_study.judged({"ours": one, "dynesty": one | {"median": {"J1": 1.05}}})
    assert "medians 0.50 standard deviations apart at most" in words
