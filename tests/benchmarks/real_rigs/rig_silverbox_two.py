"""Silverbox by a model that lacks two terms: the cubic stiffness, and the offset of the input."""

import silverbox
from silverbox import initial, writings  # noqa: F401 (a rig's own)

truth = (
    {"spring.cubic_stiffness", "mass.constant_torque"},
    {"spring.cubic_stiffness", "u.sensor_offset"},
    # an offset of the output is one of the input but for a thousandth: the spring is nearly straight
    {"spring.cubic_stiffness", "y.sensor_offset"},
)
same = "cubic stiffness"


def build(writing=0):
    return silverbox.build(writing, offset=False)


def records():
    return [silverbox.record("multisine", silverbox.MULTISINE)], [silverbox.record("arrow", silverbox.ARROW)]


def by_hand():
    return silverbox.by_hand(records())
