"""Experiment: the mapping of channels, its history and its descriptions."""

import json

import numpy as np
import pytest

from casadi_engine.errors import CasadiEngineError, ExperimentError
from casadi_engine.experiment import Channel, Experiment, read_experiment, with_unique_names

BAD = ExperimentError


def channel(name="a", **changes):
    return Channel(**{"name": name, "unit": "1", "time": [0.0, 1.0], "values": [1.0, 2.0], **changes})


def test_it_is_a_mapping_of_channels(engine):
    assert engine.names == ("theta", "p1", "p2", "T_load", "omega")
    assert "omega" in engine
    assert "p3" not in engine
    assert 3 not in engine
    assert engine["omega"].unit == "rad/s"
    assert (engine.samples, engine.span) == (601, (0.0, 0.3))
    assert engine.duration == pytest.approx(0.3)
    assert engine.place == "experiment 'engine'"


def test_an_unknown_channel(engine, refused):
    refused(BAD, ["experiment 'engine' has no channel 'omegaa'", "T_load, omega", "did you mean 'omega'?"],
            lambda: engine["omegaa"])  # fmt: skip
    refused(BAD, ["no channel 3", "use one of the channels"], lambda: engine[3])


def test_faulty_experiments(refused):
    refused(BAD, ["needs a name", "''"], Experiment, "", (channel(),))
    refused(BAD, ["needs a name", "None"], Experiment, None, (channel(),))
    refused(BAD, ["experiment 'r' has no channels", "read_experiment"], Experiment, "r", ())
    refused(BAD, ["no channels", "'int'"], Experiment, "r", (3,))
    refused(BAD, ["has channel 'a' twice", "each name once"], Experiment, "r", (channel(), channel()))
    refused(BAD, ["has no channel 'b'"], Experiment, "r", (channel(),), inputs=("b",))


def test_every_verb_returns_a_new_experiment_and_adds_a_line(engine):
    keep = np.arange(601) != 3
    done = (
        engine.moving_average(T_load=5)
        .low_pass(cutoff_hz=300, channels="omega")
        .shift_pressures({"p3": "p1"})
        .masked("omega", keep)
        .resample(omega=3)
        .between(0.01, 0.29)
        .cycles(2, 2)
        .with_hold(T_load="zero")
        .with_channel(channel())
        .without("a")
        .only("theta", "p3", "omega")
    )
    assert [step.function for step in done.history] == [
        "from_arrays", "moving_average", "low_pass", "shift_pressures", "masked", "resample", "between",
        "cycles", "with_hold", "with_channel", "without", "only",
    ]  # fmt: skip
    assert len(engine.history) == 1
    assert engine.names == ("theta", "p1", "p2", "T_load", "omega")
    assert done.names == ("theta", "omega", "p3")
    json.dumps([step.to_dict() for step in done.history], allow_nan=False)


def test_with_channel_adds_or_replaces(engine, refused):
    assert engine.with_channel(channel()).names[-1] == "a"
    replaced = engine.with_channel(channel("p1"))
    assert replaced.names == engine.names
    assert len(replaced["p1"]) == 2
    assert (replaced.history[-1].rows_in, replaced.history[-1].rows_out) == (601, 2)
    refused(BAD, ["not a channel", "str"], engine.with_channel, "p1")


def test_with_hold_and_with_inputs(engine, refused):
    assert engine["T_load"].hold == "first"
    assert engine.with_hold(T_load="zero")["T_load"].hold == "zero"
    refused(BAD, ["unknown hold", "linear"], engine.with_hold, T_load="linear")
    refused(BAD, ["no channel 'x'"], engine.with_hold, x="zero")
    assert engine.with_inputs("p1", "theta", "p1").inputs == ("p1", "theta")
    refused(BAD, ["no channel 'x'"], engine.with_inputs, "x")


def test_any_allowed_name_may_be_used_as_a_keyword():
    experiment = Experiment("r", (channel("self", time=[0, 1, 2], values=[1, 2, 3]), channel("T load")))
    assert len(experiment.resample(self=2)["self"]) == 2
    assert experiment.moving_average(self=3).with_hold(self="zero")["self"].hold == "zero"
    assert experiment.resample(**{"T load": 1}).names == ("self", "T load")


def test_without_and_only_keep_the_order_and_the_inputs_that_are_left(engine, refused):
    known = engine.with_inputs("theta", "p1")
    assert known.without("p1", "T_load").names == ("theta", "p2", "omega")
    assert known.without("p1").inputs == ("theta",)
    assert known.only("omega", "theta").names == ("theta", "omega")
    refused(BAD, ["no channel 'x'"], engine.without, "x")
    refused(BAD, ["no channel 'x'"], engine.only, "x")
    refused(BAD, ["has no channels"], engine.without, *engine.names)


def test_names_of_records():
    records = [Experiment(name, (channel(),)) for name in ("run", "run", "run_2", "other", "run")]
    assert [r.name for r in with_unique_names(records)] == ["run", "run_3", "run_2", "other", "run_4"]
    assert [r.name for r in with_unique_names(records[:2])] == ["run", "run_2"]
    assert with_unique_names(records)[0] is records[0]
    assert records[0].renamed("new").name == "new"


def test_the_description_is_json_and_complete(engine, tmp_path, refused):
    path = tmp_path / "run.csv"
    engine.to_csv(path)
    experiment = read_experiment(path, required=["theta", "omega"], inputs=["theta"]).resample(omega=15)
    found = json.loads(json.dumps(experiment.describe(), allow_nan=False))
    assert found["file"] == str(path)
    assert found["sha256"] == experiment.sha256
    assert (found["name"], found["samples"], found["outputs"]) == ("run", 601, ["omega"])
    assert found["ignored"] == ["p1 [Pa]", "p2 [Pa]", "T_load [N m]"]
    assert found["history"][-1] == {
        "function": "resample",
        "arguments": {"omega": 15},
        "rows_in": 601,
        "rows_out": 41,
    }
    assert found["channels"][1] == {
        "name": "omega", "unit": "rad/s", "samples": 41, "missing": 0, "from": 0.0, "to": 0.3,
        "rate": pytest.approx(2000 / 15), "hold": "first", "origin": "measured",
    }  # fmt: skip
    assert experiment.describe(outputs=["omega", "theta"])["outputs"] == ["omega", "theta"]
    assert engine.describe()["file"] is None
    refused(BAD, ["no channel 'x'"], experiment.describe, outputs=["x"])


def test_the_text(engine, tmp_path):
    path = tmp_path / "run.csv"
    engine.to_csv(path)
    experiment = read_experiment(path, required=["omega"], inputs=["theta"]).masked(
        "omega", np.arange(601) > 0
    )
    lines = str(experiment).split("\n")
    assert lines[0] == "Experiment run: 2 channels, 0.3 s, 601 samples"
    assert str(path) in lines[1]
    assert experiment.sha256[:12] in lines[1]
    assert lines[2].split() == [
        "channel",
        "unit",
        "samples",
        "missing",
        "from",
        "[s]",
        "to",
        "[s]",
        "rate",
        "[Hz]",
        "hold",
        "origin",
    ]
    assert lines[3].split() == ["theta", "rad", "601", "0", "0", "0.3", "2000", "first", "measured"]
    assert lines[4].split() == ["omega", "rad/s", "601", "1", "0", "0.3", "2000", "first", "measured"]
    assert lines[5] == "  inputs   theta"
    assert lines[6] == "  ignored  p1 [Pa], p2 [Pa], T_load [N m]"
    assert lines[7].startswith("  history  read_experiment(")
    assert lines[8] == "           masked(name='omega', newly_missing=1): 601 -> 601 samples"
    assert max(len(line) for line in lines[2:7]) < 100
    uneven = Experiment("r", (channel(time=[0, 1, 3], values=[1, 2, 3]),))
    assert str(uneven).startswith("Experiment r: 1 channel, 3 s, 3 samples\n")
    assert "uneven" in str(uneven)
    assert Experiment("<b>", (channel(),))._repr_html_().startswith("<pre>Experiment &lt;b&gt;")


def test_all_errors_are_of_one_family(engine):
    with pytest.raises(CasadiEngineError) as caught:
        engine.resample(omega=0)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("name", [np.array([1, 2]), ["omega"], None, 3])
def test_a_channel_by_something_that_is_no_name(engine, name):
    assert name not in engine
    for look in (engine.__getitem__, engine.without, engine.only):
        with pytest.raises(ExperimentError, match="has no channel"):
            look(name)
    with pytest.raises(ExperimentError, match="inputs is not a list of channel names"):
        engine.with_inputs(name)
