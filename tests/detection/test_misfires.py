"""Misfires found in records of the independent simulator, which shares no code with the package."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError, ExperimentError, ModelError

DATA = Path(__file__).resolve().parents[2] / "data"
OFFSETS = {1: 0.0, 3: math.pi, 4: 2 * math.pi, 2: 3 * math.pi}


def truth(found, lost):
    cycle = [
        round((a - OFFSETS[c]) / (4 * math.pi)) + 1 for a, c in zip(found.angle, found.cylinder, strict=True)
    ]
    return np.array([k in lost.get(c, ()) for c, k in zip(found.cylinder, cycle, strict=True)])


@pytest.fixture(scope="module")
def found(fit, record):
    return ce.misfires(fit, record)


def test_every_lost_combustion_is_found_in_its_cylinder_and_no_other(found, lost):
    expected = truth(found, lost)
    assert expected.sum() == 5
    assert found.lost.tolist() == expected.tolist()
    assert found.probability[expected].min() > 0.999
    assert found.probability[~expected].max() < 1e-6
    assert found.rate[1] == pytest.approx(1 / 11, abs=0.001)


def test_sizes_are_those_of_the_combustions_within_their_errors(found, made, lost):
    expected = truth(found, lost)
    size = found.strength[: -found.lag]
    assert np.isnan(found.strength[-found.lag :]).all()
    assert np.abs(size[expected[: -found.lag]]).max() < 0.15
    assert np.abs(size[~expected[: -found.lag]] - 1).max() < 0.25
    assert np.nanmedian(found.separation) > 12
    assert found.expected_error < 1e-4


def test_a_load_switched_at_the_engine_and_a_jolt_of_the_road_are_no_misfires(fit, speed_only):
    from simulator import simulate_two_mass

    def switched(time, _state):
        return np.array([-40.0 * (0.3 < time < 0.6), 0.0])

    def jolt(time):
        return 57.0 + 150.0 * (0.7 < time < 0.73) * math.sin(math.pi * (time - 0.7) / 0.03)

    made = simulate_two_mass(1200.0, extra=switched, load=jolt, scatter_seed=9, rtol=1e-7)
    found = ce.misfires(fit, speed_only(made))
    assert np.ptp(made["omega_true"]) > 15
    assert found.probability.max() < 1e-3


def test_what_is_decided_does_not_depend_on_what_comes_later_than_the_lag(fit, record, found):
    cut = ce.misfires(fit, record.between(0.0, 0.8))
    sure = len(cut.lost) - cut.lag - 1
    assert sure > 20
    np.testing.assert_allclose(cut.strength[:sure], found.strength[:sure], rtol=1e-6)
    np.testing.assert_allclose(np.log(cut.probability[:sure]), np.log(found.probability[:sure]), rtol=1e-6)


def test_missing_samples_cost_no_more_than_what_they_held(fit, made, lost, speed_only):
    speed = made["omega"].copy()
    speed[np.random.default_rng(3).uniform(size=speed.size) < 0.3] = np.nan
    found = ce.misfires(fit, speed_only(made | {"omega": speed}))
    assert found.lost.tolist() == truth(found, lost).tolist()
    speed = made["omega"].copy()
    hole = (made["time"] > 0.1) & (made["time"] < 0.16)
    speed[hole] = np.nan
    found = ce.misfires(fit, speed_only(made | {"omega": speed}))
    inside = np.flatnonzero((found.time > 0.11) & (found.time < 0.13))
    assert found.separation[inside].min() < 0.5 * np.nanmedian(found.separation)
    assert found.lost.tolist() == truth(found, lost).tolist()


def test_samples_that_are_no_speed_do_no_harm(fit, made, lost, speed_only):
    random = np.random.default_rng(5)
    wild = made["omega"].copy()
    wild[random.integers(0, wild.size, 40)] += 50 * random.standard_normal(40)
    wild[5000] = 1e4
    wild[9000:9020] += 30
    found = ce.misfires(fit, speed_only(made | {"omega": wild}))
    assert found.lost.tolist() == truth(found, lost).tolist()
    assert found.misfit < 1.1
    late = made["omega"].copy()
    late[:3000] = np.nan
    found = ce.misfires(fit, speed_only(made | {"omega": late}))
    assert found.time[0] > 0.2
    assert found.lost.tolist() == truth(found, lost).tolist()
    assert np.nanmedian(found.separation) > 12


@pytest.mark.slow
def test_the_nonlinear_form_of_the_model_finds_the_same(record, found, fit_of):
    other = ce.misfires(fit_of(ce.two_mass()), record)
    assert other.lost.tolist() == found.lost.tolist()
    np.testing.assert_allclose(other.strength, found.strength, atol=0.03)


def test_more_noise_is_less_separation(fit, record, found):
    assert np.nanmedian(ce.misfires(fit, record, sigma=1.0).separation) < 0.7 * np.nanmedian(found.separation)


def test_noise_that_is_larger_than_said_is_told_and_counted(fit, record, found):
    assert 0.9 < found.misfit < 1.1
    assert found.trusted
    assert "times its noise" not in str(found)
    poor = ce.misfires(fit, record, sigma=0.02)
    assert poor.misfit == pytest.approx(5 * found.misfit, rel=0.1)
    assert not poor.trusted
    assert "not to be trusted: the speed differs from the model by 5.0 times its noise; give" in str(poor)
    assert np.nanmedian(poor.separation) == pytest.approx(np.nanmedian(found.separation), rel=0.05)
    quiet = ce.misfires(fit, record, sigma=0.5)  # or a filtered record
    assert quiet.misfit < 0.25
    assert not quiet.trusted
    some = ce.misfires(fit, record, sigma=0.06)
    assert some.trusted
    assert "\nthe speed differs from the model by 1.7 times its noise" in str(some)


@pytest.mark.slow  # noise larger than said is told above
def test_a_model_without_the_torsion_of_the_crankshaft_is_refuted_by_the_record(speed_only):
    from simulator import simulate_crankshaft

    paths = [DATA / "crankshaft" / f"{kind}_1200rpm.csv.gz" for kind in ("normal", "misfire")]
    records = [ce.read_experiment(path, optional=("omega_load",)) for path in paths]
    model = ce.two_mass(reciprocating_speed="measured")
    fit = ce.estimate(model, records, noise=ce.Noise(omega=0.1), progress=False)
    lost = {1: [4], 2: [6], 4: [8]}
    made = simulate_crankshaft(4500.0, cycles=10, misfire=lost, scatter_seed=31, noise_seed=32, rtol=1e-7)
    found = ce.misfires(fit, speed_only(made))
    assert found.misfit > 10
    assert not found.trusted
    assert not found.to_dict()["trusted"]
    # Its error counts as noise: combustions that burned are no longer taken for lost ones with certainty.
    expected = truth(found, lost)[: -found.lag]
    assert found.lost[: -found.lag].tolist() == expected.tolist()
    assert np.nanmedian(found.separation) < 7


def test_combustions_that_burn_in_part_are_neither_lost_nor_usual(fit, speed_only):
    from simulator.hidden import hidden
    from simulator.hidden_runs import Case, simulate_hidden

    half = Case((hidden("misfire", "cylinder_2", 0.5, cycles=(3, 5)),), 5, 6, {})
    made = simulate_hidden("two_mass", [half], cycles=7)[0]
    found = ce.misfires(fit, speed_only(made))
    expected = truth(found, {2: [3, 5]})
    assert found.neither.tolist() == expected.tolist()
    assert np.abs(found.strength[expected] - 0.5).max() < 0.1
    assert found.trusted
    assert "2 neither lost nor usual (sizes 0.47 to 0.55): partial burns" in str(found)


@pytest.mark.parametrize("lag", [0, 1, 5])
def test_any_lag(fit, record, lost, lag):
    found = ce.misfires(fit, record, lag=lag)
    assert found.lost.tolist() == truth(found, lost).tolist()
    assert np.isnan(found.strength).sum() == lag


def test_six_cylinders_whose_combustions_overlap():
    from simulator.pressure import pressure

    model = ce.two_mass(cylinders=6, reciprocating_speed="measured")
    time = np.arange(14402) / 14402.0
    theta, random = 125.6 * time, np.random.default_rng(4)
    channels = {"theta": theta, "T_load": np.full(time.size, 57.0), "omega": np.full(time.size, 125.6)}
    units = {"theta": "rad", "T_load": "N m", "omega": "rad/s"}
    order, silent = (1, 5, 3, 6, 2, 4), {5: 4, 3: 6}  # cylinder: cycle

    def simulated(missing):
        for place, cylinder in enumerate(order):
            angle = theta - place * 4 * math.pi / 6
            cycle = np.floor(angle / (4 * math.pi) + 0.5).astype(int)
            size = 2e6 * (1 + 0.02 * random.standard_normal(20))
            size[missing.get(cylinder, 0) - 1 if cylinder in missing else 15] = 0.0
            channels[f"p{cylinder}"] = pressure(angle, size[cycle])
            units[f"p{cylinder}"] = "Pa"
        data = ce.Experiment.from_arrays("six", time=time, units=units, **channels)
        clean = ce.simulate(model, data, initial={"omega_eng": 125.6, "omega_load": 125.6, "twist": -0.03})
        noisy = clean["omega"].values + 0.1 * random.standard_normal(time.size)
        return ce.Experiment.from_arrays("six", time=time, units=units, **channels | {"omega": noisy})

    fit = ce.estimate(model, simulated({}), noise=ce.Noise(omega=0.1), progress=False)
    found = ce.misfires(fit, simulated(silent))
    assert set(found.cylinder[found.lost]) == {5, 3}
    assert found.lost.sum() == 2
    for cylinder, cycle in silent.items():
        hit = found.lost & (found.cylinder == cylinder)
        assert found.angle[hit][0] / (4 * math.pi) == pytest.approx(
            cycle - 1 + order.index(cylinder) / 6, abs=0.1
        )


def test_rates_of_blocks(found):
    counted = [found.probability[8 * k : 8 * k + 8].sum() / 8 for k in range(5)]
    assert found.rates(4).tolist() == pytest.approx(counted)
    assert sum(found.rates(4)) == pytest.approx(5 / 8, abs=0.01)
    assert found.rates(20).tolist() == pytest.approx([5 / 40], abs=0.01)
    for bad in (0, 100, "all", True):
        with pytest.raises(ExperimentError, match="holds no such block of revolutions"):
            found.rates(bad)


def test_what_is_printed_and_stored(found):
    text = str(found)
    assert not found.neither.any()
    assert "neither" not in text
    assert text.startswith(f"Combustions of record: 5 of {len(found.lost)} lost")
    assert f"{4:8d}  {11:11d}  {1:4d}" in text
    assert "standard deviations" in text
    stored = json.loads(json.dumps(found.to_dict()))
    assert stored["strength"][-1] is None
    assert len(stored["probability"]) == len(found.lost)


def test_where_little_burns_it_is_said_that_nothing_can_be_told(fit, record):
    vague = ce.misfires(fit, record, sigma=10.0)
    assert "too little to decide each combustion" in str(vague)


# ---- bad input


def test_records_that_will_not_do(fit, made, speed_only):
    with pytest.raises(ExperimentError, match=r"has no crank angle.*theta"):
        ce.misfires(fit, speed_only(made).only("omega"))
    with pytest.raises(ExperimentError, match="has no crank speed"):
        ce.misfires(fit, speed_only(made).only("theta"))
    with pytest.raises(ExperimentError, match=r"too short to find misfires.*3 whole combustions"):
        ce.misfires(fit, speed_only({key: made[key][:1400] for key in ("time", "theta", "omega")}))
    back = made["theta"].copy()
    back[5000:5010] -= 0.1
    with pytest.raises(ExperimentError, match="does not increase at"):
        ce.misfires(fit, speed_only(made | {"theta": back}))
    uneven = np.sort(np.random.default_rng(1).choice(len(made["time"]), 9000, replace=False))
    with pytest.raises(ExperimentError, match="not sampled evenly"):
        ce.misfires(fit, speed_only({key: made[key][uneven] for key in ("time", "theta", "omega")}))
    with pytest.raises(ExperimentError, match="too few samples to find misfires"):
        ce.misfires(fit, speed_only({key: made[key][::60] for key in ("time", "theta", "omega")}))
    with pytest.raises(ExperimentError, match=r"misfires needs one record; seen: list"):
        ce.misfires(fit, [speed_only(made)])
    for factor in (-1, 30 / math.pi):
        with pytest.raises(ExperimentError, match="speed and crank angle of 'record' do not agree"):
            ce.misfires(fit, speed_only(made | {"omega": factor * made["omega"]}))
    with pytest.raises(ExperimentError, match="no valid samples"):
        ce.misfires(fit, speed_only(made | {"omega": np.full(len(made["time"]), np.nan)}))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lag": 7}, "invalid `lag`.*0 to 6"),
        ({"lag": True}, "invalid `lag`"),
        ({"lost": 0.0}, "invalid `lost`"),
        ({"scatter": 1.5}, "invalid `scatter`"),
        ({"step": -1.0}, "invalid `step`"),
        ({"road": "rough"}, "invalid `road`"),
        ({"sigma": 0.0}, "invalid `sigma`"),
    ],
)
def test_options_that_are_not_acceptable(fit, record, options, words):
    with pytest.raises(EstimationError, match=words):
        ce.misfires(fit, record, **options)


def test_fits_that_will_not_do(fit, record):
    with pytest.raises(EstimationError, match="misfires needs a fit"):
        ce.misfires(ce.two_mass(), record)
    with pytest.raises(ExperimentError, match="the fit has no output 'omega_load'"):
        ce.misfires(fit, renamed(record, "omega_load"), output="omega_load")
    time = np.arange(400) / 1000
    plain = ce.Experiment.from_arrays(
        "plain", time=time, units={"T": "N m", "omega": "rad/s"}, T=np.sin(9 * time), omega=np.cos(time)
    )
    free = ce.estimate(ce.one_inertia(), plain, noise=ce.Noise(omega=0.1), progress=False)
    with pytest.raises(ModelError, match=r"misfires cannot be found.*no cylinders"):
        ce.misfires(free, record)


def renamed(record, name):
    return ce.Experiment.from_arrays(
        "named", time=record["theta"].time, units={"theta": "rad", name: "rad/s"},
        theta=record["theta"].values, **{name: record["omega"].values},
    )  # fmt: skip
