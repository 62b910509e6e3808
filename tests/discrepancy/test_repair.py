"""repair on records of the independent simulator, whose hidden effects are as sharp as in nature."""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy.fresh import portions

DATA = Path(__file__).resolve().parents[2] / "data"
if str(DATA) not in sys.path:
    sys.path.insert(0, str(DATA))

UNITS = {"theta": "rad", "p1": "Pa", "p2": "Pa", "p3": "Pa", "p4": "Pa", "T_load": "N m", "omega": "rad/s",
         "omega_load": "rad/s"}  # fmt: skip
RATE = 1440.2


@pytest.fixture(scope="module")
def records():
    """name -> (record, fresh record at another speed)."""
    from simulator.hidden import hidden
    from simulator.hidden_runs import Case, simulate_hidden

    effects = {
        "nothing": (),
        "coulomb": (hidden("coulomb_friction", "coupling", 8.0),),
        "constant": (hidden("coulomb_friction", "load", 20.0),),
        "misfire": (hidden("misfire", "cylinder_2", 1.0, cycles=(3,)),),
    }

    @cache
    def record(name, rpm, cycles):
        case = Case(effects[name], scatter_seed=rpm, noise_seed=rpm + list(effects).index(name))
        options = {"speed_rpm": rpm, "cycles": cycles, "rate": RATE, "steps": 3}
        (run,) = simulate_hidden("two_mass", [case], load=20.0, **options)
        columns = {key: np.asarray(run[key]) for key in UNITS}
        return ce.Experiment.from_arrays(f"{name}_{rpm}", time=run["time"], units=UNITS, **columns)

    def of(name):
        # a combustion is lost once
        return record(name, 1200, 8), record("nothing" if name == "misfire" else name, 1400, 6)

    return of


@pytest.fixture(scope="module")
def drive():
    """The two-mass model and its parameters with the ranges of problems/two_mass.py."""
    model = ce.two_mass(outputs=("omega", "omega_load"))
    pars = model.parameters()
    ranges = {
        "J_eng": (0.05, 4),
        "J_load": (0.02, 2),
        "K_el": (200, 2e4),
        "C_el": (0.05, 50),
        "C_eng": (5e-3, 5),
    }
    for name, (low, high) in ranges.items():
        pars[name].set(min=low, max=high)
    return model, pars


# Effects among which these are looked for in the slow run, which looks among the whole library too. The quick run has
# the parts of an answer in test_repair_requests.py, a search among the whole library in test_law_refit.py, records in
# which nothing is missing in test_own_jumps.py and test_input_hold.py, classes in test_choice.py and
# tests/effects/test_sensor_gain.py, a misfire's cycle in test_real_measurements.py, and events in test_events.py.
FEW = {
    "coulomb": ["coulomb_friction", "cubic_stiffness", "viscous_friction"],
    "constant": ["coulomb_friction", "constant_torque", "viscous_friction", "cubic_stiffness"],
    "misfire": ["misfire", "cylinder_imbalance", "coulomb_friction"],
}
WHOLE = pytest.param({"effects": None}, marks=pytest.mark.slow, id="the whole library")
SLOW = [pytest.param({}, marks=pytest.mark.slow, id="few"), WHOLE]


@pytest.fixture(scope="module")
def repaired(records, drive):
    model, pars = drive
    made = {}

    def of(name, **options):
        key = (name, *sorted(options))
        if key not in made:
            if name in FEW:
                options.setdefault("effects", FEW[name])
            first, second = records(name)
            options.setdefault("noise", ce.Noise(omega=0.1, omega_load=0.1))
            made[key] = ce.repair(
                model, first, parameters=pars, fresh=second, starts=1, progress=False, **options
            )
        return made[key]

    return of


@pytest.mark.parametrize("among", SLOW)
def test_dry_friction_in_the_coupling_is_named_and_confirmed(repaired, among):
    found = repaired("coulomb", **among)
    assert found.verdict == "named"
    assert found.confirmed is True
    (one,) = found.effects
    assert one.key == "coupling.coulomb_friction"
    assert one.sentence == "dry friction at coupling"
    amplitude = one.amplitude
    low, high = amplitude.interval or (
        amplitude.value - 2 * amplitude.stderr,
        amplitude.value + 2 * amplitude.stderr,
    )
    assert low < 8 < high
    assert high - low < 2
    assert one.p_value < 1e-10
    assert one.share_explained > 0.9
    assert one.selection_frequency > 0.9
    assert [m.name for m in one.members] == ["coulomb_friction"]
    assert found.where.location == "coupling"
    assert found.latent[0].port == "coupling"


@pytest.mark.slow
def test_nothing_is_missing_where_nothing_is(repaired):
    found = repaired("nothing")
    assert found.verdict == "nothing missing"
    assert found.effects == ()
    assert found.where is None
    assert found.unknown is None
    assert found.confirmed is None
    assert found.fit is found.null_fit
    assert found.candidates > 100
    assert max(row.statistic for row in found.scores) < found.threshold


def test_the_last_engine_cycles_are_held_out_where_no_fresh_record_is_given(drive):
    model, _ = drive
    record = ce.read_experiment(DATA / "normal_1200rpm.csv.gz").cycles(1, 8)
    made = portions(model, (record,), (), share=0.3)
    (kept,), (held,) = made.data, made.fresh
    assert made.source == "cycles"
    # 8 cycles of 4 pi, of which the last three are held out
    assert kept["theta"].values[-1] == pytest.approx(5 * 4 * np.pi, abs=0.2)
    assert held["omega"].time[0] > kept["omega"].time[-1]
    assert len(kept["omega"].time) + len(held["omega"].time) == len(record["omega"].time)


@pytest.mark.slow
def test_an_effect_is_confirmed_on_the_cycles_held_out(records, drive):
    model, pars = drive
    record, noise = records("coulomb")[0], ce.Noise(omega=0.1, omega_load=0.1)
    found = ce.repair(
        model, record, parameters=pars, noise=noise, starts=1, effects=["coulomb_friction"], progress=False
    )
    assert found.gaps.source == "cycles"
    assert found.data[0].span[1] < found.fresh[0].span[0]
    assert found.effects[0].key == "coupling.coulomb_friction"
    assert found.gaps.gain_per_cycle.cycles == 3


@pytest.mark.slow  # test_spectral_line.py and test_law_refit.py have torques that no effect names in the quick run
def test_a_load_that_hums_is_missing_and_no_effect_names_it(shaft):
    data = shaft.data(hidden=lambda t, x: np.array([0, 5 * np.sin(2 * np.pi * 21.7 * t)]), n=400)
    noise = ce.Noise(**shaft.sigma)
    found = ce.repair(shaft.model, data, noise=noise, starts=1, progress=False)
    assert found.verdict == "unnamed"
    assert found.effects == ()
    assert found.unknown.tests
    assert found.where is not None
    assert "no effect of the library names it" in str(found)


@pytest.mark.parametrize("among", SLOW)
def test_friction_on_a_shaft_that_never_turns_back_is_one_of_a_class(repaired, among):
    found = repaired("constant", **among)
    assert found.verdict == "class"
    members = {(m.name, m.at): m for m in found.effects[0].members}
    assert ("coulomb_friction", "load") in members
    assert ("constant_torque", "load") in members
    assert abs(members["constant_torque", "load"].rho) > 0.9999 or len(members) > 1
    assert sum(m.probability for m in members.values()) == pytest.approx(1)


@pytest.mark.parametrize("among", SLOW)
def test_a_lost_combustion_is_named_with_its_cycle(repaired, among):
    found = repaired("misfire", **among)
    assert found.status == "answered"
    one = found.effects[0]
    assert one.key == "cylinder_2.misfire"
    assert one.constants == {"first": 3.0, "last": 3.0}
    assert one.amplitude.value == pytest.approx(1, abs=0.03)
    assert found.fit.converged
    assert found.where.cycles is None or 3 in found.where.cycles or 4 in found.where.cycles
    assert found.gaps.estimation_after.gap.chi2_per_sample < 1.15


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nothing", "coulomb", "constant", "misfire"])
def test_the_summary_fits_one_screen(repaired, name):
    lines = str(repaired(name)).splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith(("Next: ", "      "))
    if name == "nothing":
        assert "nothing is missing that these data could show" in str(repaired(name))


@pytest.mark.slow
def test_one_cycle_says_what_it_cannot_tell(records, drive):
    model, pars = drive
    record = records("nothing")[0].cycles(2, 2)
    noise = ce.Noise(omega=0.1, omega_load=0.1)
    options = {"effects": FEW["coulomb"], "starts": 1, "progress": False}
    found = ce.repair(model, record, parameters=pars, noise=noise, **options)
    assert found.verdict == "nothing missing"
    assert found.confirmed is None
    assert found.gaps.validation_after is None
    said = " ".join(found.messages)
    assert "no fresh data, and 1 engine cycle: too few to hold 3 out, so nothing is confirmed" in said
    assert "one engine cycle: in which cycles an effect acts" in said
