"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
FromOption = Annotated[
    float | None, typer.Option("--from", metavar="S", help="Leave out what is before this time, in s.")
]
ToOption = Annotated[
    float | None, typer.Option("--to", metavar="S", help="Leave out this time, in s, and what is after it.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else on stdout.")]
ReportOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.html", help="Write a page with plots; for several, one per recording."),
]
TraceOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE.parquet", help="Write the course over time; for several, one each."),
]
