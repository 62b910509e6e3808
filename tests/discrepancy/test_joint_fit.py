"""Records that are too short to tell the parameters are no sign of something missing, whatever fresh ones look like."""

from dataclasses import replace
from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import fresh_misfit as misfit_module
from casadi_engine.discrepancy import joint_fit as module
from casadi_engine.discrepancy.confirmation import Gap
from casadi_engine.discrepancy.fresh_misfit import FRESH, _mostly_left, fresh_doubt
from casadi_engine.discrepancy.joint_fit import asks_for_one
from casadi_engine.discrepancy.repaired import Gaps, Side
from casadi_engine.errors import EstimationError

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


def test_first_states_that_were_given_are_those_of_all_records(body):
    """The fit of all records had left out initial=..., ran away, and louder noise in fresh data was "and more that no
    effect of the library names"."""
    seen = []

    def fit(model, records, *, initial, **_):
        seen.append(initial)
        raise EstimationError("none", seen="x", allowed="y", cure="z")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "estimate", fit)
        given = {"T1": stub(fixed=True, value=3.0), "T2": stub(fixed=False, value=7.0)}
        repair = stub(
            **vars(repair_of(within=40.0)) | {"fit": stub(model=body, initial={"a": given, "c": {}})}
        )
        refitter = stub(parameters=None, interval="auto")
        repair.effects = ()
        assert module.with_joint_fit(repair, refitter) is repair
    assert seen == [{"a": {"T1": 3.0}}]


@pytest.mark.parametrize(("own", "fresh", "told"), [(1.0, 1.0, True), (1.1, 45.0, True), (30.0, 45.0, False)])
def test_parameters_of_all_records_that_describe_them_worse_are_no_answer(own, fresh, told):
    """The parameters of the search leave 1 and 50: what leaves more than that in all has not arrived."""

    def traces(**sizes):
        return {name: {"y": stub(residual=np.full(500, np.sqrt(size)))} for name, size in sizes.items()}

    before = repair_of(within=40.0)
    after = replace(before.gaps.validation_after, traces=traces(b=50.0))
    before.gaps = replace(before.gaps, validation_after=after)
    before.fit = stub(model=None, initial={}, traces=traces(a=1.0), parameters=stub(copy=stub))
    both = stub(traces=traces(a=own, b=fresh), free=("k",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "estimate", lambda *_, **__: both)
        patch.setattr(module, "as_fitted", lambda fit: None)
        patch.setattr(
            module,
            "replace",
            lambda one, **more: stub(**vars(one) | more) if one is before else replace(one, **more),
        )
        found = module.with_joint_fit(before, stub(parameters=None, interval="auto"))
    assert (found is not before) is told
    if told:
        assert found.gaps.validation_after.within_errors == pytest.approx(fresh)


@pytest.mark.parametrize(
    ("coloured", "found", "verdict"),
    [(True, 2.5, "unnamed"), (True, 1.5, "nothing missing"), (False, 2.5, "nothing missing")],
)
def test_what_grows_in_fresh_data_is_no_colour_of_a_noise(coloured, found, verdict):
    """A cogging that was taken for coloured noise, three times as large in fresh data, was "nothing missing"."""
    repair = repair_of(found=50.0, within=1.0)
    repair.verdict, repair.effects = "nothing missing", ()
    repair.noise = stub(scatter={}, colour={}, is_coloured=coloured, sigma={"y": (1.0, True)})
    rmse = replace(repair.gaps.validation_after.gap, rmse={"y": found})
    repair.gaps = replace(repair.gaps, validation_after=replace(repair.gaps.validation_after, gap=rmse))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(misfit_module, "replace", lambda one, **more: stub(**vars(one) | more))
        patch.setattr(misfit_module, "fresh_misfit", lambda _: None)
        held = misfit_module._held(repair)
    assert held.verdict == verdict
