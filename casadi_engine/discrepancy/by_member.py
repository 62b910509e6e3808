"""What parameters are with another member of a class in the place of the one that leads: its names are as good, and
the numbers beside them are not the same."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from casadi_engine.discrepancy.repaired import FoundEffect, Member
from casadi_engine.discrepancy.wording import si
from casadi_engine.estimation.fit import Fit

Key = frozenset[tuple[str, str]]
# Standard errors by which a value has to be another one to be told, and how many of them are.
_APART, _TOLD = 2.0, 4
# Change of chi-squared, and of the log probability of fresh data, that tells nothing.
_SAME = 0.5


def told_by_member(
    found: Sequence[FoundEffect], key: Key, values: Mapping[Key, Mapping[str, float]], fit: Fit
) -> list[str]:
    """A sentence for each effect of which the values of the fit hold with its own name alone.

    key : the structure of all effects found; values : structure -> parameters where its refit arrived. The values of a
    refit are held against those of the refit of the lead, both with corners of the same width.
    """
    lead = values.get(key)
    if lead is None:
        return []
    said = []
    for one in found:
        apart = []
        for member in one.members[1:]:
            there = _in_place(key, one, member)
            off = [] if there is None else _off(lead, values.get(there, {}), fit)
            if off:
                place = "" if member.more else f" in the place of {one.name} at {one.at}"
                apart.append((off, f"with {member.label}{place}"))
        if apart:
            off, words = max(apart, key=lambda pair: pair[0][0][0])
            names = ", ".join(f"{name} is {text}" for _, name, text in off[:_TOLD])
            more = f", and {len(off) - _TOLD} more are others" if len(off) > _TOLD else ""
            said.append(f"values and ± hold only for the names that lead: {words} {names}{more}")
    return said


def told_by_priors(found: Sequence[FoundEffect], key: Key, pool: Mapping[Key, Any]) -> list[str]:
    """A sentence for each effect of which another one does the same to all data: their odds are no finding.

    pool : structure -> what its refit left
    """
    lead, said = pool.get(key), []
    for one in found:
        alike = []
        for member in one.members[1:]:
            there = _in_place(key, one, member)
            other = None if there is None else pool.get(there)
            if lead is None or other is None:
                continue
            apart = abs(other.evidence.cost - lead.evidence.cost), abs(other.fresh - lead.fresh)
            if max(apart) < _SAME:
                alike.append(member.label)
        if alike:
            said.append(
                f"{one.name} at {one.at} and {' and '.join(alike)} explain all data alike: their probabilities are "
                "those of their priors"
            )
    return said


def _in_place(key: Key, one: FoundEffect, member: Member) -> Key | None:
    """The structure with a member in the place of the lead of its class; None where it is of another kind."""
    rest = key - {(one.name, one.at)}
    if not member.more:
        return rest | {(member.name, member.at)}
    word, _, other = member.more.strip().partition(" ")
    name, _, at = other.partition(" at ")
    return rest | {(member.name, member.at), (name, at)} if word == "with" else None


def _off(lead: Mapping[str, float], other: Mapping[str, float], fit: Fit) -> list[tuple[float, str, str]]:
    """The parameters that are others with a member: by how many standard errors, name, and value; largest first."""
    found = []
    for name, estimate in fit.estimates.items():
        if not estimate.stderr or name not in lead or name not in other:
            continue
        size = abs(other[name] - lead[name]) / estimate.stderr
        if size > _APART and math.isfinite(size):
            own, value = fit.parameters[name.partition("@")[0]], estimate.value + other[name] - lead[name]
            if not own.min <= value <= own.max:  # far along a valley two refits do not differ as two fits do
                value = other[name]
            found.append((size, name, f"{value:.4g}{si(estimate.unit)}"))
    return sorted(found, reverse=True)
