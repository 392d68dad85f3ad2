"""Whether u and y are in step: the delay that the recordings show, against the one that the loop file gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoscope.core.errors import RecordingError
from servoscope.core.messages import Message, message
from servoscope.estimation.reference_period import reference_period
from servoscope.learning.inspection import delay as alignment
from servoscope.learning.inspection import model_order, residual, rules
from servoscope.learning.inspection.delay_fit import DelayFit, fit_delay
from servoscope.models.loop import Loop
from servoscope.models.lti import settling_samples
from servoscope.signals import Recording

TOLERANCE = 0.3  # rad at the filter's cutoff, beyond which a recording is refused: half a sample at f_s = 10 cutoff
MIN_PHASE_NOTED = 0.06  # rad; an inverse that is too simple moves the estimate a little, so this is only said
# rad; a delay whose standard deviation is larger is not told: setting it might be as wrong as TOLERANCE
MAX_PHASE_STD = 0.1
NORMAL_95 = 1.96  # standard deviations, half of a 95 % interval
DELAY_FORMAT = ".4g"  # how a delay is written into the loop file, as the message has it


def check_delay(
    loop: Loop, recordings: Sequence[Recording], accept: bool = False
) -> tuple[float | None, list[Message]]:
    """Estimate the delay from the longest recording; refuse one that is out of step with the loop file.

    One sample at 100 Hz that the model does not know costs 63 % at 10 Hz, so half of it matters.
    Only the likelihood of y can refuse: least squares with noise in its regressors dates y late, by a sample or more
    under smooth motion. Where the likelihood cannot be written down, as with friction, nothing is refused; nor where
    it tells that there is a delay, but not closely enough to set it.

    The delay is None where the recordings do not show it; the messages are warnings. `accept` turns a refusal into one.
    """
    recording = max(recordings, key=lambda candidate: candidate.samples)
    g = model_order.form_regressors(recording, loop)
    to_rad = 2.0 * np.pi * loop.cutoff  # at the cutoff
    regression = _regression_delay(loop, recording, g)
    seconds = regression.seconds if regression is not None and regression.gain >= rules.DELAY_GAIN else None
    if seconds is not None and loop.delay == 0.0 and -to_rad * seconds >= MIN_PHASE_NOTED:
        return seconds, [message("learning.y_early", recording=recording.name, early_ms=-seconds * 1e3)]
    fit = fit_delay(loop, recording, g)
    if fit is None or not fit.white:
        return _unverified(loop, recording, regression, to_rad)
    if to_rad * fit.std_s > MAX_PHASE_STD:
        return None, [_delay_rough(loop, recording, fit) if fit.significant else message("learning.delay_unknown")]
    off = to_rad * abs(fit.seconds - loop.delay)
    if off < MIN_PHASE_NOTED or not fit.significant:
        return fit.seconds, []
    return fit.seconds, [_out_of_step(loop, recording, fit, off > TOLERANCE and not accept)]


def _delay_rough(loop: Loop, recording: Recording, fit: DelayFit) -> Message:
    """Return the warning about a delay that is certainly another one, without which one: no remedy can be given."""
    low, high = (1e3 * (fit.seconds + way * NORMAL_95 * fit.std_s) for way in (-1.0, 1.0))
    values = {"recording": recording.name, "configured_s": loop.delay, "low_ms": max(low, 0.0), "high_ms": high}
    return message("learning.delay_rough", **values)


def _out_of_step(loop: Loop, recording: Recording, fit: DelayFit, refuse: bool) -> Message:
    """Return the warning about a delay that is certain, or refuse the recording; the remedy was tried."""
    written = float(format(fit.seconds, DELAY_FORMAT))
    values = {"recording": recording.name, "late_ms": fit.seconds * 1e3, "configured_s": loop.delay}
    if not fit.improves(written):
        return message("learning.delay_unverified", **values)
    if refuse:
        raise RecordingError(str(message("learning.delay_refused", delay_s=written, **values)))
    return message("learning.delay_differs", delay_s=written, **values)


def _unverified(
    loop: Loop, recording: Recording, regression: alignment.Delay | None, to_rad: float
) -> tuple[float | None, list[Message]]:
    """Judge by the regression alone, which noise can fake: its delay counts where it is that of the loop file."""
    if regression is None or regression.seconds is None:
        return None, [message("learning.delay_unknown")]
    if to_rad * abs(regression.seconds - loop.delay) < MIN_PHASE_NOTED:
        return regression.seconds, []
    if regression.gain < rules.DELAY_GAIN:
        return None, []
    values = {"recording": recording.name, "late_ms": regression.seconds * 1e3, "configured_s": loop.delay}
    return None, [message("learning.delay_unverified", **values)]


def _regression_delay(loop: Loop, recording: Recording, g: model_order.Regressors) -> alignment.Delay | None:
    """Return the delay that leaves the least residual variance of the inverse; None without a regression."""
    block = settling_samples(loop.cutoff, g.bank.n, 1.0 / loop.sample_rate)
    fit = model_order.fit_regression(g.bank.names, g.eta, g.phi, g.ok, block)
    if fit is None:
        return None
    period = reference_period(recording)
    _, independent, _ = residual.analyse_residual(recording, fit.v, g.eta, fit.used, block, period)
    return alignment.estimate_delay(recording, g, np.arange(g.bank.n), fit, independent)
