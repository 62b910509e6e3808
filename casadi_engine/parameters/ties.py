"""The graph of ties: `references` maps each tied name to the names in its tie."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

References = Mapping[str, tuple[str, ...]]


def in_order(references: References) -> tuple[str, ...]:
    """The tied names, each after the tied ones that its own tie refers to (the graph has no cycle)."""
    done: dict[str, None] = {}

    def visit(name: str) -> None:
        if name in references and name not in done:
            for reference in references[name]:
                visit(reference)
            done[name] = None

    for name in references:
        visit(name)
    return tuple(done)


def closure(references: References, names: Iterable[str]) -> set[str]:
    """`names` and all that their ties refer to, directly or through other ties."""
    found: set[str] = set()
    stack = list(names)
    while stack:
        name = stack.pop()
        if name not in found:
            found.add(name)
            stack.extend(references.get(name, ()))
    return found


def cycle(references: References, name: str, tied_to: Iterable[str]) -> list[str]:
    """The way a, b, …, a that tying `name` to `tied_to` would close, or an empty list."""
    way_back = {first: [name, first] for first in tied_to}
    stack = list(way_back)
    while stack:
        reached = stack.pop()
        if reached == name:
            return way_back[name]
        for following in references.get(reached, ()):
            if following not in way_back:
                way_back[following] = [*way_back[reached], following]
                stack.append(following)
    return []
