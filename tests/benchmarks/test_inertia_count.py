"""A record of seven inertias asks for more than two or three, and one of three for three."""

import pytest
from inertia_count import counted

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("dof", "counts"), [(7, (2, 3, 5, 7)), (3, (2, 3, 5))])
def test_as_many_as_there_are_are_asked_for(dof, counts):
    found, refused = counted(dof, counts=counts)
    assert not refused
    assert next(iter(found.log_evidence)) == f"{dof} inertias"
    assert found.probability[f"{dof} inertias"] > 0.999
