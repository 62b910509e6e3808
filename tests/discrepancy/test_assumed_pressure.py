"""Assumed pressures as parameters: shapes against the independent simulator, scatter, calibration and power."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, stats

import casadi_engine as ce
from casadi_engine.discrepancy.assumed_pressure import (
    CHARGE,
    SCATTER,
    STRENGTH,
    TIMING,
    carried_cylinders,
    carry,
    is_carried,
    likely_scatter,
    remarks,
    settle_scatter,
)
from casadi_engine.discrepancy.fresh_fits import held_fit
from casadi_engine.discrepancy.noise_choice import scatter_of
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_model import null_at, null_model
from casadi_engine.discrepancy.screening import screen
from casadi_engine.errors import ModelError

DATA = Path(__file__).parents[2] / "data"
sys.path.insert(0, str(DATA))

from simulator.hidden import hidden  # noqa: E402
from simulator.hidden_runs import Case, simulate_hidden  # noqa: E402

NOISE = ce.Noise(omega=0.1)
BOTH = ("cylinder_3", "cylinder_4")
# cylinders 3 and 4 burn so much stronger, later, and take in so much more than 1 and 2, whose pressure they were given
DIFFER = {
    "cylinder_3": (1.015 / 1.030 - 1, np.radians(-0.2 - 0.4), 0.993 / 1.005 - 1),
    "cylinder_4": (0.985 / 0.970 - 1, np.radians(0.1 + 0.3), 1.004 / 0.998 - 1),
}


def simulated(seeds, effects=(), **options):
    cases = [Case(tuple(effects), seed, seed) for seed in seeds]
    return simulate_hidden("two_mass", cases, rate=1440.2, duration=1.0, sigma=0.1, **options)


def experiment(record, *, assumed=True, name="record"):
    columns = {key: record[key] for key in ("theta", "p1", "p2", "p3", "p4", "T_load", "omega")}
    units = dict.fromkeys(("p1", "p2", "p3", "p4"), "Pa") | {
        "theta": "rad",
        "T_load": "N m",
        "omega": "rad/s",
    }
    if assumed:
        columns |= {"p3": record["p3_assumed"], "p4": record["p4_assumed"]}
    origin = {key: "assumed" if assumed and key in ("p3", "p4") else "measured" for key in columns}
    return ce.Experiment.from_arrays(name, time=record["time"], units=units, origin=origin, **columns)


def fitted(data, **options):
    made = carry(ce.two_mass(), ce.two_mass().parameters(), [data], **options)
    fit = ce.estimate(made.model, made.data, parameters=made.parameters, noise=NOISE, progress=False)
    return settle_scatter(fit, made.parameters, noise=NOISE)[0]


@pytest.fixture(scope="module")
def record():
    return simulated([710_001])[0]


@pytest.fixture(scope="module")
def fit(record):
    return fitted(experiment(record))


def test_measured_pressures_are_left_alone(record):
    model, data = ce.two_mass(), experiment(record, assumed=False)
    pars = model.parameters()
    made = carry(model, pars, [data])
    assert made.model is model
    assert made.parameters is pars
    assert made.data == (data,)
    assert carry(model, pars, [experiment(record)], cylinders=None).model is model


def test_the_model_carries_assumed_pressures_alone(record):
    model, data = ce.two_mass(), experiment(record)
    before = dict.fromkeys(data.names)
    made = carry(model, model.parameters(), [data])
    assert carried_cylinders(made.model) == made.cylinders == BOTH
    assert dict.fromkeys(data.names) == before
    added = [name for name in made.parameters if name not in model.parameters()]
    assert all(is_carried(name) for name in added)
    assert not any(is_carried(name) for name in model.parameters())
    assert not made.parameters[SCATTER].vary
    assert all(made.parameters[n].prior == (0.0, 1.0) and made.parameters[n].vary for n in added[1:])
    # strength, timing and charge, and each cycle of ten
    assert {n.rpartition("_")[2] for n in added if n.startswith("cylinder_3") and "cycle" in n} == {
        str(k) for k in range(1, 11)
    }
    again = carry(made.model, made.parameters, made.data)
    assert again.model is made.model


def test_a_port_that_does_not_exist_is_refused(record):
    model = ce.two_mass()
    with pytest.raises(ModelError, match="the model has no such port"):
        carry(model, model.parameters(), [experiment(record)], cylinders=["cylinder_9"])


def test_the_user_is_told_where_pressures_cannot_be_carried_or_believed(record, fit):
    model, data = ce.two_mass(), experiment(record)
    assert remarks(fit) == []
    plain = replace(fit, model=model)
    (text,) = remarks(plain)
    assert text.startswith(
        "what is wrong with the pressure of cylinder_3, cylinder_4 is counted as noise alone"
    )
    assert remarks(plain, None) == []
    assert "cylinder_2 is counted" in remarks(plain, "cylinder_2")[0]
    made = carry(model, model.parameters(), [data], level=0.3)
    other = ce.estimate(
        made.model, made.data, parameters=made.parameters, noise=NOISE, progress=False, max_iterations=1
    )
    (text,) = remarks(other)
    assert text.startswith("combustion in cylinder_3, cylinder_4 would scatter by 30 %")


def test_the_same_simulation_where_nothing_is_wrong(record):
    model, data = ce.two_mass(), experiment(record)
    made = carry(model, model.parameters(), [data])
    first = {"omega_eng": 125.0, "omega_load": 125.0, "twist": -0.03}
    old = ce.simulate(model, data, initial=first)["omega"].values
    new = ce.simulate(made.model, made.data[0], parameters=made.parameters, initial=first)["omega"].values
    assert new == pytest.approx(old, rel=1e-12)


def test_the_shapes_say_what_is_wrong_with_an_assumed_pressure():
    """The simulator's true pressure against the shapes at the simulator's own differences, finely sampled."""
    record = simulate_hidden(
        "two_mass", [Case((), 3, 3)], rate=7200.0, duration=0.5, sigma=0.0, scatter=0.02
    )[0]
    data = carry(ce.two_mass(), ce.two_mass().parameters(), [experiment(record)]).data[0]
    for port, (strength, timing, charge) in DIFFER.items():
        cylinder = int(port[-1])
        place = {name: data[f"p{cylinder}_{name}"].values for name in ("burned", "late", "charge", "cycle")}
        wrong = record[f"p{cylinder}"] - record[f"p{cylinder}_assumed"]
        factors, given = record["factors"][cylinder - 1], record["factors"][cylinder - 3]
        ratio = factors / given  # of event k; event 1 is the first in the record
        event = np.clip(place["cycle"].astype(int) + 1, 0, len(ratio) - 1)
        said = (ratio[event] - 1) * place["burned"] + timing * place["late"] + charge * place["charge"]
        inside = np.abs(place["burned"]) > 1e5
        assert strength == pytest.approx(ratio[0] - 1, rel=1e-9)
        assert np.std((wrong - said)[inside]) < 0.15 * np.std(wrong[inside])
        # without timing and charge it is not right
        half = (ratio[event] - 1) * place["burned"]
        assert np.std((wrong - half)[inside]) > 0.3 * np.std(wrong[inside])


def test_the_fit_finds_parameters_and_scatter(record, fit):
    assert fit.converged
    truth = {"J_eng": 1 / 2.557, "J_load": 1 / 5.646, "K_el": 1992.0, "C_el": 2.5, "C_eng": 0.1541}
    for name, value in truth.items():
        found = fit.estimates[name]
        assert abs(found.value - value) < 4 * (found.stderr or found.quadratic)
    drawn = np.array([record["factors"][c, 1:11] / record["factors"][c - 2, 1:11] for c in (2, 3)])
    realised = np.sqrt(np.mean(drawn.var(axis=1, ddof=1)))
    assert fit.values[SCATTER] == pytest.approx(realised, rel=0.25)
    levels = (STRENGTH, TIMING, CHARGE)
    for port, differ in DIFFER.items():
        for what, level, value in zip(("strength", "timing", "charge"), levels, differ, strict=True):
            name = f"{port}.assumed_pressure.{what}"
            # the cycles' own mean is part of the strength
            found = fit.estimates[name]
            size = found.stderr or found.quadratic
            assert abs(found.value * level - value) < 4 * level * size + 0.01
    without = ce.estimate(ce.two_mass(), experiment(record), noise=NOISE, progress=False)
    assert without.cost / without.n > 1.5 > 1.1 > fit.cost / fit.n


def test_the_likely_scatter_is_that_of_the_dense_likelihood(fit):
    null = null_model(fit)
    record = null.records[0]
    random = [k for k, name in enumerate(null.parameters) if ".cycle_" in name]
    slopes = record.slopes["omega"] / 0.1
    scale = np.diag(null.turn)
    assert np.array_equal(null.turn, np.diag(scale))
    width = len(scale)
    tau = fit.values[SCATTER]
    g = slopes[:, random] / scale[random] / tau
    others = [k for k in range(slopes.shape[1]) if k not in random]
    e = record.residual["omega"] / 0.1 + tau * g @ null.values[random]
    known = [k for k in others if k < width and is_carried(null.parameters[k])]
    x = slopes[:, others]
    free = x[:, [k not in known for k in others]]
    held = slopes[:, known] / scale[known]
    e = e + held @ null.values[known]
    keep = np.linalg.svd(free / np.linalg.norm(free, axis=0), full_matrices=True)[0][:, free.shape[1] :]
    g, held, e = keep.T @ g, keep.T @ held, keep.T @ e

    def dense(log_tau):
        """Restricted likelihood, the shared differences' standard normal priors kept at their optimum's information."""
        v = np.eye(len(e)) + np.exp(2 * log_tau) * g @ g.T
        inside = np.linalg.solve(v, held)
        information = held.T @ inside + np.eye(held.shape[1])
        rest = np.linalg.solve(v, e) - inside @ np.linalg.solve(information, inside.T @ e)
        return np.linalg.slogdet(v)[1] + np.linalg.slogdet(information)[1] + e @ rest

    best = optimize.minimize_scalar(dense, bounds=(np.log(0.005), np.log(0.2)), method="bounded").x
    assert likely_scatter(null, {"omega": 0.1}) == pytest.approx(np.exp(best), rel=1e-3)


def test_no_scatter_is_counted_as_noise_that_the_model_carries(fit):
    null = null_model(fit)
    assert scatter_of(null, fit.data) == ()
    plain = ce.two_mass()
    first = {"record": np.array([125.0, 125.0, -0.03])}
    bare = null_at(plain, fit.data, plain.parameters(), plain.parameter_vector()[:5], first)
    assert len(scatter_of(bare, fit.data)[0].directions) >= 20


@pytest.mark.slow
def test_other_records_have_amplitudes_of_their_own(record):
    model = ce.two_mass()
    other = experiment(record, assumed=False, name="b")
    shown = other["omega"]  # a measurement of its own, though nearly the same
    data = [
        experiment(record, name="a"),
        other.with_channel(replace(shown, values=shown.values + 1e-9)),
    ]
    made = carry(model, model.parameters(), data)
    assert (made.data[1]["p3_burned"].values == 0).all()
    assert made.parameters["cylinder_3.assumed_pressure.cycle_2"].varies_by_experiment
    assert not made.parameters[SCATTER].varies_by_experiment
    fit = ce.estimate(made.model, made.data, parameters=made.parameters, noise=NOISE, progress=False)
    assert fit.converged
    # the measured one has nothing that could be wrong
    assert fit.values["cylinder_3.assumed_pressure.strength@b"] == pytest.approx(0, abs=1e-6)
    assert fit.stderr["cylinder_3.assumed_pressure.strength@b"] == pytest.approx(1, rel=1e-6)
    assert likely_scatter(null_model(fit), {"omega": 0.1}) == pytest.approx(0.028, rel=0.5)


@pytest.mark.slow
def test_held_parameters_leave_other_cycles_their_own_combustion(fit):
    other = experiment(simulated([710_002])[0], name="other")
    made = carry(ce.two_mass(), ce.two_mass().parameters(), [other]).data[0]
    held = held_fit(fit, made, noise=NoiseModel({"omega": 0.1}))
    assert held.values["J_eng"] == fit.values["J_eng"]
    assert held.values[SCATTER] == fit.values[SCATTER]
    assert np.std([v for n, v in held.values.items() if ".cycle_" in n]) > 0.2
    assert held.cost / held.n < 1.3


@pytest.mark.parametrize("others", [(), pytest.param((720_000,), marks=pytest.mark.slow)])
def test_scores_of_records_without_effects_are_calibrated(fit, others):
    """Records like those of tests/benchmarks/repair_nothing.py: no alarm, and scores of unit variance."""
    square, count = 0.0, 0
    for one in (fit, *(fitted(experiment(simulated([seed])[0])) for seed in others)):
        screened = screen(one, noise=NoiseModel({"omega": 0.1}))
        assert not screened.significant
        # z = directions' y with independent y
        square, count = square + float(screened.scores.y @ screened.scores.y), count + len(screened.scores.y)
    assert stats.chi2.sf(square, count) > 1e-3
    assert stats.chi2.cdf(square, count) > 1e-3


@pytest.mark.slow
def test_the_mean_square_of_the_scores_is_one():
    """24 records: it was 1.26 to 1.90 while the scatter was noise alone."""
    squares = []
    for one in simulated(range(740_000, 740_024)):
        scores = screen(fitted(experiment(one)), noise=NoiseModel({"omega": 0.1})).scores
        squares.append(float(np.mean(scores.z[scores.testable] ** 2)))
    error = np.std(squares) / np.sqrt(len(squares))
    assert abs(np.mean(squares) - 1) < 3 * error


@pytest.mark.slow  # a real engine's is in test_real_measurements.py
def test_an_effect_is_found_beside_the_scatter():
    one = simulated([730_000], [hidden("misfire", "cylinder_1", 0.15, cycles=[5])])[0]
    few = ["misfire", "cylinder_imbalance", "load_step", "coulomb_friction"]
    screened = screen(fitted(experiment(one)), few, noise=NoiseModel({"omega": 0.1}))
    best = screened.candidates[screened.significant[0]]
    assert (best.effect, best.port, best.nuisance["first"]) == ("misfire", "cylinder_1", 5)


@pytest.mark.slow  # scores of such records stand above
def test_repair_says_that_nothing_is_missing_where_pressures_are_assumed():
    data = ce.read_experiment(DATA / "assumed_pressure_1200rpm.csv.gz", assumed=("p3", "p4"))
    data = data.resample(**dict.fromkeys(data.names, 10)).without("omega_load")
    found = ce.repair(ce.two_mass(), data, noise=ce.Noise(omega="estimate"), starts=1, progress=False)
    assert found.verdict == "nothing missing"
    assert 0.01 < found.noise.scatter["combustion"] < 0.05
    assert found.gaps.validation_before.gap.chi2_per_sample < 1.3
    blind = ce.estimate(ce.two_mass(), data, noise=NOISE, progress=False)
    assert blind.cost / blind.n > 1.15


@pytest.mark.slow
def test_repair_finds_an_effect_and_then_the_scatter_anew():
    """A load of 5 N m that comes on at 0.4 s: before it is in the model, the combustion has to scatter in its place."""
    one = simulated([950_001], [hidden("load_step", "load", 5.0, time=0.4)])[0]
    model = ce.two_mass()
    pars = model.parameters()
    pars["C_el"].set(min=0.05, max=50)
    pars["K_el"].set(min=200, max=20_000)
    found = ce.repair(
        model,
        experiment(one),
        parameters=pars,
        effects=["load_step", "misfire"],
        noise=NOISE,
        starts=1,
        progress=False,
    )
    assert (found.effects[0].name, found.effects[0].at, found.confirmed) == ("load_step", "load", True)
    assert abs(found.effects[0].amplitude.value - 5.0) < 4 * found.effects[0].amplitude.stderr
    assert found.fit.values[SCATTER] < 0.8 * found.null_fit.values[SCATTER]
    assert not any(is_carried(name) for name in found.effects[0].predicted_shift)
