"""Colours and dashes of sketches as those of a page, which has them for light, dark and paper."""

from __future__ import annotations

import re

import numpy as np

# Colours of sketches that a page sets itself, so that they fit light and dark.
NAMED = {
    "#0072B2": "simulated", "#D55E00": "predicted", "0.45": "measured", "0.88": "band", "black": "ink", "0.3": "ink",
}  # fmt: skip
CYCLE = (
    "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf",
)  # fmt: skip
DASHES = {"--": (6, 4), ":": (1.5, 3)}
_COLD, _MIDDLE, _WARM = np.array([33, 102, 172]), np.array([247, 247, 247]), np.array([178, 24, 43])


def paint(colour: str) -> str:
    """The name of a colour of the page, or the colour itself.

    >>> paint("0.45"), paint("0.7"), paint("#56B4E9"), paint("C1")
    ('measured', 'pale', '#56B4E9', '#ff7f0e')
    """
    if colour in NAMED:
        return NAMED[colour]
    if re.fullmatch(r"C\d", colour):
        return CYCLE[int(colour[1])]
    return colour if colour.startswith("#") else "pale"


def css(colour: str) -> str:
    """A colour as a value of CSS."""
    name = paint(colour)
    return name if name.startswith("#") else f"var(--{name})"


def shade(value: float) -> str:
    """Blue for -1, nearly white for 0, red for 1, grey for no number."""
    if not np.isfinite(value):
        return "var(--band)"
    end = _WARM if value > 0 else _COLD
    mixed = np.rint(_MIDDLE + min(abs(value), 1.0) ** 0.8 * (end - _MIDDLE)).astype(int)
    return "rgb({} {} {})".format(*mixed.tolist())
