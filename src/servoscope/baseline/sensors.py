"""Several sensors of one output against each other: healthy disagreement, and which sensor departs from it.

With x_i the sensors and m their median, d_i = x_i - m - (offset_i + slope_i m) is noise while all are healthy. Means of
d_i and the logarithm of the noise of x_i, over blocks, go through one-sided CUSUMs; a sensor that repeats its value
while another one moves stands still. Two sensors disagree alike: which of them is wrong, `wrong` has to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from servoscope.baseline.records import BaselineModel, Vector
from servoscope.baseline.threshold import SECONDS_PER_YEAR
from servoscope.core.arrays import FloatArray, IntArray
from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.models.loop import Loop
from servoscope.signals import Recording

SensorKind = Literal["fixed", "gain", "offset", "noise"]

ALLOWANCE = 1.0  # standard deviations of a block that each CUSUM forgives per block
LIMIT_MARGIN = 1.5  # times the largest CUSUM of the healthy recordings: slow disagreement is no white noise
REPEATS = 5  # equal values in a row from which a sensor stands still, where no healthy one repeats any
MIN_EXPLAINED_SHARE = 0.5  # share of the squared disagreement from which an offset or a gain explains it
MIN_BLOCKS = 20  # of healthy recordings
MIN_NOISE_SHARE = 1e-6  # of the sensors' rms: the least noise, for sensors that are copies of each other


class SensorModel(BaselineModel):
    """How the sensors of one output disagree while all are healthy, one value per sensor."""

    names: tuple[str, ...]
    samples: int  # per block
    offset: Vector  # against the median of all, in units of y
    slope: Vector  # and what grows with it
    std: Vector  # of block means of the disagreement
    log_noise: Vector  # mean and standard deviation of the logarithm of a block's noise power
    log_noise_std: Vector
    limit: float  # of the CUSUMs, in standard deviations
    repeats: int  # equal values in a row from which a sensor stands still


class SensorDeviation(NamedTuple):
    """A sensor that departs from the others."""

    names: tuple[str, ...]  # the sensor; both where it cannot be told which of two it is
    others: tuple[str, ...]
    kind: SensorKind
    size: float  # value at which it stands, ratio of its gain or its noise to the healthy one, or offset in units of y
    onset: int  # sample from which it departs
    detected: int  # sample at which that is detected

    @property
    def text(self) -> Message:
        """What is wrong with it, as a message."""
        if len(self.names) > 1:
            return message(
                "sensor.either", names=self.names, size=message(f"sensor.either_{self.kind}", size=self.size)
            )
        return message(f"sensor.{self.kind}", name=self.names[0], others=self.others, size=self.size)


class _Blocks(NamedTuple):
    """Block means of the sensors' median (K,), and per sensor its disagreement and log noise (K, S)."""

    median: FloatArray
    difference: FloatArray
    log_noise: FloatArray


def sensor_values(recording: Recording, names: Sequence[str]) -> FloatArray | None:
    """Return the sensors of a recording, shape (N, S); None where it does not hold all of them."""
    if len(names) < 2 or any(name not in recording.channels for name in names):
        return None
    return np.column_stack([recording.channels[name] for name in names])


def learn_sensors(loop: Loop, recordings: Sequence[Recording]) -> SensorModel | None:
    """Return how the sensors of one output disagree in healthy recordings; None where the output has one sensor.

    Raises NotEnoughError if the recordings are too short.
    """
    names = loop.columns.outputs
    values = [signals for rec in recordings if (signals := sensor_values(rec, names)) is not None]
    if not values:
        return None
    size = max(2, round(loop.sample_rate / loop.monitor.evaluation_rate))
    parts = [_blocks(x, size) for x in values]
    blocks = _Blocks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if len(blocks.median) < MIN_BLOCKS:
        raise NotEnoughError(
            f"{recordings[0].name}: {len(blocks.median)} blocks of {size} samples are too few to compare "
            f"{' and '.join(names)}, at least {MIN_BLOCKS} are needed: record longer"
        )
    regressors = np.column_stack([np.ones_like(blocks.median), blocks.median])
    (offset, slope), *_ = np.linalg.lstsq(regressors, blocks.difference, rcond=None)
    floor = MIN_NOISE_SHARE * float(np.sqrt(np.mean(np.concatenate(values) ** 2))) + np.finfo(np.float64).tiny
    model = SensorModel(
        names=names,
        samples=size,
        offset=tuple(offset),
        slope=tuple(slope),
        std=tuple(np.maximum((blocks.difference - regressors @ np.array([offset, slope])).std(axis=0), floor)),
        log_noise=tuple(blocks.log_noise.mean(axis=0)),
        log_noise_std=tuple(np.maximum(blocks.log_noise.std(axis=0), MIN_NOISE_SHARE)),
        limit=_cusum_limit(loop, len(names)),
        repeats=max(REPEATS, 1 + 2 * max(int(_repeats(x).max(initial=0)) for x in values)),
    )
    worst = max(float(level.max(initial=0.0)) for part in parts for level in _levels(model, part))
    return model.model_copy(update={"limit": max(model.limit, LIMIT_MARGIN * worst)})


def find_sensor_deviation(
    model: SensorModel,
    recording: Recording,
    wrong: Callable[[int], int | None] = lambda onset: None,
) -> SensorDeviation | None:
    """Return the first sensor of a recording that departs from the others; None where none does.

    `wrong`: of two sensors, which one is wrong from a sample on, as far as that can be told.
    """
    x = sensor_values(recording, model.names)
    if x is None:
        return None
    blocks = _blocks(x, model.samples)
    levels = _levels(model, blocks)
    alarms = [np.flatnonzero((level > model.limit).any(axis=1)) for level in levels]
    at = [int(alarm[0]) if alarm.size else len(blocks.median) for alarm in alarms]
    first = min(at)
    still = np.argwhere(_repeats(x) >= model.repeats)
    if still.size and still[0, 0] < (first + 2) * model.samples:  # its jump may be seen a block before
        sample, i = (int(index) for index in still[0])
        return _deviation(model, (i,), "fixed", float(x[sample, i]), sample - model.repeats + 1, sample)
    if first == len(blocks.median):
        return None
    rises = at[2] < min(at[:2])
    level = levels[2] if rises else levels[0] if at[0] <= at[1] else levels[1]
    i = int(np.argmax(level[first]))
    onset_block = _last_zero(level[: first + 1, i])
    onset, detected = onset_block * model.samples, (first + 1) * model.samples - 1
    return _classify(model, blocks, i, slice(onset_block, None), onset, detected, wrong)


def _classify(
    model: SensorModel,
    blocks: _Blocks,
    i: int,
    after: slice,
    onset: int,
    detected: int,
    wrong: Callable[[int], int | None],
) -> SensorDeviation:
    """Say what is wrong with sensor i, from what all blocks after the onset have in common."""
    two = len(model.names) == 2
    median = blocks.median[after]
    differences = blocks.difference[after] - np.array(model.offset) - np.array(model.slope) * median[:, None]
    # the median of three is the larger of two, where one is far off: sizes are against the mean of the others
    e = differences[:, i] if two else differences[:, i] - np.delete(differences, i, axis=1).mean(axis=1)
    offset, total = float(e.mean()), float(e @ e)
    gain = float(e @ median / (median @ median)) if median.any() else 0.0
    of_offset, of_gain = float(((e - offset) ** 2).sum()), float(((e - gain * median) ** 2).sum())
    if min(of_offset, of_gain) > (1.0 - MIN_EXPLAINED_SHARE) * total:
        growth = blocks.log_noise[after].mean(axis=0) - np.array(model.log_noise)
        loudest = int(np.argmax(growth))
        return _deviation(model, (loudest,), "noise", math.exp(0.5 * float(growth[loudest])), onset, detected)
    kind: SensorKind = "offset" if of_offset <= of_gain else "gain"
    if not two:
        size = offset if kind == "offset" else 1.0 + gain
        return _deviation(model, (i,), kind, size, onset, detected)
    # of two sensors, the median is their mean: each disagrees with it by half of what it does with the other
    which = wrong(onset)
    sign = 1.0 if which in (i, None) else -1.0
    size = 2.0 * sign * offset if kind == "offset" else (1.0 + sign * gain) / (1.0 - sign * gain)
    return _deviation(model, (i, 1 - i) if which is None else (which,), kind, size, onset, detected)


def _deviation(
    model: SensorModel, which: tuple[int, ...], kind: SensorKind, size: float, onset: int, detected: int
) -> SensorDeviation:
    names = tuple(model.names[i] for i in which)
    others = tuple(name for name in model.names if name not in names)
    return SensorDeviation(names, others, kind, size, max(onset, 0), detected)


def _blocks(x: FloatArray, size: int) -> _Blocks:
    """Return means over blocks of `size` samples; what is left over at the end is left out."""
    count, sensors = len(x) // size, x.shape[1]
    median = np.median(x, axis=1)
    rows = x[: count * size].reshape(count, size, sensors)
    middle = median[: count * size].reshape(count, size).mean(axis=1)
    # second differences leave motion out; a sensor without any noise has that of its resolution
    rough = np.diff(x, n=2, axis=0, prepend=x[:1], append=x[-1:])[: count * size] if len(x) > 1 else x[:0]
    power = (rough.reshape(count, size, sensors) ** 2).mean(axis=1)
    least = MIN_NOISE_SHARE**2 * float((x**2).mean()) if len(x) else 0.0
    log_noise = np.log(power + least + np.finfo(np.float64).tiny)
    return _Blocks(middle, rows.mean(axis=1) - middle[:, None], log_noise)


def _levels(model: SensorModel, blocks: _Blocks) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the CUSUMs of disagreement upward and downward and of noise upward, shape (K, S) each."""
    expected = np.array(model.offset) + np.array(model.slope) * blocks.median[:, None]
    z = (blocks.difference - expected) / np.array(model.std)
    noise = (blocks.log_noise - np.array(model.log_noise)) / np.array(model.log_noise_std)
    return _cusum(z), _cusum(-z), _cusum(noise)


def _cusum(z: FloatArray) -> FloatArray:
    """Return g_k = max(0, g_(k-1) + z_k - allowance), along the first axis: a sum minus its smallest value so far."""
    sums = np.cumsum(z - ALLOWANCE, axis=0)
    return np.asarray(sums - np.minimum(np.minimum.accumulate(sums, axis=0), 0.0))


def _last_zero(level: FloatArray) -> int:
    """Return the block after the last one in which a CUSUM was 0."""
    zeros = np.flatnonzero(level <= 0.0)
    return int(zeros[-1]) + 1 if zeros.size else 0


def _repeats(x: FloatArray) -> IntArray:
    """Return how often each sensor has repeated its value while another one has changed, shape (N, S)."""
    changed = np.vstack([np.ones((1, x.shape[1]), np.bool_), x[1:] != x[:-1]])
    counts = np.cumsum(~changed & changed.any(axis=1, keepdims=True), axis=0)
    return np.asarray(counts - np.maximum.accumulate(np.where(changed, counts, 0), axis=0))


def _cusum_limit(loop: Loop, sensors: int) -> float:
    """Return the limit at which white noise alarms as often as the budget allows, after Siegmund (1985)."""
    rate = loop.monitor.evaluation_rate
    blocks = SECONDS_PER_YEAR * rate / loop.monitor.false_alarms_per_year * 3.0 * sensors
    return math.log(2.0 * ALLOWANCE**2 * blocks) / (2.0 * ALLOWANCE) - 1.166


def without_sensor(recording: Recording, names: Sequence[str], wrong: str, onset: int) -> FloatArray:
    """Return y with the mean of the other sensors from a sample on, shape (N,)."""
    y = recording.y.copy()
    others: Any = [recording.channels[name] for name in names if name != wrong]
    y[onset:] = np.mean(others, axis=0)[onset:]
    return y
