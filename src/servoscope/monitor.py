"""The corridor: a Baseline turned into init / run / step, and into the diagnosis of a whole recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from servoscope import ifrf
from servoscope.baseline import Baseline
from servoscope.detection import statistic
from servoscope.diagnosis import Diagnosis, Trace
from servoscope.errors import BaselineError, RecordingError
from servoscope.examination import Examination
from servoscope.pipeline import Estimates
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.twostage import Stage

if TYPE_CHECKING:
    from servoscope.recursion import Constants, Layout


def diagnose(baseline: Baseline, recording: Recording) -> Diagnosis:
    """Say whether the actuator was healthy; if not, what changed, by how much, since when, and how sure that is.

    Parameters
    ----------
    baseline
        What healthy looks like.
    recording
        The recording to judge.

    Raises
    ------
    RecordingError
        If the recording's sample rate is not the loop's.
    """
    return examine(baseline, recording)[0]


def examine(
    baseline: Baseline, recording: Recording, progress: Callable[[str], None] = lambda _: None
) -> tuple[Diagnosis, Trace]:
    """Return the diagnosis of a recording together with its trace; arguments and errors as for `diagnose`."""
    examination = Examination.of(baseline, recording)
    return examination.diagnosis(progress), examination.trace


class Monitor:
    """Follows one asset, or a fleet of assets that share one loop, block by block or sample by sample.

    Its state is one plain array, shape (size,) for one asset and (assets, size) for a fleet: saving it is copying it,
    resuming is bit-identical, and splitting the samples into blocks anywhere changes nothing. With two stages, that of
    stage 1 stands before that of stage 2.

    Parameters
    ----------
    baseline
        One baseline, or one per asset.

    Raises
    ------
    BaselineError
        If the baselines do not share one loop.
    """

    def __init__(self, baseline: Baseline | Sequence[Baseline]) -> None:
        from servoscope.recursion import Layout, block

        self.baselines = (baseline,) if isinstance(baseline, Baseline) else tuple(baseline)
        self.fleet = not isinstance(baseline, Baseline)
        if not self.baselines:
            raise BaselineError("a monitor needs at least one baseline")
        if len({each.loop.hash() for each in self.baselines}) > 1:
            raise BaselineError("the baselines of one monitor must share one loop: make one monitor per loop")
        self.loop = self.baselines[0].loop
        self.pipeline = self.baselines[0].pipeline()
        self.tunings = tuple(each.tuning for each in self.baselines)
        self._constants: tuple[Constants, ...] = tuple(self.pipeline.constants(t) for t in self.tunings)
        self._layout: Layout = Layout(self._constants[0])
        self._stages = tuple(Stage(self.loop, each.stage_one) for each in self.baselines)
        self._head = self._stages[0].size  # where the state of stage 2 begins
        self._block = block(self.loop.monitor.estimator)
        self._one = np.empty((3, 1, 1))
        self._go_on = np.zeros((1, 1), dtype=np.bool_)
        self._row = np.empty((1, 1, self._layout.row))

    def init(self) -> FloatArray:
        """Return the state before the first sample."""
        states = [
            np.concatenate([stage.start(), self._layout.start(c, 1)[0]])
            for stage, c in zip(self._stages, self._constants, strict=True)
        ]
        return np.array(states) if self.fleet else states[0]

    def run(
        self,
        state: FloatArray,
        r: npt.ArrayLike,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        restart: npt.ArrayLike | None = None,
    ) -> tuple[FloatArray, Trace]:
        """Feed a block of samples of any length.

        Parameters
        ----------
        state
            As returned by `init` or an earlier `run`; it stays valid.
        r, u, y
            Shape (N,), or (assets, N) for a fleet. A NaN anywhere in a sample is a gap: the estimate is held.
        restart
            True where a sample does not follow its predecessor by one sample time; same shape.

        Returns
        -------
        numpy.ndarray, Trace
            The new state, and the evaluations that fell into the block, shape (K, ...) or (assets, K, ...).

        Raises
        ------
        RecordingError
            If the shapes do not fit together.
        """
        from servoscope.recursion import SAMPLE

        signals = [np.atleast_2d(np.ascontiguousarray(signal, dtype=np.float64)) for signal in (r, u, y)]
        shape = (len(self.baselines), signals[0].shape[1])
        if any(signal.shape != shape for signal in signals) or state.shape != self._shape:
            raise RecordingError(
                f"r, u, y must have the same shape ({'assets, N' if self.fleet else 'N,'}) for {shape[0]} asset(s), "
                "and the state must come from this monitor's init or run"
            )
        flags = np.zeros(shape, dtype=np.bool_)
        if restart is not None:
            flags = np.atleast_2d(np.ascontiguousarray(restart, dtype=np.bool_))
        if flags.shape != shape:
            raise RecordingError("restart must have the shape of r")
        new = np.array(state, dtype=np.float64, copy=True)
        rows = new if self.fleet else new[None, :]
        sample = int(rows[0, self._head + SAMPLE])
        every = self.pipeline.every
        count = (sample + shape[1]) // every - sample // every
        out = np.empty((shape[0], count, self._layout.row))
        for i, c in enumerate(self._constants):
            one = slice(i, i + 1)
            r, u, y = (signal[one] for signal in signals)
            u = self._stages[i].run(rows[i, : self._head], r[0], u[0], flags[i])[None, :]
            self._block(c, rows[one, self._head :], r, u, y, flags[one], out[one])
        index = (sample // every + 1 + np.arange(count)) * every - 1
        return new, self._trace(out, index)

    def step(self, state: FloatArray, r: float, u: float, y: float) -> bool:
        """Feed one sample of one asset, in place; return whether a new evaluation stands in the state.

        Read it with `latest`. NaN in any of the three is a gap.
        """
        if state.shape != self._shape or self.fleet:
            raise RecordingError("step follows one asset: give the state of a monitor with one baseline, or use run")
        self._one[0, 0, 0], self._one[1, 0, 0], self._one[2, 0, 0] = r, u, y
        one, head = self._one, self._head
        if head:
            one[1] = self._stages[0].run(state[:head], one[0, 0], one[1, 0], self._go_on[0])
        return self._block(self._constants[0], state[None, head:], one[0], one[1], one[2], self._go_on, self._row) == 1

    def latest(self, state: FloatArray) -> Trace:
        """Return the trace of this moment, one evaluation, from a state."""
        from servoscope.recursion import POWER, SAMPLE, UPDATES

        rows = (state if self.fleet else state[None, :])[:, self._head :]
        at = self._layout.slices
        out = np.concatenate(
            [rows[:, UPDATES : POWER + 1], rows[:, at["theta"]], rows[:, at["S"]], rows[:, at["Psi"]]], axis=1
        )
        return self._trace(out[:, None, :], np.array([int(rows[0, SAMPLE]) - 1]))

    @property
    def _shape(self) -> tuple[int, ...]:
        size = self._head + self._layout.size
        return (len(self.baselines), size) if self.fleet else (size,)

    def _trace(self, out: FloatArray, index: npt.NDArray[np.int64]) -> Trace:
        parts = [
            _watch(baseline, self.pipeline.unpack(tuning, rows, index))
            for baseline, tuning, rows in zip(self.baselines, self.tunings, out, strict=True)
        ]
        stacked = [np.array(column) if self.fleet else column[0] for column in zip(*parts, strict=True)]
        theta, covariance, expected, T2, ready = stacked
        respond = self.pipeline.bank, self.loop.monitor.frequencies
        limits = np.array([[baseline.limit] for baseline in self.baselines])
        return Trace(
            t=index / self.loop.sample_rate,
            names=self.pipeline.bank.names,
            theta=theta,
            covariance=covariance,
            expected=expected,
            statistic=T2,
            threshold=limits if self.fleet else float(limits[0, 0]),
            ifrf=ifrf.response(*respond, theta, covariance),
            ifrf_expected=ifrf.response(*respond, expected, 0.0 * covariance),
            ready=ready.astype(np.bool_),
        )


def _watch(baseline: Baseline, e: Estimates) -> tuple[npt.NDArray[Any], ...]:
    covariance = e.S + baseline.cov()
    expected = np.broadcast_to(np.array(baseline.theta), e.theta.shape)
    ready = e.updates > 0
    T2 = np.where(ready, statistic(e.theta, expected, covariance), 0.0)
    return e.theta, covariance, expected, T2, ready
