"""Fit the posterior of `servoscope assess` to simulated loops of the training family and to process loops.

python benchmarks/assessment/train.py [--data ../shared/data]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from records import Records, measured, servos, simulated

from servoscope.assessment import posterior
from servoscope.assessment.posterior import PENALTY, CausePosterior

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tables import parse_with_data, parser

SIMULATED, SEED = 1200, 2
LOOP_WEIGHT = 8.0  # what one measured loop counts, in simulated ones; its logs share it
BACKLASH_WEIGHT = 0.5  # valves stick more often than they have play
SERVO_WEIGHT = 20.0  # the same of all servo recordings in a folder


def fit(training: Records, real: Records, servo: Records, left_out: str = "") -> CausePosterior:
    """Fit the posterior to simulated and measured loops, without one of the latter or one folder."""
    features, possible, weights = (
        [training.features],
        [training.possible],
        [np.where(training.possible[:, 1], BACKLASH_WEIGHT, 1.0)],
    )
    for records, weight in ((real, LOOP_WEIGHT), (servo, SERVO_WEIGHT)):
        kept = records.loops != left_out
        names, counts = np.unique(records.loops, return_counts=True)
        share = dict(zip(names.tolist(), (weight / counts).tolist(), strict=True))
        features.append(records.features[kept])
        possible.append(records.possible[kept])
        weights.append(np.array([share[str(loop)] for loop in records.loops[kept]]))
    stacked = np.vstack(features), np.vstack(possible), np.concatenate(weights)
    return CausePosterior.fit(training.names, *stacked, PENALTY)


def main() -> None:
    """Fit, and write `posterior.json`."""
    given = parse_with_data(parser(__doc__), "real/process_loops")
    real, servo = measured(given.data / "real" / "process_loops"), servos(given.data / "real")
    target = Path(posterior.__file__).with_name("posterior.json")
    target.write_text(fit(simulated(SIMULATED, SEED, "training"), real, servo).to_json(), encoding="utf-8")


if __name__ == "__main__":
    main()
