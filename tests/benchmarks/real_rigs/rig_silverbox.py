"""Silverbox, found on a multisine, fresh on the end of the arrow, whose amplitudes are half as large again."""

import silverbox
from silverbox import build, initial, writings  # noqa: F401 (a rig's own)

truth = ({"spring.cubic_stiffness"},)
same = "cubic stiffness"


def records():
    return [silverbox.record("multisine", silverbox.MULTISINE)], [silverbox.record("arrow", silverbox.ARROW)]


def by_hand():
    return silverbox.by_hand(records())
