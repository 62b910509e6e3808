"""A repair of which the effects are no answer."""

from types import SimpleNamespace as stub

import pytest

from casadi_engine.discrepancy.withdrawal import far_less_probable


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
