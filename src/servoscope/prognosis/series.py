"""The size of a change over time, with what is known of each value: the input of a prognosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import PrognosisError
from servoscope.core.settings_errors import suggest_name

NORMAL_95 = 1.959963984540054  # half the width of a 95 % interval, in standard deviations


@dataclass(frozen=True)
class SizeSeries:
    """A size or coefficient over time.

    Parameters
    ----------
    name
        What it is the size of.
    t : (N,)
        Times [UTC s], increasing.
    value, std : (N,)
        Value, and its standard deviation; 0 where nothing is known of that.
    covariates
        By name, shape (N,): what moves the value without wear, such as a temperature.
    """

    name: str
    t: FloatArray
    value: FloatArray
    std: FloatArray
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)

    @classmethod
    def from_arrays(
        cls,
        name: str,
        t: Sequence[float] | FloatArray,
        value: Sequence[float] | FloatArray,
        std: Sequence[float] | FloatArray | None = None,
        covariates: Mapping[str, Sequence[float] | FloatArray] | None = None,
    ) -> SizeSeries:
        """Return a series in the order of time, without rows in which something is unknown.

        Raises PrognosisError if the arrays differ in length or nothing is left of them.
        """
        columns = [np.asarray(column, dtype=float) for column in (t, value)]
        columns.append(np.zeros_like(columns[0]) if std is None else np.asarray(std, dtype=float))
        columns += [np.asarray(column, dtype=float) for column in (covariates or {}).values()]
        lengths = sorted({column.size for column in columns})
        if len(lengths) > 1:
            raise PrognosisError(f"{name}: its columns have different lengths, {lengths[0]} and {lengths[-1]}")
        table = np.stack(columns)
        table = table[:, np.isfinite(table).all(axis=0)]
        table = table[:, np.argsort(table[0], kind="stable")]
        if not table.shape[1]:
            raise PrognosisError(f"{name}: has no row in which all values are numbers")
        t_sorted, values, stds, *others = table
        return cls(name, t_sorted, values, stds, dict(zip(covariates or {}, others, strict=True)))

    def after(self, t: float) -> SizeSeries:
        """Return what was measured from `t` [UTC s] on: after a repair."""
        keep = self.t >= t
        if not keep.any():
            raise PrognosisError(f"{self.name}: has no value from that date on, its last one is earlier")
        covariates = {name: covariate[keep] for name, covariate in self.covariates.items()}
        return replace(self, t=self.t[keep], value=self.value[keep], std=self.std[keep], covariates=covariates)

    def thinned(self, points: int) -> SizeSeries:
        """Return at most `points` values: means over equal spans of time, each with the weight of its certainty."""
        if self.t.size <= points:
            return self
        span = self.t[-1] - self.t[0]
        part = np.minimum(((self.t - self.t[0]) / span * points).astype(np.int64), points - 1)
        _, part = np.unique(part, return_inverse=True)
        certain = self.std > 0.0
        # values of unknown certainty count alike
        weight = 1.0 / np.square(self.std) if certain.all() else np.ones_like(self.value)
        total = np.bincount(part, weight)

        def mean(column: FloatArray) -> FloatArray:
            return np.bincount(part, weight * column) / total

        std = np.sqrt(1.0 / total) if certain.all() else np.zeros(total.size)
        covariates = {name: mean(covariate) for name, covariate in self.covariates.items()}
        return SizeSeries(self.name, mean(self.t), mean(self.value), std, covariates)


def read_sizes(
    path: str | Path,
    value: str,
    *,
    time: str = "time",
    std: str | None = None,
    interval: tuple[str, str] | None = None,
    covariates: Sequence[str] = (),
    after: float | None = None,
) -> SizeSeries:
    """Read a series from a CSV file with a header row.

    `time`: dates (ISO 8601, UTC where they name no zone) or seconds; `std`: its standard deviation; `interval`: the two
    ends of its 95 % interval instead; `after`: [UTC s] what is before it is left out.

    Raises
    ------
    PrognosisError
        If the file cannot be read, lacks a column, or a row's date or number is none; it names file, row and column.
    """
    import csv

    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            lines = csv.reader(file)
            (_, head), *rows = [(lines.line_num, row) for row in lines if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise PrognosisError(f"{path}: cannot be read: {error}") from None
    except ValueError:
        raise PrognosisError(f"{path}: is empty, a header row and values are needed") from None
    wanted = [time, value, *([std] if std else interval or ()), *covariates]
    for name in wanted:
        if name not in head:
            raise PrognosisError(f"{path}: has no column {name!r}, {suggest_name(name, head)}")
    columns = []
    for name in wanted:
        k, parse = head.index(name), _seconds if name == time else _number
        numbers: list[float] = []
        for line, row in rows:
            text = row[k] if k < len(row) else ""
            try:
                numbers.append(parse(text))
            except ValueError:
                raise PrognosisError(f"{path}: row {line}, column {name}: {text!r} cannot be read") from None
        columns.append(np.array(numbers))
    t, values, *others = columns
    spread = None
    if std:
        spread = others.pop(0)
    elif interval:
        spread = (others.pop(1) - others.pop(0)) / (2.0 * NORMAL_95)
    series = SizeSeries.from_arrays(value, t, values, spread, dict(zip(covariates, others, strict=True)))
    return series if after is None else series.after(after)


def _number(text: str) -> float:
    return float(text) if text.strip() else float("nan")


def _seconds(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return parse_date(text.strip())


def parse_date(text: str) -> float:
    """Return a date and time of ISO 8601 as UTC seconds; UTC where it names no zone. Raises ValueError."""
    from datetime import UTC

    date = datetime.fromisoformat(text)
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
