"""Records that are too short to tell the parameters are no sign of something missing, whatever fresh ones look like."""

from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy.confirmation import Gap
from casadi_engine.discrepancy.fresh_misfit import FRESH, _mostly_left, fresh_doubt
from casadi_engine.discrepancy.joint_fit import asks_for_one
from casadi_engine.discrepancy.repaired import Gaps, Side

STEP, NOISE = 4.0, 0.02
C1, C2, G12, G2 = 600.0, 1600.0, 14.0, 5.0


def plant(name, samples, seed, *, radiated=0.0, swing=400.0):
    """A heated body and its case, by SciPy; the heat is held from sample to sample."""
    random = np.random.default_rng(seed)
    time = STEP * np.arange(samples)
    heat = np.repeat(random.uniform(0, swing, samples // 15 + 1), 15)[:samples]

    def rates(_t, x, power):
        through = G12 * (x[0] - x[1])
        return [(power - through) / C1, (through - G2 * x[1] - radiated * x[1] * abs(x[1])) / C2]

    states = np.zeros((samples, 2))
    for k in range(samples - 1):
        states[k + 1] = solve_ivp(rates, (0, STEP), states[k], args=(heat[k],), rtol=1e-9, atol=1e-9).y[:, -1]
    noisy = states[:, 0] + NOISE * random.standard_normal(samples)
    return ce.Experiment.from_arrays(
        name, time=time, units={"P": "W", "T": "K"}, hold={"P": "zero"}, P=heat, T=noisy
    )


@pytest.fixture(scope="module")
def body():
    b = ce.Blueprint("body")
    c2 = b.parameter("C2", 1000.0, unit="J/K", min=50, max=32_000)
    through, out = (
        b.parameter("G12", 10.0, unit="W/K", min=0.5, max=300),
        b.parameter("G2", 3.0, unit="W/K", min=0.2, max=100),
    )
    t1, t2, heat = b.state("T1", unit="K"), b.state("T2", unit="K"), b.input("P", unit="W")
    lost = b.port("case", "inertia", {"speed": t2}, unit="W")
    b.ode("T1", (heat - through * (t1 - t2)) / C1)
    b.ode("T2", (through * (t1 - t2) - out * t2 + lost) / c2)
    b.output("T", t1, unit="K")
    return b.model()


def repaired(body, data, fresh):
    return ce.repair(body, data, fresh=fresh, initial={"T1": 0.0, "T2": 0.0}, progress=False)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_parameters_that_a_short_record_leaves_open_are_no_missing_effect(body, seed):
    found = repaired(body, plant("short", 31, seed), plant("long", 500, 50 + seed))
    after = found.gaps.validation_after
    assert found.verdict == "nothing missing"
    assert after.gap.chi2_per_sample > 100 * after.within_errors
    assert after.within_errors == pytest.approx(1, abs=0.5)
    assert "known too little to describe fresh data" in " ".join(found.messages)


@pytest.mark.slow
def test_what_no_parameters_describe_stays_a_sign(body):
    """A loss that grows with the square of the temperature, which the short record does not reach."""
    found = repaired(body, plant("short", 31, 1), plant("hot", 500, 51, radiated=0.4, swing=1500.0))
    assert found.verdict != "nothing missing"
    if found.verdict == "unnamed":
        assert FRESH in found.unknown.tests


def repair_of(*, found=50.0, within=1.0, jointly=True, names=("a", "b")):
    """One that fresh data do not fit, by stand-ins: chi2/N 1 where it was found, 100 on fresh data without effects."""

    def side(chi2, **more):
        gap = Gap(rmse={"y": np.sqrt(chi2)}, chi2_per_sample=chi2, samples=500, fit_percent={"y": 0.0})
        return Side(gap, {"r": {"y": 0.5}}, {}, **more)

    gaps = Gaps(
        side(80.0), side(1.0), side(100.0),
        side(found, within_errors=within, parameters_p=0.4, left={"y": within / found}, jointly=jointly),
        None, "records",
    )  # fmt: skip
    return stub(
        verdict="named", confirmed=True, gaps=gaps, effects=(stub(),), unknown=None, messages=(),
        noise=stub(scatter={}, colour={}, is_coloured=False, sigma={"y": (1.0, True)}),
        data=(stub(name=names[0]),), fresh=(stub(name=names[1]),),
    )  # fmt: skip


def test_parameters_for_all_records_are_asked_for_where_fresh_data_do_not_fit():
    misfit = repair_of(within=40.0)
    assert asks_for_one(misfit, [stub(placed=False)])
    assert not asks_for_one(misfit, [stub(placed=False), stub(placed=True)])  # an event is of one record
    assert not asks_for_one(repair_of(within=40.0, names=("a", "a")), [stub(placed=False)])
    assert not asks_for_one(repair_of(within=1.0), [stub(placed=False)])  # that is within the errors


@pytest.mark.parametrize(
    ("before", "after", "mostly"),
    [(3.3, 0.92, False), (3.3, 1.0, False), (3.3, 1.5, False), (3.3, 2.0, True), (1.0, 0.9, True)],
)
def test_what_is_left_is_counted_beyond_the_noise(before, after, mostly):
    """A gap of 3.3 that closed to the noise had been called mostly left: 0.92 is more than a quarter of it."""

    def side(chi2):
        return stub(gap=stub(chi2_per_sample=chi2), jointly=False, within_errors=None)

    gaps = stub(validation_before=side(before), validation_after=side(after))
    assert _mostly_left(stub(gaps=gaps, noise=stub(is_coloured=False))) is mostly


@pytest.mark.parametrize(("jointly", "mostly"), [(True, False), (False, True)])
def test_what_parameters_for_all_records_leave_is_what_is_left(jointly, mostly):
    """A step of the parameters only promises as much."""
    assert _mostly_left(repair_of(jointly=jointly)) is mostly
    said = fresh_doubt(repair_of(jointly=jointly))
    assert "on the fresh data chi2/N is 50, and 1 with" in said
    assert ("with parameters for all records" in said) is jointly
