"""Arguments and options that several commands share, and how recordings are read, as one parameter of a command."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

LoopArgument = Annotated[Path, typer.Argument(metavar="LOOP", help="Loop file (TOML).")]
ColumnsOption = Annotated[
    str | None,
    typer.Option("--columns", metavar="MAP", help="Where signals stand: 't=Time, r=Ref, u=2*Amps, y=Pos'."),
]
WhereOption = Annotated[
    list[str] | None,
    typer.Option(metavar="COND", help="Rows to take, 'load=20,run=1-5': values, lists, ranges."),
]
ByOption = Annotated[str | None, typer.Option(metavar="COLUMN", help="One recording per value of this column.")]
HeaderRowOption = Annotated[
    int | None, typer.Option(min=1, metavar="LINE", help="Text files: the line with the names of the columns.")
]
SkipOption = Annotated[
    int, typer.Option("--skip", min=0, metavar="LINES", help="Text files: leave out lines at the top.")
]
CommentOption = Annotated[
    str | None, typer.Option(metavar="TEXT", help="Text files: what lines that hold no row begin with.")
]
RateOption = Annotated[
    float | None, typer.Option(metavar="HZ", help="Of a file without a time column: the rate at which its rows came.")
]
FromOption = Annotated[
    float | None, typer.Option("--from", metavar="S", help="Leave out what is before this time, in s.")
]
ToOption = Annotated[
    float | None, typer.Option("--to", metavar="S", help="Leave out this time, in s, and what is after it.")
]
ResampleOption = Annotated[
    bool,
    typer.Option(
        "--resample", help="Put irregular rows, or those of another rate, on the loop's sample rate; the error is told."
    ),
]
AxisOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="Of a file with several axes: the one to take, 2 or X for example.")
]
UserOption = Annotated[str | None, typer.Option(metavar="NAME", help="Who asks; default: the user of this terminal.")]
ReasonOption = Annotated[str, typer.Option(metavar="TEXT", help="Why; kept in the history.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else on stdout.")]
ReportOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.html", help="Write a page with plots, or print it (.pdf); for several, one each."),
]
TraceOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.parquet", help="Write the course over time; for several, one each."),
]


@dataclass(frozen=True)
class ReadingOptions:
    """How a command reads its recordings: which columns, rows and lines, as its options say."""

    columns: ColumnsOption = None
    axis: AxisOption = None
    where: WhereOption = None
    by: ByOption = None
    header_row: HeaderRowOption = None
    skip: SkipOption = 0
    comment: CommentOption = None
    rate: RateOption = None
    resample: ResampleOption = False
    from_s: FromOption = None
    to_s: ToOption = None

    def given(self) -> dict[str, object]:
        """Return the options by what they are called on the command line."""
        return {f"--{name.removesuffix('_s').replace('_', '-')}": value for name, value in vars(self).items()}


def with_reading_options(*left_out: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of `ReadingOptions`, in the place of its parameter ``reading``, but for some."""
    return with_options("reading", ReadingOptions, *left_out)


def with_options(place: str, group: type[Any], *left_out: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of a group, a dataclass, in the place of a parameter, but for some."""
    hints = get_type_hints(group, include_extras=True)
    given = [field for field in fields(group) if field.name not in left_out]
    options = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
        )
        for field in given
    ]

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = get_type_hints(command, include_extras=True)
        parameters: list[inspect.Parameter] = []
        for name, parameter in inspect.signature(command).parameters.items():
            keyword = parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=own[name])
            parameters += options if name == place else [keyword]

        @functools.wraps(command)
        def run(**values: Any) -> None:
            command(**{place: group(**{field.name: values.pop(field.name) for field in given})}, **values)

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorate
