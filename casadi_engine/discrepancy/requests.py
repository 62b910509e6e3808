"""What is to be looked for: effects, and the ports at which they may act."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from casadi_engine.discrepancy.candidate import Candidate
from casadi_engine.effects import Effect, library, ports_for
from casadi_engine.errors import EffectError, EstimationError
from casadi_engine.estimation.options import as_number
from casadi_engine.model import Model
from casadi_engine.model.effect import check_effect
from casadi_engine.model.term import find_port


@dataclass(frozen=True, eq=False)
class Request:
    """effects : each once; where : effect name -> the ports that were asked for, None for all that fit."""

    effects: tuple[Effect, ...]
    where: dict[str, tuple[str, ...] | None]

    def wants(self, candidate: Candidate) -> bool:
        """True if this candidate was asked for."""
        ports = self.where[candidate.effect]
        return ports is None or candidate.port in ports


def read_request(model: Model, effects: Any, at: Sequence[str] | str | None = None) -> Request:
    """Read effects and ports.

    effects : None for the library, or a sequence of effects, names of the library, or pairs (effect or name, port)
    at : names of ports to which the search is held, None for all
    Raises EffectError for an effect that does not follow the protocol, for one that is there twice, for a port that
    does not exist or that no effect fits, and where nothing is left to be tested.
    """
    if effects is not None and (
        isinstance(effects, Mapping) or not isinstance(effects, (Effect, str, Iterable))
    ):
        raise EffectError(
            "what is to be looked for is not acceptable",
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
    if held is not None:
        where = {name: tuple(p for p in held if ports is None or p in ports) for name, ports in where.items()}
    fits = {name: [port.name for port in ports_for(model, effect)] for name, effect in found.items()}
    if not any(
        port in (where[name] or fits[name]) and where[name] != () for name in fits for port in fits[name]
    ):
        raise EffectError(
            f"none of these effects can act anywhere in the model {model.name}",
            seen=", ".join(found) or "no effects",
            allowed="effects that attach to ports of the model" + ("" if at is None else f" among {at}"),
            cure="print(model.ports) lists the ports; leave effects out for the whole library",
        )
    return Request(tuple(found.values()), where)


def _pair(item: Any) -> tuple[Any, Any]:
    """An effect or name, and the port that it was paired with, None without one."""
    if not isinstance(item, tuple):
        return item, None
    if len(item) != 2:
        raise EffectError(
            "what is to be looked for at a port is no pair",
            seen=repr(item),
            allowed="an effect or its name, and the name of a port",
            cure='write ("coulomb_friction", "coupling"), for instance; one pair for each port',
        )
    return item[0], item[1]


def _held(model: Model, ports: Any) -> tuple[str, ...]:
    if not isinstance(ports, Iterable) or not (names := tuple(ports)):
        raise EffectError(
            "the ports at which effects are to be looked for are not acceptable",
            seen=repr(ports),
            allowed=", ".join(model.ports.names),
            cure="give one name or a sequence of names; leave it out for all ports",
        )
    for name in names:
        if name not in model.ports.names:
            raise EffectError(
                f"effects are to be looked for at a port that the model {model.name} does not have",
                seen=repr(name),
                allowed=", ".join(model.ports.names),
                cure="print(model.ports) lists all ports",
            )
    return names


def check_alpha(alpha: Any) -> None:
    """Raise EstimationError for a false-alarm rate that is none."""
    number = as_number(alpha)
    if number is None or not 0 < number < 1:
        raise EstimationError(
            "alpha is not acceptable",
            seen=alpha,
            allowed="a number between 0 and 1",
            cure="give alpha=0.01, for one false alarm in a hundred",
        )
