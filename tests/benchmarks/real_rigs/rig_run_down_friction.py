"""Run-downs of an engine by a model whose friction is viscous: it lacks a dry one.

The shaft turns one way, so that a constant torque is the same. Pressures are absolute, by an assumed intake.
"""

import engine_run_down
from engine_run_down import initial, writings  # noqa: F401 (a rig's own)

truth = ({"engine.coulomb_friction"}, {"engine.constant_torque"}, {"engine.asymmetric_friction"})
same = "dry friction"


def build(writing=0):
    return engine_run_down.build(writing, dry=False, absolute=True)


def records():
    return engine_run_down.records(absolute=True)


def by_hand():
    free = {"nothing added": ("viscous",), "dry friction": ("viscous", "dry"), "drag": ("viscous", "drag")}
    free |= {"dry friction, free mass": ("viscous", "dry", "mass")}
    return engine_run_down.by_hand(free, absolute=True)
