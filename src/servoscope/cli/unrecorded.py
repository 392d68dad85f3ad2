"""The commands that need no recording, thin: parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.arguments import Source
from servoscope.cli.options import AsJson, By, ColumnsText, From, LoopFile, To, Where
from servoscope.cli.outputs import RECORDINGS, REPORTS, check_output
from servoscope.cli.shell import print_json


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

    from servoscope import simulation, summaries, writers
    from servoscope.cli import terminal
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
def design(
    loop: LoopFile,
    healthy: Annotated[
        list[Path] | None,
        typer.Argument(metavar="HEALTHY", help="Healthy recordings, if there are any.", show_default=False),
    ] = None,
    reference: Annotated[
        str, typer.Option(metavar="KIND|FILE", help="Motion, without recordings: as for simulate.")
    ] = "profile",
    after: Annotated[float, typer.Option(metavar="S", help="Time since the onset that may be used, in s.")] = 30.0,
    noise_u: Annotated[float, typer.Option(metavar="X", min=0.0, help="Noise on u, std. dev.")] = 1e-4,
    noise_y: Annotated[float, typer.Option(metavar="X", min=0.0, help="Noise on y, std. dev.")] = 3.162e-4,
    columns: ColumnsText = None,
    where: Where = None,
    by: By = None,
    from_s: From = None,
    to_s: To = None,
    as_json: AsJson = False,
    report: Annotated[Path | None, typer.Option(metavar="FILE.html", help="Write a page with plots.")] = None,
) -> None:
    """Say before deployment which faults can be detected and told apart, at which size, after how long."""
    check_output(report, "--report", REPORTS, [loop, *(healthy or [])])
    arguments.check_reference(reference)

    from servoscope import summaries
    from servoscope.cli import studies, terminal
    from servoscope.cli.progress import progress
    from servoscope.design import design_study
    from servoscope.loop import Loop

    settings = Loop.load(loop)
    arguments.check_length(after, settings.sample_rate)
    source = Source.of(settings, columns, where, by, (from_s, to_s))
    with progress(1, 4 + 2 * len(settings.plant.faults)) as steps:
        steps.begin("reading" if healthy else "simulating")
        recordings = [recording for path in healthy or [] for recording in source.read(path)]
        said = design_study(
            settings,
            recordings,
            reference=reference,
            after_s=after,
            noise_u_std=noise_u,
            noise_y_std=noise_y,
            progress=steps.tell,
        )
    if as_json:
        print_json(summaries.plain(said), lines=False)
    else:
        studies.study(terminal.console(), said)
    if report is not None:
        from servoscope.report import studies as pages

        pages.write(report, said)
        terminal.written(terminal.console(stderr=as_json), report)


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
    from servoscope.output import make_folder
    from servoscope.paper import measures, reproduction

    make_folder(output)
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
    share: Annotated[
        float, typer.Option(metavar="SHARE", min=0.001, max=1.0, help="Of assets, samples, simulations.")
    ] = 1.0,
    as_json: AsJson = False,
) -> None:
    """Measure how fast it is here, beside the machine's own limits and the other libraries that are installed."""
    from servoscope import bench as benchmark
    from servoscope.cli import terminal
    from servoscope.cli.progress import progress

    with progress(9, 1) as steps:
        found = benchmark.run(repeats, steps.begin, share=share)
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
