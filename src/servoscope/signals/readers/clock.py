"""Dates and times of day as text: ISO, German, American and MATLAB's, and durations."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import date, datetime, timedelta
from functools import cache

import numpy as np

from servoscope.core.arrays import FloatArray

DAY_S = 86400.0
EPOCH = date(1970, 1, 1).toordinal()
QUARTER_S = 900.0  # clocks are put forward and back at full quarters of an hour
MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
MOMENT = re.compile(
    r"(?P<date>\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?\.\d\d?\.\d{2,4}|\d\d?/\d\d?/\d{2,4}|\d\d?-[A-Za-z]{3}-\d{4})?"
    r"(?:^|(?<=\d)$|[T ]+|,\s*)"
    r"(?:(?P<h>\d\d?):(?P<m>\d\d)(?::(?P<s>\d\d(?:[.,:;]\d{1,9})?))?\s*(?P<half>[AaPp][Mm])?"
    r"\s*(?P<zone>Z|UTC|[+-]\d\d:?\d\d)?)?"
)
ZONED = re.compile(r":\d\d\S*(?:Z|UTC|[+-]\d\d:?\d\d)\s*$")
DURATION = re.compile(r"([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)\s*(sec|s|ms|min|hr|h)")
DURATIONS = {"sec": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "hr": 3600.0, "h": 3600.0}


def is_clock(text: str) -> bool:
    """Tell whether a text is a date, a time of day, both, or a duration with its unit."""
    return parse_moment(text) is not None


def parse_moment(text: str) -> tuple[int | None, float] | None:
    """Return day, None where the text has no date, and seconds in it; None if it is no moment.

    A local time counts as it is written: where clocks are put back, time starts again. A date of three numbers with
    slashes is month, day, year, unless the first is more than 12.
    """
    text = text.strip()
    match = MOMENT.fullmatch(text) if text[:1].isdigit() else None
    if match is None or (match["date"] is None and match["h"] is None):
        duration = DURATION.fullmatch(text)
        return (None, float(duration[1]) * DURATIONS[duration[2]]) if duration else None
    day = _day_number(match["date"]) if match["date"] else None
    if (match["date"] and day is None) or int(match["h"] or 0) > 24 or int(match["m"] or 0) > 59:
        return None
    seconds = 3600.0 * int(match["h"] or 0) + 60.0 * int(match["m"] or 0)
    if match["s"]:
        whole, fraction = match["s"][:2], match["s"][3:]
        seconds += int(whole) + (int(fraction) / 10 ** len(fraction) if fraction else 0.0)
    if match["half"]:
        seconds += {"am": 0.0, "pm": 43200.0}[match["half"].lower()] - 43200.0 * (int(match["h"]) == 12)
    zone = match["zone"]
    if zone and zone[0] in "+-":
        minutes = 60 * int(zone[1:3]) + int(zone[-2:])
        seconds -= 60.0 * minutes * (1 if zone[0] == "+" else -1)
    return day, seconds


@cache
def _day_number(text: str) -> int | None:
    """Return the number of a day, None if there is no such day."""
    parts = re.split(r"[-/.]", text)
    try:
        if len(parts[0]) == 4:
            year, month, day = map(int, parts)
        elif parts[1].isalpha():
            day, month, year = int(parts[0]), MONTHS.index(parts[1].lower()) + 1, int(parts[2])
        else:
            day, month, year = map(int, parts)
            if "/" in text and day <= 12:
                day, month = month, day
        return date(year + 2000 * (year < 100), month, day).toordinal()
    except ValueError:
        return None


class ZoneOffset:
    """How far the clocks of a zone are ahead of UTC, piece by piece; `zone`: its IANA name.

    In the hour that comes twice when clocks are put back, rows after the step back belong to the second one.
    """

    def __init__(self, zone: str) -> None:
        from zoneinfo import ZoneInfo

        self._zone = ZoneInfo(zone)
        self._last, self._again = -math.inf, -math.inf  # last row; until when the hour is its second [s]

    def offsets(self, local: FloatArray) -> FloatArray:
        """Return the offset [s], shape (N,), at local times [s since 1970 as written], shape (N,), NaN at NaN."""
        offsets = np.full(local.size, np.nan)
        known = np.flatnonzero(np.isfinite(local))
        if not known.size:
            return offsets
        times = local[known]
        steps, quarters = np.diff(times, prepend=self._last), np.floor(times / QUARTER_S)
        distinct, where = np.unique(quarters, return_inverse=True)
        first, second = np.array([self._both(quarter * QUARTER_S) for quarter in distinct.tolist()]).T
        again = np.where(steps < -QUARTER_S, times + 3.0 * 3600.0, -np.inf)  # clocks go back by less than three hours
        again = np.maximum.accumulate(np.append(self._again, again))[1:]
        offsets[known] = np.where(times < again, second[where], first[where])
        self._last, self._again = float(times[-1]), float(again[-1])
        return offsets

    def _both(self, local: float) -> tuple[float, float]:
        """Return the offsets [s] of a local time that comes once or twice."""
        moment = datetime(1970, 1, 1) + timedelta(seconds=local)
        both = (moment.replace(tzinfo=self._zone, fold=fold).utcoffset() for fold in (0, 1))
        first, second = (offset.total_seconds() if offset is not None else 0.0 for offset in both)
        return first, second if second < first else first  # an hour that is skipped has no second one


class ClockParser:
    """Turns dates and times of day into seconds, chunk by chunk; without dates, midnight starts a new day."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._last, self._days = -np.inf, 0

    @property
    def midnight(self) -> float | None:
        """The first midnight [s since 1970 as written]; None where the texts have no dates."""
        return None if self._first is None else DAY_S * (self._first - EPOCH)

    def seconds(self, cells: Sequence[str | None]) -> FloatArray | int:
        """Return seconds since the first midnight, NaN for empty cells, shape (N,); else the index of a misfit."""
        elapsed = np.full(len(cells), np.nan)
        for index, cell in enumerate(cells):
            if cell is None or not cell.strip():
                continue
            moment = parse_moment(cell)
            if moment is None:
                return index
            day, seconds = moment
            if day is None:
                if seconds < self._last - DAY_S / 2:
                    self._days += 1
                self._last = seconds
                elapsed[index] = seconds + DAY_S * self._days
            else:
                self._first = day if self._first is None else self._first
                elapsed[index] = seconds + DAY_S * (day - self._first)
        return elapsed
