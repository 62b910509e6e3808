"""Effects at one port that are together one function of what moves there: of which the data tell no number, or which
add up to a curve that one law may have as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca

from casadi_engine.discrepancy.one_product import may_be_a_product
from casadi_engine.discrepancy.path import FAILURES
from casadi_engine.discrepancy.repaired import Unknown
from casadi_engine.discrepancy.wording import HOLDS
from casadi_engine.effects.table import rows_of
from casadi_engine.estimation.corner_widths import courses, paths_of

if TYPE_CHECKING:
    from casadi_engine.discrepancy.repaired import FoundEffect, Repair
    from casadi_engine.effects.protocol import Effect
    from casadi_engine.estimation import Fit
    from casadi_engine.estimation.fit import Estimate

# So many laws at one port bend to any curve that one law has, whichever sign what moves there has.
_MANY = 3
_LAW = "a law that the library lacks may be the true one there"


def told_as_one_law(repair: Repair) -> Repair:
    """The repair with a law that the library lacks beside effects at a port that it may be in place of.

    Two or three laws of one signal, or one with a shape of its own, bend to many a smooth curve. Where the data tell
    none of their numbers, neither by an error nor by an interval, they tell the curve alone: the leak through an
    orifice comes out as a proportional one and one that fades. Where the signal keeps its sign nothing jumps with it,
    and they add up to a curve whose numbers may be known while its law is not: a root about its mean is a constant and
    a proportional loss. Three laws at one port are one curve whatever its sign: two linear losses and one by the square
    had stood for a body that radiates.
    """
    ports: dict[str, list[FoundEffect]] = {}
    for one in repair.effects:
        ports.setdefault(one.at, []).append(one)
    said = {at: words for at, own in ports.items() if (words := _said(repair.fit, at, own))}
    if not said and len(ports) > 1 and (words := _over_one_variable(repair.fit, repair.effects)):
        said = {repair.effects[0].at: words}
    if not said and (words := may_be_a_product(repair.fit, repair.effects)):
        said = {repair.effects[0].at: words}
    if not said:
        said = {at: words for at, own in ports.items() if (words := _at_its_bound(own))}
    if not said:
        beside = [words for at, own in ports.items() if (words := _beside_own_terms(repair.fit, at, own))]
        return replace(repair, messages=(*beside, *repair.messages)) if beside else repair
    port, words = next(iter(said.items()))
    unknown = repair.unknown or Unknown(words, {}, port, odds=1.0)
    verdict = "class" if repair.verdict == "named" else repair.verdict  # a law of no name is a member too
    return replace(repair, verdict=verdict, unknown=unknown, messages=(*said.values(), *repair.messages))


def _said(fit: Fit | None, at: str, own: list[FoundEffect]) -> str:
    """What is said of the effects at a port; "" of those that stand for themselves."""
    names = f"{' and '.join(one.name for one in own)} at {at}"
    numbers = [value for one in own for value in one.parameters.values()]
    if len(numbers) > 1 and not any(_is_told(one) for one in numbers):
        verb, whose = ("are", "their") if len(own) > 1 else ("is", "its")
        return f"{names} {verb} identified as one curve alone, none of {whose} parameters by itself: {_LAW}"
    if fit is not None and len(_static(fit, at)) >= _MANY:
        return f"{names} add up to one curve of what moves there: {_LAW}"
    signal = _one_signal(fit, at, 2) if len(own) > 1 and fit is not None else None
    if signal is None:
        return ""
    return f"{names} add up to a curve over {signal}, which keeps its sign in the records: {_LAW}"


def _at_its_bound(own: Sequence[FoundEffect]) -> str:
    """What is said of an effect of which a number of its shape has gone to its bound: a storage that takes as long as
    the record is a drift, and nothing shows that it gives back. A share may well be all or nothing, and what is 0 is
    not there."""
    for one in own:
        shape = list(one.parameters.items())[1:]
        ended = [
            n.rpartition(".")[2]
            for n, value in shape
            if value.at_bound and value.value != 0 and value.unit not in ("1", "-")
        ]
        if ended:
            verb = "is at its bound" if len(ended) == 1 else "are at their bounds"
            return (
                f"{' and '.join(ended)} of {one.name} at {one.at} {verb}, so that the data do not determine its shape: "
                f"{_LAW}"
            )
    return ""


def _is_told(one: Estimate) -> bool:
    """True of a number that the data tell: by an error, an interval, or an error of the quadratic that leaves it away
    from 0, where a look beside the optimum found that this is not symmetric; not of one that is held."""
    if one.stderr is not None or one.interval is not None:
        return True
    return one.quadratic is not None and abs(one.value) > HOLDS * one.quadratic


def _over_one_variable(fit: Fit | None, effects: Sequence[FoundEffect]) -> str:
    """The same of effects at several ports that add, to one equation, what depends on a state or an input alone: an
    offset of a speed that acts by its square and a constant head are together a square of the speed."""
    if fit is None:
        return ""
    model, names = fit.model, list(fit.model.parameter_names)
    left = [one for one in effects if next(iter(one.parameters)) in names]
    own = [names.index(next(iter(one.parameters))) for one in left]
    ode = model.closed_ode
    gone = [ca.vertcat(*[0 if k == j else model.p[k] for k in range(len(names))]) for j in own]
    adds = [ca.simplify(ode - ca.substitute(ode, model.p, other)) for other in gone]
    for row in range(ode.size1()):
        here = [k for k, one in enumerate(adds) if not one[row].is_zero()]
        moving = {s.name(): s for k in here for s in ca.symvar(adds[k][row]) if not _is_in(s, model.p)}
        if len(here) < 2 or len(here) < len(effects) or len(moving) != 1:
            continue
        ((name, symbol),) = moving.items()
        if _is_in(symbol, ca.vertcat(model.x, model.u)) and _keeps_its_sign(fit, symbol):
            said = " and ".join(f"{left[k].name} at {left[k].at}" for k in here)
            return f"{said} add up to a curve over {name}, which keeps its sign in the records: {_LAW}"
    return ""


def _is_in(symbol: ca.SX, symbols: ca.SX) -> bool:
    return any(symbol.element_hash() == one.element_hash() for one in ca.symvar(symbols))


def _beside_own_terms(fit: Fit | None, at: str, own: list[FoundEffect]) -> str:
    """What is said of an effect at a port where the model has a term of the same signal, which keeps its sign; "" where
    it has none."""
    signal = _one_signal(fit, at, 1) if fit is not None and len(own) == 1 else None
    if fit is None or signal is None or fit.model.ports[at].kind in ("input", "sensor"):
        return ""
    if any(state.name.startswith(f"{at}_{own[0].name}_") for state in fit.model.states):
        return ""  # what has a memory is no curve
    names, model = list(fit.model.parameter_names), fit.model
    amplitude = next(iter(own[0].parameters))
    if amplitude not in names:
        return ""
    known = _symbols(ca.substitute(model.ports[at].signals[signal], model.d, model.drive_expressions))
    moving = _symbols(ca.vertcat(model.x, model.u, model.t))
    slopes = ca.jacobian(model.closed_ode, model.p)
    rows = [i for i in range(slopes.size1()) if not slopes[i, names.index(amplitude)].is_zero()]
    terms = []
    for name in fit.free:
        if name not in names or name.startswith(f"{own[0].key}."):
            continue
        read = [_symbols(slopes[i, names.index(name)]) & moving for i in rows]
        if any(read) and all(one <= known for one in read):
            terms.append(name)
    if not terms:
        return ""
    return (
        f"{own[0].name} at {at} and what {' and '.join(terms)} does there add up to a curve over {signal}, which keeps "
        "its sign in the records: their ± hold for these laws alone"
    )


def _symbols(expression: ca.SX) -> set[int]:
    return {symbol.element_hash() for symbol in ca.symvar(expression)}


def _static(fit: Fit, at: str) -> list[Effect]:
    """The effects at a port that act at any time and have no memory."""
    own = [one.effect for one in fit.model.effects if one.at == at]
    states = [state.name for state in fit.model.states]
    return [
        one
        for one in own
        if all(grid.over == "value" for grid in one.nuisance.values())
        and not any(name.startswith(f"{at}_{one.name}_") for name in states)
    ]


def _one_signal(fit: Fit, at: str, least: int) -> str | None:
    """The signal of a port on which all effects there depend that act at any time, where it keeps its sign and they are
    so many at least."""
    port, laws = fit.model.ports[at], _static(fit, at)
    read = {name for one in laws for row in rows_of(one) if row.port == port.kind for name in row.signals}
    if len(laws) < least or len(read) != 1 or not read <= set(port.signals):
        return None
    (signal,) = read
    return signal if _keeps_its_sign(fit, port.signals[signal]) else None


def _keeps_its_sign(fit: Fit, signal: ca.SX) -> bool:
    """Whether a signal is on one side of zero in all records."""
    try:
        found = courses(paths_of(fit), signal)
    except FAILURES:
        return False
    return not min(one.min() for one in found) < 0 < max(one.max() for one in found)
