"""The pendulum of rig_pendulum_cart until it stays at rest: found on 30 to 72.4 s, fresh 8 to 30 s, every third sample.

In small swings dry friction is all; the fresh record swings three times as far.
"""

import rig_pendulum_cart
from rig_pendulum_cart import build, initial, truth, writings  # noqa: F401 (a rig's own)

same = "dry friction"
SPANS, EVERY = ((30.0, 72.5), (8.0, 30.0)), 3


def records():
    return rig_pendulum_cart.records(SPANS, EVERY)


def by_hand():
    return rig_pendulum_cart.by_hand(SPANS, EVERY)
