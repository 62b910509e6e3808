"""Storages that would begin with a content that nothing there has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from casadi_engine.discrepancy.refit import Addition

# Times of what the signal behind which a storage is varies by that its content may differ from it where a record
# begins. A content without bounds and a conductance near 0 are a course that fades, whatever causes it.
_FULLEST = 30.0


def is_overfull(effects: Sequence[Addition], initial: Mapping[str, Mapping[str, float]]) -> bool:
    """True if a storage that an effect brings would begin far beyond what is ever stored there.

    initial : record -> state -> value where it begins
    """
    for one in effects:
        effect = one.candidate.source.effect
        reach, first = getattr(effect, "reach", 0.0), getattr(effect, "first", 0.0)
        if not reach > 0:
            continue
        stem = f"{one.candidate.port}_{one.candidate.effect}_"
        own = [v for states in initial.values() for name, v in states.items() if name.startswith(stem)]
        if any(abs(value - first) > _FULLEST * reach for value in own):
            return True
    return False
