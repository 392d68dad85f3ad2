"""The commands about recordings, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.arguments import Source
from servoscope.cli.options import AsJson, By, ColumnsText, From, LoopFile, Report, To, Trace, Where
from servoscope.cli.outputs import REPORTS, TRACES, Outputs, check_output, stem_of
from servoscope.cli.shell import FAULT, Failures, print_json

if TYPE_CHECKING:
    from servoscope.recording import Recording


@app.command()
def inspect(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Recordings.")],
    loop: Annotated[Path | None, typer.Option(metavar="LOOP", help="Loop file: columns, sample rate, plant.")] = None,
    columns: ColumnsText = None,
    where: Where = None,
    by: By = None,
    from_s: From = None,
    to_s: To = None,
    as_json: AsJson = False,
    report: Report = None,
) -> None:
    """Say whether a log is usable, and if not, why; without a mapping, say which columns it has."""
    check_output(report, "--report", REPORTS, [*logs, *filter(None, [loop])], folder=True)

    from servoscope import inspection, summaries
    from servoscope.cli import terminal
    from servoscope.cli.progress import progress
    from servoscope.inspection import pages as inspection_figures
    from servoscope.loop import Loop

    settings = Loop.load(loop) if loop is not None else None
    source = Source.of(settings, columns, where, by, (from_s, to_s))
    many = source.many(logs)
    pages = Outputs.of(report, ".html", many, logs)
    out, failures = terminal.console(), Failures()
    with progress(len(logs), 2) as steps:
        for path in logs:
            steps.begin(path.name)
            with failures.noted():
                if unmapped := source.unmapped(path):
                    with steps.paused():
                        if as_json:
                            print_json(summaries.channels(path.name, unmapped), lines=many)
                        else:
                            terminal.channels(out, path.name, unmapped)
                    raise arguments.no_mapping(path)
                for recording in source.read(path):
                    steps.tell("inspecting")
                    said = inspection.inspect(recording, settings)
                    with steps.paused():
                        if as_json:
                            print_json(said.model_dump(mode="json"), lines=many)
                        else:
                            terminal.inspection(out, said)
                    if pages is not None:
                        with failures.noted():
                            target = pages.path(stem_of(path, recording.name))
                            inspection_figures.write(target, said, recording)
                            terminal.written(terminal.console(stderr=as_json), target)
    failures.leave()


@app.command()
def learn(
    loop: LoopFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="BASELINE", help="Baseline to write (JSON).")],
    healthy: Annotated[
        list[str] | None,
        typer.Argument(metavar="[POINT=]HEALTHY", help="Healthy recordings, at operating points.", show_default=False),
    ] = None,
    nominal: Annotated[bool, typer.Option("--nominal", help="From the plant's nominal parameters instead.")] = False,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="BASELINE", help="Refuse recordings that are a fault to this earlier baseline."),
    ] = None,
    accept_change: Annotated[
        bool, typer.Option("--accept-change", help="Learn them all the same, and note the change.")
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=FILE", help="Recording of a known fault to learn too, NAME@POINT=FILE; repeatable."),
    ] = None,
    columns: ColumnsText = None,
    where: Where = None,
    by: By = None,
    from_s: From = None,
    to_s: To = None,
    as_json: AsJson = False,
) -> None:
    """Learn from healthy recordings what healthy looks like, and from labelled ones what faults look like."""
    named = arguments.healthy(healthy or [])
    if nominal == bool(named):
        raise typer.BadParameter("give healthy recordings or --nominal, and not both")
    if (accept_change and compare is None) or (nominal and compare is not None):
        raise typer.BadParameter("--accept-change goes with --compare, and that with recordings")
    if nominal and fault:
        raise typer.BadParameter("--fault goes with healthy recordings, not with --nominal")
    faults = arguments.labelled(fault or [], list(dict.fromkeys(point for point, _ in named)))
    files = [path for _, path in named] + [path for *_, path in faults]
    check_output(output, "-o", (), [loop, *files, *filter(None, [compare])])

    from servoscope import learning, points, summaries
    from servoscope.baseline import Baseline
    from servoscope.cli import terminal
    from servoscope.cli.progress import progress
    from servoscope.loop import Loop

    settings = Loop.load(loop)
    source = Source.of(settings, columns, where, by, (from_s, to_s))
    if source.columns is not None:  # into the baseline with it: whoever diagnoses need not say it again
        settings = settings.model_copy(update={"columns": source.columns})
    earlier = Baseline.load(compare) if compare is not None else None
    failures = Failures()
    recordings: dict[str, list[Recording]] = {point: [] for point, _ in named}
    labels: dict[str, dict[str, list[Recording]]] = {point: {} for point in recordings}
    with progress(len(files) + 1, 6 * max(1, len(recordings))) as steps:
        for point, path in named:
            steps.begin(path.name)
            with failures.noted():
                recordings[point] += source.read(path)
        if failures.count and not any(recordings.values()):
            failures.leave()
        for point, name, path in faults:
            steps.begin(path.name)
            with failures.noted():
                labels[point][name] = labels[point].get(name, []) + source.read(path)
        steps.begin("learning")
        if nominal:
            found = learning.nominal(settings, steps.tell)
        else:
            chosen, known = recordings.get("", recordings), labels.get("", labels)
            found = points.learn(
                settings, chosen, steps.tell, compare=earlier, accept_change=accept_change, faults=known
            )
        found.save(output)
    if as_json:
        print_json({"baseline": str(output), **summaries.baseline(found)}, lines=False)
    else:
        terminal.baseline(terminal.console(), found)
        terminal.written(terminal.console(), output)
    failures.leave()


@app.command()
def diagnose(
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="What learn wrote.")],
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING", help="Recordings to judge.")],
    point: Annotated[
        str | None, typer.Option(metavar="NAME", help="Operating point that they were taken at; else any.")
    ] = None,
    columns: ColumnsText = None,
    where: Where = None,
    by: By = None,
    from_s: From = None,
    to_s: To = None,
    as_json: AsJson = False,
    report: Report = None,
    trace: Trace = None,
    fail_on_fault: Annotated[bool, typer.Option("--fail-on-fault", help="Exit with 3 if there is a fault.")] = False,
) -> None:
    """Say whether the actuator was healthy; if not, what changed, by how much, since when, and how sure."""
    inputs = [baseline, *recordings]
    check_output(report, "--report", REPORTS, inputs, folder=True)
    check_output(trace, "--trace", TRACES, inputs, folder=True)

    from servoscope import monitor, summaries, writers
    from servoscope.baseline import Baseline
    from servoscope.cli import terminal, verdicts
    from servoscope.cli.progress import progress

    healthy = Baseline.load(baseline)
    if point is not None:
        healthy = healthy.at(point)
    source = Source.of(healthy.loop, columns, where, by, (from_s, to_s))
    many = source.many(recordings)
    pages, traces = Outputs.of(report, ".html", many, inputs), Outputs.of(trace, ".parquet", many, inputs)
    out, failures, faulty = terminal.console(), Failures(), False
    with progress(len(recordings), 3 + len(healthy.loop.plant.faults) + len(healthy.learned)) as steps:
        for path in recordings:
            steps.begin(path.name)
            with failures.noted():
                for recording in source.read(path):
                    with failures.noted():
                        steps.tell("recursion")
                        if traces is None and pages is None:
                            said, course = monitor.diagnose(healthy, recording, steps.tell), None
                        else:
                            said, course = monitor.examine(healthy, recording, steps.tell)
                        faulty |= said.verdict == "fault"
                        with steps.paused():
                            if as_json:
                                print_json(summaries.plain(said), lines=many)
                            else:
                                verdicts.diagnosis(out, said)
                        stem = stem_of(path, recording.name)
                        if traces is not None and course is not None:
                            target = traces.path(stem)
                            writers.write_table(target, course.table())
                            terminal.written(terminal.console(stderr=as_json), target)
                        if pages is not None and course is not None:
                            from servoscope import report as reports

                            target = pages.path(stem)
                            judged = healthy.at(said.point) if said.point else healthy
                            origin = summaries.provenance(judged, baseline, path)
                            reports.write(target, said, course, recording, judged.loop, origin)
                            terminal.written(terminal.console(stderr=as_json), target)
    if fail_on_fault and faulty:
        raise typer.Exit(FAULT)
    failures.leave()
