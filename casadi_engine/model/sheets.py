"""The printed sheet of a model: its equations as text and LaTeX, and its tables of names and units."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca

from casadi_engine.experiment.units import unit_words
from casadi_engine.model.lags import delays
from casadi_engine.model.late_inputs import as_they_act
from casadi_engine.model.printing import write_expressions
from casadi_engine.model.styles import LATEX, TEXT, Style

if TYPE_CHECKING:
    from casadi_engine.model.model import Model

Rows = list[tuple[str, ...]]


def equation_pairs(model: Model, style: Style) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Left and right sides of the model's equations, and of the shared parts in them.

    Slots in which no law acts are left out; so are drives that pass a channel of their name on.
    """
    laws = model.laws
    acting = [row for row in range(laws.numel()) if not laws[row].is_zero()]
    idle = [row for row in range(laws.numel()) if row not in acting]
    no_torque = ca.SX.zeros(len(idle), 1)

    # what acts in the place of a channel is another quantity, and has another symbol
    acts, known = (
        [_is_made_of_its_name(one.name, model.drive_expressions[k]) for k, one in enumerate(model.drives)],
        model.d,
    )
    own = [f"{one.name}_acting" if made else one.name for one, made in zip(model.drives, acts, strict=True)]
    named = ca.vertcat(ca.SX(0, 1), *[ca.SX.sym(name) for name in own])

    def without_idle(column: Any) -> Any:
        column = ca.substitute(column, model.w[idle], no_torque) if idle else column
        return ca.substitute(column, known, named) if any(acts) else column

    acting_late, late_at = as_they_act(model), dict[int, str]()
    left = [style.derivative(variable.name) for variable in model.states]
    right = list(ca.vertsplit(without_idle(model.ode)))
    for row, drive in enumerate(model.drives):
        value = model.drive_expressions[row]
        if drive.name in acting_late:
            delay, value = acting_late[drive.name]
            at = f"{style.symbol('t')} - {style.symbol(delay)}"
            late_at[len(right)] = f"({at})" if value.is_symbolic() else f" {style.remark(f'at {at}').strip()}"
            left.append(style.symbol(drive.name))
            right.append(value)
            continue
        if not (value.is_symbolic() and value.name() == drive.name):
            _, value = _of_its_own_name(style, drive.name, value, "")
            left.append(style.symbol(own[row]))
            right.append(value)
    for row in acting:
        left.append(style.symbol(model.w[row].name()))
        right.append(without_idle(laws[row]))
    late = {
        output: (name, model.p[model.parameter_names.index(name)]) for output, name in delays(model).items()
    }
    for row, output in enumerate(model.outputs):
        name = style.symbol(output.name)
        remark, shown = _of_its_own_name(style, output.name, model.output_expressions[row], "measured")
        if output.name in late:  # the law is what holds it at one instant
            delay, symbol = late[output.name]
            shown = ca.substitute(shown, symbol, dict(model.lags).get(output.name, 0.0))
            name = f"{name}({style.symbol('t')} + {style.symbol(delay)})"
        left.append(name + remark)
        right.append(without_idle(shown))
    written = write_expressions(right, style=style, named=_known_parts(model))
    rates = [
        (style.symbol(model.channel_rates[row].name()), style.derivative(name))
        for row, name in enumerate(model.rates)
        if any(ca.depends_on(value, model.channel_rates[row]) for value in right)
    ]
    texts = [f"{text}{late_at.get(row, '')}" for row, text in enumerate(written.texts)]
    return [*zip(left, texts, strict=True), *rates], list(written.shared)


def _is_made_of_its_name(name: str, value: Any) -> bool:
    """True of what is made of something of its own name, and is not that alone."""
    return not value.is_symbolic() and any(one.name() == name for one in ca.symvar(value))


def _of_its_own_name(style: Style, name: str, value: Any, words: str) -> tuple[str, Any]:
    """A remark and a right side for what is made of something of its own name, such as a sensor of another gain,
    ``w (measured) = w*(1 + gain)``: no symbol stands for two things. No remark for others."""
    if not _is_made_of_its_name(name, value):
        return "", value
    own = next(one for one in ca.symvar(value) if one.name() == name)
    slope = ca.jacobian(value, own)
    is_gain = not ca.depends_on(slope, own) and ca.substitute(value, own, ca.SX(0)).is_zero()
    return style.remark(words), own * slope if is_gain else value


def _known_parts(model: Model) -> dict[str, Any]:
    """The crank-slider factors of the cylinders, by the names f_k and df_k, to be printed once each."""
    short = {"torque_factor": "f", "torque_factor_slope": "df"}
    found: dict[str, Any] = {}
    for port in model.ports:
        for signal, letter in short.items():
            if signal in port.signals:
                found[f"{letter}_{port.name.removeprefix('cylinder_')}"] = port.signals[signal]
    return found


def equations(model: Model) -> str:
    """The equations as plain text, one in each line; parts with a name of their own follow under "with"."""
    main, shared = equation_pairs(model, TEXT)
    lines = [f"{left} = {right}" for left, right in main]
    if shared:
        lines += ["with", *(f"  {left} = {right}" for left, right in shared)]
    return "\n".join(lines)


def changed_equations(model: Model, base: Model) -> tuple[str, ...]:
    """The lines of a model's equations that are not those of another one, with all parts of a name that they use."""
    known = set(equations(base).splitlines())
    main, shared = equation_pairs(model, TEXT)
    lines = [line for line in (f"{left} = {right}" for left, right in main) if line not in known]
    used = set(re.findall(r"\w+", " ".join(lines)))
    parts: list[str] = []
    for left, right in reversed(shared):  # one is made of those before it
        line = f"{left} = {right}"
        if left in used or f"  {line}" not in known:
            parts.insert(0, line)
            used |= set(re.findall(r"\w+", right))
    return (*lines, *parts)


def latex(model: Model) -> str:
    """The equations as a LaTeX `aligned` environment, without dollar signs."""
    main, shared = equation_pairs(model, LATEX)
    rows = " \\\\\n".join(f"{left} &= {right}" for left, right in [*main, *shared])
    return f"\\begin{{aligned}}\n{rows}\n\\end{{aligned}}"


def sections(model: Model) -> list[tuple[str, Rows]]:
    """The tables of states, inputs, drives, outputs (name, unit, description) and parameters."""
    made: list[tuple[str, Rows]] = []
    for title, group in (
        ("states", model.states),
        ("inputs", model.inputs),
        ("drives", model.drives),
        ("outputs", model.outputs),
    ):
        rows: Rows = [(variable.name, "", f"[{variable.unit}]", variable.description) for variable in group]
        if rows:
            made.append((title, rows))
    parameters: Rows = [
        (
            declared.name,
            f"{declared.value:.6g}",
            f"[{unit_words(declared.unit)}]",
            declared.description + ("" if declared.vary else " (fixed)"),
        )
        for declared in model.declarations
    ]
    return [*made, ("parameters", parameters)] if parameters else made


def table(model: Model) -> str:
    """The tables as aligned text."""
    parts = sections(model)
    widths = [max(len(row[column]) for _, rows in parts for row in rows) for column in range(3)]
    lines = []
    for title, rows in parts:
        lines.append(title)
        lines += ["  " + _aligned(row, widths) for row in rows]
    return "\n".join(lines)


def sheet(model: Model) -> str:
    """Name, description, equations and tables as text."""
    title = model.name + (f": {model.description}" if model.description else "")
    kind = "linear" if model.linear is not None else "general (not affine in states and drives)"
    if model.linear is not None and model.has_slot_laws:
        kind = "linear core with nonlinear laws in slots"
    return f"{title}\n{kind}\n\n{equations(model)}\n\n{table(model)}"


def html_sheet(model: Model) -> str:
    """The same as HTML: equations in a pre block, one table for each section."""
    parts = [f"<h4>{html.escape(model.name)}</h4>"]
    if model.description:
        parts.append(f"<p>{html.escape(model.description)}</p>")
    parts.append(f"<pre>{html.escape(equations(model))}</pre>")
    for title, rows in sections(model):
        cells = "".join(
            "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
        )
        parts.append(f"<table><caption>{title}</caption>{cells}</table>")
    return "\n".join(parts)


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    name, value, unit, description = row
    text = f"{name:<{widths[0]}}  {value:>{widths[1]}}  {unit:<{widths[2]}}  {description}"
    return text.rstrip()
