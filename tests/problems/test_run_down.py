"""The run-down of a single-cylinder engine: on a made record with a known answer, and on real ones."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.cli import main
from casadi_engine.errors import DataFileError, ProblemError

PAGE = Path(__file__).parents[2] / "problems" / "run_down.py"
RECORDS = Path(__file__).parents[3] / "shared" / "data" / "engine_tue"
RPM = 30 / np.pi

# The made engine. Its sizes are those of the page, its laws are written anew here.
J, T_F, P_CRANK, MASS, R, L, AREA = 0.022, 0.75, 1.2e4, 0.22, 0.0275, 0.0842, np.pi * 0.0677**2 / 4
TDC = np.radians(244.2)


def factor(angle):
    sine, cosine = np.sin(angle), np.cos(angle)
    return sine + R / L * sine * cosine / np.sqrt(1 - (R / L * sine) ** 2)


def mass_inertia(angle):
    """Inertia of the reciprocating mass less its mean [kg m2]."""
    turn = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
    return MASS * R**2 * (factor(angle) ** 2 - np.mean(factor(turn) ** 2))


def integral(values, at):
    return np.concatenate([[0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(at))])


def made_pressure(angle):
    """A motored cycle [Pa] without a loop: compression and expansion by p V^1.3, flat otherwise."""
    turned = (angle + 2 * np.pi) % (4 * np.pi) - 2 * np.pi
    travel = (
        1 - np.cos(turned) + R / L * np.sin(turned) ** 2 / (1 + np.sqrt(1 - (R / L * np.sin(turned)) ** 2))
    )
    volume = 2 / 7.5 + travel  # compression ratio 8.5
    closed = np.abs(turned) < np.pi
    return np.where(closed, 0.9e5 * ((2 / 7.5 + 2) / volume) ** 1.3, 0.9e5)


@pytest.fixture
def made(tmp_path):
    """Writes a run-down by the energy balance: a closed form in the crank angle."""

    def write(*, half_turn=0, pitch=0.004, seed=1):
        rng = np.random.default_rng(seed)
        slot_angle = np.radians(np.arange(0, 10 * 360, 0.1))  # from slot 0
        angle = slot_angle - TDC - 2 * np.pi * half_turn
        pressure = made_pressure(angle)
        work = integral((pressure - 0.9e5 - P_CRANK) * AREA * R * factor(angle), angle) - T_F * (
            angle - angle[0]
        )
        inertia = J + mass_inertia(angle)
        speed = np.sqrt((inertia[0] * 150.0**2 + 2 * work) / inertia)
        time = integral(1 / speed, angle)
        slots = np.array([s for s in range(599) if s % 60 < 58])
        errors = rng.normal(0, pitch, 60)  # the same tooth errs in every turn
        edges = np.interp(np.radians(6 * (slots + errors[slots % 60])), slot_angle, time)
        steps = np.diff(slots)
        grid = np.arange(2, 3590)
        grid_time = np.interp(np.radians(grid), slot_angle, time)
        drift = 20e5 - 2e5 * grid_time
        path = tmp_path / f"made_{half_turn}.npz"
        np.savez(
            path,
            edge_time_s=edges,
            edge_slot=slots,
            omega_time_s=(edges[1:] + edges[:-1]) / 2,
            omega_rad_s=np.radians(6 * steps) / np.diff(edges),
            omega_step=steps,
            theta_deg=grid,
            theta_time_s=grid_time,
            p_rel_bar=(np.interp(np.radians(grid), slot_angle, pressure) + drift) / 1e5,
        )
        return path

    return write


@pytest.fixture(scope="module")
def page():
    """The page as a module, to call its functions."""
    import importlib.util

    spec = importlib.util.spec_from_file_location("run_down_page", PAGE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def problem():
    return ce.load_problem(PAGE)


def fit_to(problem, record):
    return ce.estimate(problem.model, record, parameters=problem.parameters, progress=False)


def rmse(fit):
    (trace,) = (traces["omega"] for traces in fit.traces.values())
    return RPM * np.sqrt(np.nanmean(trace.residual**2))


@pytest.mark.parametrize("half_turn", [0, 1])
def test_a_made_record_gives_its_truth_back(problem, made, half_turn):
    record = problem.read(made(half_turn=half_turn))
    top = record["theta"].values[np.argmax(record["p1"].values)] % (4 * np.pi)
    assert min(top, 4 * np.pi - top) < np.radians(1)
    fit = fit_to(problem, record)
    assert fit.converged
    assert fit.values["J_eng"] == pytest.approx(J, rel=0.01)
    assert fit.values["T_f"] == pytest.approx(T_F, rel=0.02)
    assert fit.values["p_crank"] == pytest.approx(P_CRANK, abs=1500)


def test_the_pitch_errors_of_the_teeth_are_divided_out(problem, page, made, monkeypatch):
    path = made(pitch=0.01)
    even = rmse(fit_to(problem, problem.read(path)))
    monkeypatch.setattr(page, "even_teeth", lambda exp, slot: exp)
    uneven = rmse(fit_to(problem, page.read(path)))
    assert uneven > 10
    assert even < uneven / 2


def test_the_record_says_what_was_done_to_it(problem, made):
    path = made()
    record = problem.read(path)
    assert record.names == ("theta", "p1", "omega")
    assert record.inputs == ("theta", "p1")
    assert {record[name].origin for name in record.names} == {"derived"}
    assert record.sha256
    steps = {step.function: step.arguments for step in record.history}
    assert list(steps) == ["read_experiment", "masked", "without", "from_combustion_tdc", "peg", "even_teeth"]
    assert steps["from_combustion_tdc"] == {"channel": "theta", "tdc_deg": 244.2}
    assert steps["peg"]["drift_bar_per_s"] == pytest.approx(-2, rel=0.01)
    assert steps["even_teeth"]["relative_spread"] == pytest.approx(0.004 * 2**0.5, rel=0.25)
    with np.load(path) as arrays:
        slot = arrays["edge_slot"][:-1] % 60
    assert not record["omega"].mask[np.isin(slot, (0, 1, 55, 56, 57))].any()
    assert record["omega"].mask[(slot > 1) & (slot < 55)].all()


def test_the_page_asks_for_a_record(problem):
    with pytest.raises(
        ProblemError, match=r"run_down has no records; seen: records=\(\); .*give --data FILE"
    ):
        problem.load_records()


def test_a_file_without_the_wheel_is_named(problem, tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, theta_deg=np.arange(3.0))
    with pytest.raises(DataFileError, match=r"other\.npz: key 'theta_time_s' is missing; seen: theta_deg"):
        problem.read(path)


# ---- the real records


@pytest.fixture(scope="module")
def real():
    """Gives the path of a recording that is kept beside the project."""

    def find(name):
        path = RECORDS / f"{name}.npz"
        if not path.is_file():
            pytest.skip(f"the recording {name}.npz is not there: it is kept beside the project, not in it")
        return path

    return find


def energy_balance(record):
    """J, T_f and the RMSE [rpm] by linear least squares on work and kinetic energy at each speed.

    omega/2 = (c + W - p_crank V - T_f theta - change omega^2/2)/(J omega), with W the integral of p dV
    """
    theta, p, omega = record["theta"], record["p1"].values, record["omega"]
    angle = np.interp(omega.time, theta.time, theta.values)[omega.mask]
    speed = omega.values[omega.mask]
    lever = AREA * R * factor(theta.values)
    work = np.interp(angle, theta.values, integral(p * lever, theta.values))
    volume = np.interp(angle, theta.values, integral(lever, theta.values))
    work -= mass_inertia(angle) * speed**2 / 2
    terms = np.stack([np.ones_like(angle), work, -volume, -angle], axis=1) / speed[:, None]
    c, *_ = np.linalg.lstsq(terms, speed / 2, rcond=None)
    return 1 / c[1], c[3] / c[1], RPM * np.sqrt(np.mean((speed / 2 - terms @ c) ** 2))


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "inertia"), [("ENGINEOFF4", 0.02194), ("ENGINEOFF3", 0.02213), ("ENGINEOFF", 0.02194)]
)
def test_three_run_downs_agree_on_the_inertia(problem, real, name, inertia):
    record = problem.read(real(name))
    fit = fit_to(problem, record)
    assert fit.converged
    assert fit.values["J_eng"] == pytest.approx(inertia, abs=2e-5)
    assert 0.7 < fit.values["T_f"] < 0.85
    assert 0 < fit.values["p_crank"] < 2.5e4  # the pressure at the start of compression is below ambient
    assert rmse(fit) < 5.1
    j, friction, error = energy_balance(record)
    assert j == pytest.approx(fit.values["J_eng"], rel=0.002)
    assert friction == pytest.approx(fit.values["T_f"], rel=0.02)
    assert error == pytest.approx(rmse(fit), rel=0.02)


@pytest.mark.shared
def test_what_is_left_is_not_white_and_the_page_says_so(problem, real):
    checked = ce.validate(fit_to(problem, problem.read(real("ENGINEOFF4"))))
    assert not checked.passed
    assert checked.failed == ("ENGINEOFF4/omega/whiteness", "ENGINEOFF4/omega/T_1")
    assert checked.records["ENGINEOFF4"]["omega"].whiteness.p_value < 1e-16
    assert "The residual is not white" in problem.goal


@pytest.mark.shared
def test_the_plain_way_gives_the_known_figures(page, real, monkeypatch):
    """Without mass, peg and tooth errors: J = 0.0225 to 0.0231 kg m2 and 7 to 9 rpm were found before."""
    monkeypatch.setattr(page, "even_teeth", lambda exp, slot: exp)
    monkeypatch.setattr(page, "peg", lambda exp: exp)
    monkeypatch.setattr(page, "TDC", 243.7)
    monkeypatch.setattr(page, "GEOMETRY", replace(page.GEOMETRY, m_eq=0.0, p_crank=0.0))
    model = page.model()
    fit = ce.estimate(model, page.read(real("ENGINEOFF4")), parameters=page.parameters(model), progress=False)
    assert 0.02245 < fit.values["J_eng"] < 0.0231
    assert 7 < rmse(fit) < 9


@pytest.mark.shared
def test_a_linear_form_with_the_measured_speed_agrees(page, real):
    record = page.read(real("ENGINEOFF4"))
    omega = record["omega"]
    filled = np.interp(omega.time, omega.time[omega.mask], omega.values[omega.mask])
    record = record.with_channel(replace(omega, values=filled, mask=np.ones(len(omega), dtype=bool)))
    model = ce.one_inertia(
        cylinders=1, geometry=page.GEOMETRY, friction_torque=0.8, reciprocating_speed="measured"
    )
    fit = ce.estimate(model, record, parameters=page.parameters(model), progress=False)
    assert model.linear is not None
    assert fit.values["J_eng"] == pytest.approx(0.02194, abs=1e-4)


@pytest.mark.slow
@pytest.mark.shared
def test_the_scatter_between_cycles_is_larger_than_the_error_of_white_noise(page, problem, real):
    record = problem.read(real("ENGINEOFF4"))
    values, error = page.leave_one_cycle_out(record, problem.model, problem.parameters)
    assert len(values) == 6
    assert error == pytest.approx(2.3e-4, abs=0.5e-4)
    fit = fit_to(problem, record)
    white = fit.stderr["J_eng"] / fit.own_noise["J_eng"]
    assert error > 1.3 * white
    assert 0.75 * error < fit.stderr["J_eng"] < 2.5 * error


@pytest.mark.shared
def test_the_command_line_makes_the_report(real, tmp_path, capsys):
    code = main(["fit", str(PAGE), "--data", str(real("ENGINEOFF4")), "--out", str(tmp_path)])
    printed = capsys.readouterr()
    assert (code, printed.err) == (0, "")
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert result["status"] == "converged"
    assert result["parameters"]["J_eng"]["value"] == pytest.approx(0.02194, abs=2e-5)
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8")
