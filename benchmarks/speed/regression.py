"""Compares how fast it is now with what was stored, as ratios within one run, so that another machine tells nothing.

python benchmarks speed/regression [--store] [--repeats 9]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from speed.chain import run_benchmarks

STORED = Path(__file__).with_name("ratios.json")
SLOWER = 1.3  # times as slow, from which it is said


def main() -> int:
    """Measure, compare or store; return 1 if something has become slower."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--store", action="store_true", help="keep this run's ratios as what to compare with")
    command.add_argument("--repeats", type=int, default=9)
    given = command.parse_args()
    found = run_benchmarks(given.repeats)
    peak = found.facts["peak multiply-adds per ns, one core, double"]
    ours = [x for x in found.figures if x.name.startswith(("log", "fleet")) or "servoscope" in x.name]
    ratios = {figure.name: figure.processor * peak for figure in ours}
    if given.store:
        STORED.write_text(json.dumps(ratios, indent=1) + "\n", encoding="utf-8")
        return 0
    slower = 0
    for name, before in json.loads(STORED.read_text(encoding="utf-8")).items():
        now = ratios.get(name)
        if now is not None:
            word = "slower" if now > SLOWER * before else ""
            slower += bool(word)
            print(f"{name}: {now:.0f} multiply-adds at the peak, stored {before:.0f} {word}")
    return 1 if slower else 0
