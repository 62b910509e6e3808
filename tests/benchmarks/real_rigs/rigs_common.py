"""What all rigs share: where the records are, what a rig's file holds, and outputs in one unit.

A rig is a module (rig_NAME.py) with

    writings            one sentence for each way in which the model is written
    build(writing)      (model, parameters); the start values of all writings are the same physics
    initial(writing)    initial states with which the writings are compared
    records()           (estimation, fresh): lists of experiments, conditioned as a user would
    truth               the right answers: sets of "port.effect", each a complete one
    by_hand()           structure -> Structure fitted with SciPy alone, what by_hand.json keeps
    same                the structure of by_hand() that a right answer has
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[2]
SHARED = PROJECT.parent / "shared" / "data"
PROBLEMS = PROJECT / "problems"
NAMES = tuple(sorted(path.stem.removeprefix("rig_") for path in HERE.glob("rig_*.py")))


class NoDataError(Exception):
    """The measurements, which are kept beside the project, are not there."""


def shared(*parts: str) -> Path:
    """A file of the real measurements; NoDataError if it is not there."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        raise NoDataError(f"{'/'.join(parts)} is not in ../shared/data")
    return path


def rig(name: str) -> ModuleType:
    """The module of a rig."""
    if name not in NAMES:
        raise SystemExit(f"no rig is called {name}; there are {', '.join(NAMES)}")
    if str(HERE) not in sys.path:
        sys.path.insert(0, str(HERE))
    return importlib.import_module(f"rig_{name}")


def page(name: str) -> ModuleType:
    """A problem file of the gallery as a module."""
    if str(PROBLEMS) not in sys.path:
        sys.path.insert(0, str(PROBLEMS))
    return importlib.import_module(name)


def to_si(model: Any) -> dict[str, float]:
    """Output -> what one of its unit is in SI (differences: an offset of the scale does not count)."""
    from casadi_engine.experiment.units import converted, si_unit

    made = {}
    for output in model.outputs:
        if output.unit in ("-", "1", "V"):
            made[output.name] = 1.0
            continue
        one, zero = converted(np.array([1.0, 0.0]), output.unit, si_unit(output.unit))
        made[output.name] = float(one - zero)
    return made
