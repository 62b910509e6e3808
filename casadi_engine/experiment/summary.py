"""An experiment described for a person and for a result file."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from .channel import Channel
from .header import name_list

if TYPE_CHECKING:
    from .experiment import Experiment


def describe(experiment: Experiment, outputs: Iterable[str] | None) -> dict[str, Any]:
    """JSON-able dict of an experiment, as it stands in a result file."""
    if outputs is None:
        names = tuple(name for name in experiment.names if name not in experiment.inputs)
    else:
        names = tuple(experiment[name].name for name in name_list(outputs, "outputs"))
    return {
        "name": experiment.name,
        "file": experiment.source,
        "sha256": experiment.sha256,
        "samples": experiment.samples,
        "outputs": list(names),
        "channels": [_channel_dict(channel) for channel in experiment.channels],
        "ignored": list(experiment.ignored),
        "history": [step.to_dict() for step in experiment.history],
    }


def _channel_dict(channel: Channel) -> dict[str, Any]:
    return {
        "name": channel.name,
        "unit": channel.unit,
        "samples": len(channel),
        "missing": channel.missing,
        "from": channel.span[0],
        "to": channel.span[1],
        "rate": channel.rate,
        "hold": channel.hold,
        "origin": channel.origin,
    }


def text(experiment: Experiment) -> str:
    """One screen of text."""
    count = len(experiment.channels)
    lines = [
        f"Experiment {experiment.name}: {count} channel{'s' if count > 1 else ''}, "
        f"{experiment.duration:.6g} s, {experiment.samples} samples"
    ]
    if experiment.source is not None:
        lines.append(f"  file     {experiment.source}  (sha256 {(experiment.sha256 or '')[:12]})")
    rows: list[tuple[str, ...]] = [
        ("channel", "unit", "samples", "missing", "from [s]", "to [s]", "rate [Hz]", "hold", "origin")
    ]
    rows += [_row(channel) for channel in experiment.channels]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for row in rows:
        cells = [
            cell.rjust(width) if 2 <= k <= 6 else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append(("  " + "  ".join(cells)).rstrip())
    if experiment.inputs:
        lines.append(f"  inputs   {', '.join(experiment.inputs)}")
    if experiment.ignored:
        lines.append(f"  ignored  {', '.join(experiment.ignored)}")
    lines += [f"  {'history ' if k == 0 else ' ' * 8} {step}" for k, step in enumerate(experiment.history)]
    return "\n".join(lines)


def _row(channel: Channel) -> tuple[str, ...]:
    rate = channel.rate
    return (
        channel.name,
        channel.unit,
        str(len(channel)),
        str(channel.missing),
        f"{channel.span[0]:.6g}",
        f"{channel.span[1]:.6g}",
        "uneven" if rate is None else f"{rate:.6g}",
        channel.hold,
        channel.origin,
    )


def as_html(experiment: Experiment) -> str:
    """The text of :func:`text` for a notebook."""
    return f"<pre>{html.escape(text(experiment))}</pre>"
