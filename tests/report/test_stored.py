"""load_result: what was written comes back, and every fault of a file is named."""

import json
import math

import numpy as np
import pytest

from casadi_engine.errors import ResultError
from casadi_engine.report import Result, load_result, to_result, write_result


@pytest.fixture
def stored(tmp_path, fit):
    document = to_result(fit, command="fit", arguments={}, seconds=1.0, seed=7)
    return write_result(tmp_path / "result.json", document)


def changed(path, **changes):
    document = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(document))
    return path


def test_a_fit_comes_back(stored, fit):
    result = load_result(stored)
    assert isinstance(result, Result)
    assert (result["seed"], result["status"]) == (7, "converged")
    assert result.values["J_eng"] == fit.values["J_eng"]
    assert result.stderr["C_el"] is None
    assert result.free == fit.free
    assert result.records == ("misfire_1200rpm",)
    assert result.initial == {
        "misfire_1200rpm": {"omega_eng": 125.0123, "omega_load": 124.98, "twist": -0.0286}
    }
    np.testing.assert_allclose(result.covariance, fit.covariance)
    assert repr(result) == f"Result({str(stored)!r}: fit, converged)"
    assert set(result) == set(result.to_dict())
    assert len(result) == len(list(result))
    assert load_result(stored.parent).path == str(stored)


def test_the_parameter_set_comes_back(stored):
    pars = load_result(stored).parameter_set()
    assert pars["K_el"].value == 1992.0
    assert pars["C_half"].tie == "C_eng/2"
    assert pars["C_eng"].prior == (0.15, 0.01)
    pars["K_el"].set(2000.0)  # it is a fresh set


def test_nothing_can_be_changed(stored):
    result = load_result(stored)
    with pytest.raises(TypeError):
        result["parameters"]["J_eng"]["value"] = 1.0
    with pytest.raises(AttributeError):
        result.path = "x"
    copy = result.to_dict()
    copy["parameters"]["J_eng"]["value"] = 1.0
    assert result.values["J_eng"] != 1.0


def test_undetermined_errors_come_back_as_nan(tmp_path, factory):
    fit = factory.fit(covariance=np.full((5, 5), math.nan))
    path = write_result(tmp_path / "r.json", to_result(fit, command="fit", arguments={}, seconds=1.0, seed=0))
    assert np.isnan(load_result(path).covariance).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "broken JSON at line 1, column 2"),
        (b"", "broken JSON at line 1, column 1"),
        (b'{"a": NaN}', "a number that is no number; seen: NaN; allowed: finite numbers"),
        (b'{"a": -Infinity}', "seen: -Infinity"),
        (b'{"a": 1e999}', "seen: 1e999"),
        (b"\xff\xfe", "not UTF-8 text; seen: byte 0"),
        (b"[1]", "not a result; seen: list; allowed: a JSON object"),
        (b"{}", "another version of the result file; seen: None; allowed: 'casadi-engine/1'"),
        (b'{"schema": "casadi-engine/2"}', "seen: 'casadi-engine/2'"),
        (b'{"schema": "casadi-engine/1"}', "result does not fit the schema; seen: without 'command'"),
        (b"[" * 100_000, "cannot be read as JSON"),
        (b'{"a": ' + b"9" * 5000 + b"}", "cannot be read as JSON"),
    ],
)
def test_files_that_are_no_results(tmp_path, content, message):
    path = tmp_path / "result.json"
    path.write_bytes(content)
    with pytest.raises(ResultError) as error:
        load_result(path)
    assert str(error.value).startswith(str(path))
    assert message in str(error.value)
    assert error.value.cure


def test_a_place_that_breaks_the_schema_is_named(stored):
    with pytest.raises(
        ResultError, match=r'result\.n does not fit the schema; seen: "many"; allowed: integer'
    ) as e:
        load_result(changed(stored, n="many"))
    assert e.value.cure == "run the command again to write it anew"
    parameters = json.loads(stored.read_text())["parameters"]
    parameters["J_eng"]["at_bound"] = True
    with pytest.raises(ResultError, match=r"result\.parameters\.J_eng\.at_bound .* allowed: false, "):
        load_result(changed(stored, n=1, parameters=parameters))


def test_paths_that_lead_nowhere(tmp_path):
    with pytest.raises(ResultError, match=r"none\.json: no such file; do: check the path") as error:
        load_result(tmp_path / "none.json")
    assert "fit writes DIR/result.json" in error.value.cure
    with pytest.raises(ResultError, match=r"result\.json: no such file"):
        load_result(tmp_path)
    with pytest.raises(ResultError, match="not the path of a result; seen: int; allowed: text"):
        load_result(3)
    with pytest.raises(ResultError, match="cannot be read"):
        load_result("a\0b")


def test_a_validation_has_no_initial_states(tmp_path, validation):
    document = to_result(validation, command="validate", arguments={}, seconds=1.0, seed=0)
    result = load_result(write_result(tmp_path / "v.json", document))
    assert result.values["J_eng"] == 0.391083
    with pytest.raises(
        ResultError, match="has no initial_states; seen: a result of validate; allowed: a result of fit"
    ):
        _ = result.initial


def test_parameter_sets_that_cannot_be_read(stored):
    result = load_result(changed(stored, parameter_set=None, why={"parameter_set": "a tie without text"}))
    with pytest.raises(ResultError, match="the set of parameters is not stored; seen: a tie without text"):
        result.parameter_set()
    result = load_result(changed(stored, parameter_set={"parameters": 3}))
    with pytest.raises(
        ResultError, match="the stored set of parameters cannot be read; seen: stored parameters"
    ):
        result.parameter_set()
