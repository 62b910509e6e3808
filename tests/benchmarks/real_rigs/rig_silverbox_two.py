"""Silverbox by a model that lacks two terms: the cubic stiffness, and the offset of the input."""

import silverbox
from silverbox import initial, writings  # noqa: F401 (a rig's own)

truth = (
    {"spring.cubic_stiffness", "mass.constant_torque"},
    # beside a nearly straight spring an offset of the output is one of the input
    {"spring.cubic_stiffness", "sensor_y.sensor_offset"},
)
same = "cubic stiffness"


def build(writing=0):
    return silverbox.build(writing, offset=False)


def records():
    return [silverbox.record("multisine", silverbox.MULTISINE)], [silverbox.record("arrow", silverbox.ARROW)]


def by_hand():
    return silverbox.by_hand(records())
