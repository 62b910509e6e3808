"""Silverbox the other way: found on the end of the arrow, fresh on a multisine."""

import silverbox
from silverbox import build, initial, writings  # noqa: F401 (a rig's own)

# the output has a small offset of its own, beside that of the input: by hand it takes another tenth of the rmse away
truth = ({"spring.cubic_stiffness"}, {"spring.cubic_stiffness", "sensor_y.sensor_offset"})
same = "cubic stiffness"


def records():
    return [silverbox.record("arrow", silverbox.ARROW)], [silverbox.record("multisine", silverbox.MULTISINE)]


def by_hand():
    return silverbox.by_hand(records())
