"""In which order effects are refitted where one is a special case of another."""

from types import SimpleNamespace

import pytest

from casadi_engine.discrepancy.additions import Additions
from casadi_engine.effects import (
    AsymmetricFriction,
    ConstantTorque,
    CoulombFriction,
    LoadStep,
    ViscousFriction,
)

EFFECTS = [AsymmetricFriction(), CoulombFriction(), ViscousFriction(), LoadStep(), ConstantTorque()]


@pytest.mark.parametrize(
    ("left", "first"),
    [
        (
            [("asymmetric_friction", "car"), ("viscous_friction", "car"), ("coulomb_friction", "car")],
            "coulomb_friction",
        ),
        ([("asymmetric_friction", "car"), ("viscous_friction", "car")], "asymmetric_friction"),
        ([("viscous_friction", "car"), ("asymmetric_friction", "car")], "viscous_friction"),
        # one at a bound of its time is told from its fit
        ([("load_step", "car"), ("constant_torque", "car")], "load_step"),
    ],
)
def test_the_special_case_comes_before_what_has_a_number_more(left, first):
    """Dry friction was named asymmetric friction with an asymmetry of 0.002, as the time was up in between."""
    additions = Additions.__new__(Additions)
    candidates = [SimpleNamespace(source=SimpleNamespace(effect=one)) for one in EFFECTS]
    additions.screened = SimpleNamespace(candidates=candidates)
    additions.families = {(one.name, "car"): [k] for k, one in enumerate(EFFECTS)}
    ordered = additions._special_case_first(left)
    assert ordered[0] == (first, "car")
    assert sorted(ordered) == sorted(left)
