"""The command that calibrates an arm, and what init, learn and diagnose do with one, thin: parse, call, print."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.exit import FailureCounter, exit_after, print_json
from servoscope.cli.output_paths import OutputPaths, check_output
from servoscope.core.errors import BaselineError, OutputError
from servoscope.core.files import atomic_write
from servoscope.core.messages import render, say

if TYPE_CHECKING:
    from servoscope.arm.baseline import ArmBaseline
    from servoscope.core.verdict import VerdictKind


def refuse_options(options: Mapping[str, object]) -> None:
    """Refuse options, by name, that were given and have no meaning for an arm."""
    given = [name for name, value in options.items() if value]
    if given:
        raise typer.BadParameter(f"{', '.join(given)}: not for an arm, leave out")


def write_proposal(logs: Sequence[Path], urdf: Path, output: Path, replace: bool) -> None:
    """Propose the loop file of an arm from a log and its URDF, write it, and print it."""
    import os

    from servoscope.arm.setup import propose_arm_loop
    from servoscope.cli.render import results

    if output.exists() and not replace:
        raise OutputError(f"{output}: exists; name another file with -o, or replace it with --yes")
    loop, why = propose_arm_loop(logs[0], urdf, os.path.relpath(urdf, output.parent))
    text = loop.to_toml({key: render(reason) for key, reason in why.items()})
    atomic_write(output, text.encode())
    out = results.create_console()
    typer.echo(text)
    results.print_written_path(out, output)
    learn = shlex.join(["servoscope", "learn", str(output), *map(str, logs), "-o", "baseline.json"])
    results.print_command(out, say("init.next"), learn)


@app.command("calibrate-load")
def calibrate(
    baseline: Annotated[Path, typer.Argument(metavar="BASELINE", help="Of an arm, learned without the load.")],
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Log of moves with the load.")],
    mass: Annotated[float, typer.Option(metavar="KG", min=0.01, help="Mass of the load [kg].")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="LOOP", help="Loop file to write.")],
) -> None:
    """Find the drive gains of an arm from a load of known mass, and write its loop file with them."""
    check_output(output, "-o", (".toml",), [baseline, log])

    from servoscope.arm.baseline import ArmBaseline
    from servoscope.arm.log import read_arm_log
    from servoscope.arm.setup import calibrate_load
    from servoscope.cli.render import results

    if (healthy := ArmBaseline.load(baseline)) is None:
        raise BaselineError(f'{baseline}: is no baseline of an arm, give one that learn wrote for kind = "arm"')
    loop = healthy.loop
    gains = calibrate_load(healthy, read_arm_log(log, loop, healthy.model.arm), mass)
    joints = {
        gain.joint: loop.joints[gain.joint].model_copy(
            update={"gain": float(f"{gain.gain:.4g}")} if gain.determined else {}
        )
        for gain in gains
    }
    calibrated = loop.model_copy(update={"joints": {name: joints[name] for name in loop.joints}, "gains": "load"})
    atomic_write(output, calibrated.to_toml({}).encode())
    out = results.create_console()
    rows = [(gain.joint, f"{gain.gain:.4g} ± {1.96 * gain.std * abs(gain.gain):.2g}") for gain in gains]
    results.print_table(out, ("joint", "drive gain"), rows)
    open_joints = [gain.joint for gain in gains if not gain.determined]
    results.print_notes(out, [say("arm.gain_open", joints=open_joints)] if open_joints else [])
    results.print_written_path(out, output)


def learn_baseline(loop: Path, logs: Sequence[Path], output: Path, as_json: bool) -> None:
    """Learn the baseline of an arm from healthy logs, write it, and print it."""
    from servoscope.arm.learning import learn_arm
    from servoscope.arm.log import read_arm_log
    from servoscope.arm.settings import ArmLoop
    from servoscope.cli.render import results

    settings, urdf = ArmLoop.load(loop)
    arm = settings.kinematics(urdf, settings.urdf)
    failures, recordings = FailureCounter(), []
    for path in logs:
        with failures.catch():
            recordings.append(read_arm_log(path, settings, arm))
    if not recordings:
        failures.exit_if_any()
    baseline = learn_arm(settings, urdf, recordings)
    baseline.save(output)
    if as_json:
        print_json({"baseline": str(output), **baseline.summary()}, lines=False)
    else:
        _print_baseline(baseline)
        results.print_written_path(results.create_console(), output)
    failures.exit_if_any()


def _print_baseline(baseline: ArmBaseline) -> None:
    from servoscope.cli.render import results

    out = results.create_console()
    summary = baseline.summary()
    results.print_title(out, baseline.loop.name, f": {say('arm.baseline', recordings=len(baseline.sources))}")
    rows = [
        (name, *(f"{value:.4g} ± {1.96 * std:.2g}" for value, std in joint["friction"]), f"{joint['unexplained']:.1%}")
        for name, joint in summary["joints"].items()
    ]
    results.print_table(out, ("joint", "viscous friction", "Coulomb friction", "unexplained"), rows)
    notes = [say("arm.undetermined_friction", names=baseline.undetermined)] if baseline.undetermined else []
    results.print_notes(out, [*notes, *map(str, baseline.notes)])


def diagnose_logs(
    baseline: ArmBaseline, logs: Sequence[Path], as_json: bool, report: Path | None, details: bool
) -> None:
    """Diagnose logs of an arm, print the verdicts, and write reports on them."""
    from servoscope.arm.diagnosis import examine_arm
    from servoscope.arm.log import read_arm_log
    from servoscope.cli.render import diagnosis, results
    from servoscope.report import document, plain_values

    pages = OutputPaths.from_option(report, ".html", len(logs) > 1, logs)
    failures = FailureCounter()
    verdicts: list[VerdictKind] = []
    for path in logs:
        with failures.catch():
            recording = read_arm_log(path, baseline.loop, baseline.model.arm)
            result, examination = examine_arm(baseline, recording)
            verdicts.append(result.verdict)
            if as_json:
                print_json(plain_values.to_plain_values(result), lines=len(logs) > 1)
            else:
                diagnosis.print_diagnosis(
                    results.create_console(), result, document.DETAILS if details else document.EVIDENCE
                )
            if pages is not None:
                from servoscope.arm.page import write_arm_page  # late: it draws

                pages.write(path, recording.name, write_arm_page, result, examination, baseline, stderr=as_json)
    exit_after(verdicts)
    failures.exit_if_any()
