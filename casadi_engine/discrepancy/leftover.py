"""Tests for what no effect of the library names: whiteness, sensors that move together, lines in the spectrum, unknown
functions of a signal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from casadi_engine.discrepancy.common_noise import common_tests
from casadi_engine.discrepancy.compression import compress, scatter_columns
from casadi_engine.discrepancy.driven_lines import driven_by
from casadi_engine.discrepancy.linear_algebra import Array, without
from casadi_engine.discrepancy.noise_choice import innovation_p, white_p
from casadi_engine.discrepancy.noise_model import left_over
from casadi_engine.discrepancy.null_distribution import NullDistribution, Row
from casadi_engine.discrepancy.random_families import (
    Course,
    Family,
    family_candidates,
    family_columns,
    family_course,
    family_row,
)
from casadi_engine.discrepancy.rounding import beyond_rounding
from casadi_engine.discrepancy.score import Scores, score
from casadi_engine.discrepancy.spectral_line import strongest_line

if TYPE_CHECKING:
    from casadi_engine.discrepancy.screening import Screened

# Share by which steps may differ and still be called equal.
_EQUAL = 1e-3


@dataclass(frozen=True, eq=False)
class Leftover:
    """Tests for what no effect of the library names.

    tests : name -> p-value of a residual test ("record/output/whiteness", "record/output/line at ...") or of a family
    of functions; level : a p-value below it is an alarm; family, course : the family of the smallest p-value and its
    function; lines : test of a line -> what a sine of that frequency takes off chi-squared; drop : what the family does
    driven : test of a line that is rejected -> the inputs that have it too
    """

    tests: Mapping[str, float]
    level: float
    family: Family | None = None
    family_p: float | None = None
    course: Course | None = None
    lines: Mapping[str, float] | None = None
    drop: float = 0.0
    driven: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def alarms(self) -> dict[str, float]:
        """The tests that are rejected, the surest first."""
        return dict(
            sorted(((n, p) for n, p in self.tests.items() if p < self.level), key=lambda pair: pair[1])
        )

    @property
    def line(self) -> str | None:
        """The line that is rejected and explains most; None without one, where the family explains more, or where the
        inputs have it too: it is what answers to them."""
        best = self._clearest
        return None if best in self.driven else best

    @property
    def driven_line(self) -> str | None:
        """The line that would be ``line``, if the inputs had it not."""
        best = self._clearest
        return best if best in self.driven else None

    @property
    def _clearest(self) -> str | None:
        found = {name: drop for name, drop in (self.lines or {}).items() if name in self.alarms}
        best = max(found, key=lambda name: found[name], default=None)
        return best if best is not None and found[best] > self.drop else None


def leftover(screened: Screened) -> Leftover:
    """Half of the remaining false-alarm rate each for the residuals and for families.

    Where the noise is coloured its innovations are to be white, but for a residual that is larger than the noise that
    was stated: that is no noise. A line is none in noise of any colour.
    """
    rest = screened.alpha - screened.share
    null, choice = screened.null, screened.choice
    tests, lines, driven = _residual_tests(screened)
    found, families = family_candidates(null)
    scores = None
    if found:
        columns = family_columns(null, found)
        scores = score(compress(null, found, choice.noise, scatter=choice.scatter, columns=columns))
    rows: list[tuple[Row, Family]] = []
    for family in families if scores is not None else ():
        row = family_row(scores, family)  # type: ignore[arg-type]
        if row is not None:
            rows.append((row, family))
    level = 0.5 * rest / max(len(tests), 1)
    if not rows or scores is None:
        return Leftover(tests, level, lines=lines, driven=driven)
    law = NullDistribution([row for row, _ in rows], seed=screened.seed)
    p_values = {row.name: float(row.p_value(scores.y[:, None])[0]) for row, _ in rows}
    best, family = min(rows, key=lambda pair: p_values[pair[0].name])
    pooled = law.pooled(p_values[best.name])
    # on the scale of the residual tests
    tests[family.name] = pooled * level / (0.5 * rest)
    course, drop = family_course(scores, family), _explained(scores, best)
    return Leftover(tests, level, family, pooled, course, lines, drop, driven)


def _explained(scores: Scores, row: Row) -> float:
    """What the group of a family takes off chi-squared."""
    return float(((row.frame.T @ scores.y) ** 2).sum())


def _residual_tests(
    screened: Screened,
) -> tuple[dict[str, float], dict[str, float], dict[str, tuple[str, ...]]]:
    """Test -> p-value, of whiteness, of outputs that move together and of lines; line -> what it explains; line -> the
    inputs that have it too."""
    null, choice = screened.null, screened.choice
    tests: dict[str, float] = {}
    lines: dict[str, float] = {}
    driven: dict[str, tuple[str, ...]] = {}
    slopes = {record.name: dict(record.slopes) for record in null.records}
    random = {r.name: scatter_columns(r, choice.scatter) for r in null.records} if choice.scatter else None
    left = left_over(null, choice.noise, slopes, random)
    for record in null.records:
        for output in record.outputs:
            held = record.slopes[output]
            if random is not None:
                held = np.concatenate([held, random[record.name][output]], axis=1)
            e = left[record.name][output]
            larger = (record.name, output) in choice.larger

            def white(e, record=record, output=output, held=held, larger=larger):  # type: ignore[no-untyped-def]
                if larger:
                    return white_p(record, output, e, held)
                return innovation_p(record, output, e, held, choice.noise)

            def line(e, record=record, output=output):  # type: ignore[no-untyped-def]
                found = _line(record, output, e)
                return None if found is None else found.p

            def known(p, test, record=record, output=output):  # type: ignore[no-untyped-def]
                # one that is no alarm is left as it is
                alarm = p < screened.alpha - screened.share
                return beyond_rounding(record, output, test, screened.seed)(p) if alarm else p

            p = white(e)
            if p is not None:
                tests[f"{record.name}/{output}/whiteness"] = known(p, white)
            found = _line(record, output, e)
            if found is not None:
                tests[found.name] = known(found.p, line)
                lines[found.name] = found.power / choice.noise.sigma[output] ** 2
                if found.p < screened.alpha - screened.share and (own := _inputs_at(record, output, found)):
                    driven[found.name] = own
    if not choice.scatter and not choice.rounded:
        tests |= dict(common_tests(null.records, left))
    return tests, lines, driven


@dataclass(frozen=True)
class _Found:
    """The test for a line in the spectrum of a residual, its p-value, and the squares that a sine there explains;
    frequency : in cycles per sample, which are ``gap`` s apart."""

    name: str
    p: float
    power: float
    frequency: float
    gap: float


def _line(record: Any, output: str, e: Array) -> _Found | None:
    """The clearest line in a residual; None where there is no test."""
    length, index = record.length[output], record.index[output]
    full, valid = np.zeros(length), np.zeros(length, dtype=bool)
    full[index], valid[index] = e, True
    time = record.time[output]
    gap = np.diff(time) / np.diff(index)
    found = strongest_line(full, valid) if len(time) > 1 and np.ptp(gap) < _EQUAL * gap.mean() else None
    if found is None:
        return None
    turns = 2 * math.pi * found.frequency * index
    sine = np.linalg.qr(np.column_stack([np.cos(turns), np.sin(turns)]))[0]
    left = without(sine, e[:, None])[:, 0]
    # no finer than one over the record's length
    digits = max(0, math.ceil(math.log10(time[-1] - time[0])))
    name = f"{record.name}/{output}/line at {found.frequency / gap.mean():.{digits}f} Hz"
    return _Found(name, found.p, float(e @ e - left @ left), found.frequency, float(gap.mean()))


def _inputs_at(record: Any, output: str, found: _Found) -> tuple[str, ...]:
    """The inputs that have a line of a residual too, over the time in which its output was measured."""
    grid, time = record.path.grid, record.time[output]
    own = np.arange(time[0], time[-1] + 0.5 * found.gap, found.gap)
    rows = zip(
        record.path.model.inputs, grid.rows, strict=False
    )  # behind the inputs there may be their rates
    return driven_by(found.frequency, {v.name: np.interp(own, grid.time, row) for v, row in rows})
