"""The benchmark of hidden terms: its simulator against closed forms, its tasks well formed, its judge."""

import itertools
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hidden_terms import kind as kinds_of
from hidden_terms import run
from hidden_terms.judge import judged
from hidden_terms.kind import NULLS, TASKS, Manoeuvre, load_kinds, nulls_of, tasks_of, true_values
from hidden_terms.records import case_of, noisy, with_terms
from hidden_terms.rivals import answer, by_bic, refit_all, run_rival, table
from hidden_terms.simulator import Dry, simulate
from hidden_terms.tables import tables

import casadi_engine as ce

KINDS = load_kinds(sealed=True)
TIME = 0.01 * np.arange(301)


# ---- the simulator


def test_a_sliding_body_stops_where_the_closed_form_says_and_stays():
    x = simulate(lambda t, x, u: (x[1], 0.0), (0.0, 2.0), TIME, {}, dry=[Dry((0, 1), (0, 1), lambda x: 1.5)])
    stop = 2.0 / 1.5
    slides = np.minimum(TIME, stop)
    np.testing.assert_allclose(x[:, 1], 2 - 1.5 * slides, atol=1e-9)
    np.testing.assert_allclose(x[:, 0], 2 * slides - 0.75 * slides**2, atol=1e-9)


def test_a_body_at_rest_breaks_away_when_the_force_exceeds_its_friction():
    force = {"F": 2.0 * TIME}
    x = simulate(lambda t, x, u: (u["F"],), (0.0,), TIME, force, dry=[Dry((1,), (1,), lambda x: 1.0)])
    late = np.maximum(TIME - 0.5, 0)
    np.testing.assert_allclose(x[:, 0], late**2, atol=1e-8)


def test_dry_friction_between_two_bodies_holds_them_together():
    """A board under a block: both move as one as long as friction can carry the block along."""
    dry = [Dry((1, -1), (1.0, -0.5), lambda x: 0.4)]
    x = simulate(lambda t, x, u: (0.0, 0.5 * u["F"]), (0.0, 0.0), TIME, {"F": 0.6 + 0 * TIME}, dry=dry)
    np.testing.assert_allclose(x[:, 0], x[:, 1], atol=1e-12)
    np.testing.assert_allclose(x[:, 0], 0.2 * TIME, atol=1e-9)
    x = simulate(lambda t, x, u: (0.0, 0.5 * u["F"]), (0.0, 0.0), TIME, {"F": 3.0 + 0 * TIME}, dry=dry)
    np.testing.assert_allclose(x[:, 0], 0.4 * TIME, atol=1e-9)
    np.testing.assert_allclose(x[:, 1], 1.3 * TIME, atol=1e-9)


def test_an_input_is_a_straight_line_between_samples_and_a_break_is_met():
    coarse = np.array([0.0, 1.0, 2.0])
    x = simulate(lambda t, x, u: (u["v"] + (t > 1.3),), (0.0,), coarse, {"v": [0.0, 1.0, 0.0]}, breaks=[1.3])
    np.testing.assert_allclose(x[:, 0], [0, 0.5, 1.7], atol=1e-9)


def test_a_pendulum_without_friction_keeps_its_energy():
    run_ = Manoeuvre(0.03 * np.arange(300), {"T": np.zeros(300)}, (2.0, 0.5))
    found = KINDS["pendulum"].course({"m": 0.5, "L": 0.4, "c": 0.0}, run_)
    energy = 0.5 * 0.4 * found["gyro"] ** 2 - 9.81 * np.cos(found["phi"])
    np.testing.assert_allclose(energy, energy[0], atol=1e-7)


def test_a_circuit_rings_as_its_closed_form_does():
    run_ = Manoeuvre(1e-3 * np.arange(100), {"U": np.zeros(100)}, (1e-3, 0.0))
    found = KINDS["rlc"].course({"L": 0.1, "R": 5.0, "C": 1e-4}, run_)
    damping, frequency = 25.0, np.sqrt(1e5 - 25.0**2)
    turned = np.cos(frequency * run_.time) + damping / frequency * np.sin(frequency * run_.time)
    np.testing.assert_allclose(found["UC"], 10 * np.exp(-damping * run_.time) * turned, atol=1e-6)


def test_tanks_settle_where_outflow_is_inflow():
    run_ = Manoeuvre(4.0 * np.arange(2000), {"u": 5 + np.zeros(2000)}, (0.1, 0.1))
    truth = {"k": 8e-6, "a1": 2e-5, "a2": 2.2e-5, "A": 0.01}
    found = KINDS["tanks"].course(truth, run_)
    for name, hole in (("y1", 2e-5), ("y2", 2.2e-5)):
        assert found[name][-1] == pytest.approx((4e-5 / hole) ** 2 / 2 / 9.81, rel=1e-3)


# ---- kinds and tasks


@pytest.mark.parametrize("name", KINDS)
def test_a_kind_is_well_formed(name):
    kind = KINDS[name]
    model = kind.model(kind.outputs[0])
    declared = {one.name for one in model.declarations}
    assert set(kind.truth) == declared
    assert set(kind.absent) <= declared
    assert {one for pair in kind.pairs for one in pair} == set(kind.manoeuvres)
    assert all(a != b for a, b in kind.pairs)
    for way in kind.outputs:
        assert [one.name for one in kind.model(way).outputs] == [
            one.name for one in model.outputs if one.name in way
        ]
    for made in kind.manoeuvres.values():
        run_ = made(np.random.default_rng(0))
        assert 300 <= len(run_.time) <= 1500
        assert {one.name for one in model.inputs} == set(run_.inputs)
        assert len(run_.start) >= len(model.states)
    used = {term for choice in kind.choices for part in choice.split("|") for term in part.split("+")}
    assert used <= set(kind.terms)
    for term, one in kind.terms.items():
        if one.wrong:
            assert term == f"parameter_{one.wrong}.wrong_value"
            assert one.wrong in {declared.name for declared in model.declarations if not declared.vary}
        if one.effect is not None:
            assert term == f"{one.at}.{one.effect.name}"
            assert (
                with_terms(kind, model, (term,), {term: one.amplitude, "event": 1.0}).effects[0].key == term
            )
    free = [one for one in model.declarations if one.vary]
    assert all(one.min <= kind.truth[one.name] / 2 and 2 * kind.truth[one.name] <= one.max for one in free)


def test_tasks_have_keys_of_their_own_and_any_part_holds_all_ratios():
    every = [task for kind in KINDS.values() for task in (*tasks_of(kind), *nulls_of(kind))]
    assert len({(task.null, task.key) for task in every}) == len(every)
    for kind in KINDS.values():
        tasks, nulls = tasks_of(kind), nulls_of(kind)
        assert (len(tasks), len(nulls)) == (TASKS, NULLS)
        assert {task.snr for task in tasks[:10]} == {10, 20, 30, 40}
        assert {task.noise for task in tasks} == {"white", "coloured", "quantised"}
        assert not any(task.deleted for task in nulls)
        known = [one for one in kind.terms.values() if one.effect is not None]
        assert any(task.declared for task in nulls) == bool(known)


def test_a_plant_is_drawn_about_the_kind_and_what_is_absent_is_zero():
    kind = KINDS["pendulum"]
    task = next(task for task in tasks_of(kind) if task.absent)
    values = true_values(kind, task, ["L", "c"])
    assert values["c"] == 0
    assert values["m"] == kind.truth["m"]
    assert values["L"] != kind.truth["L"]
    assert values["L"] == pytest.approx(kind.truth["L"], rel=0.21)
    assert values == true_values(kind, task, ["L", "c"])


@pytest.mark.slow
def test_a_case_has_noise_of_the_ratio_asked_for():
    kind = KINDS["pendulum"]
    task = next(task for task in tasks_of(kind) if task.snr == 20 and task.noise == "white")
    case = case_of(kind, task)
    off = case.fresh["phi"].values - case.clean["phi"]
    assert np.std(off) == pytest.approx(case.sigma["phi"], rel=0.1)
    values = case.parameters["L"].value / case.values["L"]
    assert 0.2 <= abs(values - 1) <= 0.5


@pytest.mark.parametrize("noise", ["white", "coloured", "quantised"])
def test_noise_has_its_standard_deviation(noise):
    clean = np.linspace(0, 100, 20_000)
    off = noisy(clean, 0.2, noise, np.random.default_rng(1)) - clean
    assert np.std(off) == pytest.approx(0.2, rel=0.05)
    neighbours = np.corrcoef(off[1:], off[:-1])[0, 1]
    assert (neighbours > 0.7) == (noise == "coloured")


# ---- the judge

DRY, DRAG, OFFSET = "pivot.coulomb_friction", "pivot.quadratic_drag", "sensor_phi.sensor_offset"


def said(*classes, verdict="named", confirmed=True, gap=None):
    effects = [{"members": [[name, 1 / len(one)] for name in one], "lead": one[0]} for one in classes]
    return {"verdict": verdict, "confirmed": confirmed, "effects": effects, "gap": gap}


def task_with(*deleted):
    return next(task for task in tasks_of(KINDS["pendulum"]) if task.deleted == deleted)


SMALL = {"before": 10.0, "after": 0.9}


@pytest.mark.parametrize(
    ("deleted", "answer", "word"),
    [
        ((DRY,), said([DRY]), "right"),
        ((DRY,), said([DRAG, DRY]), "in class"),
        ((DRY,), said([DRAG]), "wrong single"),
        ((DRY,), said([DRAG, OFFSET]), "wrong class"),
        ((DRY,), said([DRY], [OFFSET]), "wrong single"),
        ((DRY,), said(verdict="unnamed"), "unnamed"),
        ((DRY,), said(verdict="nothing missing"), "missed"),
        ((DRY,), said(verdict=None), "no answer"),
        ((DRY, DRAG), said([DRY]), "partly"),
        ((DRY, DRAG), said([DRY], [DRAG]), "right"),
        (("pivot.cogging",), said(verdict="unnamed"), "right (unnamed)"),
        (("pivot.cogging",), said([OFFSET]), "wrong single"),
        (("pivot.cogging",), said([OFFSET], gap=SMALL), "alike"),
        (("pivot.cogging",), said([OFFSET], gap=SMALL, confirmed=None), "wrong single"),
        ((DRY,), said([OFFSET], gap=SMALL), "wrong single"),
    ],
)
def test_what_an_answer_counts_as(deleted, answer, word):
    assert judged(KINDS["pendulum"], task_with(*deleted), answer) == word


def test_a_null_is_right_only_if_nothing_is_said_to_be_missing():
    kind = KINDS["pendulum"]
    null = nulls_of(kind)[0]
    assert judged(kind, null, said(verdict="nothing missing")) == "right"
    assert judged(kind, null, said(verdict="unnamed")) == "false alarm"
    assert judged(kind, null, said([DRY])) == "false alarm"


# ---- the runner


@pytest.mark.slow
def test_a_run_stores_crashes_and_goes_on_where_it_was(tmp_path, monkeypatch, capsys):
    def broken(*_args, **_options):
        raise ValueError("of no use")

    monkeypatch.setattr(run.ce, "repair", broken)
    out, table = tmp_path / "rows.jsonl", tmp_path / "table.md"
    given = [
        "tanks",
        "--tasks",
        "1",
        "--nulls",
        "1",
        "--out",
        str(out),
        "--label",
        "a",
        "--table",
        str(table),
    ]
    run.main(given)
    assert [row["outcome"] for row in run.read(out)] == ["crashed: ValueError: of no use"] * 2
    assert Counter(row["null"] for row in run.read(out)) == {False: 1, True: 1}
    run.main(given)
    assert len(run.read(out)) == 2
    run.main([*given[:-3], "b"])
    assert len(run.read(out)) == 4
    assert "| tanks | 1 | 1 | 0 of 1 (1 without an answer) |" in table.read_text()
    assert "of no use" in capsys.readouterr().out


def test_a_budget_of_cpu_time_ends_a_task():
    with pytest.raises(run.OutOfBudgetError), run.limited(0.05):
        sum(k for k in itertools.count())


def test_a_line_that_was_cut_is_run_again(tmp_path):
    (tmp_path / "rows.jsonl").write_text('{"key": "a", "version": "b"}\n{"key": "c", "ver')
    assert run.read(tmp_path / "rows.jsonl") == [{"key": "a", "version": "b"}]


def test_sealed_kinds_are_loaded_only_if_asked_for():
    here = Path(kinds_of.__file__).parent
    assert len(load_kinds()) == len(list(here.glob("kind_*.py")))
    assert len(KINDS) == len(list(here.rglob("kind_*.py")))


def test_a_table_counts_probabilities_and_amplitudes():
    row = {
        "null": False, "kind": "a", "label": "b|c", "snr": 20, "noise": "white", "outcome": "in class", "seconds": 2.0,
        "members": [[0.7, True], [0.3, False]], "answer": {"gap": {"before": 4.0, "after": 0.5}},
        "amplitudes": [{"term": "x.drag", "true": 1.0, "amplitude": 1.2, "stderr": 0.2}],
    }  # fmt: skip
    text = tables([row], "0")
    assert "| 0.6 to 0.8 | 1 | 0.70 | 1.00 |" in text
    assert "| drag | 1 | 1 | 1.00 |" in text
    assert "| a | 1 | 4.00 | 0.50 |" in text
    assert "| a: b\\|c | 1 | 1 | 2.0 | 2 |" in text


# ---- rivals


@pytest.fixture(scope="module")
def dragged():
    """A pendulum with drag that nobody can miss, 30 dB."""
    kind = KINDS["pendulum"]
    task = task_with(DRAG)
    return kind, task, case_of(kind, task)


@pytest.mark.slow
def test_stepwise_regression_names_a_clear_term(dragged):
    kind, task, case = dragged
    row = run_rival("stepwise", kind, task, case)
    assert row["outcome"] in ("right", "in class")
    assert DRAG in row["names"][0]


def test_sindy_is_left_out_with_a_reason_where_it_is_not_installed(dragged, monkeypatch):
    monkeypatch.setitem(sys.modules, "pysindy", None)
    assert run_rival("sindy residual", *dragged)["outcome"].startswith("skipped: ")


@pytest.mark.slow
def test_refits_keep_the_candidate_that_is_best_by_bic(dragged):
    kind, task, case = dragged
    offered = replace(case, effects=[ce.effects.QuadraticDrag(), ce.effects.ConstantTorque()])
    classes = refit_all(offered)
    assert classes[0] == [DRAG]
    assert judged(kind, task, answer(classes[:1])) == "right"


def test_a_class_holds_what_is_within_six_of_the_best():
    assert by_bic({"a": 10.0, "b": 4.5, "c": 5.0}) == ["b", "c", "a"]
    assert by_bic({"a": 11.0, "b": 4.5}) == ["b"]


def test_the_table_of_rivals_counts_tasks_and_false_alarms():
    rows = [
        {"rival": "stepwise", "null": False, "outcome": "right", "seconds": 1.0},
        {"rival": "stepwise", "null": False, "outcome": "crashed: of no use", "seconds": 1.0},
        {"rival": "stepwise", "null": True, "outcome": "false alarm", "seconds": 1.0},
    ]
    assert "| stepwise | 2 | 1 | 1 | 1 of 1 | 1.0 |" in table(rows)
