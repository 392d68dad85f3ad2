"""Whether u and y are in step: the delay with the smallest residual, against the one that the loop file gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.errors import RecordingError
from servoscope.loop import Loop
from servoscope.pipeline import Pipeline
from servoscope.recording import Recording
from servoscope.tuning import Fit, least_squares

DELAY_TOLERANCE = 0.5  # samples; intersample models alone move the estimate by a tenth
DELAY_SIGNIFICANT = 0.1  # relative gain in residual variance below which a delay is not worth a refusal


def check_delay(loop: Loop, recordings: Sequence[Recording], found: Fit) -> tuple[float | None, list[str]]:
    """Find the delay with the smallest residual; refuse a recording that is out of step with the loop file.

    One sample that the model does not know costs 63 % at 10 Hz (THEORY section 6), so half a sample matters.
    """
    dt = 1.0 / loop.sample_rate
    late = loop.delay + dt * np.arange(-1.5, 3.1, 0.5)
    late = np.unique(np.append(late[late >= 0.0], loop.delay))
    log_R = []
    for delay in late:
        shifted = Pipeline.of(loop.model_copy(update={"delay": float(delay)}))
        square = count = 0.0
        for rec in recordings:
            g = shifted.regression(rec.r, rec.u, rec.y, rec.restart)
            v = (g.eta - g.phi @ least_squares(g))[g.ok]
            square, count = square + float(v @ v), count + len(v)
        log_R.append(np.log(max(square / count, 1e-300)))
    values = np.array(log_R)
    here = values[int(np.argmin(np.abs(late - loop.delay)))]
    i = int(np.argmin(values))
    best = float(late[i])
    inside = 0 < i < len(late) - 1  # at an end the residual only falls: a misfit of another kind
    if inside:
        left, mid, right = values[i - 1 : i + 2]
        step_left, step_right = late[i] - late[i - 1], late[i + 1] - late[i]
        slope = (right - mid) / step_right - (mid - left) / step_left
        if slope > 0.0:
            best -= float(
                ((right - mid) / step_right * step_left + (mid - left) / step_left * step_right) / (2 * slope)
            )
    gain = found.dof * (here - values[i]) / 2.0  # log likelihood ratio of the best delay
    if (i and not inside) or (gain < 5.0 and values.max() - values.min() < 10.0 / found.dof):
        return None, ["the recordings do not tell the delay between u and y"]
    if gain > 10.0 and abs(best - loop.delay) > DELAY_TOLERANCE * dt and here - values[i] > DELAY_SIGNIFICANT:
        raise RecordingError(
            f"{recordings[0].name}: y answers u {best * 1e3:.3g} ms late, the loop file says delay = {loop.delay:g} s: "
            f"set delay = {best:.4g} or align the channels"
        )
    return best, []
