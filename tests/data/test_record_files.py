"""The files in data/: contract, size, bytes, and that they are what the simulator makes."""

import ast
import gzip
import hashlib
import shutil
from pathlib import Path

import generate
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from simulator import Engine, burn_factors, two_mass_shaft, unequal_cylinders
from simulator.files import (
    compare,
    compress,
    read_columns,
    read_hashes,
    read_starts,
    to_text,
    write_starts,
)
from simulator.hidden import PLACES
from simulator.records import CONTRACT, PLANS, Plan, hidden_truth
from simulator.run import Plant, Start
from simulator.simulate import simulate_two_mass

HEADER = "time [s],theta [rad],p1 [Pa],p2 [Pa],p3 [Pa],p4 [Pa],T_load [N m],omega [rad/s],omega_load [rad/s]"
QUICK = next(plan for plan in PLANS if plan.path == "normal_1400rpm.csv.gz")
PATHS = [plan.path for plan in PLANS]


def load(folder: Path, path: str) -> dict[str, np.ndarray]:
    return read_columns((folder / path).read_bytes())


def test_files_on_disk_are_the_planned_ones(data_folder):
    found = {str(path.relative_to(data_folder)) for path in data_folder.rglob("*.csv.gz")}
    assert found == set(PATHS)


def test_data_stays_small(data_folder):
    files = [path for path in data_folder.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    total = sum(path.stat().st_size for path in files if ".mypy_cache" not in path.parts)
    assert total < 15e6


@pytest.mark.parametrize("path", PATHS)
def test_contract_of_each_file(data_folder, path):
    content = (data_folder / path).read_bytes()
    # gzip header: bytes 4..7 are the time stamp, bit 3 of byte 3 says that a file name follows
    assert content[4:8] == b"\0\0\0\0"
    assert content[3] & 0x08 == 0
    assert gzip.decompress(content).startswith(HEADER.encode() + b"\n")
    record = read_columns(content)
    assert tuple(record) == tuple(CONTRACT)
    step = np.diff(record["time"])
    np.testing.assert_allclose(step, 1 / 14402, rtol=1e-6)
    assert record["time"][0] == 0.0
    assert record["theta"][0] == 0.0
    assert np.diff(record["theta"]).min() > 0.0
    assert 40 * np.pi <= record["theta"][-1] < 40 * np.pi + 0.15
    assert all(np.isfinite(column).all() for column in record.values())
    wanted = next(plan.speed_rpm for plan in PLANS if plan.path == path)
    assert record["omega"].mean() * 30 / np.pi == pytest.approx(wanted, abs=0.003 * wanted)
    np.testing.assert_array_equal(record["T_load"], 57.0)


@pytest.mark.parametrize("path", PATHS)
def test_noise_in_each_file_is_a_tenth_of_a_radian_per_second(data_folder, path):
    record = load(data_folder, path)
    # centred differences of the exact angle give the true speed to about 2e-3 rad/s
    speed = (record["theta"][2:] - record["theta"][:-2]) / (record["time"][2:] - record["time"][:-2])
    noise = record["omega"][1:-1] - speed
    assert noise.std() == pytest.approx(0.1, rel=0.03)
    assert abs(noise.mean()) < 4 * 0.1 / np.sqrt(len(noise))


@pytest.mark.parametrize("path", [path for path in PATHS if "1200rpm" in path])
def test_records_at_1200_rpm_have_14400_samples(data_folder, path):
    assert len(load(data_folder, path)["time"]) == 14400


@pytest.mark.parametrize("path", PATHS)
def test_cylinder_2_burns_unless_it_misfires(data_folder, path):
    record = load(data_folder, path)
    peaks = [record[f"p{c}"].max() for c in (1, 2, 3, 4)]
    if "misfire" in path:
        assert 1.0e6 < peaks[1] < 1.1e6
        assert min(peaks[0], peaks[2], peaks[3]) > 2.5e6
    else:
        assert min(peaks) > 2.2e6
        assert 1.01 < max(peaks) / min(peaks) < 1.15


def test_peaks_scatter_from_cycle_to_cycle(data_folder):
    record = load(data_folder, "normal_1200rpm.csv.gz")
    cycle = (record["theta"] // (4 * np.pi)).astype(int)
    peaks = np.array([record["p1"][cycle == k].max() for k in range(10)])
    assert 0.003 < peaks.std(ddof=1) / peaks.mean() < 0.03


def test_assumed_pressures_differ_from_the_truth_and_nothing_else_does(data_folder):
    seen = load(data_folder, "assumed_pressure_1200rpm.csv.gz")
    true = load(data_folder, "assumed_pressure_1200rpm_truth.csv.gz")
    for name in CONTRACT:
        if name not in ("p3", "p4"):
            np.testing.assert_array_equal(seen[name], true[name])
    later = (seen["theta"] > np.pi) & (seen["theta"] < 39 * np.pi)
    theta = seen["theta"]
    from_1 = np.interp(theta[later] - np.pi, theta, seen["p1"])
    from_2 = np.interp(theta[later] + np.pi, theta, seen["p2"])
    np.testing.assert_allclose(seen["p3"][later], from_1, rtol=2e-3)
    np.testing.assert_allclose(seen["p4"][later], from_2, rtol=2e-3)
    for name in ("p3", "p4"):
        assert np.abs(seen[name] - true[name]).max() > 0.02 * true[name].max()


def test_hash_list_is_that_of_the_files(data_folder):
    listed = read_hashes(data_folder)
    assert list(listed) == PATHS
    for path, digest in listed.items():
        assert hashlib.sha256((data_folder / path).read_bytes()).hexdigest() == digest


def test_no_script_here_uses_the_package_under_test(data_folder):
    allowed = {"numpy", "scipy", "pandas", "simulator"}
    standard = {"argparse", "collections", "dataclasses", "functools", "gzip", "hashlib", "io", "json", "math",
                "pathlib", "sys", "time", "types", "typing"}  # fmt: skip
    for script in data_folder.rglob("*.py"):
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            for name in names:
                assert name.split(".")[0] in allowed | standard, f"{script.name} imports {name}"


def test_readme_names_every_file_with_its_seeds(data_folder):
    text = (data_folder / "README.md").read_text(encoding="utf-8")
    for plan in PLANS:
        row = next(line for line in text.splitlines() if line.startswith(f"| `{plan.path}`"))
        assert f"| {plan.speed_rpm:.0f} |" in row
        assert f"| {plan.scatter_seed} | {plan.noise_seed} |" in row


def test_regenerating_a_record_gives_the_kept_file():
    good, message = generate.check(QUICK)
    assert good, message
    # on the machine and versions that made the files this says "identical bytes"
    assert "identical" in message or "units in its last place" in message


@pytest.mark.slow
@pytest.mark.parametrize("plan", [plan for plan in PLANS if plan is not QUICK], ids=lambda plan: plan.path)
def test_regenerating_every_other_record_gives_the_kept_file(plan):
    good, message = generate.check(plan)
    assert good, message


def test_starts_are_listed_and_close_the_mean_cycle_of_their_engine(data_folder):
    """By another integrator than the warm-up's own, of another order."""
    starts = read_starts(data_folder)
    assert list(starts) == PATHS
    start, plan = starts[QUICK.path], QUICK
    factors = burn_factors(unequal_cylinders(), cycles=10, seed=plan.scatter_seed)[:, :1]
    shaft = two_mass_shaft()
    plant = Plant(shaft, Engine(unequal_cylinders(), factors, start.strength), lambda _: 57.0)
    round_trip = solve_ivp(
        plant.equation(), (0, 1), start.state, method="RK45", rtol=1e-8, atol=1e-8,
        events=lambda t, x: x[0] - 4 * np.pi if t > 0.01 else -1.0,
    )  # fmt: skip
    end, lasts = round_trip.y_events[0][0], round_trip.t_events[0][0]
    assert np.abs(end[1:3] - start.state[1:3]).max() < 2e-4
    assert 4 * np.pi / lasts == pytest.approx(plan.speed_rpm * np.pi / 30, abs=2e-4)


WARM = {"speed": 100.0}  # rad/s, what the warm-up of a tiny record comes to


def tiny(_speed_rpm: float, start: Start | None = None, **_options: object) -> dict[str, np.ndarray]:
    """A record that follows its start."""
    start = Start(1e6, (0.0, WARM["speed"], 100.0, 1e-2)) if start is None else start
    columns = {name: np.linspace(0.0, 1.0, 5) for name in CONTRACT}
    columns |= {"theta": start.state[1] * columns["time"], "strength": np.array(start.strength)}
    return columns | {"states": np.array(start.state)[:, None]}


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """generate.py working in an empty folder on two tiny records."""
    plans = tuple(Plan(path, tiny, 1200.0, None, 1, 2) for path in ("a.csv.gz", "below/b.csv.gz"))
    monkeypatch.setattr(generate, "FOLDER", tmp_path)
    monkeypatch.setattr(generate, "PLANS", plans)
    return tmp_path


def test_generate_writes_and_then_finds_the_files_good(scratch, capsys):
    assert generate.main([]) == 0
    assert list(read_hashes(scratch)) == ["a.csv.gz", "below/b.csv.gz"]
    first = (scratch / "a.csv.gz").read_bytes()
    assert generate.main(["--only", "a.csv"]) == 0
    assert (scratch / "a.csv.gz").read_bytes() == first
    assert generate.main(["--check"]) == 0
    assert capsys.readouterr().out.count("identical bytes; its warm-up comes within 0.0e+00") == 2


def test_a_warm_up_has_to_come_near_the_kept_start_and_the_record_follows_that(scratch, capsys, monkeypatch):
    """Steps of a warm-up depend on the processor's last bits: 5e-8 by one that has wider registers, of which the angle
    at a record's end makes 1.8e-6 rad. The record from the same start agrees to its last digits."""
    generate.main([])
    kept = read_starts(scratch)
    monkeypatch.setitem(WARM, "speed", 100 * (1 + 5e-8))
    assert generate.main(["--check", "--only", "a.csv"]) == 0
    assert "identical bytes; its warm-up comes within 5.0e-08 of the kept one" in capsys.readouterr().out
    one = kept["a.csv.gz"]
    other = Start(one.strength, (one.state[0], WARM["speed"], *one.state[2:]))
    write_starts(scratch, kept | {"a.csv.gz": other})  # from which the file was not made
    assert generate.main(["--check", "--only", "a.csv"]) == 1
    assert "theta differs by up to 5000.0 units in its last place" in capsys.readouterr().out
    write_starts(scratch, kept)
    monkeypatch.setitem(WARM, "speed", 100 * (1 + 5e-6))
    assert generate.main(["--check", "--only", "a.csv"]) == 1
    assert "its warm-up comes within 5.0e-06 of the kept one" in capsys.readouterr().out
    write_starts(scratch, {})
    assert generate.main(["--check", "--only", "a.csv"]) == 1
    assert "starts.json does not list its start" in capsys.readouterr().out


def test_check_reports_missing_and_changed_files(scratch, capsys):
    generate.main(["--only", "a.csv"])
    shutil.copy(scratch / "a.csv.gz", scratch / "kept")
    (scratch / "a.csv.gz").write_bytes(compress("time [s]\n0\n1\n"))
    assert generate.main(["--check"]) == 1
    out = capsys.readouterr().out
    assert "FAIL a.csv.gz: the file is not the one listed in SHA256SUMS" in out
    assert "FAIL below/b.csv.gz: the file is missing" in out


def test_only_with_an_unknown_text_lists_the_records(scratch, capsys):
    with pytest.raises(SystemExit) as stop:
        generate.main(["--only", "zzz"])
    assert stop.value.code == 2
    assert "no record's path holds 'zzz'; there are a.csv.gz, below/b.csv.gz" in capsys.readouterr().err


def test_compare_tolerates_the_last_digit_and_no_more():
    columns = {name: np.linspace(0.0, 1.0, 5) for name in CONTRACT}
    kept = compress(to_text(columns))
    last_digit = columns | {"omega": columns["omega"] + 1e-4}
    wrong = columns | {"omega": columns["omega"] + 1e-3}
    shorter = {name: column[:-1] for name, column in columns.items()}
    assert compare(kept, kept) == (True, "identical bytes")
    assert compare(gzip.compress(gzip.decompress(kept), 1), kept)[1].startswith("identical text")
    assert compare(compress(to_text(last_digit)), kept)[0]
    good, message = compare(compress(to_text(wrong)), kept)
    assert not good
    assert message.startswith("omega differs by up to 10.0 units")
    assert compare(compress(to_text(shorter)), kept) == (False, "other columns or another length")


def test_written_digits_are_far_below_the_noise():
    record = simulate_two_mass(1400.0, cycles=1, sigma=0.0, rtol=1e-8)
    columns = {name: record[name] for name in CONTRACT}
    again = read_columns(compress(to_text(columns)))
    for name, error in {"time": 6e-13, "theta": 6e-10, "p1": 0.51, "omega": 6e-5}.items():
        assert np.abs(again[name] - columns[name]).max() < error


def test_what_the_records_hide_is_told_in_one_file_that_only_the_simulator_reads(data_folder):
    (secret,) = hidden_truth()
    assert secret.name in PLACES
    root = data_folder.parent
    readers = [
        path.relative_to(root).as_posix()
        for folder in ("casadi_engine", "problems", "data")
        for path in (root / folder).rglob("*.py")
        if "truth.json" in path.read_text(encoding="utf-8")
    ]
    assert readers == ["data/simulator/records.py"]
    problem = (root / "problems" / "hidden_effect.py").read_text(encoding="utf-8")
    assert secret.name not in problem
    assert all(secret.name not in plan.path for plan in PLANS)
