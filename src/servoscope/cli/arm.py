"""What learn, diagnose and init do with an arm, thin: parse, call, print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from servoscope.cli.exit import EXIT_FAULT, FailureCounter, print_json
from servoscope.cli.output_paths import OutputPaths

if TYPE_CHECKING:
    from servoscope.baseline.arm import ArmBaseline


def refuse_options(options: Mapping[str, object]) -> None:
    """Refuse options, by name, that were given and have no meaning for an arm."""
    given = [name for name, value in options.items() if value]
    if given:
        raise typer.BadParameter(f"{', '.join(given)}: not for an arm, leave out")


def learn_baseline(loop: Path, logs: Sequence[Path], output: Path, as_json: bool) -> None:
    """Learn the baseline of an arm from healthy logs, write it, and print it."""
    from servoscope.cli.render import results
    from servoscope.learning.arm import learn_arm
    from servoscope.models.arm.settings import ArmLoop
    from servoscope.signals.readers.arm_log import read_arm_log

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
    from servoscope.report.page import say

    out = results.create_console()
    summary = baseline.summary()
    results.print_title(out, baseline.loop.name, f": {say('arm.baseline', recordings=len(baseline.sources))}")
    rows = [
        (name, *(f"{value:.4g} ± {1.96 * std:.2g}" for value, std in each["friction"]), f"{each['unexplained']:.1%}")
        for name, each in summary["joints"].items()
    ]
    results.print_table(out, ("joint", "viscous friction", "Coulomb friction", "unexplained"), rows)
    notes = [say("arm.undetermined_friction", names=baseline.undetermined)] if baseline.undetermined else []
    results.print_notes(out, [*notes, *map(str, baseline.notes)])


def diagnose_logs(
    baseline: ArmBaseline, logs: Sequence[Path], as_json: bool, report: Path | None, fail_on_fault: bool, details: bool
) -> None:
    """Diagnose logs of an arm, print the verdicts, and write reports on them."""
    from servoscope.cli.render import diagnosis, results
    from servoscope.diagnosis.arm import examine_arm
    from servoscope.report import document, plain_values
    from servoscope.report.arm_page import write_arm_page
    from servoscope.signals.readers.arm_log import read_arm_log

    pages = OutputPaths.from_option(report, ".html", len(logs) > 1, logs)
    failures, faulty = FailureCounter(), False
    for path in logs:
        with failures.catch():
            recording = read_arm_log(path, baseline.loop, baseline.model.arm)
            result, examination = examine_arm(baseline, recording)
            faulty |= result.verdict == "fault"
            if as_json:
                print_json(plain_values.to_plain_values(result), lines=len(logs) > 1)
            else:
                diagnosis.print_diagnosis(
                    results.create_console(), result, document.DETAILS if details else document.EVIDENCE
                )
            if pages is not None:
                pages.write(path, recording.name, write_arm_page, result, examination, baseline, stderr=as_json)
    if fail_on_fault and faulty:
        raise typer.Exit(EXIT_FAULT)
    failures.exit_if_any()
