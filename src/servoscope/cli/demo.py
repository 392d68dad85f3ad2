"""The main job on an embedded example, as the commands that do it."""

from __future__ import annotations

import io
import re
import shlex
import textwrap
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import typer
from rich.text import Text

from servoscope.cli.exit import RAN
from servoscope.core.files import atomic_write, make_folder

WIDTH = 80
NO_BREAK = "\N{NO-BREAK SPACE}"
COEFFICIENTS = (
    "theta_0 ... theta_3 are the coefficients of s^0 ... s^3 of the inverse: the current u (A) that the "
    "position y (m) and its three derivatives ask for, in A/m, A s/m, A s²/m and A s³/m."
)


@dataclass(frozen=True)
class DemoStep:
    """One command of the demonstration."""

    purpose: str
    arguments: tuple[str, ...]  # after ``servoscope``
    output: Path | None = None  # file for its standard output; None: the terminal
    note: str = ""  # how to read what it printed


def write_loop_file(folder: Path) -> None:
    """Make the folder and put the loop file of the reference rig into it."""
    make_folder(folder)
    rig = files("servoscope").joinpath("simulation", "reference-rig.toml").read_bytes()
    atomic_write(folder / "loop.toml", rig)


def demo_steps(folder: Path) -> tuple[DemoStep, ...]:
    """Return the commands, in order: simulate healthy and faulty, learn, diagnose."""

    def at(name: str) -> str:
        return str(folder / name)

    return (
        DemoStep(
            "A healthy rig, recorded for 60 s: an electrohydraulic actuator in a closed loop.",
            ("simulate", at("loop.toml"), "-o", at("healthy.csv"), "--seed", "1"),
        ),
        DemoStep(
            "The same rig on another day: at 30 s its internal leakage grows by 20 %.",
            ("simulate", at("loop.toml"), "-o", at("suspect.csv"), "--fault", "C_ie=1.2@30", "--seed", "2"),
        ),
        DemoStep(
            "Learn what healthy looks like.",
            ("learn", at("loop.toml"), at("healthy.csv"), "-o", at("baseline.json")),
            note=COEFFICIENTS,
        ),
        DemoStep(
            "Diagnose the other day, from r, u and y alone.",
            (
                "diagnose",
                at("baseline.json"),
                at("suspect.csv"),
                "--report",
                at("report.html"),
                "--trace",
                at("trace.parquet"),
                "--json",
            ),
            folder / "diagnosis.json",
        ),
    )


def run_demo(folder: Path, run: Callable[[Sequence[str]], object]) -> None:
    """Run the demonstration and print each command, its output and what to open.

    `run` runs a command and returns its exit code, or None for 0.
    """
    from servoscope.cli.render import diagnosis, results
    from servoscope.diagnosis.result import Diagnosis

    write_loop_file(folder)
    out = results.create_console()
    for step in demo_steps(folder):
        out.print(Text(step.purpose, style="bold"))
        out.print(Text(_format_command(step), style="cyan"), soft_wrap=True)
        if step.output is None:
            _exit_on_failure(run(step.arguments))
        else:
            printed = io.StringIO()
            with redirect_stdout(printed):
                _exit_on_failure(run(step.arguments))
            atomic_write(step.output, printed.getvalue().encode())
            diagnosis.print_diagnosis(out, Diagnosis.model_validate_json(printed.getvalue()))
        if step.note:
            results.print_notes(out, [step.note], "blue", "-")
        out.print()
    out.print(
        Text(f"Open {folder / 'report.html'} in a browser; {folder / 'loop.toml'} describes the rig."),
        soft_wrap=True,
    )


def _format_command(step: DemoStep) -> str:
    """Return the command as a terminal of 80 columns shows it; an option stays with its value."""
    words = " ".join(shlex.quote(word).replace(" ", NO_BREAK) for word in ("servoscope", *step.arguments))
    if step.output is not None:
        words += f" >{NO_BREAK}{shlex.quote(str(step.output)).replace(' ', NO_BREAK)}"
    kept = re.sub(r"(?<= )(-\S+) (?![->])", rf"\1{NO_BREAK}", words)
    lines = textwrap.wrap(f"$ {kept}", WIDTH - 2, subsequent_indent="    ", break_on_hyphens=False)
    return " \\\n".join(lines).replace(NO_BREAK, " ")


def _exit_on_failure(code: object) -> None:
    if (code or 0) not in RAN:  # the command has printed the reason
        raise typer.Exit(int(str(code)))
