"""What is to be looked for: effects, and the ports at which they may act."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.effects import Effect, library
from casadi_engine.effects.protocol import check_effect
from casadi_engine.errors import EffectError, EstimationError
from casadi_engine.estimation.options import as_number
from casadi_engine.model import Model
from casadi_engine.model.term import NotApplicable, find_port, not_applicable, ports_of_kind
from casadi_engine.parameters import near_matches


@dataclass(frozen=True, eq=False)
class Request:
    """What is looked for, and where.

    effects : each once; where : effect name -> ports at which it is looked for
    skipped : effects that cannot act at a port, and why
    blind : True if the whole library was asked for and no effect of it can act inside the model, on its sensors alone
    """

    effects: tuple[Effect, ...]
    where: dict[str, tuple[str, ...]]
    skipped: tuple[NotApplicable, ...] = ()
    blind: bool = False

    def wants(self, candidate: Candidate) -> bool:
        """True if this candidate was asked for."""
        return candidate.port in self.where[candidate.effect]


def read_request(model: Model, effects: Any, at: Sequence[str] | str | None = None) -> Request:
    """Read effects and ports.

    effects : None for the library, or a sequence of effects, names of the library, or pairs (effect or name, port)
    at : names of ports to which the search is held, None for all
    An effect whose law fails at a port, or reads a signal that the port lacks, is left out there, and listed as not
    applicable.
    Raises EffectError for an effect that does not follow the protocol, for one that is there twice, for a port that
    does not exist, and where nothing is left to be tested in a model without effects.
    """
    if isinstance(effects, type):
        check_effect(effects)
    if effects is not None and (
        isinstance(effects, Mapping) or not isinstance(effects, (Effect, str, Iterable))
    ):
        raise EffectError(
            "invalid `effects`",
            seen=repr(effects),
            allowed="effects, names of the library, or pairs of one with a port",
            cure="leave effects out for the whole library",
        )
    given = library() if effects is None else (effects,) if isinstance(effects, (Effect, str)) else effects
    held = None if at is None else _held(model, (at,) if isinstance(at, str) else at)
    found: dict[str, Effect] = {}
    where: dict[str, tuple[str, ...] | None] = {}
    for item in given:
        effect, port = _pair(item)
        effect = library(effect)[0] if isinstance(effect, str) else effect
        check_effect(effect)
        ports = None if port is None else (find_port(model, effect, port).name,)
        if effect.name in found and (ports is None or where[effect.name] is None):
            raise EffectError(
                "two effects have the same name",
                seen=effect.name,
                allowed="each effect once, or several pairs of it with ports",
                cure="leave one of them out, or rename your own",
            )
        found[effect.name] = effect
        where[effect.name] = ports if ports is None else (*(where.get(effect.name) or ()), *ports)
    fits: dict[str, tuple[str, ...]] = {}
    skipped: list[NotApplicable] = []
    faults: list[EffectError] = []
    for name, effect in found.items():
        fits[name], left_out = _tried(model, effect, where[name], held, faults)
        skipped += left_out
    # beside effects that were found it is no fault that nothing more can act
    if not any(fits.values()) and not model.effects:
        if len(found) == 1 and faults:
            raise faults[0]
        lacking = [one for one in skipped if one.at]
        raise EffectError(
            f"none of these effects can act anywhere in the model {model.name}",
            seen="; ".join(map(str, lacking or skipped)) or ", ".join(found) or "no effects",
            allowed="effects that attach to ports of the model" + ("" if at is None else f" among {at}"),
            cure="put the port right where the model is written, b.port(name, kind, {signal: ...})"
            if lacking
            else "print(model.ports) lists the ports; leave effects out for the whole library",
        )
    inside = any(model.ports[port].slot is not None for ports in fits.values() for port in ports)
    return Request(tuple(found.values()), fits, tuple(skipped), effects is None and at is None and not inside)


def left_out(effects: Any, names: Any) -> Any:
    """What is to be looked for less the effects of these names; EffectError for a name that is not among them."""
    names = (names,) if isinstance(names, str) else tuple(names)
    if not names:
        return effects
    given = (
        library() if effects is None else (effects,) if isinstance(effects, (Effect, str)) else tuple(effects)
    )
    known = [one[0] if isinstance(one, tuple) else one for one in given]
    called = [one if isinstance(one, str) else getattr(one, "name", "") for one in known]
    for name in names:
        if name not in called:
            raise EffectError(
                "invalid `without`: an effect that is not looked for",
                seen=repr(name),
                allowed=near_matches(str(name), called),
                cure="print(casadi_engine.effects.table()) lists the library",
            )
    return [one for one, name in zip(given, called, strict=True) if name not in names]


def _tried(
    model: Model,
    effect: Effect,
    asked: tuple[str, ...] | None,
    held: tuple[str, ...] | None,
    faults: list[EffectError],
) -> tuple[tuple[str, ...], list[NotApplicable]]:
    """The ports at which an effect can act, by a call of its law on trial, and where it cannot.

    asked : the ports that it was paired with; held : those to which the search is held; faults : to be added to
    """
    there = [port for port in ports_of_kind(model, effect) if asked is None or port.name in asked]
    there = [port for port in there if held is None or port.name in held]
    if not there and held is None:
        kinds = " or ".join(effect.attaches)
        return (), [NotApplicable(effect.name, "", (), (), f"the model has no port of the kind {kinds}")]
    fine, left_out = [], []
    for port in there:
        why = not_applicable(model, effect, port)
        if why is None:
            fine.append(port.name)
        else:
            left_out.append(why[0])
            faults.append(why[1])
    return tuple(fine), left_out


def _pair(item: Any) -> tuple[Any, Any]:
    """An effect or name, and the port that it was paired with, None without one."""
    if not isinstance(item, tuple):
        return item, None
    if len(item) != 2:
        raise EffectError(
            "invalid pair in `effects`",
            seen=repr(item),
            allowed="an effect or its name, and the name of a port",
            cure='write ("coulomb_friction", "coupling"), for instance; one pair for each port',
        )
    return item[0], item[1]


def _held(model: Model, ports: Any) -> tuple[str, ...]:
    if not isinstance(ports, Iterable) or not (names := tuple(ports)):
        raise EffectError(
            "invalid `at`: the ports at which effects are looked for",
            seen=repr(ports),
            allowed=", ".join(model.ports.names),
            cure="give one name or a sequence of names; leave it out for all ports",
        )
    for name in names:
        if name not in model.ports.names:
            raise EffectError(
                f"invalid `at`: the model {model.name} has no such port",
                seen=repr(name),
                allowed=near_matches(str(name), model.ports.names),
                cure="print(model.ports) lists all ports",
            )
    return names


def check_alpha(alpha: Any) -> None:
    """Raise EstimationError for a false-alarm rate that is none."""
    number = as_number(alpha)
    if number is None or not 0 < number < 1:
        raise EstimationError(
            "invalid `alpha`",
            seen=alpha,
            allowed="a number between 0 and 1",
            cure="give alpha=0.01, for one false alarm in a hundred",
        )
