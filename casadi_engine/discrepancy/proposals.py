"""Proposals: which candidates the scores alone ask for."""

from __future__ import annotations

from casadi_engine.discrepancy.classes import clusters
from casadi_engine.discrepancy.screening import Screened

# Proposals are those whose predicted drop is at least this share of the best one's, and at most so many.
_SHARE, MOST = 0.5, 5
# Of one row's names, those whose predicted drop is this near to the best one's count as the same.
_SAME = 0.5 * 2.326**2


def proposals(screened: Screened) -> list[int]:
    """The candidates worth a refit: significant, one of each effect at each port, none that is another one's row.

    Of several names of one row the one with the fewest nuisance parameters stands for all.
    """
    found: list[int] = []
    taken: set[tuple[str, str]] = set()
    rows = clusters(screened.scores)
    home = {k: number for number, row in enumerate(rows) for k in row}
    used: set[int] = set()
    drop = screened.scores.drop
    for first in screened.significant:
        alike = [k for k in rows[home[first]] if drop[k] >= drop[first] - _SAME]  # itself, even without end
        k = min(alike, key=lambda k: (freed(screened, k), screened.candidates[k].key in taken, -drop[k]))
        key = screened.candidates[k].key
        if key in taken or home[k] in used or (found and drop[k] < _SHARE * drop[found[0]]):
            continue
        found.append(k)
        taken.add(key)
        used.add(home[k])
    return found[:MOST]


def freed(screened: Screened, k: int) -> int:
    """How many nuisance parameters of a candidate a refit estimates."""
    grids = screened.candidates[k].source.effect.nuisance.values()
    return sum(not grid.whole for grid in grids)
