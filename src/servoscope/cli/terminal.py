"""How results look in a terminal: simulations, inspections, baselines; tables, facts and notes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from servoscope.baseline import Baseline
    from servoscope.bench import Result
    from servoscope.inspection import Inspection
    from servoscope.loop import Columns
    from servoscope.readers import ChannelInfo
    from servoscope.recording import Recording
    from servoscope.simulation import Truth

COLOURS = {
    "healthy": "green",
    "usable": "green",
    "fault": "red",
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


def console(*, stderr: bool = False) -> Console:
    """Return a console on stdout or stderr: without colour when that is no terminal or NO_COLOR is set."""
    return Console(stderr=stderr, highlight=False, markup=False, emoji=False)


def percent(share: float) -> str:
    """Return a share with so many digits that 99.97 % does not become 100 %."""
    if not math.isfinite(share):
        return "-"
    if 0.0005 > share > 0.0:
        return "< 0.1 %"
    if 0.9995 < share < 1.0:
        return f"{100.0 * share:.2f} %" if share <= 0.99995 else "> 99.99 %"
    return f"{100.0 * share:.3g} %"


def span(seconds: float) -> str:
    """Return a duration in the unit that suits it."""
    if seconds < 600.0:
        return f"{seconds:.4g} s"
    return f"{seconds / 60.0:.3g} min" if seconds < 7200.0 else f"{seconds / 3600.0:.3g} h"


def table(out: Console, header: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> None:
    """Print a table whose first `words` columns are text and whose others are numbers."""
    grid = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", show_edge=False)
    for i, name in enumerate(header):
        grid.add_column(name, justify="left" if i < words else "right", overflow="fold")
    for row in rows:
        grid.add_row(*(Text(cell) for cell in row))
    out.print(Padding(grid, INDENT, expand=False))


def facts(out: Console, pairs: Sequence[tuple[str, str]]) -> None:
    """Print names and values in two columns; long values wrap inside theirs."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in pairs:
        grid.add_row(name, Text(value))
    out.print(Padding(grid, INDENT, expand=False))


def notes(out: Console, texts: Sequence[str], colour: str = "yellow", mark: str = "!") -> None:
    """Print sentences as a list, wrapped under their own beginning."""
    for text in texts:
        grid = Table.grid(padding=(0, 1, 0, 0))
        grid.add_column()
        grid.add_column(overflow="fold")
        grid.add_row(Text(mark, style=colour), Text(text))
        out.print(Padding(grid, INDENT, expand=False))


def baseline(out: Console, b: Baseline) -> None:
    """Print what was learned, operating point by operating point."""
    for one in b.each:
        _baseline(out, one)


def _baseline(out: Console, b: Baseline) -> None:
    at = f" at {b.point}" if b.point else ""
    if b.loop.name == type(b.loop).model_fields["name"].default:
        out.print(Text.assemble(("Baseline", "bold"), f"{at} from {_sources(b)}"))
    else:
        out.print(Text.assemble((b.loop.name, "bold"), f": baseline{at} from {_sources(b)}"))
    std = [math.sqrt(b.covariance[i][i]) for i in range(len(b.theta))]
    rows = [
        (name, f"{value:.5g}", f"{s:.2g}", f"{100.0 * abs(s / value):.2g} %" if value else "-")
        for name, value, s in zip(b.names, b.theta, std, strict=True)
    ]
    table(out, ("coefficient", "value", "std. dev.", "relative"), rows)
    out.print()
    if b.ratios:
        table(
            out,
            ("parameter", "healthy / nominal"),
            [(name, f"{ratio:.4g}") for name, ratio in b.ratios.items()],
        )
        out.print()
    seen = [(p.name, p.parameter, percent(p.change) if p.change is not None else "never") for p in b.promises]
    if seen:
        if all(p.name == p.parameter for p in b.promises):
            table(out, ("fault", "seen from a change of"), [(name, size) for name, _, size in seen])
        else:
            table(out, ("fault", "parameter", "seen from a change of"), seen, words=2)
        out.print()
    if b.learned:
        severity = [(f.name, f"{len(f.shares)}", f"{min(f.shares):.2f} to {max(f.shares):.2f}") for f in b.learned]
        table(out, ("labelled fault", "recordings", "severity"), severity)
        out.print()
    monitor = b.loop.monitor
    listening = f" and {len(b.members)} CUSUMs" if b.members else ""
    told = [
        ("explained", f"{percent(b.explained)} of u's variance (R = {b.R:.3g})"),
        ("delay", f"{1e3 * b.delay_s:.3g} ms" if b.delay_s is not None else "the recordings do not tell"),
        ("false alarms", f"T² = {b.limit:.4g}{listening}, for a budget of {monitor.false_alarms_per_year:g} per year"),
        ("data support", f"budgets of {b.supported_false_alarms_per_year:.3g} per year or more"),
        ("model_error", f"{monitor.model_error:g} set, {b.suggested_model_error:.2g} suggested"),
    ]
    if b.noise is not None:
        told.insert(1, ("noise", f"u {b.noise.u_std:.3g}, y {b.noise.y_std:.3g} (standard deviations)"))
    facts(out, told)
    notes(out, b.notes)


def channels(out: Console, name: str, found: Sequence[ChannelInfo]) -> None:
    """Print the columns of a file."""
    out.print(Text.assemble((name, "bold"), f": {len(found)} columns"))
    rows = [(c.name, c.dtype, f"{c.min:.6g}", f"{c.max:.6g}") for c in found]
    shown = [[cell if cell != "nan" else "-" for cell in row] for row in rows]
    table(out, ("column", "type", "smallest", "largest"), shown, words=2)


def _sources(b: Baseline) -> str:
    length = span(sum(source.duration_s for source in b.sources))
    if len(b.sources) > 3:
        return f"{len(b.sources)} recordings, {length}"
    return f"{', '.join(source.name for source in b.sources)}, {length}"


def renamed(out: Console, columns: Columns) -> None:
    """Print the mapping that a simulated recording needs, where the loop's columns are no plain names."""
    pairs = (columns.time or "t", columns.reference, columns.input, columns.output)
    mapping = ", ".join(f"{letter}={name}" for letter, name in zip("truy", pairs, strict=True))
    notes(out, [f"the loop's columns are no plain names: read it with --columns '{mapping}'"])


def simulated(out: Console, path: str, reference: str, recording: Recording, truth: Truth) -> None:
    """Print what was simulated, with its truth."""
    out.print(Text.assemble((recording.name, "bold"), f": {span(recording.duration_s)}, {recording.samples} samples"))
    named = {fault.parameter: fault.name for fault in truth.plant.faults}
    told = [("reference", reference)]
    for event in truth.faults:
        how = f" over {span(event.ramp_s)}" if event.ramp_s else ""
        what = f"{event.parameter} becomes {event.ratio:g} times its value at {event.at_s:g} s{how}"
        told.append(("truth", f"{named[event.parameter]}: {what}" if event.parameter in named else what))
    if not truth.faults:
        told.append(("truth", "healthy"))
    facts(out, told)
    written(out, path)


def inspection(out: Console, i: Inspection) -> None:
    """Print whether a recording is usable, why, what it holds, and what to do."""
    s = i.sampling
    size = f"{span(s.duration_s)}, {s.samples} samples at {s.sample_rate_hz:.6g} Hz"
    out.print(Text.assemble((i.recording, "bold"), f": {size}"))
    out.print(
        Padding(Text(i.headline[:1].upper() + i.headline[1:], style=f"bold {COLOURS[i.verdict]}"), INDENT, expand=False)
    )
    told = []
    if s.runs > 1 or s.stretches > 1:
        told.append(("stretches", f"{s.stretches} in {s.runs} runs, the longest {span(s.longest_stretch_s)}"))
    if i.suggested_cutoff_hz is not None:
        told.append(("cutoff", f"{i.suggested_cutoff_hz:g} Hz suggested"))
    facts(out, told)
    if i.frequencies:
        rows = [
            (
                f"{f.frequency_hz:g} Hz",
                f"{f.coherence_u:.3f}" if f.coherence_u is not None else "-",
                f"{f.coherence_y:.3f}" if f.coherence_y is not None else "-",
                f"{f.snr:.3g}" if f.snr is not None else "-",
                percent(f.relative_std) if f.relative_std is not None else "-",
            )
            for f in i.frequencies
        ]
        table(out, ("frequency", "coherence r, u", "coherence r, y", "signal / noise", "iFRF std."), rows)
    for finding in i.findings:
        notes(out, [finding.message], COLOURS[finding.severity], "-" if finding.severity == "note" else "!")
    if i.recommendations:
        out.print("  What to do:")
        notes(out, i.recommendations, "green", "-")


def written(out: Console, path: object) -> None:
    """Print that a file was written, on one line that can be copied."""
    out.print(Text(f"  wrote {path}"), soft_wrap=True)


def claims(out: Console, found: Sequence[tuple[str, str, str]]) -> None:
    """Print claims of the paper, each with what was measured and a verdict."""
    for claim, measured, verdict in found:
        out.print(Text.assemble((verdict, COLOURS[verdict]), f": {claim}"))
        out.print(Padding(Text(measured, style="dim"), INDENT))


def speed(out: Console, found: Result) -> None:
    """Print what was measured of speed: per sample, beside what it is compared with, and single numbers."""
    rows = []
    for figure in found.figures:
        median, low, high = (f"{x:.1f}" if x < 1000.0 else f"{x:.0f}" for x in figure.ns)
        ratio = "" if figure.ratio is None else f"{figure.ratio:.3g}"
        error = "" if figure.error is None else f"{figure.error:.0e}"
        rows.append((figure.name, median, f"{low}-{high}", ratio, error))
    table(out, ("ns per sample", "median", "quartiles", "times", "error"), rows)
    notes(out, ["bare: without the sequential test; times as long as the first of its kind"], "dim", " ")
    out.print()
    for name, number in found.facts.items():
        out.print(f"{name}: {number:.4g}")
