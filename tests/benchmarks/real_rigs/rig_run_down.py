"""Run-downs of an engine by a model with dry friction, as problems/run_down.py has it.

By hand the reciprocating mass, which is fixed by a guess, explains most when it is free: 11 % of the rmse. But it goes
to zero, which no piston has. Named so, or unnamed.
"""

import engine_run_down
from engine_run_down import build, initial, records, writings  # noqa: F401 (a rig's own)

truth = ({"parameter_m_eq"}, {"parameter_moved_share"}, set())
same = "free mass"


def by_hand():
    free = {
        "nothing added": ("dry",),
        "free mass": ("dry", "mass"),
        "free mass, angle": ("dry", "mass", "timing"),
    }
    free |= {"viscous too": ("dry", "viscous"), "free mass, drag": ("dry", "mass", "drag")}
    return engine_run_down.by_hand(free)
