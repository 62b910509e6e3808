"""The pendulum of rig_pendulum_cart until it stays at rest: found on 30 to 72.4 s, fresh 8 to 30 s, every third sample.

The fresh record swings three times as far: there a drag counts, by hand five times in the fresh rmse.
"""

import rig_pendulum_cart
from rig_pendulum_cart import build, initial, writings  # noqa: F401 (a rig's own)

truth = ({"pivot.coulomb_friction", "pivot.quadratic_drag"},)
same = "dry friction and drag"
SPANS, EVERY = ((30.0, 72.5), (8.0, 30.0)), 3


def records():
    return rig_pendulum_cart.records(SPANS, EVERY)


def by_hand():
    return rig_pendulum_cart.by_hand(SPANS, EVERY)
