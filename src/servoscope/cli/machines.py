"""What learn and diagnose do with machines other than loops, thin: parse, call, print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from servoscope.cli.exit import FailureCounter, exit_after, print_json
from servoscope.cli.output_paths import OutputPaths
from servoscope.core.messages import say

if TYPE_CHECKING:
    from servoscope.core.verdict import VerdictKind
    from servoscope.machines.protocol import Machine


def refuse_options(kind: str, options: Mapping[str, object]) -> None:
    """Refuse options, by name, that were given and have no meaning for a kind of machine."""
    given = [name for name, value in options.items() if value]
    if given:
        raise typer.BadParameter(f"{', '.join(given)}: leave out, they have no meaning for kind {kind!r}")


def learn_baseline(kind: str, loop: Path, logs: Sequence[Path], output: Path, as_json: bool) -> None:
    """Learn the baseline of a machine from healthy logs, write it, and print it."""
    from servoscope.cli.render import results
    from servoscope.machines.kinds import machine_class

    failures = FailureCounter()
    machine = machine_class(kind).learn(loop, logs, failures.catch)
    machine.save(output)
    if as_json:
        print_json({"baseline": str(output), **machine.summary()}, lines=False)
    else:
        out, (head, rows, notes) = results.create_console(), machine.table()
        results.print_title(out, machine.name, f": {say('init.machine', kind=kind, recordings=len(machine.sources))}")
        results.print_table(out, head, rows)
        results.print_notes(out, notes)
        results.print_written_path(out, output)
    failures.exit_if_any()


def diagnose_logs(
    machine: Machine, file: Path, logs: Sequence[Path], as_json: bool, report: Path | None, details: bool
) -> None:
    """Diagnose logs of a machine, print the verdicts, and write reports on them."""
    from servoscope.cli.render import diagnosis, results
    from servoscope.report import document, plain_values

    pages = OutputPaths.from_option(report, ".html", len(logs) > 1, logs)
    failures = FailureCounter()
    verdicts: list[VerdictKind] = []
    for path in logs:
        with failures.catch():
            judged = machine.judge(machine.read(path), lambda _: None)
            result = judged.diagnosis
            verdicts.append(result.verdict)
            if as_json:
                print_json(plain_values.to_plain_values(result), lines=len(logs) > 1)
            else:
                diagnosis.print_diagnosis(
                    results.create_console(), result, document.DETAILS if details else document.EVIDENCE
                )
            if pages is not None:
                names = str(file), str(path)
                pages.write(path, result.recording, judged.write_report, *names, stderr=as_json)
    exit_after(verdicts)
    failures.exit_if_any()
