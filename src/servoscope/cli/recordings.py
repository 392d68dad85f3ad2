"""The commands about recordings, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servoscope.cli import arguments, machines
from servoscope.cli.app import app
from servoscope.cli.arguments import RecordingReader
from servoscope.cli.baseline import AfterOption, add_recordings
from servoscope.cli.exit import EXIT_INPUT, FailureCounter, exit_after, print_json
from servoscope.cli.options import (
    JsonOption,
    ReadingOptions,
    ReasonOption,
    ReportOption,
    TraceOption,
    UserOption,
    with_reading_options,
)
from servoscope.cli.output_paths import REPORTS, TRACES, OutputPaths, check_output
from servoscope.cli.progress import StepProgress, show_steps
from servoscope.core.messages import say

if TYPE_CHECKING:
    from servoscope.baseline.baseline import Baseline
    from servoscope.core.verdict import VerdictKind
    from servoscope.signals import Recording


@app.command()
@with_reading_options()
def inspect(
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Recordings.")],
    loop: Annotated[Path | None, typer.Option(metavar="LOOP", help="Loop file: columns, sample rate, plant.")] = None,
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
    report: ReportOption = None,
) -> None:
    """Say whether a log is usable, and if not, why; without a mapping, say which columns it has."""
    logs = arguments.expand_files(logs)
    check_output(report, "--report", REPORTS, [*logs, *filter(None, [loop])], folder=True)

    from servoscope.cli.render import results
    from servoscope.learning import inspection
    from servoscope.models.loop import Loop
    from servoscope.report import inspection_page, plain_values

    settings = Loop.load(loop) if loop is not None else None
    reader = RecordingReader.from_options(settings, reading)
    several = reader.expects_several(logs)
    pages = OutputPaths.from_option(report, ".html", several, logs)
    out, failures = results.create_console(), FailureCounter()
    with show_steps(len(logs), 2) as steps:
        for path in logs:
            steps.begin(path.name)
            with failures.catch():
                if channels := reader.unmapped_channels(path):
                    with steps.pause():
                        if as_json:
                            print_json(plain_values.channels_summary(path.name, channels), lines=several)
                        else:
                            results.print_channels(out, path, channels, reading.rate)
                    continue
                for recording in reader.read(path):
                    steps.advance("inspecting")
                    result = inspection.inspect(recording, settings)
                    with steps.pause():
                        if as_json:
                            print_json(result.model_dump(mode="json"), lines=several)
                        else:
                            results.print_inspection(out, result)
                    if pages is not None:
                        with failures.catch():
                            pages.write(
                                path,
                                recording.name,
                                inspection_page.write_inspection_page,
                                result,
                                recording,
                                stderr=as_json,
                            )
    failures.exit_if_any()


@app.command()
@with_reading_options("axis")
def learn(
    loop: Annotated[
        Path | None,
        typer.Argument(metavar="LOOP", help="Loop file (TOML); with --add a recording.", show_default=False),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="BASELINE", help="Baseline to write (JSON).")
    ] = None,
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
    accept_delay: Annotated[
        bool, typer.Option("--accept-delay", help="Learn although u and y are out of step, and note it.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Learn although the coefficients are implausible, and note it.")
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=FILE", help="Recording of a known fault to learn too, NAME@POINT=FILE; repeatable."),
    ] = None,
    population: Annotated[
        list[Path] | None,
        typer.Option(metavar="BASELINE", help="Baseline of a like machine, folder or pattern of them; repeatable."),
    ] = None,
    add: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[POINT=]HEALTHY",
            help="Learn the baseline of -b anew with further recordings; keep the earlier one.",
        ),
    ] = None,
    baseline: Annotated[
        Path | None, typer.Option("-b", "--baseline", metavar="BASELINE", help="With --add: the baseline.")
    ] = None,
    after: AfterOption = None,
    why: ReasonOption = "",
    who: UserOption = None,
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
) -> None:
    """Learn from healthy recordings what healthy looks like, and from labelled ones what faults look like."""
    if add:
        others = output is not None or nominal or compare is not None or fault or population
        logs = [*add, *([str(loop)] if loop is not None else []), *(healthy or ())]
        path = None if others else baseline
        add_recordings(
            path, logs, reading, as_json, after, why, who, accept_change, accept_delay=accept_delay, force=force
        )
        return
    if loop is None or output is None:
        raise typer.BadParameter("give LOOP and -o BASELINE, or --add RECORDING and -b BASELINE")
    if baseline is not None or after is not None or why or who:
        raise typer.BadParameter("-b, --after, --why and --who go with --add")
    named = arguments.parse_healthy(healthy or [])
    if nominal == bool(named):
        raise typer.BadParameter("give healthy recordings or --nominal, and not both")
    if (accept_change and compare is None) or (nominal and compare is not None):
        raise typer.BadParameter("--accept-change goes with --compare, and that with recordings")
    given = {"--accept-delay": accept_delay, "--population": population, "--fault": fault}
    if nominal and (wrong := next((option for option, value in given.items() if value), None)) is not None:
        raise typer.BadParameter(f"{wrong} goes with healthy recordings, not with --nominal")
    faults = arguments.parse_labelled(fault or [], list(dict.fromkeys(point for point, _ in named)))
    files = [path for _, path in named] + [path for *_, path in faults]
    alike = arguments.expand_baselines(population or [])
    check_output(output, "-o", (), [loop, *files, *alike, *filter(None, [compare])])

    from servoscope.cli.render import results
    from servoscope.machines.kinds import LOOP, kind_of_loop_file
    from servoscope.report import plain_values

    if (kind := kind_of_loop_file(loop)) != LOOP:
        points = any(point for point, _ in named)
        options = {"--nominal": nominal, "--compare": compare, "--fault": fault, "--population": population}
        machines.refuse_options(kind, {**options, "operating points": points, **reading.given()})
        machines.learn_baseline(kind, loop, [path for _, path in named], output, as_json)
        return
    acceptance = {"accept_change": accept_change, "accept_delay": accept_delay, "force": force, "population": alike}
    failures = FailureCounter()
    learned = _learn_plant(loop, named, faults, compare, reading, failures, acceptance)
    learned.save(output)
    if as_json:
        print_json({"baseline": str(output), **plain_values.baseline_summary(learned)}, lines=False)
    else:
        results.print_baseline(results.create_console(), learned)
        results.print_written_path(results.create_console(), output)
    failures.exit_if_any()


def _learn_plant(
    loop: Path,
    named: list[tuple[str, Path]],
    faults: list[tuple[str, str, Path]],
    compare: Path | None,
    reading: ReadingOptions,
    failures: FailureCounter,
    acceptance: dict[str, Any],
) -> Baseline:
    """Read the recordings and learn from them; without any, from nominal values."""
    from servoscope.baseline.baseline import Baseline
    from servoscope.diagnosis import operating_points
    from servoscope.learning.learn import nominal_baseline
    from servoscope.models.loop import Loop

    settings = Loop.load(loop)
    reader = RecordingReader.from_options(settings, reading)
    if reader.columns is not None:  # they become part of the baseline, so that diagnose need not be told again
        settings = settings.model_copy(update={"columns": reader.columns})
    earlier = Baseline.load(compare) if compare is not None else None
    with show_steps(len(named) + len(faults) + 1, 6 * max(1, len(dict(named)))) as steps:
        recordings, labels = _read_labelled(reader, named, faults, steps, failures)
        steps.begin("learning")
        if not named:
            return nominal_baseline(settings, steps.advance)
        chosen, known = recordings.get("", recordings), labels.get("", labels)
        return operating_points.learn(settings, chosen, steps.advance, compare=earlier, faults=known, **acceptance)


def _read_labelled(
    reader: RecordingReader,
    named: list[tuple[str, Path]],
    faults: list[tuple[str, str, Path]],
    steps: StepProgress,
    failures: FailureCounter,
) -> tuple[dict[str, list[Recording]], dict[str, dict[str, list[Recording]]]]:
    """Read healthy recordings, by operating point, and those of faults, by point and name."""
    recordings: dict[str, list[Recording]] = {point: [] for point, _ in named}
    labels: dict[str, dict[str, list[Recording]]] = {point: {} for point in recordings}
    for point, path in named:
        steps.begin(path.name)
        with failures.catch():
            recordings[point] += reader.read(path)
    if failures.count and not any(recordings.values()):
        failures.exit_if_any()
    for point, name, path in faults:
        steps.begin(path.name)
        with failures.catch():
            labels[point][name] = labels[point].get(name, []) + reader.read(path)
    return recordings, labels


@app.command()
@with_reading_options("axis")
def diagnose(
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="What learn wrote.")],
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING", help="Recordings to judge.")],
    point: Annotated[
        str | None, typer.Option(metavar="NAME", help="Operating point that they were taken at; else any.")
    ] = None,
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
    report: ReportOption = None,
    trace: TraceOption = None,
    fail_on_fault: Annotated[  # scripts for 1.0 name it; what it asked for is done without it now
        bool, typer.Option("--fail-on-fault", hidden=True)
    ] = False,
    details: Annotated[bool, typer.Option("--details", "-v", help="Print the statistics behind it too.")] = False,
) -> None:
    """Say whether the actuator was healthy; if not, what changed, by how much, since when, and how sure.

    Several recordings are given in order of time: one that is suspect after another one is a fault. Exits with 3 after
    a fault, with 4 after a suspect.
    """
    recordings = arguments.expand_files(recordings)
    inputs = [baseline, *recordings]
    check_output(report, "--report", REPORTS, inputs, folder=True)
    check_output(trace, "--trace", TRACES, inputs, folder=True)

    from servoscope.baseline.baseline import Baseline
    from servoscope.cli.render import diagnosis, results
    from servoscope.diagnosis.diagnose import diagnose as diagnose_recording
    from servoscope.diagnosis.diagnose import diagnose_with_trace
    from servoscope.diagnosis.verify import provenance
    from servoscope.machines.kinds import LOOP, kind_of_file, load_machine
    from servoscope.report import document, plain_values
    from servoscope.signals.writers import write_table

    if (kind := kind_of_file(baseline)) != LOOP:
        machines.refuse_options(kind, {"--point": point, "--trace": trace, **reading.given()})
        machines.diagnose_logs(load_machine(baseline), baseline, recordings, as_json, report, details)
        return
    whole = learned = Baseline.load(baseline)
    if point is not None:
        learned = whole.at(point)
    reader = RecordingReader.from_options(learned.loop, reading)
    several = reader.expects_several(recordings)
    pages = OutputPaths.from_option(report, ".html", several, inputs)
    traces = OutputPaths.from_option(trace, ".parquet", several, inputs)
    out, failures = results.create_console(), FailureCounter()
    verdicts: list[VerdictKind] = []
    with show_steps(len(recordings), 3 + len(learned.loop.plant.all_faults) + len(learned.learned)) as steps:
        for path in recordings:
            steps.begin(path.name)
            with failures.catch():
                for recording in reader.read(path):
                    with failures.catch():
                        steps.advance("recursion")
                        before = verdicts[-1] if verdicts else "undetermined"
                        if traces is None and pages is None:
                            result = diagnose_recording(learned, recording, steps.advance, before=before)
                            course = None
                        else:
                            result, course = diagnose_with_trace(learned, recording, steps.advance, before=before)
                        verdicts.append(result.verdict)
                        if as_json:
                            result = result.model_copy(update={"provenance": provenance(whole, recording)})
                        with steps.pause():
                            if as_json:
                                print_json(plain_values.to_plain_values(result), lines=several)
                            else:
                                diagnosis.print_diagnosis(
                                    out, result, document.DETAILS if details else document.EVIDENCE
                                )
                        if traces is not None and course is not None:
                            traces.write(path, recording.name, write_table, course.table(), stderr=as_json)
                        if pages is not None and course is not None:
                            from servoscope.report.diagnosis_page import write_diagnosis_page  # late: it draws

                            at = learned.at(result.point) if result.point else learned
                            origin = plain_values.provenance(at, baseline, path)
                            page = result, course, recording, at.loop, origin
                            pages.write(path, recording.name, write_diagnosis_page, *page, stderr=as_json)
    exit_after(verdicts)
    failures.exit_if_any()


@app.command()
@with_reading_options("axis", "by")
def verify(
    diagnosis: Annotated[Path, typer.Argument(metavar="DIAGNOSIS", help="What diagnose --json printed.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="The recording that it judged.")],
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="The baseline that it was judged with.")],
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
) -> None:
    """Repeat a diagnosis from its file and say whether the verdict is the same; if not, exit with 1."""
    from servoscope.baseline.baseline import Baseline
    from servoscope.cli.render import results
    from servoscope.core.errors import RecordingError
    from servoscope.diagnosis import verify as verification
    from servoscope.report import plain_values

    told = verification.load_diagnosis(diagnosis)
    learned = Baseline.load(baseline)
    reader = RecordingReader.from_options(learned.loop, reading)
    read = reader.read(recording)
    if len(read) != 1:
        raise RecordingError(f"{recording}: holds {len(read)} recordings, choose one with --where")
    verified = verification.verify(told, learned, read[0])
    if as_json:
        plain = plain_values.to_plain_values(verified)
        texts = {
            "differences": [str(difference) for difference in verified.differences],
            "remarks": [str(remark) for remark in verified.remarks],
        }
        print_json({**plain, **texts} if isinstance(plain, dict) else plain, lines=False)
    else:
        out = results.create_console()
        verdict = say("verify.same", verdict=told.verdict)
        out.print(verdict if verified.same else say("verify.changed", differences=verified.differences))
        results.print_notes(out, [str(remark) for remark in verified.remarks])
    if not verified.same:
        raise typer.Exit(EXIT_INPUT)
