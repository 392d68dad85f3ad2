"""Whether u of an axis is constant between the samples of a log, or moves on: the likelier of the two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from servoscope.core.errors import NotEnoughError
from servoscope.core.messages import Message, message
from servoscope.estimation.axis_filter import axis_stride
from servoscope.isolation.ml.axis_window import axis_signals
from servoscope.learning.axis_fit import AxisRegression, check_motion, fit_axis_noise, rest_speed
from servoscope.models.loop import Loop
from servoscope.models.plants.axis import AxisPlant
from servoscope.signals import Recording

LOOKED_AT_S = 20.0  # of a recording: a hold that matters shows in less
MIN_GAIN = 50.0  # of twice the log-likelihood, for one of the two


class LikelierHold(NamedTuple):
    """How u runs between the samples."""

    hold: Literal["zoh", "foh"]
    gain: float  # twice the logarithm of the likelihood ratio to the other one
    recording: str  # that shows it


def likelier_hold(loop: Loop, recordings: Sequence[Recording]) -> LikelierHold | None:
    """Return how u of an axis runs between the samples.

    A controller that is faster than its log moves u between the samples: held, u would come half a sample late. The
    noise is that of a u that is held, which favours it. None where it is said, or the recordings do not show it.
    """
    plant = loop.plant
    is_said = "hold" in loop.model_fields_set or loop.controller is not None or plant.has_physics
    plain = [rec for rec in recordings if not any(defect.kind == "resampled" for defect in rec.defects)]
    if is_said or not plain or not isinstance(plant, AxisPlant):
        return None
    part = _liveliest_part(max(plain, key=lambda rec: rec.samples))
    stride = axis_stride(loop.sample_rate)
    held, moving = (axis_signals(loop.model_copy(update={"hold": hold}), part, stride) for hold in ("zoh", "foh"))
    slow = rest_speed([held])
    problems = [AxisRegression.of(plant, signals) for signals in (held, moving)]
    try:
        check_motion([part], [held], slow, len(problems[0].columns))
        noise = fit_axis_noise(problems[:1], slow)
    except (NotEnoughError, np.linalg.LinAlgError):
        return None
    costs = []
    for problem in problems:
        X, e, _ = problem.regress(noise, slow)
        left = e - X @ np.linalg.lstsq(X, e, rcond=None)[0]
        costs.append(len(e) * float(np.log(left @ left)))
    gain = costs[0] - costs[1]
    if abs(gain) < MIN_GAIN:
        return None
    return LikelierHold("foh" if gain > 0.0 else "zoh", abs(gain), part.name)


def with_likelier_hold(loop: Loop, recordings: Sequence[Recording]) -> tuple[Loop, list[Message]]:
    """Return a loop with the likelier hold where its file names none, and a note where that is not the default."""
    likelier = likelier_hold(loop, recordings)
    if likelier is None or likelier.hold == loop.hold:
        return loop, []
    note = message("learning.hold", recording=likelier.recording, gain=likelier.gain)
    return loop.model_copy(update={"hold": likelier.hold}), [note]


def _liveliest_part(recording: Recording) -> Recording:
    """Return the part of a recording, `LOOKED_AT_S` long, in which y goes furthest."""
    length = round(LOOKED_AT_S * recording.sample_rate)
    if recording.samples <= length:
        return recording
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(recording.y, prepend=recording.y[0])))])
    begin = int(np.argmax(way[length:] - way[:-length]))
    return recording.rows(slice(begin, begin + length))
