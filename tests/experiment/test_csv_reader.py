"""The data-file contract, one case after the other, on files on the disk."""

import gzip
import hashlib
import time as clock

import numpy as np
import pytest

from casadi_engine.errors import DataFileError, ExperimentError, UnitError
from casadi_engine.experiment import Experiment, read_experiment

GOOD = "time [s],omega [rpm],p1 [bar]\n0,1200,1.5\n0.1,1230,\n0.2,1260,2.5\n"
NUMBER = "a number with a decimal point"
HEADER = "time [s],name [unit]"
BAD = DataFileError


def cell(text):
    """The good file with another text in row 3 of omega."""
    return GOOD.replace("1230", text)


def last(label):
    """The good file with another header above its last column."""
    return GOOD.replace("p1 [bar]", label)


@pytest.fixture
def save(tmp_path):
    def save(content, name="record.csv"):
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return save


def expect_good(experiment):
    assert experiment.names == ("omega", "p1")
    np.testing.assert_allclose(experiment["omega"].values, np.array([1200, 1230, 1260]) * np.pi / 30)
    np.testing.assert_array_equal(experiment["p1"].values, [1.5e5, np.nan, 2.5e5])
    np.testing.assert_array_equal(experiment["p1"].mask, [True, False, True])
    np.testing.assert_array_equal(experiment["p1"].time, [0, 0.1, 0.2])
    assert (experiment["omega"].unit, experiment["p1"].unit) == ("rad/s", "Pa")


@pytest.mark.parametrize(
    "content",
    [
        GOOD,
        GOOD.rstrip("\n"),
        GOOD + "\n\n",
        GOOD + " \n\t\n",
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        "\ufeff" + GOOD,
        GOOD.replace("time [s],omega [rpm]", '"time [s]","omega [rpm]"'),
        GOOD.replace("1230", '"1230"'),
        GOOD.replace(",", " , "),
        GOOD.replace("\n", ",\n"),
        GOOD.replace("\n", ",,\n"),
        GOOD.replace("1200", "1.2e3").replace("1230", "+1230.").replace("0.2", ".2"),
        GOOD.replace("omega [rpm]", "omega  [ rpm ]").replace("p1 [bar]", "p1[bar]"),
        GOOD.replace("time [s]", "time [ms]").replace("0.1,", "100,").replace("0.2,", "200,"),
    ],
)
def test_every_way_to_write_the_same_record(save, content):
    expect_good(read_experiment(save(content)))
    expect_good(read_experiment(save(gzip.compress(content.encode()), "record.csv.gz")))


def test_gzip_is_seen_by_its_content_and_several_members_are_one_file(save):
    expect_good(read_experiment(save(gzip.compress(GOOD.encode(), mtime=0), "record.csv")))
    halves = gzip.compress(GOOD[:30].encode()) + gzip.compress(GOOD[30:].encode())
    expect_good(read_experiment(save(halves, "record.csv.gz")))


@pytest.mark.parametrize(
    ("content", "options", "error", "pieces"),
    [
        # cells
        (cell("nan"), {}, BAD,
         ["record.csv, column 'omega [rpm]', row 3", "not a number", "'nan'", NUMBER, "empty"]),
        (cell("NaN"), {"inputs": ["omega"]}, BAD, ["'omega [rpm]', row 3", "'NaN'"]),
        (cell("inf"), {}, BAD, ["column 'omega [rpm]', row 3", "'inf'", "no use"]),
        (cell("-Infinity"), {}, BAD, ["column 'omega [rpm]', row 3", "no use"]),
        (cell("1e999"), {}, BAD, ["'omega [rpm]', row 3: the number is too large", "1e999"]),
        (GOOD.replace("2.5\n", "1.79e308\n"), {}, BAD,
         ["'p1 [bar]', row 4", "too large in Pa", "1.79e+308 bar"]),
        (cell("fast"), {}, BAD, ["'omega [rpm]', row 3", "'fast'", "correct the cell"]),
        (cell("x" * 500), {}, BAD, ["row 3", "x" * 60 + "...'"]),
        (cell('"1,230"'), {}, BAD, ["'omega [rpm]', row 3", "'1,230'", "thousands separators"]),
        (cell("1,230"), {}, BAD,
         ["column number 4, row 3: the row is too long", "4 cells", "3 cells, as in the header",
          "thousands separators"]),
        (cell("1 230"), {}, BAD, ["row 3", "'1 230'", "thousands separators"]),
        (cell("1'230"), {}, BAD, ["row 3", "thousands separators"]),
        (cell("1_230"), {}, BAD, ["row 3", "'1_230'"]),
        (cell('"1230'), {}, BAD, ["record.csv, row 3", "cannot be split", "take the quotes out"]),
        (GOOD.replace("0.1,", ","), {}, BAD,
         ["column 'time [s]', row 3: an empty time cell", "complete the time"]),
        (GOOD.replace("0.1,", "nan,"), {}, BAD, ["column 'time [s]', row 3", "'nan'"]),
        (GOOD, {"inputs": ["p1"]}, BAD,
         ["column 'p1 [bar]', row 3: an empty cell in an input column", "only outputs may", "fill the gap"]),
        # rows
        (GOOD.replace("0.1,1230,", "0.1,1230"), {}, BAD,
         ["column 'p1 [bar]', row 3: the row is too short", "2 cells", "3 cells, as in the header",
          "complete the row"]),
        (GOOD.replace("0.1,1230,", "0.1,1230,,"), {}, BAD, ["row 3: the row is too long", "extra commas"]),
        (GOOD.replace("0.1,1230,", ""), {}, BAD,
         ["column 'time [s]', row 3: an empty line inside the data", "delete the empty line"]),
        (GOOD.replace("0.2", "0.1"), {}, BAD,
         ["column 'time [s]', row 4: the time does not increase", "0.1 after 0.1", "strictly increasing",
          "sort the rows"]),
        (GOOD.replace("0.2", "0.05"), {}, BAD, ["row 4: the time does not increase", "0.05 after 0.1"]),
        ("time [s],omega [rpm]\n", {}, BAD,
         ["row 1: fewer than two samples", "0 below the header", "two or more rows"]),
        ("time [s],omega [rpm]", {}, BAD, ["row 1: fewer than two samples"]),
        ("time [s],omega [rpm]\n0,1\n\n", {}, BAD, ["row 2: fewer than two samples", "1 below the header"]),
        # header
        ("0,1200\n0.1,1200\n", {}, BAD,
         ["column number 1, row 1: the first column is not the time", "'0'", HEADER, "write a header line"]),
        ("omega [rpm],time [s]\n1,0\n1,1\n", {}, BAD, ["'omega [rpm]'", "move the time column to the front"]),
        ("time [s];omega [rpm]\n0;1\n1;2\n", {}, BAD, ["row 1", "separate the columns by commas"]),
        ("\n" + GOOD, {}, BAD, ["row 1: the first column is not the time", "no name"]),
        ("Time [s],omega [rpm]\n0,1\n1,2\n", {}, BAD, ["the first column is not the time", "'Time [s]'"]),
        ("time,omega [rpm]\n0,1\n1,2\n", {}, BAD, ["column 'time', row 1: no unit", "write time [s]"]),
        ("time [rpm],omega [rpm]\n0,1\n1,2\n", {}, UnitError,
         ["column 'time [rpm]', row 1: not a unit of time", "s, ms"]),
        ("time [fortnight],omega [rpm]\n0,1\n1,2\n", {}, UnitError,
         ["column 'time [fortnight]', row 1: unknown unit 'fortnight'"]),
        (GOOD.replace("[bar]", "[bar/EUR]"), {}, UnitError,
         ["record.csv, column 'p1 [bar/EUR]', row 1: unknown unit 'EUR'", "\n  bar/EUR\n      ^^^\n", "L/min",
          "convert the data"]),
        (GOOD.replace("[bar]", "[Bar]"), {}, UnitError, ["'p1 [Bar]', row 1", "did you mean 'bar'?"]),
        (GOOD.replace("[bar]", ""), {}, BAD,
         ["column 'p1', row 1: no unit in the header", HEADER, "write p1 [unit]", "required="]),
        (GOOD.replace("[bar]", "[]"), {}, UnitError, ["'p1 []', row 1: unknown unit", "dimensionless"]),
        (last("omega [rad/s]"), {}, BAD,
         ["column 'omega [rad/s]', row 1: a repeated column", "'omega' in columns number 2 and 3",
          "rename or delete"]),
        (last("time [s]"), {}, BAD, ["a repeated column", "'time' in columns number 1 and 3"]),
        (last('"p,1 [bar]"'), {}, BAD, ["row 1: not a channel name", "'p,1'", "without brackets"]),
        (last("[bar]"), {}, BAD, ["column '[bar]', row 1: not a channel name", "rename the column"]),
        (last('"p1 [bar]'), {}, BAD, ["row 1: the header line cannot be split", "quotes"]),
        (last(""), {}, BAD,
         ["column number 3 (no name), row 2: the column holds data but its header is empty", "'1.5'",
          "required="]),
        ("time [s]\n0\n1\n", {}, BAD,
         ["row 1: no column to read beside the time", "seen: time", "add a column"]),
        ("time [s],\n0,\n1,\n", {}, BAD, ["no column to read beside the time"]),
        (GOOD, {"required": ["omega", "theta"]}, BAD,
         ["row 1: column 'theta' is missing", "time, omega, p1", "a column theta [unit]", "add the column"]),
        (GOOD, {"required": ["omga"]}, BAD, ["'omga' is missing", "rename column 'omega'"]),
        (GOOD, {"inputs": ["theta"]}, BAD, ["column 'theta' is missing"]),
        (GOOD, {"assumed": ["p3"]}, BAD, ["column 'p3' is missing"]),
        (GOOD, {"required": []}, BAD, ["no column to read", "time, omega, p1"]),
        # bytes
        (b"", {}, BAD, ["record.csv, row 1: the file is empty", "a header line and two or more rows"]),
        (GOOD.encode().replace(b"1230", b"12\xff0"), {}, BAD,
         ["column 'omega [rpm]', row 3: the file is not UTF-8", "byte 0xff", "save the file as CSV UTF-8"]),
        (b"time [s],\xe9 [1]\n0,1\n1,2\n", {}, BAD,
         ["column number 2, row 1: the file is not UTF-8", "0xe9"]),
        (GOOD.encode("utf-16"), {}, BAD, ["row 1: the file is not UTF-8", "UTF-16", "save the file"]),
        (cell("12\x0030"), {}, BAD, ["column 'omega [rpm]', row 3", "a zero byte"]),
        (cell("12\r30"), {}, BAD, ["column 'omega [rpm]', row 3", "a carriage return inside"]),
        (b"PK\x03\x04abc", {}, BAD, ["row 1: the file is not text", "a zip archive"]),
        (gzip.compress(GOOD.encode(), mtime=0)[:-9], {}, BAD,
         ["record.csv: the gzip file is truncated", "copy or export"]),
        (gzip.compress(GOOD.encode(), mtime=0)[:12], {}, BAD, ["truncated"]),
        (gzip.compress(GOOD.encode(), mtime=0) + b"rest", {}, BAD, ["the gzip file is damaged", "copy or export"]),
        (gzip.compress(GOOD.encode(), mtime=0)[:20] + b"\x00" * 40, {}, BAD, ["the gzip file is"]),
        (gzip.compress(b"", mtime=0), {}, BAD, ["empty when unpacked"]),
    ],
)  # fmt: skip
def test_every_breach_of_the_contract_names_file_column_and_row(
    save, refused, content, options, error, pieces
):
    path = save(content)
    message = refused(error, pieces, read_experiment, path, **options)
    assert message.startswith(str(path))


def test_what_is_not_a_readable_file(save, refused, tmp_path):
    read = read_experiment
    refused(DataFileError, ["nothing.csv: no such file", "check the path"], read, tmp_path / "nothing.csv")
    refused(DataFileError, ["does not exist either", str(tmp_path / "no")], read, tmp_path / "no" / "a.csv")
    refused(DataFileError, [f"{tmp_path}: a directory", "one data file in it"], read, tmp_path)
    refused(DataFileError, ["not gzip", "take .gz off"], read, save(GOOD, "record.csv.gz"))
    refused(
        DataFileError,
        ["a.mat: a kind of data file", ".mat", "from_dataframe"],
        read,
        save("x", "a.mat"),
    )
    refused(DataFileError, ["not the path of a data file", "int"], read, 3)
    refused(DataFileError, ["cannot be read", "null"], read, "a\x00b.csv")
    refused(DataFileError, ["cannot be read"], read, save(GOOD) / "below.csv")


def test_a_file_without_permission(save, refused, monkeypatch):
    path = save(GOOD)

    def closed(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("builtins.open", closed)
    pieces = [f"{path}: no permission to read it", "change its permissions"]
    refused(DataFileError, pieces, read_experiment, path)


def test_a_hostile_gzip_file_does_not_fill_the_memory(save, refused, monkeypatch):
    monkeypatch.setattr("casadi_engine.experiment.source.LARGEST", 10_000)
    path = save(gzip.compress(b"0" * 20_000), "bomb.csv.gz")
    refused(
        DataFileError, ["bomb.csv.gz: too large when unpacked", "10000 bytes", "split"], read_experiment, path
    )


def test_options_are_checked(save, refused):
    path = save(GOOD)
    refused(ExperimentError, ["assumed is not a list", "seen: 3", "p3"], read_experiment, path, assumed=3)
    refused(ExperimentError, ["inputs is not a list", "[1]"], read_experiment, path, inputs=[1])
    refused(ExperimentError, ["unknown hold", "linear", "first, zero"], read_experiment, path, hold="linear")
    assert read_experiment(path, assumed="p1")["p1"].origin == "assumed"


def test_columns_that_are_not_asked_for_are_ignored_and_listed(save):
    content = "time [s],note,omega [rpm],q [furlong],,x\n"
    content += '0,"hot, dry",1,nan,a,"two\nlines"\n1,,2,inf,,\n2,b,3,-,,"y"\n'
    experiment = read_experiment(save(content), required=["omega"])
    assert experiment.names == ("omega",)
    assert experiment.ignored == ("note", "q [furlong]", "column 5 (no name)", "x")
    np.testing.assert_allclose(experiment["omega"].values * 30 / np.pi, [1, 2, 3])
    assert experiment["omega"].rows.tolist() == [2, 4, 5]  # the first row takes two lines


def test_an_empty_nameless_last_column_is_ignored_and_listed(save):
    assert read_experiment(save(GOOD.replace("\n", ",\n"))).ignored == ("column 4 (no name)",)


def test_optional_columns_may_be_absent(save):
    path = save(GOOD)
    assert read_experiment(path, required=["omega"], optional=["omega_load"]).names == ("omega",)
    assert read_experiment(path, required=["omega"], optional=["p1"]).names == ("omega", "p1")
    assert read_experiment(path, assumed=["p3"], optional=["p3"]).names == ("omega", "p1")
    assert read_experiment(path, assumed=["p1"], optional=["omega_load"])["p1"].origin == "assumed"


def test_what_an_experiment_knows_of_its_file(save):
    path = save(gzip.compress(GOOD.encode(), mtime=0), "normal_1200rpm.csv.gz")
    experiment = read_experiment(path, inputs=["omega"], hold="zero")
    assert experiment.name == "normal_1200rpm"
    assert experiment.source == str(path)
    assert experiment.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert experiment.inputs == ("omega",)
    assert experiment["omega"].hold == "zero"
    assert experiment["p1"].rows.tolist() == [2, 3, 4]
    (step,) = experiment.history
    assert (step.function, step.rows_in, step.rows_out) == ("read_experiment", 3, 3)
    assert step.arguments == {"file": str(path)}
    assert read_experiment(path, name="other").name == "other"
    assert experiment["omega"].time is experiment["p1"].time


def test_the_first_fault_in_reading_order_is_reported(save, refused):
    rows = [f"{k},{k},{k}" for k in range(5000)]
    rows[3210], rows[4000] = "3210,3210,oops", "x,y,z"
    content = "time [s],a [1],b [1]\n" + "\n".join(rows)
    refused(DataFileError, ["column 'b [1]', row 3212", "'oops'"], read_experiment, save(content))


def test_numbers_are_correctly_rounded(save):
    rng = np.random.default_rng(4)
    values = rng.normal(size=3000) * 10.0 ** rng.integers(-300, 300, size=3000)
    rows = "\n".join(f"{k},{value!r},{value:.25e}" for k, value in enumerate(values.tolist()))
    experiment = read_experiment(save(f"time [s],a [1],b [1]\n{rows}\n"))
    np.testing.assert_array_equal(experiment["a"].values, values)
    np.testing.assert_array_equal(experiment["b"].values, values)


def test_fourteen_thousand_rows_are_read_in_well_under_a_second(tmp_path):
    rng = np.random.default_rng(1)
    count = 14_400
    names = ("theta", "p1", "p2", "p3", "p4", "T_load", "omega")
    record = Experiment.from_arrays(
        "r",
        time=np.arange(count) / 14_402,
        units=dict.fromkeys(names, "1"),
        **{name: rng.normal(size=count) for name in names},
    )
    path = tmp_path / "r.csv.gz"
    record.to_csv(path)
    seconds = []
    for _ in range(5):
        start = clock.process_time()
        again = read_experiment(path)
        seconds.append(clock.process_time() - start)
    # It takes 60 ms of an idle desktop core; the bound leaves room for a busy machine and still fails for
    # any loop over rows.
    assert min(seconds) < 0.15
    for name in names:
        np.testing.assert_array_equal(again[name].values, record[name].values)


@pytest.mark.parametrize(("unit", "seconds"), [("min", 60.0), ("h", 3600.0), ("d", 86400.0), ("us", 1e-6)])
def test_a_time_in_any_unit_of_time_is_read_in_seconds(tmp_path, unit, seconds):
    path = tmp_path / "run.csv"
    path.write_text(f"time [{unit}],y [L/min]\n0,0\n0.5,60\n2,120\n")
    read = read_experiment(path)
    assert read["y"].time == pytest.approx([0.0, 0.5 * seconds, 2 * seconds], rel=1e-15)
    assert read["y"].values == pytest.approx([0.0, 1e-3, 2e-3], rel=1e-15)
    path.write_text(f"time [{unit}],y [1]\n0,0\n1,60\n1,120\n")
    with pytest.raises(DataFileError, match="row 4: the time does not increase"):
        read_experiment(path)
