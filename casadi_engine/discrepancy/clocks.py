"""Times as a model tells them: in the unit of its time, however long in seconds all else runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from casadi_engine.discrepancy.linear_algebra import Array
from casadi_engine.estimation.fit import Estimate
from casadi_engine.model.declared_units import seconds_in

if TYPE_CHECKING:
    from casadi_engine.model import Model

Times = TypeVar("Times", float, Array)
# Seconds beyond which hours are said too; share of a unit below which a duration stays in seconds.
_LONG, _SHORT = 1e4, 0.1
_HOUR = 3600.0
# Seconds of the period of a line beyond which it is slow.
_SLOW = 10.0


@dataclass(frozen=True)
class Clock:
    """A unit of time.

    >>> Clock("min").span(60.0, 90.0), Clock().span(2.0, 2.0), Clock().span(72_000.0, 144_000.0)
    ('from 1 to 1.5 min', 'at 2 s', 'from 72000 to 144000 s (20 to 40 h)')
    """

    unit: str = "s"

    @property
    def axis(self) -> str:
        """Words of an axis: ``time [h]``."""
        return f"time [{self.unit}]"

    def of(self, seconds: Times) -> Times:
        """Times in s, a number or an array of them, in this unit."""
        return seconds / seconds_in(self.unit)

    def span(self, first: float, last: float) -> str:
        """``from 16 to 20.9 h``, or ``at 16 h``: a part of a record that is given in s."""

        def words(low: float, high: float, lead: str = "from ") -> str:
            return (
                f"{lead}{_plain(low)} to {_plain(high)}" if low < high else f"{lead and 'at '}{_plain(low)}"
            )

        said = f"{words(self.of(first), self.of(last))} {self.unit}"
        if self.unit == "s" and last >= _LONG:
            said += f" ({words(first / _HOUR, last / _HOUR, '')} h)"
        return said

    def instant(self, seconds: float) -> str:
        """``47.3 h``.

        >>> Clock("h").instant(170_280.0), Clock().instant(170_280.0), Clock().instant(17.134)
        ('47.3 h', '170280 s (47.3 h)', '17.13 s')
        """
        return self.span(seconds, seconds).removeprefix("at ")

    def period(self, hertz: float) -> str:
        """How long a slow line takes, in this unit: a frequency in Hz says little of it; "" of a fast one.

        >>> Clock("h").period(3.5e-5), Clock().period(0.05), Clock().period(12.0)
        (', once in about 7.9 h', ', once in about 20 s', '')
        """
        return "" if hertz * _SLOW > 1 else f", once in about {self.about(1 / hertz)}"

    def about(self, seconds: float) -> str:
        """A time of which a record that is some periods long tells two digits.

        >>> Clock("h").about(86_234.0), Clock().about(86_234.0), Clock().about(0.0123)
        ('24 h', '86000 s (23.89 h)', '0.012 s')
        """
        return self.instant(seconds_in(self.unit) * float(f"{self.of(seconds):.2g}"))

    def told(self, one: Estimate, *, always: bool = True) -> tuple[Estimate, str]:
        """An estimate in s in this unit, and what more to say of it: long times in s are said in hours too.

        always : False to leave a duration in s that is short beside the unit. Estimates in other units stay.
        """
        if one.unit != "s" or (not always and abs(one.value) < _SHORT * seconds_in(self.unit)):
            return one, ""
        if self.unit == "s":
            return one, f" ({_plain(one.value / _HOUR)} h)" if abs(one.value) >= _LONG else ""
        scale = seconds_in(self.unit)
        return replace(
            one,
            value=one.value / scale,
            stderr=None if one.stderr is None else one.stderr / scale,
            interval=None if one.interval is None else (one.interval[0] / scale, one.interval[1] / scale),
            unit=self.unit,
        ), ""


SECONDS = Clock()


def clock_of(model: Model) -> Clock:
    """The unit in which a model's times are told."""
    return Clock(model.time_unit)


def _plain(value: float) -> str:
    """Four digits, and all of a larger number, without a power of ten.

    >>> _plain(311_400.0), _plain(17.1342), _plain(0.0), _plain(2e-5)
    ('311400', '17.13', '0', '2e-05')
    """
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"
