"""The command that assesses logs without a baseline."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.exit import FailureCounter, print_json
from servoscope.cli.options import JsonOption, ReadingOptions, ReportOption, with_reading_options
from servoscope.cli.output_paths import REPORTS, OutputPaths, check_output
from servoscope.cli.progress import StepProgress, show_steps

if TYPE_CHECKING:
    from servoscope.assessment.assess import Assessment, Kind
    from servoscope.core.workers import Progress
    from servoscope.models.loop import Columns
    from servoscope.signals.samples import Samples

MIN_FILES_PER_START = 16  # for which it pays to start processes


@app.command()
@with_reading_options("axis", "resample")
def assess(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Logs, folders, or exports with many tags.")],
    kind: Annotated[
        Literal["valve", "cylinder", "axis"] | None,
        typer.Option(help="Kind of machine, for the advice; without it, by names of columns and sample rate."),
    ] = None,
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
    report: ReportOption = None,
    work_list: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE.csv", help="Write a work list, the worst loop first.")
    ] = None,
) -> None:
    """Measure what one log of a loop shows, without a baseline; rank the loops of a folder."""
    logs = arguments.expand_files(logs)
    check_output(report, "--report", REPORTS, logs, folder=True)
    check_output(work_list, "--csv", (".csv",), logs)

    from servoscope.assessment.assess import assess as assess_log
    from servoscope.cli.render import assessment, results
    from servoscope.core.files import atomic_write
    from servoscope.report import assessment_page, loop_ranking
    from servoscope.report.plain_values import to_plain_values

    reader = arguments.RecordingReader.from_options(None, reading)
    pages = OutputPaths.from_option(report, ".html", len(logs) > 1 or reading.by is not None, logs)
    out, failures = results.create_console(), FailureCounter()
    judged: list[Assessment] = []
    with show_steps(len(logs), 2) as steps:
        if pages is None and len(logs) >= MIN_FILES_PER_START:
            for result in assess_files(logs, reader, kind, steps, failures):
                judged.append(result)
            logs = []
        for path in logs:
            steps.begin(path.name)
            with failures.catch():
                for name, samples, seen in read_loops(path, reader):
                    steps.advance("assessing")
                    result = assess_log(samples, name=name, kind=kind or seen)
                    judged.append(result)
                    if pages is not None:
                        with steps.pause():
                            pages.write(path, name, assessment_page.write_assessment_page, result, stderr=as_json)
    ranked = loop_ranking.rank(judged)
    if as_json:
        for result in ranked:
            print_json(to_plain_values(result), lines=len(ranked) > 1)
    elif len(ranked) == 1:
        assessment.print_assessment(out, ranked[0])
    elif ranked:
        assessment.print_ranking(out, ranked)
    if work_list is not None:
        table, text = assessment_page.ranking_table(ranked), io.StringIO()
        csv.writer(text).writerows([table.head, *table.rows])
        atomic_write(work_list, text.getvalue().encode())
        results.print_written_path(results.create_console(stderr=as_json), work_list)
    failures.exit_if_any()


def assess_files(
    logs: Sequence[Path],
    reader: arguments.RecordingReader,
    kind: Kind | None,
    steps: StepProgress,
    failures: FailureCounter,
) -> Iterator[Assessment]:
    """Yield the assessments of many files as they end, on all cores."""
    from servoscope.assessment.assess import Assessment
    from servoscope.core.workers import WorkerError, Workers

    tasks = ((path, reader, kind) for path in logs)
    for (path, *_), results in Workers().map(f"{__name__}:assess_file", tasks, os.cpu_count() or 1):
        steps.begin(path.name)
        with failures.catch():
            if isinstance(results, WorkerError):
                raise results
            yield from map(Assessment.model_validate, results)


def assess_file(_: Progress, task: tuple[Path, arguments.RecordingReader, Kind | None]) -> list[dict[str, Any]]:
    """Assess the loops of one file, in a process of its own."""
    from servoscope.assessment.assess import assess as assess_log

    path, reader, kind = task
    return [
        assess_log(samples, name=name, kind=kind or seen).model_dump(mode="json")
        for name, samples, seen in read_loops(path, reader)
    ]


def read_loops(path: Path, reader: arguments.RecordingReader) -> Iterator[tuple[str, Samples, Kind | None]]:
    """Yield the loops in a file, by the mapping or by the names of its columns; tags are those of valves."""
    from servoscope.signals.readers.frames import open_source
    from servoscope.signals.readers.tags import find_loops

    given = reader.columns
    loops = {"": given} if given is not None else find_loops(open_source(path, reader.text).columns)
    loops = {tag: columns.model_copy(update=reader.changes) for tag, columns in loops.items()}
    for name, tag, samples in read_tags(path, loops, reader):
        yield f"{name}[{tag}]" if len(loops) > 1 else name, samples, "valve" if tag else None


def read_tags(
    path: Path, loops: Mapping[str, Columns], reader: arguments.RecordingReader
) -> Iterator[tuple[str, str, Samples]]:
    """Yield name, tag and samples of loops that share a file; it is read once for all that have no modes."""
    from servoscope.signals.readers.recording_file import read_rows

    plain = {tag: columns for tag, columns in loops.items() if not columns.segment}
    for tag, columns in loops.items():
        if columns.segment or len(plain) == 1:
            for name, samples in read_rows(path, columns, reader.where, reader.by, reader.span).items():
                yield name, tag, samples
    if len(plain) > 1:
        signals = {
            x for columns in plain.values() for x in (columns.reference, columns.input, str(columns.output)) if x
        }
        some = next(iter(plain.values()))
        whole = some.model_copy(update={"covariates": {x: x for x in signals}})
        for name, samples in read_rows(path, whole, reader.where, reader.by, reader.span).items():
            channels = samples.channels
            for tag, columns in plain.items():
                u, y = channels[columns.input], channels[str(columns.output)]
                r = channels[columns.reference] if columns.reference else u
                yield name, tag, replace(samples, r=r, u=u, y=y, channels={})
