"""The command ``servoscope``, thin: parses, calls, prints."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.arguments import Source
from servoscope.cli.outputs import Outputs, check_output, stem_of
from servoscope.cli.shell import FAULT, Commands, Failures, print_json

if TYPE_CHECKING:
    from servoscope.recording import Recording

REPORTS, TRACES, RECORDINGS = (".html", ".htm"), (".parquet", ".pq"), (".csv", ".parquet", ".pq")
CONTEXT = {"help_option_names": ["-h", "--help"]}

app = typer.Typer(
    cls=Commands,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)

LoopFile = Annotated[Path, typer.Argument(metavar="LOOP", help="Loop file (TOML).")]
ColumnsText = Annotated[
    str | None,
    typer.Option("--columns", metavar="MAP", help="Where signals stand: 't=Time, r=Ref, u=2*Amps, y=Pos'."),
]
Where = Annotated[
    list[str] | None,
    typer.Option(metavar="COND", help="Rows to take, 'load=20,run=1-5': values, lists, ranges."),
]
By = Annotated[str | None, typer.Option(metavar="COLUMN", help="One recording per value of this column.")]
From = Annotated[float | None, typer.Option("--from", metavar="S", help="Leave out what is before this time, in s.")]
To = Annotated[float | None, typer.Option("--to", metavar="S", help="Leave out this time, in s, and what is after it.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else on stdout.")]
Report = Annotated[
    Path | None,
    typer.Option(metavar="FILE.html", help="Write a page with plots; for several, one per recording."),
]
Trace = Annotated[
    Path | None,
    typer.Option(metavar="FILE.parquet", help="Write the course over time; for several, one each."),
]


def main() -> None:
    """Run the command line of this process."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without a sign for squared is no reason to stop
    app(prog_name="servoscope")


def _version(wanted: bool) -> None:
    if wanted:
        from servoscope import __version__

        typer.echo(f"servoscope {__version__}")
        raise typer.Exit


@app.callback()
def servoscope(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Say from r, u and y of a servo loop whether its actuator is healthy; if not, what changed, and when."""


@app.command()
def simulate(
    loop: LoopFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="REC", help="Recording to write, CSV or Parquet.")],
    reference: Annotated[
        str, typer.Option(metavar="KIND|FILE", help="profile, multisine, trapezoid, steps, chirp, or a file.")
    ] = "profile",
    amplitude: Annotated[float, typer.Option(metavar="X", help="Factor on the reference.")] = 1.0,
    duration: Annotated[float, typer.Option(metavar="S", help="Length in s.")] = 60.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=RATIO@S", help="C_ie=1.2@30: step; C_ie=1.2@30~600: ramp; repeatable."),
    ] = None,
    noise_u: Annotated[float, typer.Option(metavar="X", min=0.0, help="Noise on u, std. dev.")] = 1e-4,
    noise_y: Annotated[float, typer.Option(metavar="X", min=0.0, help="Noise on y, std. dev.")] = 3.162e-4,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the noise.")] = 0,
    rig: Annotated[
        arguments.Rigs,
        typer.Option(help="nonlinear: an EHA with friction, valve, sensor, limits and warming oil."),
    ] = arguments.Rigs.linear,
    as_json: AsJson = False,
) -> None:
    """Simulate a loop, with faults if wanted, and write what a machine would log."""
    check_output(output, "-o", RECORDINGS, [loop, Path(reference)])
    arguments.check_reference(reference)
    events = arguments.fault_events(fault or [])

    from servoscope import simulation, writers
    from servoscope.cli import summaries, terminal
    from servoscope.cli.progress import progress
    from servoscope.loop import Loop

    settings = Loop.load(loop)
    arguments.check_length(duration, settings.sample_rate)
    with progress(1, 1) as steps:
        steps.begin("simulating")
        r = simulation.reference(reference, duration, settings.sample_rate, amplitude=amplitude)
        run = simulation.simulate if rig is arguments.Rigs.linear else simulation.simulate_rig
        recording, truth = run(settings, r, faults=events, noise_u_std=noise_u, noise_y_std=noise_y, seed=seed)
        steps.tell("writing")
        used = writers.write(output, recording, settings.columns)
    if as_json:
        how = {"reference": reference, "amplitude": amplitude, "seed": seed, "rig": rig.value}
        noise = {"noise_u_std": noise_u, "noise_y_std": noise_y}
        facts = summaries.simulated(recording, truth, used)
        print_json({"recording": str(output), **facts, **how, **noise}, lines=False)
    else:
        terminal.simulated(terminal.console(), str(output), reference, recording, truth)
        if used != settings.columns:
            terminal.renamed(terminal.console(), used)


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

    from servoscope import inspection
    from servoscope.cli import summaries, terminal
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
    columns: ColumnsText = None,
    where: Where = None,
    by: By = None,
    from_s: From = None,
    to_s: To = None,
    as_json: AsJson = False,
) -> None:
    """Learn from healthy recordings what healthy looks like."""
    named = arguments.healthy(healthy or [])
    if nominal == bool(named):
        raise typer.BadParameter("give healthy recordings or --nominal, and not both")
    if (accept_change and compare is None) or (nominal and compare is not None):
        raise typer.BadParameter("--accept-change goes with --compare, and that with recordings")
    check_output(output, "-o", (), [loop, *(path for _, path in named), *filter(None, [compare])])

    from servoscope import learning, points
    from servoscope.baseline import Baseline
    from servoscope.cli import summaries, terminal
    from servoscope.cli.progress import progress
    from servoscope.loop import Loop

    settings = Loop.load(loop)
    source = Source.of(settings, columns, where, by, (from_s, to_s))
    if source.columns is not None:  # into the baseline with it: whoever diagnoses need not say it again
        settings = settings.model_copy(update={"columns": source.columns})
    earlier = Baseline.load(compare) if compare is not None else None
    failures = Failures()
    recordings: dict[str, list[Recording]] = {point: [] for point, _ in named}
    with progress(len(named) + 1, 6 * max(1, len(recordings))) as steps:
        for point, path in named:
            steps.begin(path.name)
            with failures.noted():
                recordings[point] += source.read(path)
        if failures.count and not any(recordings.values()):
            failures.leave()
        steps.begin("learning")
        if nominal:
            found = learning.nominal(settings, steps.tell)
        else:
            chosen = recordings.get("", recordings)
            found = points.learn(settings, chosen, steps.tell, compare=earlier, accept_change=accept_change)
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

    from servoscope import monitor, writers
    from servoscope.baseline import Baseline
    from servoscope.cli import summaries, terminal
    from servoscope.cli.progress import progress

    healthy = Baseline.load(baseline)
    if point is not None:
        healthy = healthy.at(point)
    source = Source.of(healthy.loop, columns, where, by, (from_s, to_s))
    many = source.many(recordings)
    pages, traces = Outputs.of(report, ".html", many, inputs), Outputs.of(trace, ".parquet", many, inputs)
    out, failures, faulty = terminal.console(), Failures(), False
    with progress(len(recordings), 3 + len(healthy.loop.plant.faults)) as steps:
        for path in recordings:
            steps.begin(path.name)
            with failures.noted():
                for recording in source.read(path):
                    with failures.noted():
                        steps.tell("recursion")
                        said, course = monitor.examine(healthy, recording, steps.tell)
                        faulty |= said.verdict == "fault"
                        with steps.paused():
                            if as_json:
                                print_json(summaries.plain(said), lines=many)
                            else:
                                terminal.diagnosis(out, said)
                        stem = stem_of(path, recording.name)
                        if traces is not None:
                            target = traces.path(stem)
                            writers.write_table(target, course.table())
                            terminal.written(terminal.console(stderr=as_json), target)
                        if pages is not None:
                            from servoscope import report as reports

                            target = pages.path(stem)
                            judged = healthy.at(said.point) if said.point else healthy
                            origin = arguments.provenance(judged, baseline, path)
                            reports.write(target, said, course, recording, judged.loop, origin)
                            terminal.written(terminal.console(stderr=as_json), target)
    if fail_on_fault and faulty:
        raise typer.Exit(FAULT)
    failures.leave()


@app.command()
def reproduce(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for figures and claims.")
    ] = Path("paper-output"),
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="Realisations of the noise.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Reproduce the source paper: its figures, and every claim of it beside the measured number."""
    from servoscope.cli import terminal
    from servoscope.cli.progress import progress
    from servoscope.paper import measures, reproduction

    reproduction.prepare(output)
    numbers = range(1, seeds + 1)
    with progress(len(measures.jobs(numbers)) + reproduction.DRAWINGS + 1, 1) as steps:
        steps.begin("measuring")
        found = reproduction.run(numbers, steps.begin)
        reproduction.write(found, output, steps.begin)
    if as_json:
        print_json(found.to_dict(), lines=False)
    else:
        terminal.claims(terminal.console(), [(c.claim, c.measured, c.verdict) for c in found.claims])
        terminal.written(terminal.console(), output)


@app.command()
def bench(
    repeats: Annotated[int, typer.Option(metavar="N", min=1, help="Of each measurement; medians count.")] = 9,
    as_json: AsJson = False,
) -> None:
    """Measure how fast it is here, beside the machine's own limits and the other libraries that are installed."""
    from servoscope import bench as benchmark
    from servoscope.cli import terminal
    from servoscope.cli.progress import progress

    with progress(9, 1) as steps:
        found = benchmark.run(repeats, steps.begin)
    if as_json:
        print_json(found.to_dict(), lines=False)
    else:
        terminal.speed(terminal.console(), found)


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for what it writes.")] = Path(
        "demo-output"
    ),
) -> None:
    """Simulate a rig, break it, learn and diagnose: the main job in four commands."""
    from servoscope.cli import demo as demonstration

    demonstration.show(output, lambda words: app(list(words), standalone_mode=False))
