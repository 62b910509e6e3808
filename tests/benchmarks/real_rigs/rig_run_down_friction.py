"""Run-downs of an engine by a model whose friction is viscous: it lacks a dry one, in one direction a constant torque."""

import engine_run_down
from engine_run_down import initial, records, writings  # noqa: F401 (a rig's own)

truth = ({"engine.coulomb_friction"}, {"engine.constant_torque"}, {"engine.asymmetric_friction"})
same = "dry friction"


def build(writing=0):
    return engine_run_down.build(writing, dry=False)


def by_hand():
    free = {"nothing added": ("viscous",), "dry friction": ("viscous", "dry"), "drag": ("viscous", "drag")}
    free |= {"dry friction, free mass": ("viscous", "dry", "mass")}
    return engine_run_down.by_hand(free)
