"""Pump-controlled hydraulic cylinder: servoscope beside three simple detectors.

    python benchmarks public/eha_pump [--data DIR] [--json]

Learned from one healthy recording (load 1), the other recording of that load is healthy, those of loads 3 and 5 differ;
then the other way round. Of the healthy one, u times 1.1 is judged, too: a pump that has lost a tenth.
"""

from __future__ import annotations

from tables import Table, parse_with_data, parser, show

import servoscope as ss
from public.servoscope_detector import COLUMNS, OURS, ROOT, Count, all_scores, servoscope_scores, with_gain
from public.servoscope_detector import with_model_error as with_error

WINDOW_S = 5.0
GAIN = 1.1
HEALTHY = ("1_3", "1_4")
LOADED = ("3_2", "3_4", "5_2", "5_4")


def main() -> None:
    """Run the command line of this process."""
    given = parse_with_data(parser(__doc__), "real/eha_pump")
    folder = given.data / "real" / "eha_pump"
    loop = ss.Loop.load(ROOT / "examples" / "eha-pump.toml")
    read = {name: ss.read(folder / f"exp_data_{name}.csv", loop) for name in (*HEALTHY, *LOADED)}
    plain, example = f"{OURS}, model_error = 0", f"{OURS}, model_error = {loop.monitor.model_error:g}"
    loads, gains = dict[str, Count](), dict[str, Count]()
    for one, other in (HEALTHY, HEALTHY[::-1]):
        healthy = read[other]
        judged = [healthy, *(read[name] for name in LOADED), with_gain(healthy, GAIN)]
        scores = all_scores(with_error(loop, 0.0), [read[one]], judged, WINDOW_S)
        named = {plain: scores.pop(OURS), example: servoscope_scores(loop, [read[one]], judged), **scores}
        for name, found in named.items():
            loads.setdefault(name, Count()).add(found._replace(largest=found.largest[:-1]), 1)
            gains.setdefault(name, Count()).add(found._replace(largest=(found.largest[0], found.largest[-1])), 1)
    note = "Learned from one recording of load 1, then from the other. 31 s at 1 kHz each. Windows of 5 s."
    tables = [
        Table(
            f"Pump-controlled EHA: {title}", f"{note} {what}", COLUMNS, tuple((n, *c.cells) for n, c in counts.items())
        )
        for title, what, counts in (
            ("loads", "Found: recordings of loads 3 and 5. A load is no fault, but it is a change.", loads),
            ("gain", f"Found: the healthy recording with u times {GAIN:g}.", gains),
        )
    ]
    values = {
        f"{what}.{name}": count.cells[1]
        for what, counts in (("loads", loads), ("gain", gains))
        for name, count in counts.items()
    }
    show(tables, given.json, values)
