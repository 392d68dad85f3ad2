"""How a proposed loop file looks in a terminal: what was recognised, what is in doubt, and the next command."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from servoscope.cli.render import results
from servoscope.core.messages import Message, render, say
from servoscope.learning.inspection import Inspection
from servoscope.learning.inspection.rules import MIN_MEMORIES
from servoscope.learning.loop_proposal import LoopProposal

MAX_LOGS, MAX_DOUBTS = 6, 9  # that are listed
CHOSEN = {"set_plant", "set_cutoff", "lower_cutoff", "set_update_when", "set_memory", "drop_frequencies"}
"""Recommendations about what `init` has chosen itself: the same choice is not advised again, log by log."""


def print_proposal(out: Console, proposal: LoopProposal) -> None:
    """Print what was recognised, and what is in doubt."""
    listed = proposal.inspections[:MAX_LOGS]
    for _, inspected in listed:
        headline = str(inspected.headline)
        results.print_title(out, inspected.recording, f": {_size(inspected)}")
        verdict = Text(headline[:1].upper() + headline[1:], style=f"bold {results.COLOURS[inspected.verdict]}")
        out.print(Padding(verdict, results.INDENT, expand=False))
    columns, plant, monitor = proposal.loop.columns, proposal.candidates[0], proposal.loop.monitor
    facts = [
        ("t", columns.time or ""),
        ("r", columns.reference),
        ("u", columns.input),
        ("y", ", ".join(columns.outputs)),
    ]
    if any(line.why.key == "init.no_reference" for line in proposal.lines):
        facts.pop(1)
    facts.append(("plant", say("init.recognised", plant=plant.words, share=100.0 * plant.explained)))
    facts.append(("cutoff", say("init.band", cutoff=proposal.loop.cutoff, memory=monitor.memory)))
    results.print_facts(out, facts)
    doubts = [*_doubts(proposal)]
    results.print_notes(out, doubts[:MAX_DOUBTS])
    if hidden := len(proposal.inspections) - len(listed) + max(len(doubts) - MAX_DOUBTS, 0):
        results.print_notes(out, [say("init.more", count=hidden)])


def _size(inspected: Inspection) -> str:
    from servoscope.report.inspection_page import inspection_size

    return inspection_size(inspected)


def _doubts(proposal: LoopProposal) -> Iterator[str]:
    """Yield what is in doubt: lines of the file, what the logs show together, one piece of advice about memory."""
    plain = [line for line in proposal.lines if line.doubtful and line.why.key == "init.column_plain"]
    if plain:
        yield say("init.no_unit", columns=[f"{line.key} {line.value}" for line in plain])
    for line in proposal.lines:
        if line.doubtful and line not in plain:
            yield f"{line.key} = {line.value}: {render(line.why)}"
    yield from map(render, proposal.notes)
    reasons: dict[str, list[Inspection]] = {}
    for _, inspected in proposal.inspections:
        for kind in dict.fromkeys(finding.kind for finding in inspected.findings if finding.severity != "note"):
            reasons.setdefault(kind, []).append(inspected)
    for kind, shown in reasons.items():
        text = next(str(finding.message) for finding in shown[0].findings if finding.kind == kind)
        of = {"count": len(shown), "all": len(proposal.inspections)}
        yield text if of["all"] == 1 else say("init.of_logs", **of, finding=text)
    wanted = [
        float(text.values["memory_s"])
        for _, inspected in proposal.inspections
        for text in inspected.recommendations
        if isinstance(text, Message) and text.key == "inspection.set_memory"
    ]
    shortest = min((inspected.sampling.duration_s for _, inspected in proposal.inspections), default=0.0)
    if wanted and max(wanted) * MIN_MEMORIES <= shortest:
        yield say("inspection.set_memory", memory_s=max(wanted))


def print_details(out: Console, proposal: LoopProposal) -> None:
    """Print the settings with their reasons, the plants that were compared, and what was measured in each log."""
    lines = [
        (f"{line.section}.{line.key}".lstrip("."), line.value + " ?" * line.doubtful, render(line.why))
        for line in proposal.lines
    ]
    results.print_table(out, ("setting", "proposed", "why"), lines, words=3)
    compared = [(plant.words, f"{100.0 * plant.explained:.2f} %") for plant in proposal.candidates]
    results.print_table(out, ("plant", "explained of u"), compared)
    results.print_notes(out, [say("init.compared", count=len(proposal.candidates))])
    for _, inspected in proposal.inspections:
        advice = tuple(
            text
            for text in inspected.recommendations
            if not (isinstance(text, Message) and text.key.removeprefix("inspection.") in CHOSEN)
        )
        results.print_inspection(out, inspected.model_copy(update={"recommendations": advice}))


def print_next(out: Console, proposal: LoopProposal, loop: Path, where: Mapping[str, str]) -> None:
    """Print the command that learns from the logs that can be used, or that none can."""
    usable = [path for path, inspected in proposal.inspections if inspected.verdict != "not usable"]
    if not usable:
        results.print_notes(out, [say("init.not_usable", loop=str(loop))])
        return
    learned = " ".join(shlex.quote(str(path)) for path in usable)
    if where:
        learned += " --where " + shlex.quote(",".join(f"{column}={value}" for column, value in where.items()))
    results.print_command(
        out, say("init.next"), f"servoscope learn {shlex.quote(str(loop))} {learned} -o baseline.json"
    )
