"""result.json: contract, schema, atomic writing."""

import json
import math
import os
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from casadi_engine.errors import OutputError, ResultError
from casadi_engine.estimation.fit import Estimate, Optimum
from casadi_engine.report import Simulated, to_result, write_result
from casadi_engine.report.plain import plain
from casadi_engine.report.schema import faults, schema

COMMON = {
    "command", "schema", "version", "status", "seconds", "timing", "seed", "arguments", "inputs", "noise",
    "cost", "n", "parameters",
}  # fmt: skip


def result_of(result, command="fit", **changes):
    given = {"command": command, "arguments": {"problem": "p.py"}, "seconds": 1.5, "seed": 0}
    return to_result(result, **(given | changes))


def simulated(fit):
    return Simulated(fit.model, fit.parameters, fit.data, fit.data, ("out/a.csv",))


@pytest.fixture
def documents(fit, validation):
    return {
        "fit": result_of(fit),
        "validate": result_of(validation, "validate"),
        "simulate": result_of(simulated(fit), "simulate"),
    }


def test_the_schema_itself_is_valid():
    jsonschema.Draft202012Validator.check_schema(schema())


@pytest.mark.parametrize("command", ["fit", "validate", "simulate"])
def test_results_meet_the_schema(documents, command):
    document = documents[command]
    jsonschema.Draft202012Validator(schema()).validate(document)
    assert list(faults(document)) == []
    assert set(document) >= COMMON
    json.dumps(document, allow_nan=False)


def test_a_fit_by_the_contract(fit):
    document = result_of(fit)
    assert document["command"] == "fit"
    assert document["schema"] == "casadi-engine/1"
    assert document["status"] == "converged"
    assert document["noise"] == {"omega": {"sigma": 0.1001, "estimated": True}}
    assert (document["cost"], document["n"], document["iterations"], document["nodes"]) == (
        1168.25, 1170, 12, 60,
    )  # fmt: skip
    entry = document["parameters"]["J_eng"]
    assert (entry["value"], entry["stderr"], entry["unit"]) == (0.391083, 0.00042, "kg m2")
    assert (entry["min"], entry["vary"], entry["tie"], entry["at_bound"]) == (0.0, True, None, False)
    assert document["parameters"]["C_half"]["tie"] == "C_eng/2"
    assert document["parameters"]["C_half"]["stderr"] == 0.000155
    assert document["fit_percent"]["misfire_1200rpm"]["omega"]["simulation"] == 95.123
    first = document["inputs"][0]
    assert set(first) >= {"file", "sha256", "samples", "outputs", "history"}
    assert (first["samples"], first["outputs"]) == (1200, ["omega"])


def test_an_error_that_is_doubted_is_null_and_an_interval_is_stored(factory):
    document = result_of(factory.doubted(factory.fit()))
    unknown, uneven = (document["parameters"][name] for name in ("K_el", "J_load"))
    assert (unknown["stderr"], unknown["why"]["stderr"]) == (None, "not known (see note)")
    assert "interval" not in unknown
    assert (uneven["stderr"], uneven["why"]["stderr"]) == (None, "not symmetric (see note)")
    assert uneven["interval"] == [0.12, 0.27]
    assert not list(faults(document))


def test_every_null_number_has_a_reason(fit):
    document = result_of(fit)
    bound = document["parameters"]["C_el"]
    assert (bound["stderr"], bound["at_bound"]) == (None, "min")
    assert bound["why"]["stderr"] == "at its lower bound"
    assert document["parameters"]["r"]["why"] == {"stderr": "fixed", "max": "no upper bound"}
    prediction = document["fit_percent"]["misfire_1200rpm"]["omega"]
    assert prediction["prediction"] is None
    assert prediction["why"]["prediction"].startswith("output error")


def test_no_nan_however_broken_the_fit(factory):
    nan = math.nan
    broken = factory.fit(
        status="not converged: Invalid_Number_Detected",
        cost=nan,
        dof=math.inf,
        covariance=np.full((5, 5), nan),
        noise={"omega": (nan, True)},
        optima=(Optimum(nan, {"J_eng": -math.inf}, 1, "failed"),),
        estimates={"J_eng": Estimate(nan, nan, "kg m2")},
        options={"tolerance": nan, "noise": object(), "starts": (1, nan)},
        timing={"solve": nan},
    )
    document = result_of(broken)
    text = json.dumps(document, allow_nan=False)
    assert "NaN" not in text
    jsonschema.validate(document, schema())
    assert document["cost"] is None
    assert document["why"]["cost"] == "not a finite number (nan)"
    assert document["why"]["covariance"] == "entries that are null are not finite numbers"
    assert document["timing"] == {"solve": None}
    assert document["why"]["timing.solve"] == "not a finite number (nan)"
    assert document["noise"]["omega"]["why"]["sigma"] == "not a finite number (nan)"
    assert document["parameters"]["J_eng"]["why"]["value"] == "not a finite number (nan)"


def test_a_validation_by_the_contract(validation):
    document = result_of(validation, "validate")
    check = document["records"]["misfire_1200rpm"]["omega"]
    assert set(check) >= {"fit_percent", "rmse", "S1", "S2", "whiteness_p", "cross_p"}
    assert document["passed"] is True
    assert set(check["cross_p"]) == {"T_1", "T_load"}
    assert check["cross_p"]["T_load"] is None
    assert check["why"]["cross_p.T_load"].startswith("the drive is constant")
    trace = validation.records["misfire_1200rpm"]["omega"].trace
    assert document["cost"] == pytest.approx(np.nansum((trace.residual / 0.1001) ** 2))
    assert document["n"] == 1170


def test_a_simulation_by_the_contract(fit):
    document = result_of(simulated(fit), "simulate")
    assert document["files"] == ["out/a.csv"]
    assert document["cost"] is None
    assert "not held against measurements" in document["why"]["cost"]
    assert document["parameters"]["K_el"]["value"] == 1992.0


def test_enough_for_a_warm_start(fit):
    document = result_of(fit)
    assert document["free"] == list(fit.free)
    assert document["initial_states"]["misfire_1200rpm"]["omega_eng"]["value"] == 125.0123
    assert np.array(document["covariance"]).shape == (5, 5)
    assert document["options"]["interval"] == 0.01


def test_what_cannot_be_a_result():
    with pytest.raises(
        ResultError, match=r"result\.json does not know this kind of result; seen: int"
    ) as error:
        result_of(3)
    assert error.value.allowed == "a Fit, a Validation, a Simulated, a Repair"
    assert error.value.cure == "give what estimate, validate or simulate returned"


def test_arguments_that_json_cannot_hold(fit):
    with pytest.raises(
        ResultError, match=r"result\.arguments\.x cannot be written as JSON; seen: complex"
    ) as e:
        result_of(fit, arguments={"x": 1j})
    assert e.value.cure == "convert it first"
    document = result_of(fit, arguments={"out": Path("a/b"), "names": {"b", "a"}})
    assert document["arguments"] == {"out": os.path.join("a", "b"), "names": ["a", "b"]}


numbers = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5))


@given(
    st.recursive(
        numbers, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner)
    )
)
@example({"": {"why": None}})
def test_plain_data_are_json_whatever_comes_in(value):
    made = plain(value)
    assert json.loads(json.dumps(made, allow_nan=False)) == made


@given(st.data())
def test_the_check_agrees_with_jsonschema(data):
    """Break one place of a small result at a time: both must say yes or no together."""
    noise = {"y": {"sigma": 1.0, "estimated": True}}
    document = {
        "command": "validate", "schema": "casadi-engine/1", "version": "0", "status": "answered",
        "seconds": 1.0, "timing": {}, "seed": None, "arguments": {}, "inputs": [], "noise": noise,
        "cost": 1.0, "n": 2, "records": {}, "passed": True,
        "parameters": {"J": {"value": 1.0, "stderr": None, "unit": "1", "min": None, "max": None,
                             "vary": True, "tie": None, "at_bound": False, "interval": [0.5, 2.0], "prior": [1.0, 2.0],
                             "why": {"stderr": "x"}}},
    }  # fmt: skip
    holders = [document, document["parameters"], document["parameters"]["J"], document["noise"]["y"]]
    holder = data.draw(st.sampled_from(holders))
    key = data.draw(st.sampled_from(sorted(holder)))
    if data.draw(st.booleans()):
        del holder[key]
    else:
        holder[key] = data.draw(st.sampled_from([None, True, 0, 1.5, "fit", "min", [], [1.0], {}, {"a": 1}]))
    theirs = jsonschema.Draft202012Validator(schema()).is_valid(document)
    assert (not list(faults(document))) == theirs


def test_writing_is_all_or_nothing(tmp_path, fit, monkeypatch):
    path = tmp_path / "new" / "folder" / "result.json"
    assert write_result(path, result_of(fit)) == path
    before = path.read_bytes()
    assert before.endswith(b"}\n")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OutputError, match=r"result\.json: cannot be written; seen: .*No space left") as error:
        write_result(path, result_of(fit, seconds=9.0))
    assert error.value.cure == "check the directory, its permissions and the disk"
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["result.json"]


def test_places_that_cannot_be_written(tmp_path, fit):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="because its folder cannot be made") as error:
        write_result(tmp_path / "file" / "result.json", result_of(fit))
    assert "choose another folder" in error.value.cure
    with pytest.raises(OutputError, match="seen: a folder of that name") as error:
        write_result(tmp_path, result_of(fit))
    assert error.value.allowed == "a file, new or old"
    with pytest.raises(OutputError, match="not the path of a file to write; seen: int") as error:
        write_result(3, result_of(fit))
    with pytest.raises(OutputError, match="the path of a file to write has no name; seen: ''"):
        write_result("", result_of(fit))
    assert error.value.allowed == "text or a pathlib.Path"
