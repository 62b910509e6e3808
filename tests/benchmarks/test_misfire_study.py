"""The plant of the misfire study against the simulator, and the study itself, small."""

from dataclasses import replace

import misfire_plant as plants
import misfire_study
import numpy as np
import pytest


def test_the_fast_plant_is_the_simulators_engine():
    from simulator import simulate_two_mass

    lost = np.zeros((1, 4, 7), dtype=bool)
    lost[0, 2, 3] = True
    exact = simulate_two_mass(1200.0, cycles=5, misfire={3: [3]}, scatter=0.0, sigma=0.0, rtol=1e-9)
    theta, omega = plants.simulate_long(1200.0, 57.0, lost, seed=0, scatter=0.0, sigma=0.0, governor=None)
    count = min(omega.shape[1], len(exact["time"]))
    assert np.ptp(exact["omega_true"]) > 5
    assert np.abs(omega[0, :count] - exact["omega_true"][:count]).max() < 5e-4
    assert np.abs(theta[0, :count] - exact["theta"][:count]).max() < 5e-4


def test_shaking_is_as_large_as_it_says():
    shaken = plants.Shaking(road=30.0).torques(20_000, 1e-3, 4, np.random.default_rng(1))
    assert shaken[:, 1].std() == pytest.approx(30, rel=0.1)
    assert not shaken[:, 0].any()
    stepped = plants.Shaking(step=20.0, impulse=100.0).torques(20_000, 1e-3, 2, np.random.default_rng(1))
    assert set(np.unique(stepped[:, 0])) == {0.0, 20.0}
    assert 50 < np.abs(stepped[:, 1]).max() <= 100


def test_hindsight_finds_the_fewest_errors():
    lost = np.array([True, True, False, False, True])
    assert misfire_study.hindsight(np.array([1.0, 2.0, 3.0, 4.0, 5.0]), lost) == (1, 0)
    assert misfire_study.hindsight(np.array([5.0, 4.0, 1.0, 2.0, 3.0]), lost) == (0, 2)
    assert misfire_study.most(0, 30_000) == pytest.approx(1e-4, rel=0.01)


@pytest.mark.slow
def test_a_small_study_has_no_errors(monkeypatch):
    monkeypatch.setattr(misfire_study, "RECORDS", 2)
    monkeypatch.setattr(misfire_study, "AT_ONCE", 2)
    one = next(one for one in misfire_study.conditions() if one.name == "6000 RPM, 57 N m, rough")
    answer = misfire_study.run(replace(one, least_lost=40), 500)
    assert (answer["missed"], answer["false"], answer["wrong cylinder"]) == (0, 0, 0)
    assert answer["lost"] > 40
    assert answer["d"] > 12
    assert answer["index missed"] > 0
    assert answer["blocks"] == {}
    assert answer["refuted"] == 0
    assert answer["misfit"][1] == pytest.approx(1, abs=0.05)
    assert "6000 RPM, 57 N m, rough | " in misfire_study.table([answer])


def test_the_page_says_where_theory_does_not_allow_it():
    one = {
        "name": "loud", "date": "2026-01-01", "combustions": 1000, "lost": 100, "missed": 9, "false": 0,
        "wrong cylinder": 0, "index missed": 100, "index false": 0, "d": 5.0,
        "d low": 4.0, "expected missed": 0.05, "expected false": 1e-5,
        "ms": 0.2, "blocks": {"200": [2, 0.001, 0.09, 0.11]},
        "misfit": [0.9, 1.0, 1.1], "neither": 0, "records": 8, "refuted": 0,
    }  # fmt: skip
    calm = one | {"name": "calm", "missed": 0, "expected missed": 1e-6, "blocks": {}}
    wrong = calm | {"name": "wrong", "missed": 60, "misfit": [12.0, 13.0, 14.0], "refuted": 8}
    text = misfire_study.words([one, calm, wrong])
    assert "below its limit with 95 %; not in: calm (0 of 100 missed, 0 of 900 false)." in text
    assert "\n- wrong: 8 of 8, misfit 12 to 14, missed 60 %\n" in text
    assert "Where it does not: loud." in text
    assert "in 1 conditions: missed 0 of 100 (at most\n3 %), false 0 of 900" in text
    assert (
        "- loud: 2 blocks of 200 revolutions with 9 to 11 % lost; the share found is off by 0.1 % at most"
        in text
    )
