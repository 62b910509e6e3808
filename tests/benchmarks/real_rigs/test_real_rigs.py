"""The rigs' readers, and that all writings of a model are the same physics."""

import doctest
import json
from functools import lru_cache

import numpy as np
import outcome
import pytest
import rigs_table
from rigs_common import NAMES, NoDataError, rig, to_si

import casadi_engine as ce
from tests.quick import few


@lru_cache
def read(name):
    return rig(name).records()


def records_of(name):
    try:
        return read(name)
    except NoDataError as why:
        pytest.skip(str(why))


@pytest.mark.shared
@pytest.mark.parametrize("name", few(NAMES, *NAMES[::3]))
def test_the_writings_of_a_rig_are_one_physics(name):
    one = rig(name)
    (record, *_), _ = records_of(name)
    time = record.channels[0].time
    short = record.between(time[0], time[0] + 0.1 * (time[-1] - time[0]))
    runs = []
    for writing in range(len(one.writings)):
        model, parameters = one.build(writing)
        (output,) = model.outputs
        run = ce.simulate(model, short, parameters=parameters, initial=one.initial(writing), tolerance=1e-8)
        runs.append(run[output.name].values * to_si(model)[output.name])
    assert np.ptp(runs[0]) > 0
    for run in runs[1:]:
        assert np.abs(run - runs[0]).max() < 1e-6 * np.ptp(runs[0])


@pytest.mark.shared
@pytest.mark.parametrize("name", NAMES)
def test_a_rig_has_records_to_search_and_fresh_ones_and_a_fit_by_hand(name):
    one = rig(name)
    estimation, fresh = records_of(name)
    model, _ = one.build(0)
    (output,) = (out.name for out in model.outputs)
    for record in (*estimation, *fresh):
        assert all(channel.name in record for channel in model.inputs)
        assert 100 < record[output].mask.sum() < 6000
    assert not {record.name for record in estimation} & {record.name for record in fresh}


@pytest.mark.parametrize("name", NAMES)
def test_the_right_structure_is_better_than_nothing_by_hand(name):
    structures = outcome.kept()[name]["structures"]
    assert structures[rig(name).same]["estimation"] < structures["nothing added"]["estimation"]


def test_a_page_is_written_from_rows_and_judges_them_again(tmp_path, monkeypatch):
    monkeypatch.setattr(rigs_table, "PAGE", tmp_path / "REAL_RIGS.md")
    effect = {"key": "pivot.coulomb_friction", "amplitude": 0.1, "unit": "N m", "class": {}}
    answered = {
        "rig": "pendulum_cart",
        "writing": 0,
        "version": "1",
        "date": "2026-01-02T03:04Z",
        "cpu_s": 3.0,
    }
    crashed = answered | {"writing": 1, "outcome": "crashed", "error": "Error: of a test"}
    answered |= {
        "outcome": "wrong",
        "verdict": "named",
        "effects": [effect],
        "confirmed": True,
        "estimation": 0.0033,
    }
    rows = tmp_path / "rows.jsonl"
    rows.write_text("".join(json.dumps(row) + "\n" for row in (crashed, answered)))
    assert rigs_table.write(rows) == "wrote REAL_RIGS.md: 2 rows"
    text = (tmp_path / "REAL_RIGS.md").read_text()
    assert "Version 1, 2026-01-02." in text
    assert "| pendulum_cart | 0 | right | named: pivot.coulomb_friction 0.1 N m (alone) | confirmed |" in text
    assert "| 0.0033 | 1.99 |" in text  # over the fit by hand
    assert "| pendulum_cart | 1 | crashed | Error: of a test |" in text


def test_an_outcome_is_told_from_the_truth():
    tried = doctest.testmod(outcome)
    assert tried.attempted > 0
    assert tried.failed == 0
