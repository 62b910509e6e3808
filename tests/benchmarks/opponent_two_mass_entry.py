"""The two opponents that are written for two masses, behind the call that all opponents share."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import opponent_lfilter
import opponent_two_mass
from cases import Case
from chain import Array

ORDER = ("J_eng", "J_load", "K_el", "C_el", "C_eng")


def _fit(module: ModuleType, case: Case, start: Array, mark: Callable[[], None]) -> dict[str, Any]:
    (record,) = case.records
    mark()  # their set-up is part of one call: it is counted as solution
    given = dict(zip(ORDER, start.tolist(), strict=True))
    found = module.fit(record.speed, record.drives[0], record.drives[1], case.step, given)
    values = np.array([found["parameters"][name] for name in ORDER])
    return {"values": values, "iterations": found["evaluations"]}


def compressed(case: Case, start: Array, mark: Callable[[], None]) -> dict[str, Any]:
    """Frequency domain, everything projected and compressed."""
    return _fit(opponent_two_mass, case, start, mark)


def filters(case: Case, start: Array, mark: Callable[[], None]) -> dict[str, Any]:
    """Exact discretisation, `lfilter`, analytic Jacobian."""
    return _fit(opponent_lfilter, case, start, mark)
