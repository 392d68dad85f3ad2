"""The command that compares structures of a motor axis."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli import arguments
from servoscope.cli.app import app
from servoscope.cli.exit import FailureCounter, print_json
from servoscope.cli.options import JsonOption, LoopArgument, ReadingOptions, with_reading_options
from servoscope.cli.output_paths import check_output

if TYPE_CHECKING:
    from rich.console import Console

    from servoscope.learning.axis_structures import AxisStructure

MAX_LISTED_STRUCTURES = 8  # structures, the supported one first


@app.command()
@with_reading_options()
def explore(
    loop: LoopArgument,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG", help="Healthy recordings, two or more.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="LOOP", help="Write the loop file with the plant found.")
    ] = None,
    *,
    reading: ReadingOptions,
    as_json: JsonOption = False,
) -> None:
    """Say which terms of friction, gravity and stiffness the recordings of a motor axis support."""
    logs = arguments.expand_files(logs)
    check_output(output, "-o", (".toml",), [loop, *logs])

    from servoscope.cli.progress import show_steps
    from servoscope.cli.render import results
    from servoscope.core.errors import LoopError
    from servoscope.core.files import atomic_write
    from servoscope.core.settings import parse_toml, read_toml_text
    from servoscope.learning.axis_structures import explore_structures
    from servoscope.models.loop import Loop
    from servoscope.report.page import say

    settings = Loop.load(loop)
    reader = arguments.RecordingReader.from_options(settings, reading)
    failures, recordings = FailureCounter(), []
    with show_steps(len(logs) + 1, 1) as steps:
        for path in logs:
            steps.begin(path.name)
            with failures.catch():
                recordings += reader.read(path)
        steps.begin("structures")
        found = explore_structures(settings, recordings)
    table = plant_table(found[0])
    if as_json:
        print_json({"plant": table, "structures": [_summary(one) for one in found]}, lines=False)
    else:
        _print(results.create_console(), found, len(recordings), table)
    if output is not None:
        text = replace_plant(read_toml_text(loop, "loop file", LoopError), table)
        Loop.from_dict(
            parse_toml(text, output, LoopError), source=str(output)
        )  # nothing is written that is no loop file
        atomic_write(output, text.encode())
        results.print_written_path(results.create_console(stderr=as_json), output)
    elif not as_json:
        results.print_notes(results.create_console(), [say("explore.write")])
    failures.exit_if_any()


def plant_table(structure: AxisStructure) -> str:
    """Return the section of a loop file; the constant force joins, which every recording has of its own."""
    plant = structure.plant
    terms = ", ".join(f'"{term}"' for term in (*plant.terms, "offset"))
    lines = ["[plant]", 'kind = "axis"', f"terms = [{terms}]", f"input_gain = {plant.input_gain!r}"]
    keys = {"stribeck_speed", "hanging_at", "payload_arm", "y"}
    settings = plant.model_dump(include=keys, exclude_defaults=True)
    lines += [f"{key} = {json.dumps(value)}" for key, value in settings.items()]
    return "\n".join(lines) + "\n"


def replace_plant(text: str, table: str) -> str:
    """Return a loop file with another section ``[plant]``, in its place."""
    sections = re.split(r"(?m)^(?=\[)", text)
    place = next((k for k, one in enumerate(sections) if one.startswith("[plant]")), len(sections))
    kept = [one for one in sections[place:] if not re.match(r"\[plant[.\]]", one)]
    return "".join([*sections[:place], table + ("\n" if kept else ""), *kept])


def _summary(one: AxisStructure) -> dict[str, object]:
    return {
        "terms": list(one.plant.terms),
        "stribeck_speed": one.plant.stribeck_speed,
        "excess": one.excess,
        "excess_std": one.excess_std,
        "inertia": one.inertia,
        "over_inertia": one.ratios,
        "over_inertia_std": one.ratios_std,
    }


def _print(out: Console, found: tuple[AxisStructure, ...], count: int, table: str) -> None:
    from rich.text import Text

    from servoscope.cli.render import results
    from servoscope.report.page import say

    structures = [
        (
            ", ".join(structure.plant.terms) or "-",
            "" if structure.plant.stribeck_speed is None else f"{structure.plant.stribeck_speed:g}",
            f"{structure.excess:.1f}",
            f"{structure.excess_std:.1f}",
        )
        for structure in found[:MAX_LISTED_STRUCTURES]
    ]
    results.print_table(out, ("terms", "Stribeck speed", "worse by", "standard error"), structures)
    best = found[0]
    inertia = say("explore.no_input") if best.inertia is None else say("explore.inertia", inertia=best.inertia)
    results.print_notes(out, [say("explore.found", count=count, structures=len(found)), inertia])
    values = [(name, f"{value:.4g}", f"± {1.96 * best.ratios_std[name]:.2g}") for name, value in best.ratios.items()]
    results.print_table(out, ("coefficient over inertia", "value", "95 % between recordings"), values)
    out.print(Text("\n" + table), soft_wrap=True)
