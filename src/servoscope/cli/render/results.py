"""How results look in a terminal: simulations, inspections, baselines; tables, facts and notes."""

from __future__ import annotations

import errno
import math
import shlex
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal
from unicodedata import category

from rich.console import Console, ConsoleOptions, RenderableType
from rich.padding import Padding
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from servoscope.baseline.baseline import Baseline
from servoscope.core.messages import say, translate, translate_range
from servoscope.core.number_format import format_rough
from servoscope.learning.inspection import Inspection
from servoscope.models.loop import Columns
from servoscope.report.format_values import DASH, format_duration, format_percent
from servoscope.report.page import ResultTable
from servoscope.signals import Recording
from servoscope.signals.readers import ChannelInfo
from servoscope.simulation import Truth

COLOURS = {
    "healthy": "green",
    "usable": "green",
    "fault": "red",
    "suspect": "yellow",
    "not usable": "red",
    "stop": "red",
    "undetermined": "yellow",
    "usable with care": "yellow",
    "care": "yellow",
    "note": "blue",
    "holds": "green",
    "holds partly": "yellow",
    "does not hold": "red",
}
INDENT = (0, 0, 0, 2)
STEERING = ("Cc", "Cf", "Cs")  # control and format characters, and bytes that are no text


class _TextConsole(Console):
    """A console to which names of files, columns and assets are text: what would steer a terminal is shown as ?."""

    def on_broken_pipe(self) -> None:
        """Let the command end as where a plain print meets the end of a pipe."""
        raise BrokenPipeError(errno.EPIPE, "broken pipe")

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Return what is printed, piece by piece."""
        for segment in super().render(renderable, options):
            text = "".join("?" if category(c) in STEERING and c != "\n" else c for c in segment.text)
            yield segment if segment.control else segment._replace(text=text)


def create_console(**options: Any) -> Console:
    """Return a console on stdout, or as the options of Rich say: no colour where there is no terminal, or NO_COLOR."""
    return _TextConsole(highlight=False, markup=False, emoji=False, **options)


def print_title(out: Console, name: str, text: str) -> None:
    """Print the first line of a result: a name in bold, and what follows it."""
    out.print(Text.assemble((name, "bold"), text))


def build_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    words: int | None = None,
    unbroken: Collection[str] = (),
) -> Table:
    """Return a table whose first `words` columns, None: all, are text and whose others are numbers.

    `unbroken`: the columns that are never broken into lines.
    """
    grid = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", show_edge=False)
    for i, name in enumerate(header):
        justify: Literal["left", "right"] = "left" if words is None or i < words else "right"
        grid.add_column(translate(name), justify=justify, overflow="fold", no_wrap=name in unbroken)
    for row in rows:
        grid.add_row(*(Text(translate_range(cell)) if isinstance(cell, str) else cell for cell in row))
    return grid


def print_table(out: Console, header: Sequence[str], rows: Iterable[Sequence[str | Text]], words: int = 1) -> None:
    """Print a table as `build_table` returns it."""
    out.print(Padding(build_table(header, rows, words), INDENT, expand=False))


def print_result_table(out: Console, table: ResultTable) -> None:
    """Print a table that pages show too, with the headings of a terminal, which are lower case."""
    header = [name if name[1:2].isupper() else name[:1].lower() + name[1:] for name in map(translate, table.head)]
    print_table(out, header, table.rows, table.words)


def print_facts(out: Console, pairs: Iterable[tuple[str, str]]) -> None:
    """Print names and values in two columns; long values wrap inside theirs."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in pairs:
        grid.add_row(translate(name), Text(translate_range(value)))
    out.print(Padding(grid, INDENT, expand=False))


def print_notes(out: Console, texts: Iterable[object], colour: str = "yellow", mark: str = "!") -> None:
    """Print sentences as a list, wrapped under their own beginning."""
    for text in texts:
        grid = Table.grid(padding=(0, 1, 0, 0))
        grid.add_column()
        grid.add_column(overflow="fold")
        grid.add_row(Text(mark, style=colour), Text(str(text)))
        out.print(Padding(grid, INDENT, expand=False))


def print_written_path(out: Console, path: object) -> None:
    """Print that a file was written, on one line that can be copied."""
    out.print(Text(f"  {say('cli.wrote', path=path)}"), soft_wrap=True)


def print_command(out: Console, text: str, command: str) -> None:
    """Print what to do next, and its command on one line that can be copied."""
    print_notes(out, [text], "green", "-")
    out.print(Text(f"    {command}"), soft_wrap=True)


def print_baseline(out: Console, baseline: Baseline) -> None:
    """Print what was learned, operating point by operating point."""
    for point in baseline.per_point:
        _print_operating_point(out, point)


def _print_operating_point(out: Console, b: Baseline) -> None:
    at = say("cli.baseline.at", point=b.point) if b.point else None
    unnamed = b.loop.name == type(b.loop).model_fields["name"].default
    title = say("cli.baseline.unnamed" if unnamed else "cli.baseline.named", at=at, sources=_format_sources(b))
    print_title(out, translate("Baseline") if unnamed else b.loop.name, title)
    std = [math.sqrt(b.covariance[i][i]) for i in range(len(b.theta))]
    rows = [
        (name, f"{value:.5g}", f"{s:.2g}", f"{format_rough(100.0 * abs(s / value))} %" if value else DASH)
        for name, value, s in zip(b.names, b.theta, std, strict=True)
    ]
    changes = b.detectability.changes
    header = ("fault",) if all(p.name == p.parameter for p in changes) else ("fault", "parameter")
    promised = [
        (
            *(translate(p.name), p.parameter)[: len(header)],
            format_percent(p.change) if p.change is not None else translate("never"),
        )
        for p in changes
    ]
    severity = [(f.name, f"{len(f.shares)}", f"{min(f.shares):.2f} to {max(f.shares):.2f}") for f in b.learned]
    for head, cells, words in (
        (("coefficient", "value", "std. dev.", "relative"), rows, 1),
        (("parameter", "healthy / nominal"), [(name, f"{x:.4g}") for name, x in b.healthy.ratios.items()], 1),
        ((*header, "detected from a change of"), promised, len(header)),
        (("labelled fault", "recordings", "severity"), severity, 1),
    ):
        if cells:
            print_table(out, head, cells, words)
            out.print()
    print_facts(out, _baseline_facts(b))
    print_notes(out, b.notes)


def _baseline_facts(b: Baseline) -> Iterator[tuple[str, str]]:
    yield "explained", say("cli.baseline.explained", share=format_percent(b.detectability.explained), R=b.recursion.R)
    if b.healthy.noise is not None:
        yield "noise", say("cli.baseline.noise", u=b.healthy.noise.u_std, y=b.healthy.noise.y_std)
    delay = say("cli.baseline.delay", ms=1e3 * b.delay_s) if b.delay_s is not None else say("cli.baseline.no_delay")
    yield "delay", delay
    cusums = say("cli.baseline.cusums", count=len(b.thresholds.hypotheses)) if b.thresholds.hypotheses else None
    budget, supported = b.loop.monitor.false_alarms_per_year, b.detectability.supported_false_alarms_per_year
    yield "false alarms", say("cli.baseline.false_alarms", limit=b.thresholds.statistic, cusums=cusums, budget=budget)
    yield "data support", say("cli.baseline.data_support", budget=supported)
    error = {"set": b.loop.monitor.model_error, "suggested": b.detectability.suggested_model_error}
    yield "model_error", say("cli.baseline.model_error", **error)
    if b.features is None:
        return
    n = b.features.recordings
    for name, ratios in (
        ("coefficients", b.scatter.left_out),
        ("features", [x / b.features.limit for x in b.features.left_out]),
    ):
        if ratios:
            above = sum(ratio > 1.0 for ratio in ratios)
            yield name, say("cli.baseline.left_out", recordings=n, above=above, worst=max(ratios))
    yield (
        "guarantee",
        say(
            "cli.baseline.guarantee",
            recordings=n,
            among=n + 1,
            one_in=round(1.0 / b.features.false_alarms),
            limit=b.features.limit,
            in_a_row=b.features.in_a_row,
            span_s=b.features.layout.span_s,
        ),
    )


def _format_sources(b: Baseline) -> str:
    length = format_duration(sum(source.duration_s for source in b.sources))
    if len(b.sources) > 3:
        return say("cli.baseline.sources", count=len(b.sources), duration=length)
    return f"{', '.join(source.name for source in b.sources)}, {length}"


def print_channels(out: Console, path: Path, channels: Sequence[ChannelInfo], rate: float | None = None) -> None:
    """Print the columns of a file, which of them might be t, r, u and y, and what to do next.

    `rate`: that of the rows, where the user says it [Hz].
    """
    from servoscope.signals.readers.axes import moving_axes, signals_of_one_axis
    from servoscope.signals.readers.guess_columns import format_mapping, guess_mapping

    print_title(
        out,
        path.name,
        f": {say('cli.columns', count=len(channels), rows=max((channel.rows for channel in channels), default=0))}",
    )
    limits = [[f"{x:.6g}" if math.isfinite(x) else DASH for x in (c.min, c.max)] for c in channels]
    rows = [(c.name, c.dtype, *limit) for c, limit in zip(channels, limits, strict=True)]
    print_table(out, ("column", "type", "smallest", "largest"), rows, words=2)
    fields = guess_mapping(signals_of_one_axis(channels))
    if axes := moving_axes(channels):
        print_notes(out, [say("cli.axes", axes=[*axes])])
    if mapping := format_mapping(fields):
        print_notes(out, [say("cli.proposed_mapping", mapping=mapping)])
    missing = [letter for letter, field in (("u", "input"), ("y", "output")) if fields[field] is None]
    if missing:
        print_notes(out, [say("cli.missing_mapping", names=missing)])
    if fields["time"] is None and rate is None:
        print_notes(out, [say("cli.missing_time")])
    told = "" if rate is None and fields["time"] is not None else f" --rate {'HZ' if rate is None else f'{rate:.12g}'}"
    print_command(out, say("cli.next_init"), f"servoscope init {shlex.quote(str(path))}{told}")


def print_column_mapping(out: Console, columns: Columns) -> None:
    """Print the mapping that a simulated recording needs, where the loop's columns are no plain names."""
    pairs = [*zip("tru", (columns.time or "t", columns.reference, columns.input), strict=True)]
    mapping = ", ".join(f"{letter}={name}" for letter, name in [*pairs, *(("y", name) for name in columns.outputs)])
    print_notes(out, [say("cli.needed_mapping", mapping=mapping)])


def print_simulation(out: Console, path: str, reference: str, recording: Recording, truth: Truth) -> None:
    """Print what was simulated, with its truth."""
    print_title(
        out, recording.name, f": {format_duration(recording.duration_s)}, {recording.samples} {translate('samples')}"
    )
    named = {fault.parameter: fault.name for fault in truth.plant.all_faults}
    facts = [("reference", reference)]
    for event in truth.faults:
        over = say("cli.truth_over", duration=format_duration(event.ramp_s)) if event.ramp_s else None
        known = {"parameter": event.parameter, "ratio": event.ratio, "at": event.at_s, "over": over}
        what = say("cli.truth", **known)
        facts.append(("truth", f"{named[event.parameter]}: {what}" if event.parameter in named else what))
    print_facts(out, facts if truth.faults else [*facts, ("truth", translate("healthy"))])
    print_written_path(out, path)


def print_inspection(out: Console, i: Inspection) -> None:
    """Print whether a recording is usable, why, what it holds, and what to do."""
    from servoscope.report.inspection_page import excitation_table, inspection_size, stretches

    print_title(out, i.recording, f": {inspection_size(i)}")
    headline = str(i.headline)
    out.print(
        Padding(Text(headline[:1].upper() + headline[1:], style=f"bold {COLOURS[i.verdict]}"), INDENT, expand=False)
    )
    facts = [("sampling", stretches(i))] if i.sampling.runs > 1 or i.sampling.stretches > 1 else []
    if i.suggested_cutoff_hz is not None:
        facts.append(("cutoff", say("report.cutoff", frequency=i.suggested_cutoff_hz)))
    print_facts(out, facts)
    if i.frequencies:
        print_result_table(out, excitation_table(i))
    for finding in i.findings:
        print_notes(out, [finding.message], COLOURS[finding.severity], "-" if finding.severity == "note" else "!")
    if i.recommendations:
        out.print(f"  {translate('What to do')}:")
        print_notes(out, i.recommendations, "green", "-")


def print_claims(out: Console, claims: Iterable[tuple[str, str, str]]) -> None:
    """Print claims of the paper, each with what was measured and a verdict."""
    for claim, measured, verdict in claims:
        out.print(Text.assemble((verdict, COLOURS[verdict]), f": {claim}"))
        out.print(Padding(Text(measured, style="dim"), INDENT))
