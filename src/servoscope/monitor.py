"""The corridor: a Baseline turned into init / run / step, and into the diagnosis of a whole recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from servoscope.baseline import Baseline
from servoscope.detection import statistic
from servoscope.diagnosis import UNKNOWN, Diagnosis, Trace, Warning
from servoscope.errors import BaselineError, RecordingError
from servoscope.examination import Compared, Examination, trace_of
from servoscope.pipeline import Estimates, Pipeline
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.twostage import Stage
from servoscope.verdict import judge

if TYPE_CHECKING:
    from servoscope.recursion import Constants, Layout

DOUBTFUL = 0.05  # probability of an unknown change, from which an operating point does not explain a recording


def diagnose(baseline: Baseline, recording: Recording, *, point: str | None = None) -> Diagnosis:
    """Say whether the actuator was healthy; if not, what changed, by how much, since when, and how sure that is.

    Parameters
    ----------
    baseline
        What healthy looks like.
    recording
        The recording to judge.
    point
        Operating point that it was taken at. Without it, a recording is healthy if it is so at one point of the
        baseline. A change is explained at the point where the recording stays healthy for longest; among points
        within one memory of that, where a known fault explains it, and then where it is smallest. Other points that
        explain it too are told in a warning.

    Raises
    ------
    RecordingError
        If the recording's sample rate is not the loop's.
    BaselineError
        If the baseline has no such point.
    """
    return examine(baseline, recording, point=point)[0]


def examine(
    baseline: Baseline,
    recording: Recording,
    progress: Callable[[str], None] = lambda _: None,
    *,
    point: str | None = None,
) -> tuple[Diagnosis, Trace]:
    """Return the diagnosis of a recording together with its trace; arguments and errors as for `diagnose`."""
    examined = [Examination.of(one, recording) for one in (baseline.each if point is None else (baseline.at(point),))]
    last = max(_healthy_until(x) for x in examined)
    near = last - baseline.loop.monitor.memory if np.isfinite(last) else last
    rivals = sorted((x for x in examined if _healthy_until(x) >= near), key=_excess)
    if np.isinf(last):
        return judge(rivals[0], progress)
    judged = sorted((judge(x, progress) for x in rivals), key=lambda found: _size(found[0]))
    (said, trace), others = judged[0], [other for other, _ in judged[1:] if _explained(other)]
    t = recording.t
    doubts = [
        Warning(kind="point", from_s=float(t[0]), to_s=float(t[-1]), count=1, message=f"or else: {other.summary}")
        for other in others
    ]
    return said.model_copy(update={"warnings": (*said.warnings, *doubts)}), trace


def _healthy_until(x: Examination) -> float:
    alarms = np.flatnonzero(x.alarm)
    return float(x.t[alarms[0]]) if alarms.size else np.inf


def _excess(x: Examination) -> float:
    """Return the largest statistic of both tests, as a multiple of its limit."""
    return float(np.maximum(x.statistic / x.baseline.limit, x.estimates.level)[x.ready].max(initial=0.0))


def _size(said: Diagnosis) -> float:
    """Return how large the change is, relative; infinite where no known fault explains it."""
    if not _explained(said):
        return np.inf
    return max(fault.change for fault in said.candidates[0].faults)


def _explained(said: Diagnosis) -> bool:
    """Return whether known faults explain the change."""
    return all(c.probability < DOUBTFUL for c in said.candidates if c.name == UNKNOWN)


class Monitor:
    """Follows one asset, or a fleet of assets that share one loop, block by block or sample by sample.

    Its state is one plain array, shape (size,) for one asset and (assets, size) for a fleet: saving it is copying it,
    resuming is bit-identical, and splitting the samples into blocks anywhere changes nothing. The state of a valve law
    and that of stage 1 stand before that of stage 2.

    Parameters
    ----------
    baseline
        One baseline, or one per asset.
    share_budget
        Whether the assets of a fleet share the budget of false alarms, which is then divided among them; otherwise
        each of them has it for itself.

    Raises
    ------
    BaselineError
        If the baselines do not share one loop, or one of them has several operating points.
    """

    def __init__(self, baseline: Baseline | Sequence[Baseline], *, share_budget: bool = False) -> None:
        from servoscope.recursion import Layout, block

        self.baselines = (baseline,) if isinstance(baseline, Baseline) else tuple(baseline)
        self.fleet = not isinstance(baseline, Baseline)
        for each in self.baselines:
            if each.others:
                raise BaselineError(
                    f"a monitor follows one operating point, this baseline has {', '.join(each.points)}: give "
                    f"baseline.at({each.points[0]!r})"
                )
        if share_budget:
            self.baselines = tuple(each.shared(len(self.baselines)) for each in self.baselines)
        if not self.baselines:
            raise BaselineError("a monitor needs at least one baseline")
        if len({each.loop.hash() for each in self.baselines}) > 1:
            raise BaselineError("the baselines of one monitor must share one loop: make one monitor per loop")
        self.loop = self.baselines[0].loop
        self._pipelines = tuple(each.pipeline() for each in self.baselines)
        self.pipeline = self._pipelines[0]
        self.tunings = tuple(each.tuning for each in self.baselines)
        self._constants: tuple[Constants, ...] = tuple(
            pipeline.constants(each.tuning, each.watch(pipeline))
            for pipeline, each in zip(self._pipelines, self.baselines, strict=True)
        )
        self._layouts: tuple[Layout, ...] = tuple(Layout(c) for c in self._constants)
        self._size = max(layout.size for layout in self._layouts)  # models of the noise differ in length
        self._stages = tuple(Stage(self.loop, each.stage_one) for each in self.baselines)
        self._valve = self.pipeline.valve.size  # where the state of stage 1 begins,
        self._head = self._valve + self._stages[0].size  # and that of stage 2
        self._block = block(self.loop.monitor.estimator)
        self._one = np.empty((3, 1, 1))
        self._go_on = np.zeros((1, 1), dtype=np.bool_)
        self._row = np.empty((1, 1, self._layouts[0].row))

    def init(self) -> FloatArray:
        """Return the state before the first sample."""
        states = []
        for stage, layout, c in zip(self._stages, self._layouts, self._constants, strict=True):
            own = layout.start(c, 1)[0]
            rest = np.zeros(self._size - len(own))
            states.append(np.concatenate([self.pipeline.valve.start(), stage.start(), own, rest]))
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
        out = np.empty((shape[0], count, self._layouts[0].row))
        for i, c in enumerate(self._constants):
            one = slice(i, i + 1)
            r, u, y = (signal[one] for signal in signals)
            u = self._lead(i, rows[i], r[0], u[0], y[0], flags[i])[None, :]
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
            one[1] = self._lead(0, state, one[0, 0], one[1, 0], one[2, 0], self._go_on[0])
        return self._block(self._constants[0], state[None, head:], one[0], one[1], one[2], self._go_on, self._row) == 1

    def _lead(
        self, asset: int, state: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, restart: npt.NDArray[np.bool_]
    ) -> FloatArray:
        """Return what takes the place of u, behind the valve law and stage 1, and change their states in place."""
        flow = self.pipeline.valve.run(state[: self._valve], u, y, restart)
        return self._stages[asset].run(state[self._valve : self._head], r, flow, restart)

    def latest(self, state: FloatArray) -> Trace:
        """Return the trace of this moment, one evaluation, from a state."""
        from servoscope.recursion import CROSSED, PEAK, POWER, SAMPLE, UPDATES

        rows = (state if self.fleet else state[None, :])[:, self._head :]
        out = []
        for row, layout in zip(rows, self._layouts, strict=True):
            at = layout.slices
            counted = row[UPDATES : POWER + 1], row[PEAK : CROSSED + 1]
            out.append(np.concatenate([*counted, row[at["theta"]], row[at["S"]], row[at["Psi"]]]))
        return self._trace(np.array(out)[:, None, :], np.array([int(rows[0, SAMPLE]) - 1]))

    @property
    def _shape(self) -> tuple[int, ...]:
        size = self._head + self._size
        return (len(self.baselines), size) if self.fleet else (size,)

    def _trace(self, out: FloatArray, index: npt.NDArray[np.int64]) -> Trace:
        t = index / self.loop.sample_rate
        traces = [
            _compared(baseline, pipeline, pipeline.unpack(tuning, rows, index), t)
            for baseline, pipeline, tuning, rows in zip(self.baselines, self._pipelines, self.tunings, out, strict=True)
        ]
        return Trace.stacked(traces) if self.fleet else traces[0]


def _compared(baseline: Baseline, pipeline: Pipeline, e: Estimates, t: FloatArray) -> Trace:
    """Compare with the healthy coefficients of the baseline; their bias under its references is taken out of both."""
    covariance = e.S + baseline.cov()
    theta = np.array(baseline.theta)
    expected = np.broadcast_to(theta, e.theta.shape)
    T2 = statistic(e.theta, expected, covariance)
    bias = baseline.bias
    return trace_of(baseline, pipeline, e, t, Compared(e.theta - bias, covariance, expected - bias, baseline.cov(), T2))
