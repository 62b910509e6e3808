"""A repair of which the effects are no answer."""

import dataclasses
from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy import summary, verdict_words
from casadi_engine.discrepancy.confirmation import Gap
from casadi_engine.discrepancy.repaired import (
    REFUSED,
    UNCONFIRMED,
    Gaps,
    Nearest,
    Repair,
    Side,
    Unknown,
)
from casadi_engine.discrepancy.withdrawal import far_less_probable, withdrawn


@pytest.mark.parametrize(("probability", "withdrawn"), [(0.03, True), (0.06, False), (0.97, False)])
def test_what_the_data_exclude_beside_another_is_no_answer(probability, withdrawn):
    """The other does not lead, as its fit did not end: then none is named."""
    members = (
        stub(name="load_step", at="shaft", more="", probability=probability),
        stub(name="drag", at="shaft", more=" with sensor_gain at sensor_w", probability=1 - probability),
    )
    one = stub(name="load_step", at="shaft", key="shaft.load_step", members=members, p_value=1e-9)
    found = far_less_probable([one])
    assert (found is not None) == withdrawn
    if withdrawn:
        assert found.tests == {"shaft.load_step": 1e-9}
        assert found.sentence.startswith(
            "drag at shaft with sensor_gain at sensor_w is far more probable than load_step at shaft, but no whole fit"
        )


def gap(*sizes):
    return Gap(1.0, dict(zip("yz", sizes, strict=False)), {}, 100)


def sides(before, after, fresh=None):
    """Gaps of the data of the search and of fresh ones, (before, after) each."""
    told = [stub(gap=one) for one in (before, after, *(fresh or ()))]
    return stub(
        estimation_before=told[0],
        estimation_after=told[1],
        validation_before=told[2] if fresh else None,
        validation_after=told[3] if fresh else None,
    )


@pytest.mark.parametrize(
    ("fresh", "share"),
    [(None, 1 - (0.25 + 0.16) / 2), ((gap(4.0, 2.0), gap(3.0, 2.0)), 1 - (9 / 16 + 1) / 2)],
)
def test_what_was_withdrawn_closes_as_much_as_the_data_show_that_show_least(fresh, share):
    found = Nearest(("a",), None, gap(1.0, 2.0), fresh and fresh[1])
    given = sides(gap(2.0, 5.0), gap(2.0, 5.0), fresh and (fresh[0], fresh[0]))
    assert found.closes(given) == pytest.approx(share)


@pytest.mark.parametrize(("after", "said"), [(1.0, True), (3.5, False)])
def test_the_headline_says_what_comes_nearest(after, said):
    """A sensor's offset closed nine tenths of the gap, and the only word of it was that it had been withdrawn."""
    near = Nearest(("sensor_offset at sensor_V",), None, gap(after))
    repair = stub(nearest=near, gaps=sides(gap(4.0), gap(4.0)), noise=None)
    words = verdict_words._nearest(repair)
    assert words == (
        "; nearest is sensor_offset at sensor_V, which closes 94 % of the squared gap" if said else ""
    )
    assert verdict_words._nearest(stub(nearest=None, gaps=None, noise=None)) == ""


def test_effects_that_are_withdrawn_leave_their_model_as_the_nearest():
    effect = dataclasses.make_dataclass("Effect", ["name", "at", "why_withdrawn"])("drag", "shaft", "")
    before = Gaps(side(3.0), side(1.0), side(4.0), side(2.0))
    repair = Repair("answered", "named", True, "null", "with it", 0.01, effects=(effect,), gaps=before)
    found = withdrawn(repair, "why", Unknown("what is left is no noise", {}))
    assert (found.fit, found.nearest.fit, found.nearest.names) == ("null", "with it", ("drag at shaft",))
    assert (found.nearest.estimation.rmse, found.nearest.validation.rmse) == ({"y": 1.0}, {"y": 2.0})
    assert withdrawn(repair, "why", None).nearest is None  # nothing is missing
    words = summary._nearest(found, 3)
    assert words == [
        "  rmse with drag at shaft: y 3 -> 1; fresh: y 4 -> 2 (repair.nearest)",
    ]
    assert summary._nearest(repair, 3) == []


def side(size):
    return Side(gap(size), {}, {})


def test_an_output_that_had_no_gap_does_not_halve_what_another_one_closes():
    """theta went from 8.13 to 0.074, and the headline said that 85 % of the squared gap is closed."""
    near = Nearest(("a",), None, gap(0.1, 1.0))
    given = sides(gap(8.0, 1.0), gap(8.0, 1.0))
    assert near.closes(given, {"y": 0.1, "z": 1.0}) == pytest.approx(1 - 2 / 6401)
    assert near.closes(given) == pytest.approx((2 - (0.1 / 8) ** 2 - 1) / 2)


def test_the_nearest_prints_its_names_and_what_is_left():
    """It wrote two thousand lines of arrays."""
    near = Nearest(("drag at shaft", "lag of y"), None, gap(1.0), gap(2.0))
    assert repr(near) == "Nearest(drag at shaft and lag of y: rmse y 1; fresh rmse y 2; .fit is the model)"
    assert repr(near) == str(near)


def test_an_output_without_a_gap_says_nothing_of_what_is_closed():
    near = Nearest(("a",), None, gap(1.0, 1e-12))
    assert near.closes(sides(gap(2.0, 0.0), gap(2.0, 0.0))) == pytest.approx(0.75)
    assert Nearest(("a",), None, gap(0.0)).closes(sides(gap(0.0), gap(0.0))) == 0.0


@pytest.mark.parametrize(
    ("why", "p", "said"), [(UNCONFIRMED, 0.0043, True), (UNCONFIRMED, 0.02, False), (REFUSED, 0.0043, False)]
)
def test_what_chance_may_have_made_is_in_the_headline_and_before_the_model_is_used(why, p, said):
    """Fourteen levels of a drug, six times the noise beside two compartments: "nothing is missing", "use the model"."""
    effect = stub(name="drag", at="blood", why_withdrawn=why, p_value=p)
    found = verdict_words._by_chance(stub(withdrawn=(effect,), alpha=0.01))
    assert found == (
        "; drag at blood may be missing (p = 0.0043), and fresh data do not confirm it" if said else ""
    )
