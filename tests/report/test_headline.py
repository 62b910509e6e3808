"""The verdict in one sentence: what is sure, and what may be."""

from dataclasses import replace

from casadi_engine.discrepancy.repaired import Unknown
from casadi_engine.discrepancy.verdict_words import headline
from casadi_engine.estimation.fit import Estimate


def of_size(effect, value, stderr, **changes):
    """The effect with another amplitude."""
    name = next(iter(effect.parameters))
    return replace(effect, parameters={**effect.parameters, name: Estimate(value, stderr, "1")}, **changes)


def test_may_be_is_said_of_what_alone_is_unsure(repaired):
    """The value of a volume, right within its error, was "wrong" where the load that was missing "may be"."""
    (sure,) = repaired.effects
    unsure = of_size(sure, 0.02, 0.014, name="viscous_friction")
    both = replace(repaired, effects=(sure, unsure))
    assert headline(both).startswith(
        "coulomb_friction at coupling is missing and viscous_friction at coupling may be missing"
    )
    assert headline(replace(repaired, effects=(sure, replace(sure, name="drag")))).startswith(
        "coulomb_friction at coupling and drag at coupling are missing"
    )
    place = next(port.name for port in repaired.model.ports if port.kind == "parameter")
    known = {"at": place, "name": "wrong_value", "sentence": f"the value of {place[10:]} is wrong"}
    wrong, right = of_size(sure, 0.2, 0.01, **known), of_size(sure, 0.02, 0.014, **known)
    assert f"the value of {place[10:]} is wrong (wrong_value at" in headline(
        replace(repaired, effects=(sure, wrong))
    )
    assert f"the value of {place[10:]} may be wrong (wrong_value at" in headline(
        replace(repaired, effects=(sure, right))
    )


def test_what_a_delay_leaves_where_its_input_jumps_is_no_further_effect(repaired):
    (one,) = repaired.effects
    late = replace(one, name="input_delay", at="input_T_load", sentence="a delay of input_T_load")
    more = replace(repaired, unknown=Unknown("an unknown torque", {}))
    assert "and more that no effect of the library names" in headline(more)
    assert "and more is left, which may be the approximation of the delay where T_load jumps" in headline(
        replace(more, effects=(late,))
    )
