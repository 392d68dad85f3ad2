"""QUBE rotary pendulum, fourteen healthy runs: servoscope beside three simple detectors, leaving one run out.

    python benchmarks public/qube [--data DIR] [--json]

Each run is judged with what was learned from the thirteen others: as measured, and with u times 1.1 (a motor, magnet or
amplifier that has lost a tenth). servoscope with `model_error = 0` and with that of examples/qube.toml.
"""

from __future__ import annotations

from pathlib import Path

from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public.servoscope_detector import (
    COLUMNS,
    OURS,
    ROOT,
    Count,
    all_scores,
    servoscope_scores,
    with_gain,
    with_model_error,
)

WINDOW_S = 5.0
GAIN = 1.1


def runs(data: Path, loop: ss.Loop) -> list[ss.Recording]:
    """Return the healthy runs, by name."""
    folder = data / "real" / "qube"
    return [ss.read(path, loop) for path in [*sorted(folder.glob("*.csv")), *sorted(folder.glob("more/*.parquet"))]]


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "real/qube")
    loop = ss.Loop.load(ROOT / "examples" / "qube.toml")
    healthy, counts = runs(given.data, loop), dict[str, Count]()
    plain, example = f"{OURS}, model_error = 0", f"{OURS}, model_error = {loop.monitor.model_error:g}"
    for k, run in enumerate(healthy):
        others, judged = healthy[:k] + healthy[k + 1 :], [run, with_gain(run, GAIN)]
        scores = all_scores(with_model_error(loop, 0.0), others, judged, WINDOW_S)
        named = {plain: scores.pop(OURS), example: servoscope_scores(loop, others, judged), **scores}
        for name, found in named.items():
            counts.setdefault(name, Count()).add(found, 1)
    note = (
        f"{len(healthy)} healthy runs of 20 s at 500 Hz, each judged with what the others taught, as measured and with "
        f"u times {GAIN:g}. Windows of {WINDOW_S:g} s."
    )
    rows = tuple((name, *count.cells) for name, count in counts.items())
    values = {
        f"{name}.{what}": cell
        for name, *cells in rows
        for what, cell in zip(("false", "found"), cells[:2], strict=True)
    }
    show([Table("QUBE: detectors", note, COLUMNS, rows)], given.json, values)
