"""Whether u and y are in step: the delay that the recordings show, against the one that the loop file gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.errors import RecordingError
from servoscope.inspection import alignment, leftover, modelfit
from servoscope.inverse import cutoff_of
from servoscope.linear import settling
from servoscope.loop import Loop
from servoscope.recording import Recording

TOLERANCE = 0.3  # rad at the filter's cutoff, beyond which a recording is refused: half a sample at f_s = 10 cutoff
NOTED = 0.06  # rad; an inverse that is too simple moves the estimate a little, so this is only said
SIGNIFICANT = 0.1  # share of the residual variance below which a delay is not worth a refusal
UNTOLD = "the recordings do not tell the delay between u and y"


def check_delay(loop: Loop, recordings: Sequence[Recording]) -> tuple[float | None, list[str]]:
    """Estimate the delay from the longest recording; refuse one that is out of step with the loop file.

    One sample at 100 Hz that the model does not know costs 63 % at 10 Hz (THEORY section 6), so half of it matters.

    Returns
    -------
    float or None, list of str
        The delay [s], None where it cannot be told, and what is worth saying.

    Raises
    ------
    RecordingError
        If the delay differs by more than `TOLERANCE` and explains a tenth of the residual.
    """
    recording = max(recordings, key=lambda each: each.samples)
    g = modelfit.regressors(recording, loop)
    block = settling(cutoff_of(loop), g.bank.n, 1.0 / loop.sample_rate)
    which = np.arange(g.bank.n)
    fitted = modelfit.fit(g.bank.names, g.eta, g.phi, g.ok, block)
    if fitted is None:
        return None, [UNTOLD]
    _, independent, _ = leftover.describe(recording, fitted.v, g.eta, fitted.used, block, leftover.period_of(recording))
    delay = alignment.estimate(recording, g, which, fitted, independent)
    if delay.samples is None or delay.seconds is None:
        return None, [UNTOLD]
    to_rad = 2.0 * np.pi * cutoff_of(loop)  # at the cutoff
    possible = max(delay.seconds, 0.0)
    if delay.gain < SIGNIFICANT or to_rad * abs(delay.seconds - loop.delay) < NOTED:
        return delay.seconds, []
    if to_rad * abs(possible - loop.delay) < NOTED:
        early = (
            f"{recording.name}: y seems to answer u {-delay.seconds * 1e3:.3g} ms before it comes: channels are out "
            "of step, or the plant is too simple"
        )
        return delay.seconds, [early]
    told = (
        f"{recording.name}: y answers u {delay.seconds * 1e3:.3g} ms late, the loop file says delay = {loop.delay:g}: "
        f"set delay = {possible:.4g} or align the channels"
    )
    if to_rad * abs(possible - loop.delay) > TOLERANCE:
        raise RecordingError(told)
    return delay.seconds, [told]
