"""Sensors of one output that disagree: which one is wrong, and the recording without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from servoscope.baseline.baseline import Baseline
from servoscope.baseline.sensors import find_sensor_deviation, learn_sensors, without_sensor
from servoscope.evidence.kind import EvidenceKind, Finding
from servoscope.signals import Recording

# times the residual power of the other sensor, from which the plant says that a sensor is wrong
MIN_RESIDUAL_RATIO = 2.0
MAX_MEMORIES_AFTER_ONSET = 20.0  # memories after the onset that are asked
MIN_SAMPLES = 20  # usable samples


def check_sensors(baseline: Baseline, recording: Recording) -> tuple[Recording, list[Finding]]:
    """Return a recording without the sensor that departs from the others, and a doubt that names it.

    Where it cannot be told which of two it is, or only its noise has grown, the recording stays as it is.
    """
    model = baseline.sensors
    if model is None:
        return recording, []
    sensor_deviation = find_sensor_deviation(model, recording, lambda onset: wrong_sensor(baseline, recording, onset))
    if sensor_deviation is None:
        return recording, []
    from_s, to_s = float(recording.t[sensor_deviation.onset]), float(recording.t[-1])
    count = recording.samples - sensor_deviation.onset
    doubt = Finding("doubt", "sensor", sensor_deviation.text, from_s, to_s, count)
    if len(sensor_deviation.names) == 1 and sensor_deviation.kind != "noise":
        y = without_sensor(recording, model.names, sensor_deviation.names[0], sensor_deviation.onset)
        recording = replace(recording, y=y)
    return recording, [doubt]


def wrong_sensor(baseline: Baseline, recording: Recording, onset: int) -> int | None:
    """Return which of two sensors contradicts the healthy plant from a sample on; None where neither does more.

    An offset shows only where the plant has a stiffness, and a fault of the actuator contradicts both alike.
    """
    loop = baseline.loop
    rows = recording.rows(
        slice(onset, onset + round(MAX_MEMORIES_AFTER_ONSET * loop.monitor.memory * loop.sample_rate))
    )
    powers = [_residual_power(baseline, rows, rows.channels[name]) for name in loop.columns.outputs]
    return _larger(powers)


def _larger(powers: Sequence[float]) -> int | None:
    first, second = powers
    if max(first, second) > MIN_RESIDUAL_RATIO * min(first, second):
        return int(second > first)
    return None


def _residual_power(baseline: Baseline, rows: Recording, y: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Return the mean square of what the healthy plant leaves of u, by one sensor."""
    restart = rows.restart.copy()
    restart[:1] = True
    regression = baseline.pipeline().regression(rows.r, rows.u, y, restart)
    if regression.ok.sum() < MIN_SAMPLES:
        return 0.0
    residual = regression.eta - regression.phi @ np.array(baseline.theta)
    return float(np.mean(residual[regression.ok] ** 2))


SENSORS = EvidenceKind("sensors", lambda healthy, _: (learn_sensors(healthy.loop, healthy.recordings), ()))
