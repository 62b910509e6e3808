"""A model as plain data for another process: CasADi's symbols cannot be sent as they are."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import casadi as ca

from casadi_engine.model.declarations import Port, Ports

if TYPE_CHECKING:
    from casadi_engine.model.model import Model

_SYMBOLIC = ("x", "u", "d", "w", "t", "p", "ode", "drive_expressions", "laws", "output_expressions")


@dataclass(frozen=True)
class Parcel:
    """A model's plain fields, its ports (name, kind, description, unit, why it has none, signals, slot), and CasADi's
    text of symbols.

    The text holds the columns of ``_SYMBOLIC``, then signals and slot of port after port: what they share stays shared.
    """

    plain: dict[str, Any]
    ports: tuple[tuple[str, str, str, str, str, tuple[str, ...], bool], ...]
    text: str


def pack(model: Model) -> Parcel:
    """A model's parcel; `unpack` makes the same model of it."""
    plain = {field.name: getattr(model, field.name) for field in fields(model)}
    symbols = [ca.SX(plain.pop(name)) for name in _SYMBOLIC]
    ports = []
    for port in plain.pop("ports"):
        symbols += [ca.SX(signal) for signal in port.signals.values()]
        symbols += [] if port.slot is None else [ca.SX(port.slot)]
        ports.append(
            (
                port.name,
                port.kind,
                port.description,
                port.unit,
                port.why_no_unit,
                tuple(port.signals),
                port.slot is not None,
            )
        )
    writer = ca.StringSerializer()
    writer.pack(symbols)
    return Parcel(plain, tuple(ports), writer.encode())


def unpack(parcel: Parcel) -> Model:
    """The model of a parcel, with symbols of its own."""
    from casadi_engine.model.model import Model

    symbols = iter(ca.StringDeserializer(parcel.text).unpack())
    columns = {name: next(symbols) for name in _SYMBOLIC}
    ports = []
    for name, kind, description, unit, why, signals, slot in parcel.ports:
        known = {key: next(symbols) for key in signals}
        port = Port(name, kind, description, known, unit=unit, why_no_unit=why)
        ports.append(replace(port, slot=next(symbols)) if slot else port)
    return Model(**parcel.plain, ports=Ports(ports), **columns)
