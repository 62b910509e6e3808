"""result.json of a repair: by the contract, by the schema, and read back."""

import json
import math
from dataclasses import replace

import jsonschema
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.repaired import NextExperiment
from casadi_engine.report import to_result, write_result
from casadi_engine.report.schema import faults, schema

CONTRACT = {
    "command", "schema", "version", "status", "seconds", "timing", "seed", "arguments", "inputs", "noise", "cost", "n",
    "parameters", "verdict", "confirmed", "null_fit", "alpha", "threshold", "candidates", "effects", "where", "gap",
    "unknown", "not_found", "next_experiment", "equation",
}  # fmt: skip
KEY = "coupling.coulomb_friction.torque"


def stored(result):
    return to_result(result, command="repair", arguments={"alpha": 0.01}, seconds=12.5, seed=0)


@pytest.mark.parametrize("kind", ["repaired", "nothing_missing", "unnamed", "no_answer"])
def test_every_verdict_meets_the_schema_and_is_read_back(kind, request, tmp_path):
    document = stored(request.getfixturevalue(kind))
    jsonschema.Draft202012Validator(schema()).validate(document)
    assert list(faults(document)) == []
    assert set(document) >= CONTRACT
    assert "NaN" not in json.dumps(document, allow_nan=False)
    path = write_result(tmp_path / "result.json", document)
    again = ce.load_result(path)
    assert again.to_dict() == document
    assert again.initial["misfire_1200rpm"]["omega_eng"] == 125.0123
    assert again.parameter_set()["J_eng"].value == again.values["J_eng"]


def test_a_named_effect_by_the_contract(repaired):
    document = stored(repaired)
    assert (document["verdict"], document["confirmed"], document["status"]) == ("named", True, "answered")
    assert (document["alpha"], document["threshold"], document["candidates"]) == (0.01, 3.8, 380)
    (effect,) = document["effects"]
    assert effect["parameters"] == {KEY: {"value": 8.05, "stderr": 0.07, "unit": "N m", "null": 0.0}}
    assert effect["class"] == [{"name": "coulomb_friction", "at": "coupling", "rho": 1.0, "probability": 1.0}]
    assert (effect["z"], effect["p_value"], effect["share_explained"]) == (95.0, 1e-200, 0.99)
    assert effect["predicted_shift"]["J_load"] == -0.005
    assert effect["found_shift"]["J_load"] == -0.007117
    assert document["parameters"][KEY]["value"] == 8.05
    where = document["where"]
    assert (where["location"], where["record"]) == ("coupling", "misfire_1200rpm")
    assert (where["time"], where["cycles"]) == ([0.1, 0.3], [2, 3, 4])
    assert (where["crank_angle"], where["order"]) == ([12.3, 2.4], 1.5)
    before, after = (document["gap"]["estimation"][key] for key in ("before", "after"))
    assert set(before) >= {"rmse", "fit_percent", "whiteness_p"}
    assert before["rmse"]["omega"] == pytest.approx(math.hypot(0.1, 0.15 / math.sqrt(2)))
    assert after["rmse"]["omega"] == pytest.approx(0.1)
    assert after["whiteness_p"] == {"misfire_1200rpm": {"omega": 0.4}}
    assert document["gap"]["gain_per_cycle"] == {"mean": 339.0, "se": 36.0, "cycles": 10}
    assert document["null_fit"]["status"] == "converged"
    assert document["null_fit"]["optima"][0]["starts"] == 1
    assert document["equation"]["text"].count("coupling.coulomb_friction.torque") == 1
    names = [one["name"] for one in document["inputs"]]
    assert names == ["misfire_1200rpm", "normal_1400rpm"]
    assert document["fresh"] == ["normal_1400rpm"]
    best = [(one["name"], one["at"], one["z"]) for one in document["scores"]]
    assert best[:2] == [("coulomb_friction", "coupling", 95.0), ("backlash", "coupling", 50.0)]
    assert len(best) == 4


def test_an_effect_that_cannot_be_tested_has_no_size_but_a_reason(repaired):
    found, lost = stored(repaired)["not_found"]
    assert (found["smallest_detectable"], found["unit"], found["testable"]) == (3e-4, "rad", True)
    assert (lost["smallest_detectable"], lost["testable"]) == (None, False)
    assert lost["why"]["smallest_detectable"].startswith("not testable: the free parameters")


def test_what_is_not_there_is_null(nothing_missing, unnamed, no_answer):
    clean = stored(nothing_missing)
    assert (clean["verdict"], clean["effects"], clean["where"], clean["unknown"]) == (
        "nothing missing",
        [],
        None,
        None,
    )
    assert clean["confirmed"] is None
    assert clean["equation"] is None
    dark = stored(unnamed)
    assert (dark["verdict"], dark["effects"], dark["gap"]["validation"]) == ("unnamed", [], None)
    assert (dark["unknown"]["at"], dark["unknown"]["signal"]) == ("coupling", "twist")
    assert dark["unknown"]["looks_like"]["cubic"] == 0.97
    assert len(dark["unknown"]["course"]["torque"]) == 40
    failed = stored(no_answer)
    assert (failed["verdict"], failed["gap"], failed["threshold"]) == (None, None, None)
    assert failed["why"]["threshold"].startswith("the fit without effects has not converged")
    assert failed["null_fit"]["status"].startswith("not converged")


def test_nulls_among_what_was_found_have_reasons(repaired):
    effect = repaired.effects[0]
    fading = ce.Parameters
    second = replace(effect.parameters[KEY], value=120.0, stderr=None, unit="rad/s", at_bound="max")
    effect = replace(
        effect,
        parameters=dict(effect.parameters) | {"coupling.coulomb_friction.fading": second},
        selection_frequency=None,
    )
    gain = replace(
        repaired.gaps.gain_per_cycle,
        mean=None,
        se=None,
        cycles=1,
        confirmed=None,
        why="1 cycle of fresh data",
    )
    after = replace(repaired.gaps.estimation_after, whiteness_p={"misfire_1200rpm": {"omega": None}})
    place = replace(repaired.where, order=None, cycles=None, crank_angle=None)
    split = NextExperiment(
        "a run-up to 1800 RPM", ("coulomb_friction at coupling, backlash at coupling",), 6.1, 1.2
    )
    changed = replace(
        repaired, effects=(effect,), gaps=replace(repaired.gaps, gain_per_cycle=gain, estimation_after=after),
        where=place, withdrawn=(effect,), confirmed=None, next_experiment=split,
    )  # fmt: skip
    document = stored(changed)
    jsonschema.validate(document, schema())
    found = document["effects"][0]
    assert found["why"] == {"selection_frequency": "too few cycles to draw halves of them"}
    fading = found["parameters"]["coupling.coulomb_friction.fading"]
    assert fading["null"] is None
    assert fading["why"]["null"] == "it has a meaning with the effect alone"
    assert fading["why"]["stderr"] == "it rests on its bound"
    assert document["gap"]["gain_per_cycle"]["why"]["mean"] == "1 cycle of fresh data"
    why = document["gap"]["estimation"]["after"]["why"]
    assert why == {"whiteness_p.misfire_1200rpm.omega": "the test cannot be made"}
    assert document["where"]["why"] == {"order": "no engine order stands out"}
    assert document["next_experiment"]["expected_separation"] == 6.1
    assert len(document["withdrawn"]) == 1


def test_numbers_that_are_not_finite_have_reasons(repaired):
    side = repaired.gaps.estimation_before
    flat = replace(side, gap=replace(side.gap, fit_percent={"omega": -math.inf}))
    document = stored(replace(repaired, gaps=replace(repaired.gaps, estimation_before=flat)))
    before = document["gap"]["estimation"]["before"]
    assert before["fit_percent"]["omega"] is None
    assert before["why"]["fit_percent.omega"].startswith("the measured output does not vary")


@pytest.mark.parametrize(
    ("place", "value", "seen"),
    [
        (("verdict",), "perhaps", '"perhaps"'),
        (("effects", 0, "parameters", KEY, "unit"), 3, "3"),
        (("gap", "estimation", "before", "rmse"), [1.0], "[1.0]"),
        (("not_found", 0, "testable"), "yes", '"yes"'),
        (("where", "time"), 0.5, "0.5"),
    ],
)
def test_breaks_of_the_contract_are_seen(repaired, place, value, seen):
    document = stored(repaired)
    inside = document
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    assert not jsonschema.Draft202012Validator(schema()).is_valid(document)
    assert [fault[1] for fault in faults(document)] == [seen]


@pytest.mark.parametrize("key", sorted(CONTRACT - {"command"}))
def test_no_key_of_the_contract_may_be_left_out(repaired, key):
    document = stored(repaired)
    del document[key]
    assert not jsonschema.Draft202012Validator(schema()).is_valid(document)
    assert any(seen == f"without {key!r}" for _, seen, _ in faults(document)) or key == "schema"


def test_arrays_do_not_reach_the_file(repaired):
    document = stored(repaired)
    assert not any(isinstance(value, np.ndarray | np.generic) for value in document.values())
