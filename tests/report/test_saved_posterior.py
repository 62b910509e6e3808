"""A posterior that is saved and read back."""

import json
import os

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import OutputError, ResultError
from casadi_engine.report.schema import faults


@pytest.fixture(scope="module")
def post():
    time = np.arange(200) * 0.01
    noise = 0.02 * np.random.default_rng(1).standard_normal(200)
    record = ce.Experiment.from_arrays(
        "run_up",
        time=time,
        units={"T": "N m", "omega": "rad/s"},
        hold="zero",
        T=np.full(200, 2.0),
        omega=4 * (1 - np.exp(-time / 0.8)) + noise,
    )
    return ce.posterior(ce.estimate(ce.one_inertia(), record, progress=False))


def test_what_is_read_back_has_the_draws_and_prints_the_same(post, tmp_path):
    file = post.save(tmp_path / "kept")
    assert file == tmp_path / "kept" / "result.json"
    loaded = ce.load_result(tmp_path / "kept")
    assert str(loaded) == str(post)
    assert list(loaded.draws) == list(post.names)
    for name in post.names:
        np.testing.assert_array_equal(loaded.draws[name], post[name])
    assert loaded["posterior"]["log_evidence"] == post.log_evidence
    assert loaded.values["J_eng"] == post.fit.values["J_eng"]
    assert list(faults(loaded.to_dict())) == []
    assert os.listdir(file.parent) == [file.name]
    ce.plot(loaded)
    ce.report(loaded, tmp_path / "page.html")


def test_it_starts_a_fit(post, tmp_path):
    post.save(tmp_path)
    again = ce.estimate(post.fit.model, post.fit.data, warm=ce.load_result(tmp_path), progress=False)
    assert again.values["J_eng"] == pytest.approx(post.fit.values["J_eng"], rel=1e-4)


def test_a_file_that_cannot_be_written_leaves_the_old_one(post, tmp_path, monkeypatch):
    file = post.save(tmp_path / "kept.json")
    before = file.read_bytes()

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match=r"kept\.json"):
        post.save(tmp_path / "kept.json")
    assert file.read_bytes() == before


def test_draws_that_are_no_numbers_are_refused(post, tmp_path):
    file = post.save(tmp_path)
    document = json.loads(file.read_text(encoding="utf-8"))
    document["posterior"]["draws"]["J_eng"][3] = "x"
    file.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ResultError, match=r"posterior\.draws\.J_eng\[3\] does not fit the schema"):
        ce.load_result(tmp_path)


def test_a_result_without_draws_says_so(post, tmp_path):
    file = post.save(tmp_path)
    document = json.loads(file.read_text(encoding="utf-8"))
    del document["posterior"]
    document["command"] = "fit"
    file.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ResultError, match=r"no draws; seen: a result of fit"):
        _ = ce.load_result(tmp_path).draws


def test_a_file_that_is_no_result_is_not_replaced(post, tmp_path):
    own = tmp_path / "mine.json"
    own.write_text('{"notes": 1}')
    with pytest.raises(OutputError, match=r"a file of this name would be lost: .*mine\.json"):
        post.save(own)
    assert own.read_text() == '{"notes": 1}'
