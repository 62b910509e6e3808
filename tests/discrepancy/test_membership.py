"""The way to a structure and its classes, from evidences that are known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from casadi_engine.discrepancy.membership import class_of, number_of, ordered

DRY, DRAG, STEP, OFFSET = ("dry", "load"), ("drag", "load"), ("step", "load"), ("offset", "sensor")


# what a further effect has to gain in log probability
PRICE = math.log(10)
PAIR = PRICE - math.log(2)  # of a pair, which is found in either order


def effect(key):
    return SimpleNamespace(candidate=SimpleNamespace(key=key), label=key[0])


def pool_of(**logs):
    """dry_drag=3.0 -> the structure of both and its log evidence."""
    known = {"dry": DRY, "drag": DRAG, "step": STEP, "offset": OFFSET, "none": None}
    return {
        frozenset(known[part] for part in name.split("_") if known[part]): SimpleNamespace(
            log=log, effects=(), beyond=9.0, fresh=0.0, evidence=SimpleNamespace(cost=-2 * log)
        )
        for name, log in logs.items()
    }


def names(members):
    return [member.name for member in members]


def test_the_way_goes_over_the_most_probable_structures():
    pool = pool_of(none=0.0, dry=5.0, drag=9.0, step=1.0, dry_drag=20.0, drag_step=18.0, dry_drag_step=40.0)
    found = ordered([effect(DRY), effect(DRAG), effect(STEP)], pool)
    assert [one.label for one in found] == ["drag", "dry", "step"]


def test_what_was_never_tried_comes_last_on_the_way():
    found = ordered([effect(STEP), effect(DRY)], pool_of(none=0.0, dry=-3.0, dry_step=2.0))
    assert [one.label for one in found] == ["dry", "step"]
    assert ordered([], {}) == ()


def test_effects_that_are_as_probable_share_their_class():
    found = class_of(pool_of(dry=7.0, drag=7.0, step=-50.0), frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert [(m.name, m.at) for m in found] == [DRY, DRAG]
    assert [m.probability for m in found] == pytest.approx([0.5, 0.5])


def test_evidence_counts_less_where_no_structure_describes_the_fresh_data():
    pool = pool_of(dry=7.0, drag=3.0)
    assert names(class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)) == ["dry"]
    found = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE, 4.0)
    assert [m.probability for m in found] == pytest.approx([1 / (1 + math.exp(-1)), 1 / (1 + math.e)])
    # what an effect more has to gain counts by as much less: one alone that is far worse does not lead by that
    both, alone = pool_of(none=0.0, dry=5.0, drag=9.0, dry_drag=20.0), frozenset({DRY, DRAG})
    own = class_of(both, alone, effect(DRY), 20.0, PRICE, 100.0)
    assert own[0].probability == max(m.probability for m in own)


@pytest.mark.parametrize(("times", "inside"), [(19.0, True), (21.0, False)])
def test_an_effect_that_is_a_factor_less_probable_is_excluded(times, inside):
    pool = pool_of(dry=7.0, drag=7.0 - math.log(times))
    found = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert names(found) == (["dry", "drag"] if inside else ["dry"])
    share = times / (1 + times) if inside else 1.0
    assert found[0].probability == pytest.approx(share)
    assert sum(m.probability for m in found) == pytest.approx(1)


def test_probabilities_follow_the_evidence_and_the_rest_their_order():
    pool = pool_of(dry=0.0, step=-math.log(4), drag=-math.log(2))
    found = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert names(found) == ["dry", "drag", "step"]
    assert [m.probability for m in found] == pytest.approx([4 / 7, 2 / 7, 1 / 7])


def test_the_effect_itself_comes_first_even_where_another_is_more_probable():
    """The structure is chosen by more than the evidence: fresh data may have refused the other."""
    found = class_of(pool_of(dry=0.0, drag=math.log(9)), frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert names(found) == ["dry", "drag"]
    assert [m.probability for m in found] == pytest.approx([0.1, 0.9])


def test_rivals_stand_beside_the_same_other_effects():
    pool = pool_of(dry=30.0, drag=30.0, dry_step=50.0, drag_step=50.0, dry_offset=50.0, dry_drag=49.5)
    found = class_of(pool, frozenset({DRY, STEP}), effect(STEP), 20.0, PRICE)
    assert set(names(found)) == {"step", "offset", "drag"}
    assert names(found)[0] == "step"
    own = class_of(pool, frozenset({DRY, STEP}), effect(DRY), 20.0, PRICE)
    assert names(own) == ["dry", "drag"]


def test_two_effects_may_stand_in_the_place_of_one():
    pool = pool_of(dry=30.0, drag=20.0, step=5.0, drag_step=30.0 + PAIR, dry_step=31.0)
    first, second = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert (first.label, second.label) == ("dry at load", "drag at load with step at load")
    assert (first.probability, second.probability) == pytest.approx((0.5, 0.5))
    pool[frozenset({DRAG, STEP})].log -= math.log(21)
    assert names(class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)) == ["dry"]


def test_a_member_of_the_class_needs_no_second_effect():
    pool = pool_of(dry=30.0, drag=30.0, drag_step=30.0 + PRICE)
    assert [m.label for m in class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)] == [
        "dry at load",
        "drag at load",
    ]


def test_one_effect_may_stand_in_the_place_of_two():
    pool = pool_of(dry=10.0, drag=9.0, step=30.0, dry_drag=30.0 + PAIR)
    first, second = class_of(pool, frozenset({DRY, DRAG}), effect(DRAG), 20.0, PRICE)
    assert second.label == "step at load in place of it and dry at load"
    assert (first.probability, second.probability) == pytest.approx((0.5, 0.5))


def test_a_structure_whose_fit_failed_is_no_rival():
    found = class_of(pool_of(dry=1.0, drag=-math.inf), frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert names(found) == ["dry"]


def test_what_the_data_do_not_tell_is_named_however_improbable_it_was_before():
    pool = pool_of(dry=7.0, offset=0.5, drag=0.5)
    pool[frozenset({OFFSET})].evidence.cost = pool[frozenset({DRY})].evidence.cost + 1.9
    found = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert names(found) == ["dry", "offset"]
    assert found[1].probability == pytest.approx(1 / (1 + math.exp(6.5)))
    pool[frozenset({OFFSET})].evidence.cost += 0.2
    assert names(class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)) == ["dry"]


@pytest.mark.parametrize(
    ("fresh", "misfit", "kept"), [(-2.9, 1.0, True), (-3.1, 1.0, False), (-3.1, 2.0, True)]
)
def test_what_fresh_data_exclude_is_no_rival_however_alike_it_is_on_the_data_of_the_search(
    fresh, misfit, kept
):
    pool = pool_of(dry=7.0, offset=-30.0)
    pool[frozenset({OFFSET})].evidence.cost = pool[frozenset({DRY})].evidence.cost
    pool[frozenset({OFFSET})].fresh = fresh  # log(20) is 3.0
    found = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE, misfit)
    assert names(found) == (["dry", "offset"] if kept else ["dry"])


def test_an_effect_has_the_candidate_of_its_label_or_else_the_best_one():
    candidates = [SimpleNamespace(key=k, label=label) for k, label in ((DRY, "a"), (STEP, "b"), (STEP, "c"))]
    screened = SimpleNamespace(
        candidates=candidates, scores=SimpleNamespace(statistic=np.array([9.0, 1.0, 2.0]))
    )
    assert number_of(screened, STEP, "b") == 1
    assert number_of(screened, STEP, "another") == 2
    assert number_of(screened, DRY) == 0


def test_an_effect_of_which_its_refit_left_nothing_is_no_rival():
    pool = pool_of(none=0.0, dry=-1.0, drag=0.5, step=0.2)
    pool[frozenset({DRAG})].beyond = 0.0
    assert names(class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)) == ["dry", "step"]


def test_a_member_of_no_probability_left_is_named_all_the_same():
    """What remains of it is below the least number there is: "min() arg is an empty sequence" ended the repair."""
    pool = pool_of(dry=2000.0, offset=0.0, drag=0.0)
    for key in (OFFSET, DRAG):
        pool[frozenset({key})].evidence.cost = pool[frozenset({DRY})].evidence.cost
    found = class_of(pool, frozenset({DRY}), effect(DRY), 20.0, PRICE)
    assert sorted(names(found)) == ["drag", "dry", "offset"]
    assert [m.probability for m in found] == [1.0, 0.0, 0.0]
