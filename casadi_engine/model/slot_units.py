"""The units of slots: of what a slot is added to, else what its equation divides out, else not stated.

A slot is added to something: in ``(0.001*R*(I + slot) - u)/tau`` to I, and so it is in A, whatever the 0.001 is. Where
nothing of a known unit stands beside it, the unit of the rate, over what stands between the slot and the rate, is its
own; unless a bare number stands there of which nobody knows whether it converts units. Then no unit is told.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca

from casadi_engine.experiment.units import NOT_STATED, unit_product
from casadi_engine.model.amounts import (
    Amount,
    Step,
    amount_of,
    amounts_of,
    is_alike,
    is_of_one_kind,
    steps_of,
    symbols_of,
)
from casadi_engine.model.port_units import named, units_of

# So many ways from a slot to the rates, and terms of one sum, are looked at.
_MOST = 200


@dataclass(frozen=True)
class Rung:
    """A sum or a rate on the way of a slot to the rate of a state.

    beside : the amounts of what the slot's term is added to there; of a rate, its own alone
    between : what the slot is multiplied with up to there
    """

    beside: tuple[Amount, ...]
    between: Amount
    rate: str = ""

    def further(self, by: Amount, power: int) -> Rung:
        """The rung as seen from behind a factor."""
        return replace(self, between=self.between.times(by, power))

    def slot(self, amount: Amount) -> Amount:
        """What the slot counts if its term counts this."""
        return amount.times(self.between, -1).in_si()


@dataclass(frozen=True)
class Found:
    """The unit of a slot, None where nothing tells it; else how it was found, or why it is not stated."""

    unit: str | None = None
    by: str = "nothing"
    why: str = ""


# From the innermost sum to the rate.
Way = tuple[Rung, ...]
# The rate behind something of which no unit is known: it tells nothing.
_UNKNOWN: Way = (Rung((), Amount(loose=True, symbols=True)),)


def with_units(
    ports: Mapping[str, Any],
    units: Sequence[tuple[Any, str]],
    odes: Mapping[str, tuple[str, Any]],
    *,
    stated: Collection[str],
    may_lack: Collection[int] = (),
    per: str,
) -> dict[str, Any]:
    """Ports by name with the units of their signals, and of their slots where these were not stated.

    units : pairs of an SX symbol and its unit; may_lack : hashes of those whose unit may be a default
    odes : state -> its unit, and its rate by the unit of time ``per``
    """
    signals = [(name, key) for name, port in ports.items() for key in port.signals]
    found = units_of([ports[name].signals[key] for name, key in signals], units)
    own: dict[str, dict[str, str]] = {name: {} for name in ports}
    for (name, key), unit in zip(signals, found, strict=True):
        if unit is not None:
            own[name][key] = unit
    given = [(ports[name].slot, ports[name].unit) for name in stated if ports[name].slot is not None]
    asked = [name for name, port in ports.items() if port.slot is not None and name not in stated]
    slots = [ports[name].slot for name in asked]
    told = slot_units(slots, [*units, *given], odes, may_lack=may_lack, per=per)
    by_name = dict(zip(asked, told, strict=True))
    made = {}
    for name, port in ports.items():
        one = by_name.get(name, Found())
        unit = port.unit if one.unit is None else one.unit
        made[name] = replace(port, units=own[name], unit=unit, why_no_unit=one.why)
    return made


def slot_units(
    slots: Sequence[Any],
    units: Sequence[tuple[Any, str]],
    odes: Mapping[str, tuple[str, Any]],
    *,
    may_lack: Collection[int],
    per: str,
) -> list[Found]:
    """What the odes tell of the units of slots."""
    if not slots:
        return []
    symbols = [*slots, *(symbol for symbol, _ in units)]
    steps, ends = steps_of(ca.vertcat(*[ode for _, ode in odes.values()]), ca.vertcat(*symbols))
    amounts = amounts_of(steps, [*[None] * len(slots), *symbols_of(units, may_lack)])
    ways: list[dict[Way, None]] = [{} for _ in steps]
    for (state, (unit, _)), end in zip(odes.items(), ends, strict=True):
        if end >= 0:
            rate = () if unit == NOT_STATED else (amount_of(unit_product((unit, 1), (per, -1))),)
            ways[end][(Rung(rate, Amount(), state),)] = None
    reached = _reached(steps, len(slots))
    for k in range(len(steps) - 1, len(symbols) - 1, -1):
        if reached[k] and ways[k]:
            _hand_down(k, steps, amounts, ways, reached)
    return [_agreed([_unit(way) for way in ways[k]]) for k in range(len(slots))]


def _reached(steps: Sequence[Step], slots: int) -> list[bool]:
    """True of each step that one of the first symbols, the slots, is in."""
    found = [k < slots for k in range(len(steps))]
    for k, step in enumerate(steps):
        found[k] = found[k] or any(found[one] for one in step.of)
    return found


def _hand_down(
    k: int,
    steps: Sequence[Step],
    amounts: Sequence[Amount | None],
    ways: list[dict[Way, None]],
    reached: Sequence[bool],
) -> None:
    """Hand the ways from a step to the rates on to what it is made of, as far as slots are in that."""
    step = steps[k]
    if step.is_sum:
        terms = _terms(k, steps)
        for term in dict.fromkeys(term for term in terms if reached[term]):
            others = [amounts[one] for one in terms if one != term]
            beside = tuple(one for one in others if one is not None and one.symbols)
            here = (Rung(beside, Amount()),) if beside else ()
            _add(ways[term], [(*here, *way) for way in ways[k]])
        return
    for place, one in enumerate(step.of):
        if reached[one]:
            _add(ways[one], [_through(step, place, way, amounts) for way in ways[k]])


def _through(step: Step, place: int, way: Way, amounts: Sequence[Amount | None]) -> Way:
    """A way as seen from one of the parts of a step."""
    if (step.keeps and place == 0) or (step.does == ca.OP_IF_ELSE_ZERO and place == 1):
        return way
    if step.does == ca.OP_TWICE:
        return _behind(way, Amount(2.0), 1)
    if step.does == ca.OP_MUL or (step.does == ca.OP_DIV and place == 0):
        by = amounts[step.of[1 - place]]
        return _UNKNOWN if by is None else _behind(way, by, 1 if step.does == ca.OP_MUL else -1)
    return _UNKNOWN


def _behind(way: Way, by: Amount, power: int) -> Way:
    return tuple(rung.further(by, power) for rung in way)


def _add(to: dict[Way, None], ways: Sequence[Way]) -> None:
    for way in ways:
        if len(to) < _MOST:
            to[way] = None


def _terms(k: int, steps: Sequence[Step]) -> list[int]:
    """The terms of a sum, those of the sums in it in their place."""
    found: list[int] = []
    open_ = [k]
    while open_:
        one = open_.pop()
        inner = steps[one].is_sum or (steps[one].does == ca.OP_NEG and steps[steps[one].of[0]].is_sum)
        if inner and len(found) + len(open_) < _MOST:
            open_ += reversed(steps[one].of)
        else:
            found.append(one)
    return found


def _unit(way: Way) -> Found:
    """The unit of a slot by one of its ways to a rate: by the innermost sum that tells, else by the rate itself."""
    top = way[-1]
    # a rate tells nothing where what stands between may lack its unit
    known = bool(top.beside) and not top.between.loose
    by_rate = top.slot(top.beside[0]) if known else None
    found = _by_neighbours(way, by_rate)
    if found is not None:
        return found
    if by_rate is None:
        return Found()
    near = [rung.slot(one) for rung in way[:-1] if not rung.between.loose for one in rung.beside]
    weak = [one for one in near if one.is_plain]
    if not top.between.symbols:
        # a number alone may stand for a mass, unless what is added to the slot is a rate as well: (2*pi*f)**2*angle is
        alike = [one for one in near if (is_alike if one.is_plain else is_of_one_kind)(one, by_rate)]
        sure = top.between.is_one and bool(alike)
        return Found(_text(by_rate), "rate") if sure else Found()
    if by_rate.is_plain:
        return Found(_text(by_rate), "rate")
    same = [one for one in weak if is_of_one_kind(one, by_rate)]
    if same:
        return Found(_text(same[0]), "rate")
    number = f"{abs(top.between.number):.6g}"
    why = f"the number {number} stands between it and d({top.rate})/dt, and may convert units or not"
    return Found(NOT_STATED, "number", why)


def _by_neighbours(way: Way, by_rate: Amount | None) -> Found | None:
    """The unit of a slot by what stands beside it in the innermost sum that tells one; None if none does."""
    top = way[-1].between
    for rung in way[:-1]:
        # a + 8*slot tells nothing where the 8 may be one over an inertia; 8*(a + slot) does
        mass = not top.symbols and not rung.between.is_one
        if rung.between.loose or mass:
            continue
        told = [rung.slot(one) for one in rung.beside if one.powers and not one.loose]
        told = _surest([one for one in told if one.is_plain], by_rate)
        if not told:
            continue
        # a rate is held to what it asks for where all that stands between has a unit and no bare number
        asked = by_rate if by_rate is not None and top.symbols and top.is_plain else None
        fit = [one for one in told if asked is not None and is_of_one_kind(one, asked)]
        if not fit and asked is not None:
            texts = f"{_text(told[0])}, and d({way[-1].rate})/dt asks for {_text(asked)}"
            return Found(NOT_STATED, "neighbours", f"what it is added to is in {texts}")
        told = fit or told
        if all(is_alike(told[0], other) for other in told[1:]):
            return Found(_best(told, by_rate, top), "neighbour")
        texts = " and in ".join(list(dict.fromkeys(_text(one) for one in told))[:3])
        return Found(NOT_STATED, "neighbours", f"what it is added to is in {texts}")
    return None


def _surest(told: Sequence[Amount], by_rate: Amount | None) -> list[Amount]:
    """Terms without a bare number; and those with one by which no unit converts, of the same kind or of the rate's.

    2*x may be a force by a spring of 2 N/m.
    """
    sure = [one for one in told if one.is_one]
    model = sure[0] if sure else by_rate
    others = [one for one in told if not one.is_one and model is not None and is_of_one_kind(one, model)]
    return [*sure, *others]


def _best(told: Sequence[Amount], by_rate: Amount | None, top: Amount) -> str:
    """The shortest text of units that are alike; of a slot that is a rate itself, the text of the rate."""
    texts = [_text(one) for one in told]
    if by_rate is not None and by_rate.is_plain and is_alike(told[0], by_rate):
        if not top.symbols:
            return _text(by_rate)
        texts.append(_text(by_rate))
    return min(texts, key=len)


def _text(amount: Amount) -> str:
    return _named(amount.unit)


_named = lru_cache(maxsize=1024)(named)


def _agreed(found: Sequence[Found]) -> Found:
    """One answer of those of all ways: what stands beside a slot counts more than what its odes divide out."""
    beside = [one for one in found if one.by == "neighbour"]
    by_rate = [one for one in found if one.by == "rate"]
    open_ = [one for one in found if one.why]
    if not beside and (not found or any(one.by == "nothing" for one in found)):
        return next(iter(open_), Found()) if any(one.by == "neighbours" for one in open_) else Found()
    told = beside or by_rate
    if not told:
        return open_[0]
    if all(_same(told[0], other) for other in told[1:]):
        return min(told, key=lambda one: len(one.unit or ""))
    texts = list(dict.fromkeys(one.unit or "" for one in told))
    return Found(NOT_STATED, "odes", f"it enters odes in {' and in '.join(texts[:3])}")


def _same(one: Found, other: Found) -> bool:
    return (
        one.unit is not None and other.unit is not None and is_alike(*map(amount_of, (one.unit, other.unit)))
    )
