"""The table of a parameter set, as text and as HTML."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from casadi_engine.parameters.collection import Parameters
    from casadi_engine.parameters.parameter import Parameter

HEADER = ("name", "value", "unit", "min", "max", "")
NUMERIC = (False, True, False, True, True, False)


def _number(value: float) -> str:
    return f"{value:.6g}"


def _unit(unit: str) -> str:
    return "not stated" if unit == "-" else unit


def _note(parameter: Parameter) -> str:
    notes = []
    if parameter.tie is not None:
        notes.append(f"== {parameter.tie}")
    elif not parameter.vary:
        notes.append("(fixed)")
    if parameter.varies_by_experiment:
        notes.append("(one for each experiment)")
    if parameter.prior is not None:
        mean, sigma = parameter.prior
        notes.append(f"prior {_number(mean)} ± {_number(sigma)}")
    return " ".join(notes)


def rows(parameters: Parameters) -> list[tuple[str, ...]]:
    """One row of text cells for each parameter, in the columns of `HEADER`."""
    values = parameters.as_dict()
    return [
        (name, _number(values[name]), _unit(p.unit), _number(p.min), _number(p.max), _note(p))
        for name, p in parameters.items()
    ]


def _below(parameters: Parameters) -> list[str]:
    return [str(constraint) for constraint in (*parameters.constraints, *parameters.frequency_constraints)]


def text_table(parameters: Parameters) -> str:
    """Aligned columns; the constraints follow below."""
    body = [HEADER, *rows(parameters)]
    widths = [max(len(row[column]) for row in body) for column in range(len(HEADER))]
    lines = [
        "  ".join(
            cell.rjust(width) if numeric else cell.ljust(width)
            for cell, width, numeric in zip(row, widths, NUMERIC, strict=True)
        ).rstrip()
        for row in body
    ]
    below = _below(parameters)
    if below:
        lines += ["constraints", *(f"  {line}" for line in below)]
    return "\n".join(lines)


def html_table(parameters: Parameters) -> str:
    """The same as an HTML table; every text is escaped."""

    def line(tag: str, cells: tuple[str, ...]) -> str:
        written = "".join(
            f'<{tag} style="text-align:{"right" if numeric else "left"}">{html.escape(cell)}</{tag}>'
            for cell, numeric in zip(cells, NUMERIC, strict=True)
        )
        return f"<tr>{written}</tr>"

    body = "".join(line("td", row) for row in rows(parameters))
    below = "".join(f"<li>{html.escape(item)}</li>" for item in _below(parameters))
    return (
        f"<table><thead>{line('th', HEADER)}</thead><tbody>{body}</tbody></table>"
        f"{f'<p>constraints</p><ul>{below}</ul>' if below else ''}"
    )
