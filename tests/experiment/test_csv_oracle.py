"""Ten thousand generated CSV files: each gives the right answer or a named error that names its place.

The oracle is a slow reader of its own: it lists every fault of a file by row and column. The reader under
test must refuse exactly the files with a fault, naming one of the faulty places, and agree to the last
digits on all others.
"""

import contextlib
import csv
import gzip
import math
import random
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from casadi_engine.errors import DataFileError, UnitError
from casadi_engine.experiment import csv_reader
from casadi_engine.experiment.csv_reader import read_csv
from casadi_engine.experiment.header import make_request
from casadi_engine.experiment.source import Source
from casadi_engine.experiment.units import SI_UNITS, read_unit
from tests.quick import few

FACTORS = dict.fromkeys(SI_UNITS, 1.0) | {
    "ms": 1e-3,
    "deg": math.pi / 180,
    "rpm": math.pi / 30,
    "bar": 1e5,
    "kPa": 1e3,
    "MPa": 1e6,
    "N mm": 1e-3,
    "%": 1e-2,
    "g m2": 1e-3,
}


# -- the oracle --------------------------------------------------------------------------------------------


class Faults(Exception):
    """Every fault of a file: (row, header text of the column or None)."""

    def __init__(self, *places):
        super().__init__(places)
        self.places = places


def reference(data, required=None, inputs=()):
    """Channels {name: [value or None]} in SI with "time" among them, or Faults."""
    if data[:2] == b"\x1f\x8b":
        data = gzip.decompress(data)
    lines = text_lines(data)
    try:
        labels = [label.strip() for label in next(csv.reader(lines[:1], strict=True, skipinitialspace=True))]
    except (csv.Error, StopIteration):
        raise Faults((1, None)) from None
    columns = columns_of(labels, required, inputs)
    rows = rows_of(lines[1:], labels, columns)
    return values_of(rows, labels, columns, inputs)


def text_lines(data):
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or data[:4] == b"PK\x03\x04":
        raise Faults((1, None))
    if data[:3] == b"\xef\xbb\xbf":
        data = data[3:]
    if b"\n" in data:
        lines = data.split(b"\n")
        lines = [line[:-1] if line.endswith(b"\r") else line for line in lines[:-1]] + lines[-1:]
    else:
        lines = data.split(b"\r")
    faults = []
    for row, line in enumerate(lines, start=1):
        try:
            line.decode()
        except UnicodeDecodeError:
            faults.append((row, None))
        if b"\x00" in line or b"\r" in line:
            faults.append((row, None))
    if faults:
        raise Faults(*faults)
    lines = [line.decode() for line in lines]
    while len(lines) > 1 and not lines[-1].strip(" \t"):
        lines.pop()
    return lines


def parts(label):
    match = re.fullmatch(r"([^][]*)\[([^][]*)\]", label)
    return (match[1].strip(), match[2].strip()) if match else (label, None)


def columns_of(labels, required, inputs):
    """{name: (position, label, unit)} of the columns to be read, and the positions of nameless ones."""
    faults, read, nameless = [], {}, []
    names = [parts(label)[0] for label in labels]
    if not labels or names[0] != "time" or not is_time(parts(labels[0])[1]):
        raise Faults((1, None))
    for position, label in enumerate(labels):
        name, unit = parts(label)
        if not label:
            if required is None:
                nameless.append(position)
            continue
        if name and name in names[:position]:
            faults.append((1, label))
        if position and required is not None and name not in (*required, *inputs):
            continue
        bad = not name or bool(re.search(r'[\[\],"\x00-\x1f\x7f]', name))
        if bad or unit is None or not is_unit(" ".join(unit.split())):
            faults.append((1, label))
            continue
        read[name] = (position, label, " ".join(unit.split()))
    faults += [(1, None) for name in (*(required or ()), *inputs) if name not in read]
    if faults or len(read) < 2:
        raise Faults(*faults, (1, None))
    return read, nameless


def is_unit(text):
    """Damaged bytes may leave another unit behind, such as pm of rpm: how those are read is tested elsewhere."""
    if text not in FACTORS:
        with contextlib.suppress(UnitError):
            factor = read_unit(text)
            FACTORS[text] = float(factor.factor) * math.pi ** float(factor.pi)
    return text in FACTORS


def is_time(unit):
    text = " ".join((unit or "").split())
    return is_unit(text) and read_unit(text).si == "s"


def rows_of(lines, labels, columns):
    read, nameless = columns
    reader = csv.reader((line + "\n" for line in lines), strict=True, skipinitialspace=True)
    rows, faults = [], []
    while True:
        row = reader.line_num + 2
        try:
            cells = next(reader)
        except StopIteration:
            break
        except csv.Error:
            faults.append((row, None))
            break
        if len(cells) != len(labels):
            faults.append((row, None))
            continue
        values = {}
        for name, (position, label, _) in read.items():
            try:
                values[name] = number(cells[position].strip(" \t"))
            except ValueError:
                faults.append((row, label))
        faults += [(row, None) for position in nameless if cells[position].strip(" \t")]
        rows.append((row, values))
    if faults:
        raise Faults(*faults)
    return rows


def number(text):
    if not text:
        return None
    if not set(text) <= set("0123456789+-.eE"):
        raise ValueError
    value = float(text)
    if math.isinf(value):
        raise ValueError
    return value


def values_of(rows, labels, columns, inputs):
    read, _ = columns
    if len(rows) < 2:
        raise Faults((len(rows) + 1, None))
    faults, before = [], -math.inf
    for row, values in rows:
        for name, (_, label, unit) in read.items():
            value = values[name]
            if value is None:
                if name == "time" or name in inputs:
                    faults.append((row, label))
            elif math.isinf(value * FACTORS[unit]):
                faults.append((row, label))
        if values["time"] is not None:
            time = values["time"] / (1000.0 if read["time"][2] == "ms" else 1.0)
            if not time > before:
                faults.append((row, labels[0]))
            before = time
    if faults:
        raise Faults(*faults)
    return {
        name: [None if v[name] is None else v[name] * FACTORS[unit] for _, v in rows]
        for name, (_, _, unit) in read.items()
    }


# -- the generated files -----------------------------------------------------------------------------------

NAMES = (
    "theta [rad]",
    "p1 [bar]",
    "p2 [Pa]",
    "T_load [N m]",
    "omega [rpm]",
    "phi [deg]",
    "m [1]",
    "J [g m2]",
)
FORMATS = ("{!r}", "{:.3e}", "{:+.6f}", " {!r}", "{!r} ", "{:.4E}", "\t{!r}", "{:.20g}")
WEIRD = (
    "", " ", "\t", "nan", "NaN", "inf", "-inf", "Infinity", "NA", "null", "1,234", "1,234.5", '"1,234.5"',
    "1'234", "1 234", "1_000", "0x10", "1e999", "-1e999", "1e308", "1.8e305", "1e-400", "1e", "e5", ".", "-",
    "+", "--1", "+-1", "1-", "1..2", "1.2.3", ".5", "5.", "-.5e-3", "0", "-0", "007", '"2.5"', '" 2.5 "',
    '"2.5', '2.5"', '""', '"2"5', "'2.5'", "\u0661", "\u00bd", "\u22121", "1\u00a0", "1;2", "#", "#N/A",
    "1d3", "1e5.5", "9" * 320, "0" * 50 + "1", "4.9e-324", "1.7976931348623157e308", "1234567890" * 3,
    '"a\nb"', "text", "\x0b1", "1\x0c", "\u2028", "-nan", "1.#INF", "1e+", "1E+5", "1 e5", "e", "2" * 200,
)  # fmt: skip
HEADERS = (
    "", " ", "omega", "omega [rpm", "omega rpm]", "omega [furlong]", "omega [RPM]", "[Pa]", "omega []",
    "time [s]", "time", "omega [Pa]", "p1 [bar]", "a]b [Pa]", '"p9 [Pa]"', '"a,b [Pa]"', '"p9 [Pa]',
    "p9 [N  m]", " p9 [ Pa ] ", "p9[Pa]", "\u03c9 [rad/s]", "p9 [%]", "1.5", "time [ms]", "time [Pa]",
    "Time [s]", "p9 [Pa] x", "p9 [[Pa]]", "x\ty [1]",
)  # fmt: skip
BYTES = (
    b"\x00", b"\xff", b"\xe9", b"\xc3", b"\r", b"\n", b"\r\n", b",", b'"', b" ", b";", b"\x1a", b"e", b"-",
    b".", b"1", b"\t", b"\xef\xbb\xbf", b"\xe2\x80\xa8", b"n", b"[", b"]", b"'", b"\\",
)  # fmt: skip
KINDS = {  # most changes to the table, to the bytes
    "valid": (0, 0),
    "one cell": (1, 0),
    "table": (3, 0),
    "bytes": (0, 2),
}


def generated(pick, kind):
    """A data file and what is asked of it: a valid table, then changes to its cells and its bytes.

    pick(n) gives a whole number from 0 to n - 1: from a seed, or drawn by hypothesis.
    """
    width, height = 1 + pick(4), 2 + pick(4)
    names = list(NAMES)
    header = [
        "time [ms]" if pick(10) == 0 else "time [s]",
        *(names.pop(pick(len(names))) for _ in range(width)),
    ]
    style = FORMATS[pick(len(FORMATS))] if pick(2) else "{!r}"
    time, table = pick(2000) / 7 - 100, [header]
    for _ in range(height):
        time += (1 + pick(10**6)) / 3e5
        numbers = (time, *((pick(10**9) - 5 * 10**8) / 3e6 for _ in range(width)))
        table.append([style.format(number) for number in numbers])
        if pick(12) == 0:
            table[-1][-1] = ""
    if pick(7) == 0:
        for row in table:
            row.append("")
    most_table, most_bytes = KINDS[kind]
    for _ in range(most_table and 1 + pick(most_table)):
        change_table(table, CHANGES[pick(len(CHANGES))], pick(10**6), pick(10**6))
    separator = ("\n", "\r\n", "\n", "\r")[pick(4)]
    text = separator.join(",".join(row) for row in table) + ("", separator, 2 * separator)[pick(3)]
    data = (b"\xef\xbb\xbf" if pick(10) == 0 else b"") + text.encode()
    for _ in range(most_bytes and 1 + pick(most_bytes)):
        data = change_bytes(data, BYTE_CHANGES[pick(len(BYTE_CHANGES))], pick(10**6), pick(10**6))
    known = [name for name in (parts(label)[0] for label in header[1:]) if name]
    required = tuple(known[: 1 + pick(len(known))]) if known and pick(5) == 0 else None
    inputs = tuple(known[:1]) if pick(4) == 0 else ()
    return (gzip.compress(data, mtime=0) if pick(10) == 0 else data), required, inputs


BYTE_CHANGES = ("insert", "delete", "replace", "cut")
CHANGES = (
    "weird",
    "weird",
    "weird",
    "header",
    "drop cell",
    "add cell",
    "drop row",
    "copy row",
    "swap",
    "blank",
    "column",
)


def change_table(table, what, a, b):
    """Change a table of texts in place: ``a`` and ``b`` choose where and what."""
    row = 1 + a % (len(table) - 1) if len(table) > 1 else 0
    if what == "weird" and table[row]:
        table[row][(a // 7) % len(table[row])] = WEIRD[b % len(WEIRD)]
    elif what == "header" and table[0]:
        table[0][a % len(table[0])] = HEADERS[b % len(HEADERS)]
    elif what == "drop cell" and table[row]:
        table[row].pop(b % len(table[row]))
    elif what == "add cell":
        table[row].insert(b % (len(table[row]) + 1), ("", "1.5")[a % 2])
    elif what == "drop row" and len(table) > 1:
        table.pop(row)
    elif what == "copy row":
        table.insert(row, list(table[row]))
    elif what == "swap":
        other = b % len(table)
        table[row], table[other] = table[other], table[row]
    elif what == "blank":
        table.insert(b % (len(table) + 1), [("", " ")[a % 2]])
    elif what == "column":
        text = WEIRD[b % len(WEIRD)]
        for k, cells in enumerate(table):
            cells.append(HEADERS[a % len(HEADERS)] if k == 0 else text)


def change_bytes(data, what, a, b):
    where = a % (len(data) + 1)
    sign = BYTES[b % len(BYTES)]
    if what == "insert":
        return data[:where] + sign + data[where:]
    if what == "delete":
        return data[:where] + data[where + 1 + b % 3 :]
    if what == "replace":
        return data[:where] + sign + data[where + 1 :]
    return data[:where] or b"\n"


# -- the comparison ----------------------------------------------------------------------------------------


def compare(data, required, inputs):
    """Read by both; they must agree. Returns True for a right answer and False for a named error."""
    name = "record.csv.gz" if data[:2] == b"\x1f\x8b" else "record.csv"
    source = Source(name, data, "")
    request = make_request(required=required, inputs=inputs)
    try:
        expected, faults = reference(data, required, inputs), ()
    except Faults as error:
        expected, faults = None, error.places
    try:
        loaded, message = read_csv(source, request), ""
    except (DataFileError, UnitError) as error:
        loaded, message = None, str(error)
    if loaded is None:
        assert expected is None, f"refused a good file: {message}\n{data!r}"
        check_message(message, name, faults, data)
        return False
    assert expected is not None, f"accepted a faulty file: {faults}\n{data!r}"
    assert {c.name for c in loaded.channels} | {"time"} == set(expected), data
    for channel in loaded.channels:
        wanted = [math.nan if value is None else value for value in expected[channel.name]]
        assert same(channel.values.tolist(), wanted), (channel, data)
        assert channel.mask.tolist() == [value is not None for value in expected[channel.name]], data
        assert same(channel.time.tolist(), expected["time"]), (channel, data)
    return True


def same(found, wanted):
    """Equal but for the last digit, which the order of the arithmetic of a unit may change."""
    return len(found) == len(wanted) and all(
        a == b or (a != a and b != b) or abs(a - b) <= 5e-16 * abs(b) + 1e-323
        for a, b in zip(found, wanted, strict=True)
    )


def check_message(message, name, faults, data):
    assert message.startswith(name), message
    row = re.search(r"row (\d+)", message)
    assert row, message
    labels = [label for fault_row, label in faults if fault_row == int(row[1])]
    assert labels, f"{message}: wrong row, the faults are {faults}\n{data!r}"
    assert None in labels or any(repr(label)[1:-1] in message for label in labels), (message, faults)
    assert "; do: " in message, message
    assert "allowed: " in message, message


@pytest.mark.parametrize("part", few(range(2), 0))
@pytest.mark.parametrize("kind", KINDS)
def test_1250_generated_files_give_the_right_answer_or_a_named_error(kind, part, monkeypatch):
    if part:  # pandas, which reads long files, has one half of them
        monkeypatch.setattr(csv_reader, "_SHORT", 0)
    counts = {True: 0, False: 0}
    for seed in range(1250 * part, 1250 * (part + 1)):
        rng = random.Random(f"{kind} {seed}")
        counts[compare(*generated(lambda n, rng=rng: int(rng.random() * n), kind))] += 1
    if kind == "valid":
        assert counts[True] > 1000  # the others have an empty cell in an input
    else:
        assert min(counts.values()) > 100


@settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(st.data(), st.sampled_from(sorted(KINDS)))
def test_files_drawn_by_hypothesis_which_shrinks_what_it_finds(data, kind):
    compare(*generated(lambda n: data.draw(st.integers(0, n - 1)), kind))


@pytest.mark.parametrize("text", WEIRD)
def test_every_odd_text_alone_in_an_output_in_the_time_and_in_an_ignored_column(text):
    for line in (f"0.5,{text},1", f"{text},0.5,1", f"0.5,1,{text}"):
        data = f"time [s],omega [rad/s],note\n0.25,1,1\n{line}\n".encode()
        compare(data, ("omega",), ())
    data = f"time [s],omega [rad/s]\n0.25,1\n0.5,{text}\n".encode()
    compare(data, None, ())
    compare(data, None, ("omega",))


@pytest.mark.parametrize("label", HEADERS)
def test_every_odd_header_as_a_channel_as_the_time_and_as_an_ignored_column(label):
    for data in (
        f"time [s],omega [rad/s],{label}\n0,1,2\n1,2,3\n",
        f"time [s],omega [rad/s],{label}\n0,1,\n1,2,\n",
        f"{label},q [Pa]\n0,1\n1,2\n",
        f"time [s],{label}\n0,1\n1,2\n",
    ):
        compare(data.encode(), None, ())
        compare(data.encode(), ("omega",), ())


def test_the_oracle_finds_the_faults_that_it_should():
    good = b"time [s],omega [rpm]\n0,1\n1,\n"
    assert reference(good)["omega"][1] is None
    with pytest.raises(Faults) as caught:
        reference(good.replace(b"1,\n", b"1,x\n"))
    assert caught.value.places == ((3, "omega [rpm]"),)
    with pytest.raises(Faults) as caught:
        reference(good, inputs=("omega",))
    assert caught.value.places == ((3, "omega [rpm]"),)
