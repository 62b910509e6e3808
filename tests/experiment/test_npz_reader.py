"""NumPy archives."""

import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from casadi_engine.errors import DataFileError, ExperimentError, UnitError
from casadi_engine.experiment import Experiment, read_experiment
from casadi_engine.experiment.header import make_request
from casadi_engine.experiment.npz_reader import read_npz
from casadi_engine.experiment.source import Source

T = np.arange(5) / 10
BAD = DataFileError
EVENTS = {"omega": ("omega_time_s", "omega_rad_s", "rad/s"), "p": ("theta_time_s", "p_rel_bar", "bar")}


@pytest.fixture
def save(tmp_path):
    def save(**arrays):
        path = tmp_path / "run.npz"
        np.savez(path, **arrays)
        return path

    return save


def good(**changes):
    return {"time [s]": T, "omega [rpm]": [1.0, 2, np.nan, 4, 5], "p1 [bar]": T.astype("float32"), **changes}


def test_keys_with_units(save):
    path = save(**good())
    experiment = read_experiment(path, assumed=["p1"])
    assert experiment.names == ("omega", "p1")
    np.testing.assert_allclose(experiment["omega"].values, np.array([1, 2, np.nan, 4, 5]) * np.pi / 30)
    assert experiment["omega"].missing == 1
    assert experiment["p1"].origin == "assumed"
    assert experiment["p1"].values[1] == float(np.float32(0.1)) * 1e5
    assert experiment["omega"].time is experiment["p1"].time
    assert (experiment.name, experiment.source, len(experiment.sha256)) == ("run", str(path), 64)
    assert experiment.history[0].arguments == {"file": str(path), "assumed": ["p1"]}
    only = read_experiment(path, required=["omega"])
    assert (only.names, only.ignored) == (("omega",), ("p1 [bar]",))


def test_a_mapping_for_channels_with_their_own_times(save):
    path = save(
        omega_time_s=[0.0, 0.11, 0.2], omega_rad_s=[1, 2, 3], theta_time_s=T, p_rel_bar=T, edge_slot=[1, 2]
    )
    experiment = Experiment.from_npz(path, channels=EVENTS, name="tue", hold="zero")
    assert experiment.name == "tue"
    assert experiment["omega"].rate is None
    assert len(experiment["p"]) == 5
    assert experiment["p"].unit == "Pa"
    assert experiment["p"].hold == "zero"
    assert experiment.ignored == ("edge_slot",)
    assert experiment.history[0].arguments["channels"] == {key: list(value) for key, value in EVENTS.items()}


def test_the_time_of_a_mapping_is_converted_when_its_key_says_so(save):
    path = save(**{"clock [ms]": T * 1000, "p": T})
    experiment = Experiment.from_npz(path, channels={"p": ("clock [ms]", "p", "Pa")})
    np.testing.assert_allclose(experiment["p"].time, T)


@pytest.mark.parametrize(
    ("arrays", "options", "error", "pieces"),
    [
        (good(**{"omega [rpm]": T[:3]}), {}, BAD,
         ["run.npz, key 'omega [rpm]': channel 'omega' has values and times", "3 values, 5 times"]),
        (good(**{"omega [rpm]": T[:, None]}), {}, BAD, ["key 'omega [rpm]' is not a list", "(5, 1)"]),
        (good(**{"omega [rpm]": list("abcde")}), {}, BAD, ["key 'omega [rpm]' is not a list", "<U1"]),
        (good(**{"omega [rpm]": [1, 2, np.inf, 4, 5]}), {}, BAD,
         ["'omega' is not finite at sample 2", "inf"]),
        (good(**{"omega [rpm]": np.array([1, None, 2, 3, 4])}), {}, BAD,
         ["run.npz: not a readable .npz archive", "allow_pickle", "save the record again"]),
        (good(**{"time [s]": [0, 1, 1, 2, 3]}), {}, BAD, ["does not increase at sample 2", "1.0 after 1.0"]),
        (good(**{"time [s]": [0, 1, np.nan, 2, 3]}), {}, BAD, ["not finite at sample 2"]),
        (good(), {"inputs": ["omega"]}, BAD,
         ["key 'omega [rpm]': NaN in an input at sample 2", "fill the gap"]),
        (good(), {"required": ["thta", "omega"]}, BAD, ["channel 'thta' is missing", "seen: omega"]),
        (good(), {"required": []}, BAD,
         ["no array to read beside the time", "time [s], omega [rpm], p1 [bar]"]),
        (good(**{"q": T}), {}, BAD, ["key 'q': no unit in the key", "rename the key to q [unit]"]),
        (good(**{"q [furlong]": T}), {}, UnitError, ["run.npz, key 'q [furlong]': unknown unit", "furlong"]),
        (good(**{"omega [rad/s]": T}), {}, BAD,
         ["key 'omega [rad/s]': a repeated name", "'omega [rpm]' and"]),
        (good(**{"time [ms]": T}), {}, BAD,
         ["more than one key for the time", "time [ms]", "rename the keys"]),
        ({"omega [rpm]": T}, {}, BAD, ["run.npz: no key for the time", "seen: omega [rpm]"]),
        ({"time": T, "omega [rpm]": T}, {}, BAD, ["key 'time': no unit", "rename it to time [s]"]),
        ({"time [Pa]": T, "omega [rpm]": T}, {}, UnitError, ["key 'time [Pa]': not a unit of time", "s, ms"]),
        (good(**{"a,b [1]": T}), {}, BAD, ["not a channel name", "'a,b'"]),
    ],
)  # fmt: skip
def test_faulty_arrays(save, refused, arrays, options, error, pieces):
    refused(error, pieces, read_experiment, save(**arrays), **options)


def test_faulty_mappings(save, refused):
    path = save(t=T, p=T)
    read = Experiment.from_npz
    refused(BAD, ["key 'q' is missing", "seen: t, p"], read, path, channels={"p": ("t", "q", "Pa")})
    refused(BAD, ["did you mean 'p'?"], read, path, channels={"p": ("t", "pp", "Pa")})
    refused(
        ExperimentError, ["'p' is not three texts", "omega_time_s"], read, path, channels={"p": ("t", "p")}
    )
    refused(ExperimentError, ["'p' is not three texts"], read, path, channels={"p": "abc"})
    refused(UnitError, ["key 'p': unknown unit", "psig"], read, path, channels={"p": ("t", "p", "psig")})
    refused(BAD, ["'w' is missing"], read, path, channels={"p": ("t", "p", "Pa")}, required=["w"])


def test_what_is_not_an_archive(tmp_path, refused):
    path = tmp_path / "a.npz"
    refused(BAD, ["a.npz: no such file"], read_experiment, path)
    path.write_bytes(b"text, not an archive")
    refused(BAD, ["a.npz: not a readable .npz archive", "save the record again"], read_experiment, path)
    np.save(tmp_path / "b.npy", T)
    path.write_bytes((tmp_path / "b.npy").read_bytes())
    refused(BAD, ["a.npz: a single array", "numpy.savez"], read_experiment, path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("time [s].npy", b"not an array")
        archive.writestr("p [Pa].npy", b"not an array")
    refused(BAD, ["a.npz"], read_experiment, path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("huge.txt", b"")
    refused(BAD, ["no key for the time", "huge.txt"], read_experiment, path)


@pytest.fixture(scope="module")
def archive_bytes(tmp_path_factory):
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    np.savez(path, **good())
    return path.read_bytes()


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(changes=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_damaged_archive_gives_channels_or_a_named_error(archive_bytes, changes):
    data = bytearray(archive_bytes)
    for where, byte in changes:
        data[where % len(data)] = byte
    message, loaded = "a.npz", None
    try:
        loaded = read_npz(Source("a.npz", bytes(data), ""), make_request())
    except (DataFileError, UnitError) as error:
        message = str(error)
    assert message.startswith("a.npz")
    assert message != "a.npz" or loaded.channels


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_truncated_archive_is_a_named_error(archive_bytes, refused, share):
    data = archive_bytes[: int(share * len(archive_bytes))]
    refused(BAD, ["a.npz: not a readable"], read_npz, Source("a.npz", data, ""), make_request())
