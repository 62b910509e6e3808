"""The yardstick of the study of hidden effects: refits of the null plant, the search for sizes, and what is counted."""

import numpy as np
import pytest
import repair_detectable as yardstick
import repair_hidden_tables as tables
import repair_null_plant as plant
from repair_detectable import Detectable, Place, Point, clean_records


@pytest.fixture(scope="module")
def records():
    """Without effects; viscous friction at the load; a misfire."""
    viscous = Place("viscous_friction", "load", 0.01, 0.4).hidden(0.1)
    misfire = Place("misfire", "cylinder_2", 0.1, 1.0, {"cycles": (4,)}).hidden(0.02)
    return clean_records([(), (viscous,), (misfire,)], 57.0)


@pytest.fixture(scope="module")
def left(records):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plant, "STARTS", plant.STARTS[:2])
        return plant.refitted(records, [1, 1, 1])


@pytest.mark.slow
def test_a_record_without_effects_leaves_nothing_and_gives_the_truth(left):
    assert left[0].mu < 0.01
    assert left[0].converged
    found = [left[0].values[name] for name in plant.NAMES]
    assert found == pytest.approx(list(plant.TRUTH), rel=2e-3)


@pytest.mark.slow
def test_viscous_friction_at_the_load_is_taken_up_by_the_engine(left):
    assert left[1].mu < 1.0
    assert left[1].values["C_eng"] == pytest.approx(0.1541 + 0.1, rel=0.02)


@pytest.mark.slow
def test_a_misfire_is_left_over_as_far_as_a_linear_refit_says(left):
    assert left[2].mu == pytest.approx(left[2].linear, rel=0.1)
    assert left[2].mu > 3


@pytest.mark.slow
def test_the_refit_is_a_minimum(records, left):
    drives = plant.drives_of(records)
    best = np.array([left[2].values[name] for name in plant.NAMES])
    first = np.array([records[2]["states"][k, 0] for k in (1, 2, 3)])
    own = plant.driven(drives, np.array([2]), best[:, None], first[:, None])[0, 0]
    e = (records[2]["omega_true"][::2][: len(own)] - own) / plant.SIGMA
    assert left[2].mu <= np.linalg.norm(e) + 1e-9  # the refit's first state is better than the true one


@pytest.mark.slow
def test_parameters_stay_within_the_bounds_of_a_user(records, left, monkeypatch):
    monkeypatch.setattr(plant, "STARTS", plant.STARTS[:1])
    monkeypatch.setattr(plant, "HIGH", np.array([4.0, 2.0, 20_000.0, 50.0, 0.2]))
    (one,) = plant.refitted([records[1]], [1])
    assert "C_eng" in one.at_bound
    found = np.array([one.values[name] for name in plant.NAMES])
    assert np.all(found <= plant.HIGH * (1 + 1e-9))
    assert np.all(found >= plant.LOW * (1 - 1e-9))
    assert one.values["C_eng"] == pytest.approx(0.2, rel=1e-6)
    assert one.mu > left[1].mu


def curve_of(law):
    """A stand-in for simulator and refit: mu by a law of the size."""

    def points(asked, warm=None):
        blank = dict.fromkeys(plant.NAMES, 1.0)
        return {key: Point(s, law(s), 2 * law(s), blank, (), True) for key, s in asked.items()}

    return points


@pytest.mark.parametrize("law", [lambda s: 3.7 * s, lambda s: 40 * s**2, lambda s: 300 * s**2 / (1 + 80 * s)])
def test_the_size_is_found_on_the_curve_itself(law, monkeypatch):
    monkeypatch.setattr(yardstick, "points_at", curve_of(law))
    place = Place("coulomb_friction", "load", 1.0, 100.0)
    found = yardstick.detectable([(place, 1)])[place, 1]
    assert law(found.size) == pytest.approx(yardstick.WANTED, rel=0.02)
    assert found.points[4].size == pytest.approx(4 * found.size)
    assert found.untestable == {}


def test_a_place_that_leaves_nothing_is_not_testable(monkeypatch):
    monkeypatch.setattr(yardstick, "points_at", curve_of(lambda s: s / (1 + s)))
    place = Place("viscous_friction", "load", 0.01, 0.4)
    found = yardstick.detectable([(place, 1)])[place, 1]
    assert found.size is None
    assert found.untestable[4] == "mu is 0.29 at 0.4, the largest size that makes sense"
    assert "not testable: mu is 0.29" in yardstick.table({(place, 1): found})


def test_sizes_that_make_no_sense_and_curves_that_fall_back_are_told(monkeypatch):
    monkeypatch.setattr(yardstick, "points_at", curve_of(lambda s: 6 * s if s < 2 or s > 9 else 1.0))
    place = Place("coulomb_friction", "load", 0.5, 9.5)
    found = yardstick.detectable([(place, 1)])[place, 1]
    assert found.untestable[4] == "the curve falls back: mu is 1"
    place = Place("coulomb_friction", "load", 0.5, 8.5)
    monkeypatch.setattr(yardstick, "points_at", curve_of(lambda s: 6 * s))
    found = yardstick.detectable([(place, 1)])[place, 1]
    assert found.untestable[10].endswith("is more than 8.5, the largest that makes sense")
    assert isinstance(found, Detectable)


def row_of(*classes, size=1, fresh=1.0):
    side = {"fresh chi2/N": fresh, "passed": True, "fresh passed": True, "chi2/N": 1.0}
    return {
        "effects": [{"members": [list(m) for m in one]} for one in classes],
        "at optimum": {"class": size},
        "at truth": {"class": size},
        "by refits": {"class": size},
        "after": side,
        "true": {**side, "fresh chi2/N": 1.0, "z": 0.0},
        "amplitude": None,
        "separable": True,
    }


DRY, STEP = ("coulomb_friction", "load"), ("load_step", "load")
PIECE = "coulomb_friction at load, 1, 4, 0"


@pytest.mark.parametrize(
    ("row", "good", "single", "wrong", "companions"),
    [
        (row_of([DRY]), True, True, False, 0),
        (row_of([STEP]), False, False, True, 1),
        (row_of([DRY, STEP]), False, False, False, 0),
        (row_of([STEP, DRY], size=2), True, False, False, 0),
        (row_of([DRY], [STEP]), True, True, True, 1),
        (row_of(), False, False, False, 0),
    ],
)
def test_what_counts_as_named_right(row, good, single, wrong, companions):
    found = tables.judged(PIECE, row)
    counted = [found[key] for key in ("good", "single right", "single wrong", "companions")]
    assert counted == [good, single, wrong, companions]


def test_a_model_counts_as_good_as_the_truth_within_two_percent():
    assert tables.judged(PIECE, row_of([DRY], fresh=1.019))["fresh"]
    assert not tables.judged(PIECE, row_of([DRY], fresh=1.021))["fresh"]


def test_a_step_at_the_start_is_a_constant_torque():
    def word(rivals):
        least = min(rivals.values())
        count = 1 + sum(d < tables.SEPARATED for d in rivals.values())
        return {
            "by refits": {"rivals": rivals, "class": count, "d": least},
            "d": least,
            "separable": least >= 5,
        }

    told = tables.with_nested(
        "constant_torque at load, 2, 4", word({"engine/constant_torque": 0.1, "load/load_step": 9.0})
    )
    assert told["by refits"]["rivals"] == {
        "engine/constant_torque": 0.1,
        "load/load_step": 0.0,
        "engine/load_step": 0.1,
    }
    assert (told["theory"], told["separable"]) == (4, False)
    alone = word({"engine/backlash": 7.0, "load/quadratic_drag": 8.0})
    assert tables.with_nested("cubic_stiffness at coupling, 2, 4", alone) == alone | {"theory": 1}
    step = word({"load/constant_torque": 6.0})
    assert tables.with_nested("load_step at load, 2, 4", step)["by refits"]["rivals"] == {
        "load/constant_torque": 6.0
    }
