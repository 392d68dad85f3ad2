"""The main job on an embedded example, as the commands that do it."""

from __future__ import annotations

import io
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import typer
from rich.text import Text

from servoscope.cli.progress import on_compiling
from servoscope.output import atomic_write, make_folder

__all__ = ["Step", "prepare", "show", "steps"]

WIDTH = 80
COEFFICIENTS = (
    "theta_0 ... theta_3 are the coefficients of s^0 ... s^3 of the inverse: the current u (A) that the "
    "position y (m) and its three derivatives ask for, in A/m, A s/m, A s²/m and A s³/m."
)


@dataclass(frozen=True)
class Step:
    """One command of the demonstration.

    Parameters
    ----------
    words
        What it is for.
    arguments
        The command's words after ``servoscope``.
    into
        File that takes its standard output; None: the terminal.
    after
        What to know about what it said.
    """

    words: str
    arguments: tuple[str, ...]
    into: Path | None = None
    after: str = ""


def prepare(folder: Path) -> None:
    """Make the folder and put the loop file of the reference rig into it.

    Raises
    ------
    OutputError
        If that is not possible.
    """
    make_folder(folder)
    rig = files("servoscope").joinpath("examples", "reference-rig.toml").read_bytes()
    atomic_write(folder / "loop.toml", rig)


def steps(folder: Path) -> tuple[Step, ...]:
    """Return the commands, in order: simulate healthy and faulty, learn, diagnose."""

    def at(name: str) -> str:
        return str(folder / name)

    return (
        Step(
            "A healthy rig, recorded for 60 s: an electrohydraulic actuator in a closed loop.",
            ("simulate", at("loop.toml"), "-o", at("healthy.csv"), "--seed", "1"),
        ),
        Step(
            "The same rig on another day: at 30 s its internal leakage grows by 20 %.",
            ("simulate", at("loop.toml"), "-o", at("suspect.csv"), "--fault", "C_ie=1.2@30", "--seed", "2"),
        ),
        Step(
            "Learn what healthy looks like.",
            ("learn", at("loop.toml"), at("healthy.csv"), "-o", at("baseline.json")),
            after=COEFFICIENTS,
        ),
        Step(
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


def show(folder: Path, run: Callable[[Sequence[str]], object]) -> None:
    """Run the demonstration and print each command, what it says and what to open.

    Parameters
    ----------
    folder
        Where the files go.
    run
        Runs a command; returns its exit code, or None for 0.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    from servoscope.cli import terminal, verdicts
    from servoscope.diagnosis import Diagnosis

    prepare(folder)
    out = terminal.console()
    told: list[bool] = []
    stream = sys.stdout

    def compiling() -> None:
        if not told:
            with redirect_stdout(stream):  # not among what a command prints into a file
                out.print(Text("  compiling, once: the next time this starts at once", style="dim"))
        told.append(True)

    with on_compiling(compiling):
        for step in steps(folder):
            out.print(Text(step.words, style="bold"))
            out.print(Text(_command(step), style="cyan"), soft_wrap=True)
            if step.into is None:
                _checked(run(step.arguments))
            else:
                said = io.StringIO()
                with redirect_stdout(said):
                    _checked(run(step.arguments))
                atomic_write(step.into, said.getvalue().encode())
                verdicts.diagnosis(out, Diagnosis.model_validate_json(said.getvalue()))
            if step.after:
                terminal.notes(out, [step.after], "blue", "-")
            out.print()
    out.print(
        Text(f"Open {folder / 'report.html'} in a browser; {folder / 'loop.toml'} describes the rig."),
        soft_wrap=True,
    )


def _command(step: Step) -> str:
    """Return the command as one would type it, broken where it is too long for a line."""
    words = [shlex.quote(word) for word in ("servoscope", *step.arguments)]
    if step.into is not None:
        words.append(f"> {shlex.quote(str(step.into))}")
    lines = ["$"]
    for i, word in enumerate(words):
        value = i + 1 < len(words) and word.startswith("-") and not words[i + 1].startswith(("-", ">"))
        needed = len(f"{word} {words[i + 1]}") if value else len(word)  # an option stays with its value
        if len(lines[-1]) + needed + 3 > WIDTH and len(lines[-1].split()) > 1:
            lines[-1] += " \\"
            lines.append("   ")
        lines[-1] += f" {word}"
    return "\n".join(lines)


def _checked(code: object) -> None:
    if code:  # the command has said why
        raise typer.Exit(int(str(code)))
