"""One screen of text: what does not fit is left out by whole items, and what is left out is counted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from casadi_engine.estimation.summary import COLUMNS, count, wrapped

Lines = list[str]


def fitted(parts: Mapping[str, Sequence[Lines]], order: Sequence[tuple[str, int]], most: int) -> Lines:
    """The parts one below the other, in at most so many lines if shorter forms of them allow it.

    parts : name -> its lines, the whole first and then shorter forms
    order : names in which parts are shortened, each with the number of forms that are left to be told later

    >>> parts = {"a": [["a 1", "a 2"], ["a: 2"]], "b": [["b 1", "b 2"], ["b 1"], []]}
    >>> fitted(parts, [("b", 1), ("a", 0), ("b", 0)], 3)
    ['a 1', 'a 2', 'b 1']
    >>> fitted(parts, [("b", 1), ("a", 0), ("b", 0)], 1)
    ['a: 2']
    >>> fitted(parts | {"c": [["c 1", "c 2", "c 3"], []]}, [("b", 1), ("c", 0)], 4)
    ['a 1', 'a 2', 'b 1', 'b 2']
    """
    chosen = dict.fromkeys(parts, 0)

    def lines() -> Lines:
        return [line for name, k in chosen.items() for line in (parts[name][k] if parts[name] else ())]

    for name, left in order:
        while len(lines()) > most and chosen[name] + 1 + left < len(parts[name]):
            chosen[name] += 1
    for name in dict.fromkeys(name for name, _ in reversed(order)):  # room that the last cut left over
        while (
            chosen[name]
            and len(lines()) - len(parts[name][chosen[name]]) + len(parts[name][chosen[name] - 1]) <= most
        ):
            chosen[name] -= 1
    return lines()


def in_columns(lines: Sequence[str], indent: str = "      ") -> Lines:
    """Lines of at most 100 columns; a longer one goes on below, as no end of it may be lost."""
    return [
        part.rstrip()
        for line in lines
        for part in (wrapped(line, indent) if len(line.rstrip()) > COLUMNS else [line])
    ]


def listed(items: Sequence[str], most: int, more: str = "more") -> list[str]:
    """The first items, and how many more there are.

    >>> listed(["a", "b", "c"], 2), listed(["a"], 2), listed(["a", "b"], 1, "more outputs")
    (['a', 'b', 'and 1 more'], ['a'], ['a', 'and 1 more outputs'])
    """
    rest = len(items) - most
    return [*items[:most], *([f"and {count(rest)} {more}"] if rest > 0 else [])]


def shortened(form: Callable[[int], Lines], whole: int, *sizes: int) -> list[Lines]:
    """Forms of a part: with all of its items, and with fewer of them, the most first.

    >>> shortened(lambda n: [f"{n} items"], 4, 6, 3, 1)
    [['4 items'], ['3 items'], ['1 items']]
    """
    return [form(whole), *(form(size) for size in sizes if size < whole)]
