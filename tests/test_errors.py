"""What every message shows."""

import pytest

from casadi_engine.errors import CasadiEngineError


@pytest.mark.parametrize(
    ("seen", "shown"),
    [
        ("a word", "seen: a word; do: this"),
        (3.5, "seen: 3.5; do: this"),
        (list(range(3)), "seen: [0, 1, 2]; do: this"),
    ],
)
def test_what_was_seen_is_shown(seen, shown):
    assert str(CasadiEngineError("wrong", seen=seen, cure="this")) == f"wrong; {shown}"


def test_no_message_is_longer_than_a_screen():
    """A posterior given for a fit printed all of its draws before what was allowed."""
    said = str(CasadiEngineError("wrong", seen=list(range(10_000)), cure="this"))
    assert len(said) < 1100
    assert said.endswith("… (list); do: this")
