"""Silverbox the other way: found on the end of the arrow, fresh on a multisine."""

import silverbox
from silverbox import build, initial, writings  # noqa: F401 (a rig's own)

truth = ({"spring.cubic_stiffness"},)
same = "cubic stiffness"


def records():
    return [silverbox.record("arrow", silverbox.ARROW)], [silverbox.record("multisine", silverbox.MULTISINE)]


def by_hand():
    return silverbox.by_hand(records())
