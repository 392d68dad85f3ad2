"""The commands that need no recording: simulate, design, reproduce, demo; parse, call, print."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.arguments import RecordingReader
from servoscope.cli.exit import print_json
from servoscope.cli.options import (
    JsonOption,
    LoopArgument,
    ReadingOptions,
    with_reading_options,
)
from servoscope.cli.output_paths import RECORDINGS, REPORTS, check_output
from servoscope.cli.progress import show_steps
from servoscope.core.errors import LoopError
from servoscope.core.files import atomic_write, exclusive_folder
from servoscope.core.messages import say

if TYPE_CHECKING:
    from servoscope.design import BaselineStudy


@app.command()
def simulate(
    loop: LoopArgument,
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
        Literal["linear", "nonlinear"],
        typer.Option(help="nonlinear: an EHA with friction, valve, sensor, limits and warming oil."),
    ] = "linear",
    as_json: JsonOption = False,
) -> None:
    """Simulate a loop, with faults if wanted, and write what a machine would log."""
    check_output(output, "-o", RECORDINGS, [loop, Path(reference)])
    arguments.check_reference(reference)
    events = arguments.parse_fault_events(fault or [])

    from servoscope import simulation
    from servoscope.cli.render import results
    from servoscope.models.loop import Loop
    from servoscope.report import plain_values
    from servoscope.signals import writers

    settings = Loop.load(loop)
    arguments.check_length(duration, settings.sample_rate)
    with show_steps(1, 1) as steps:
        steps.begin("simulating")
        r = simulation.reference(reference, duration, settings.sample_rate, amplitude=amplitude)
        run = simulation.simulate if rig == "linear" else simulation.simulate_rig
        recording, truth = run(settings, r, faults=events, noise_u_std=noise_u, noise_y_std=noise_y, seed=seed)
        steps.advance("writing")
        used = writers.write_recording(output, recording, settings.columns)
    if as_json:
        how = {"reference": reference, "amplitude": amplitude, "seed": seed, "rig": rig}
        noise = {"noise_u_std": noise_u, "noise_y_std": noise_y}
        facts = plain_values.simulation_summary(recording, truth, used)
        print_json({"recording": str(output), **facts, **how, **noise}, lines=False)
    else:
        results.print_simulation(results.create_console(), str(output), reference, recording, truth)
        if used != settings.columns:
            results.print_column_mapping(results.create_console(), used)


@app.command()
@with_reading_options("axis")
def design(
    loop: LoopArgument,
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
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
    report: Annotated[Path | None, typer.Option(metavar="FILE.html", help="Write a page with plots.")] = None,
) -> None:
    """Say which faults can be detected and isolated, from which size on: of a loop file, or of a baseline alone."""
    check_output(report, "--report", REPORTS, [loop, *(healthy or [])])
    arguments.check_reference(reference)

    from servoscope.baseline.baseline import Baseline
    from servoscope.cli.render import design, results
    from servoscope.design import DesignStudy, design_study, study_baseline
    from servoscope.models.loop import Loop
    from servoscope.report import plain_values

    baseline = Baseline.load(loop) if loop.suffix.lower() == ".json" else None
    if baseline is not None and healthy:
        raise LoopError(f"{loop}: is a baseline, which knows its healthy recordings: leave out the others")
    settings = Loop.load(loop) if baseline is None else baseline.loop
    arguments.check_length(after, settings.sample_rate)
    reader = RecordingReader.from_options(settings, reading)
    with show_steps(1, 3 + 2 * len(settings.plant.faults)) as steps:
        steps.begin("reading" if healthy else "simulating")
        study: DesignStudy | BaselineStudy
        if baseline is not None:
            study = study_baseline(baseline, reference=reference, after_s=after, progress=steps.advance)
        else:
            study = design_study(
                settings,
                [recording for path in healthy or [] for recording in reader.read(path)],
                reference=reference,
                after_s=after,
                noise_u_std=noise_u,
                noise_y_std=noise_y,
                progress=steps.advance,
            )
    if as_json:
        print_json(plain_values.to_plain_values(study), lines=False)
    elif isinstance(study, DesignStudy):
        design.print_study(results.create_console(), study)
    else:
        design.print_learned_study(results.create_console(), study)
    if report is not None:
        if not isinstance(study, DesignStudy):
            raise LoopError(f"{loop}: no page without a simulation of the loop: {study.missing}")
        from servoscope.report import design_page as pages

        pages.write_design_page(report, study)
        results.print_written_path(results.create_console(stderr=as_json), report)


@app.command()
def reproduce(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for figures and claims.")
    ] = Path("paper-output"),
    seeds: Annotated[int, typer.Option(metavar="N", min=1, help="Realisations of the noise.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Reproduce the source paper: its figures, and every claim of it beside the measured number."""
    from servoscope.cli.render import results
    from servoscope.research.paper import jobs, reproduction

    count = len(jobs.list_jobs(range(1, seeds + 1))) + reproduction.FIGURE_COUNT + 1
    with exclusive_folder(output), show_steps(count, 1) as steps:
        steps.begin("measuring")
        paper = reproduction.reproduce(seeds, output, progress=steps.begin)
    if as_json:
        print_json(paper.to_dict(), lines=False)
    else:
        results.print_claims(results.create_console(), [(c.claim, c.measured, c.verdict) for c in paper.claims])
        results.print_written_path(results.create_console(), output)


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for what it writes.")] = Path(
        "demo-output"
    ),
) -> None:
    """Simulate a rig, break it, learn and diagnose: the main job in four commands."""
    from servoscope.cli import demo as demonstration

    with exclusive_folder(output):
        demonstration.run_demo(output, lambda words: app(list(words), standalone_mode=False))


@app.command()
def tutorial(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the logs.")] = Path(
        "tutorial"
    ),
) -> None:
    """Write the four logs that the tutorial reads: a motor axis, healthy on three days and faulty on Friday."""
    from servoscope.cli.render import results
    from servoscope.simulation.tutorial import DAYS, tutorial_log

    out = results.create_console()
    with exclusive_folder(output):
        for day in DAYS:
            atomic_write(output / f"{day}.csv", tutorial_log(day).encode())
            results.print_written_path(out, output / f"{day}.csv")
    results.print_notes(out, [say("tutorial.next", log=str(output / "monday.csv"))], "green", "-")
