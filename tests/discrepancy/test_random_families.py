"""Unknown functions of a signal: found, located and drawn, and not found where there is nothing."""

import casadi as ca
import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.discrepancy import random_families
from casadi_engine.discrepancy.certificate import likeness_words
from casadi_engine.discrepancy.clocks import Clock
from casadi_engine.discrepancy.compression import compress
from casadi_engine.discrepancy.noise_model import NoiseModel
from casadi_engine.discrepancy.null_distribution import NullDistribution
from casadi_engine.discrepancy.random_families import (
    course_of,
    family_candidates,
    family_columns,
    family_course,
    family_row,
    smooth_family,
    terms_at,
)
from casadi_engine.discrepancy.score import score


def scored(shaft, data):
    null = shaft.null(data)
    candidates, families = family_candidates(null)
    return score(compress(null, candidates, NoiseModel(shaft.sigma))), families


def test_every_location_has_its_families(shaft):
    candidates, families = family_candidates(shaft.null(shaft.data()), first=5)
    names = [f.name for f in families]
    assert "a function of twist at coupling" in names
    assert "a function of time at load" in names
    assert "a function of value at input_T" in names
    assert "a function of value at sensor_omega" in names
    assert families[0].members[0] == 5
    assert sum(len(f.members) for f in families) == len(candidates)
    assert all(f.visited.sum() == pytest.approx(1) for f in families)


def test_a_law_of_the_twist_is_found_and_drawn(shaft):
    """A gap-like law that no candidate of the library is: torque 0.8 sin(25 twist) between the sides."""

    def hidden(t, x):
        return 0.8 * np.sin(25 * x[2]) * np.array([1, -1])

    made, families = scored(shaft, shaft.data(hidden=hidden, n=900, seed=3))
    rows = {f.name: row for f in families if (row := family_row(made, f)) is not None}
    p = {name: float(row.p_value(made.y[:, None])[0]) for name, row in rows.items()}
    assert p["a function of twist at coupling"] < 1e-12
    pooled = NullDistribution(list(rows.values()), draws=1000).pooled(min(p.values()))
    assert pooled < 1e-6
    family = next(f for f in families if f.name == "a function of twist at coupling")
    course = family_course(made, family)
    truth = 0.8 * np.sin(25 * course.signal)
    seen = family.visited > 0
    # a level and a slope belong to the parameters: compare what is left beside them
    shape = np.column_stack([np.ones_like(truth), course.signal])[seen]
    weight = np.sqrt(family.visited[seen])

    def bent(values):
        fit = np.linalg.lstsq(shape * weight[:, None], values[seen] * weight, rcond=None)[0]
        return (values[seen] - shape @ fit) * weight

    assert np.corrcoef(bent(course.mean), bent(truth))[0, 1] > 0.95
    assert course.level > 0
    assert set(course.looks_like) == {"linear", "quadratic", "cubic", "step", "periodic"}


def surest(made, families):
    rows = [(row, f) for f in families if (row := family_row(made, f)) is not None]
    p = {f.name: float(row.p_value(made.y[:, None])[0]) for row, f in rows}
    return min(p, key=p.get), min(p.values())


def test_what_comes_back_with_every_turn_is_found_by_its_order(shaft):
    """A ripple of 2 N m, twice a turn of the load: the angle is no state of the model."""
    angle = [0.0]

    def hidden(t, x):
        angle[0] += x[1] * 4e-4
        return np.array([0.0, 2.0 * np.sin(2 * angle[0] + 1)])

    made, families = scored(shaft, shaft.data(hidden=hidden, n=900, seed=3))
    name, p = surest(made, families)
    assert name == "2 per turn at load"
    assert p < 1e-12
    family = next(f for f in families if f.name == name)
    course = family_course(made, family)
    assert 0.5 * np.ptp(course.mean) == pytest.approx(2.0, rel=0.25)


def test_an_input_that_bends_is_found_at_the_input(shaft):
    data = shaft.data(n=900, seed=3)
    shown = data["T"].values + 2e-5 * (data["T"].values - 20) ** 3
    columns = {name: data[name].values for name in data.names} | {"T": shown}
    units = {name: data[name].unit for name in data.names}
    shifted = ce.Experiment.from_arrays("shown", time=data["T"].time, units=units, **columns)
    name, p = surest(*scored(shaft, shifted))
    assert name == "a function of value at input_T"
    assert p < 1e-12


@pytest.mark.parametrize("draws", [5, pytest.param(12, marks=pytest.mark.slow)])
def test_families_of_effect_free_records_are_not_significant(shaft, draws):
    smallest = []
    for seed in range(draws):
        made, families = scored(shaft, shaft.data(seed=40 + seed, n=300))
        rows = [row for f in families if (row := family_row(made, f)) is not None]
        least = min(float(row.p_value(made.y[:, None])[0]) for row in rows)
        smallest.append(NullDistribution(rows, draws=500).pooled(least))
    assert min(smallest) > 5e-4
    assert np.mean(smallest) > 0.2


def test_a_family_that_parameters_take_whole_cannot_be_tested(shaft):
    made, families = scored(shaft, shaft.data())
    family = families[0]
    blind = type(made)(**{**vars(made), "information": np.zeros_like(made.information)})
    assert family_row(blind, family) is None
    assert family_course(blind, family).level == 0


def test_a_term_beyond_all_numbers_is_not_tested(shaft, monkeypatch):
    null = shaft.null(shaft.data())
    candidates, families = family_candidates(null)
    whole = random_families.candidate_columns

    def grown(record, terms):
        found = whole(record, terms)
        found["omega"][-1, families[0].members[0]] = np.inf
        return found

    monkeypatch.setattr(random_families, "candidate_columns", grown)
    columns = family_columns(null, candidates)["shaft"]
    assert all(np.isfinite(own).all() for own in columns.values())
    assert not columns["omega_load"][:, families[0].members[0]].any()
    made = score(compress(null, candidates, NoiseModel(shaft.sigma), columns={"shaft": columns}))
    assert made.information[families[0].members[0]] == 0
    assert made.testable.any()


@pytest.mark.parametrize("terms", [12, 20])
def test_a_function_that_does_not_end_level_is_followed_to_its_ends(terms):
    """Cosines have no slope there: a field that saturates was 5 V off beside 0.5 V of noise, and a drift with time of
    the sensor was "far more probable"."""
    current = np.linspace(8.0, 28.0, 400)
    family = smooth_family("parameter_K", "i", current, terms=terms)
    symbol = ca.SX.sym("i")
    basis = ca.Function("basis", [symbol], [ca.vertcat(*terms_at(family, symbol))])(current[None]).full().T
    wanted = 1 / (1 + 0.025 * current)

    def left(columns):
        return np.abs(wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]).max()

    assert left(basis) < 1e-5 < 1e-3 < left(basis[:, :-2])  # a line and a parabola are the last ones
    np.testing.assert_allclose(basis[:, -2], np.linspace(-1, 1, 400), atol=1e-12)
    assert (family.variances[-2], family.variances[-1]) == (family.variances[1], family.variances[2])
    course = course_of(family, np.eye(terms)[-2], np.zeros((terms, 0)))
    np.testing.assert_allclose(course.mean, np.linspace(-1, 1, len(course.mean)), atol=1e-12)


@pytest.mark.parametrize("periods", [2.3, 2.8, 3.3])
def test_a_course_over_time_that_comes_back_has_a_period(shaft, periods):
    """A load of 2 N m that swings: it was a function of time, and of its period nothing was said."""
    time, own = [0.0], 900 * 4e-3 / periods

    def hidden(t, x):
        time[0] += 4e-4
        return np.array([0.0, 2.0 * np.sin(2 * np.pi * time[0] / own + 1)])

    made, families = scored(shaft, shaft.data(hidden=hidden, n=900, seed=3))
    course = family_course(made, next(f for f in families if f.name == "a function of time at load"))
    assert next(iter(course.looks_like)) == "periodic"
    assert course.period == pytest.approx(own, rel=0.07)
    for clock, unit in ((Clock(), 1.0), (Clock("min"), 60.0)):
        told = f"{course.period / unit:.2g} {clock.unit}"
        assert likeness_words(course, clock) == f" and comes back about every {told}"


@pytest.mark.parametrize("shape", [lambda t: t**2, lambda t: 1.0 * (t > 0.4), lambda t: 0 * t])
def test_what_comes_once_has_no_period(shape):
    time = np.linspace(0.0, 1.0, 400)
    family = smooth_family("load", "time", time)
    points = np.linspace(0, 1, 61)
    course = random_families._course(family, points, shape(points), np.ones(61), 1.0)
    assert "comes back" not in likeness_words(course, Clock())
    assert course.looks_like["periodic"] < 0.5


def test_other_signals_have_no_period(shaft):
    made, families = scored(shaft, shaft.data(n=400))
    course = family_course(made, next(f for f in families if f.name == "a function of twist at coupling"))
    assert np.isnan(course.period)
