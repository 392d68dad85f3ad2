"""Where the signals stand in a recording, and where a text file's table begins."""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from servoscope.core.settings import NonEmptyStr, Settings

ROW_TIME = re.compile(r"\s*row\s*/\s*(\d+\.?\d*(?:[eE][-+]?\d+)?)\s*")  # number of the row over the rate [Hz]


def _check_zone(value: str) -> str:
    from zoneinfo import ZoneInfo

    try:
        ZoneInfo(value)
    except (KeyError, ValueError, OSError):
        raise ValueError(f"{value!r} is no zone of the IANA list, give one as Europe/Berlin") from None
    return value


TimeZone = Annotated[NonEmptyStr, AfterValidator(_check_zone)]  # its name, as Europe/Berlin


class TextLayout(Settings):
    """What cannot be found in a text file by itself: where its table begins."""

    header_row: Annotated[int, Field(strict=True, ge=1)] | None = None  # line with the names of the columns, from 1
    skip_rows: Annotated[int, Field(strict=True, ge=0)] = 0  # lines at the beginning that are not looked at
    comment: NonEmptyStr | None = None  # what lines that hold no row begin with, in the place of #, % and //


class Columns(Settings):
    """Where the signals stand in a recording."""

    # column of the time stamps; None when there is none and the samples are uniform at the loop's rate; "row / 200" at
    # 200 Hz
    time: NonEmptyStr | None = "t"
    # reference, input, output: columns of r, u, y, or linear combinations of columns, for example ``"set_point -
    # position_error"``; where the command is u itself, the reference may be left out
    reference: NonEmptyStr = "r"
    input: NonEmptyStr = "u"
    # of the output, several of the same quantity may be listed: y is their mean, and they are compared with each other
    output: NonEmptyStr | Annotated[tuple[NonEmptyStr, ...], Field(min_length=2)] = "y"
    # columns of what the healthy coefficients depend on, by its name, as ``oil_temperature = "T_oil"``
    covariates: dict[NonEmptyStr, NonEmptyStr] = Field(default_factory=dict)
    time_unit: Literal["s", "ms", "us", "ns", "min"] = "s"  # unit of a numeric time column
    segment: tuple[NonEmptyStr, ...] = ()  # columns whose change starts a new run; a time reset does too
    resample: bool = False  # whether rows are put on the loop's sample rate, where logs come irregularly or at another
    # zone of dates and times that are written in local time, as Europe/Berlin; None: they count as they are written
    time_zone: TimeZone | None = None
    text: TextLayout | None = None  # of text files whose table is not found by itself

    @field_validator("output")
    @classmethod
    def _different_sensors(cls, value: str | tuple[str, ...]) -> str | tuple[str, ...]:
        if not isinstance(value, str) and len(set(value)) < len(value):
            raise ValueError("names a channel twice, remove one")
        return value

    @field_validator("time")
    @classmethod
    def _rate_above_zero(cls, value: str | None) -> str | None:
        if value is not None and (match := ROW_TIME.fullmatch(value)) and not float(match[1]) > 0.0:
            raise ValueError(f"{value!r}: give a rate above 0 Hz, as in row/200")
        return value

    @property
    def row_rate(self) -> float | None:
        """Rate [Hz] of the rows of a file without a time column, as ``time = "row / 200"`` says; else None."""
        match = ROW_TIME.fullmatch(self.time or "")
        return float(match[1]) if match is not None else None

    @model_validator(mode="after")
    def _two_signals(self) -> Self:
        """Refuse one column as u and y: a torque that moves y is not y."""
        u, *ys = (text.rpartition("* ")[2].strip("`") for text in (self.input, *self.outputs))
        if u in ys:
            raise ValueError(f"input and output are one column, {u!r}: name the column of y, which the input moves")
        return self

    @property
    def outputs(self) -> tuple[str, ...]:
        """The channels whose mean is y, as a rule one."""
        return (self.output,) if isinstance(self.output, str) else self.output
