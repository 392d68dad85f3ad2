"""The corridor: a Baseline turned into init / run / step, and into the diagnosis of a whole recording."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from servoscope.baseline import Baseline
from servoscope.diagnosis import UNKNOWN, Diagnosis, Trace, Warning
from servoscope.errors import BaselineError, RecordingError
from servoscope.examination import Examination
from servoscope.followed import Followed, clock
from servoscope.ifrf import Response
from servoscope.meaning import Meaning, trace
from servoscope.plants import FloatArray
from servoscope.recording import Recording
from servoscope.verdict import judge

if TYPE_CHECKING:
    from servoscope.recursion import Recursion

DOUBTFUL = 0.05  # probability of an unknown change, from which an operating point does not explain a recording


def diagnose(
    baseline: Baseline,
    recording: Recording,
    progress: Callable[[str], None] = lambda _: None,
    *,
    point: str | None = None,
) -> Diagnosis:
    """Say whether the actuator was healthy; if not, what changed, by how much, since when, and how sure that is.

    Parameters
    ----------
    baseline
        What healthy looks like.
    recording
        The recording to judge.
    progress
        Told what is being done.
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
    return _judged(baseline, recording, progress, point)[0]


def examine(
    baseline: Baseline,
    recording: Recording,
    progress: Callable[[str], None] = lambda _: None,
    *,
    point: str | None = None,
) -> tuple[Diagnosis, Trace]:
    """Return the diagnosis of a recording together with its trace; arguments and errors as for `diagnose`."""
    said, x, meant = _judged(baseline, recording, progress, point)
    return said, trace(x, meant)


def _judged(
    baseline: Baseline, recording: Recording, progress: Callable[[str], None], point: str | None
) -> tuple[Diagnosis, Examination, Meaning | None]:
    """Return the diagnosis, at the operating point that explains the recording, and what its trace is made of."""
    examined = [Examination.of(one, recording) for one in (baseline.each if point is None else (baseline.at(point),))]
    last = max(_healthy_until(x) for x in examined)
    near = last - baseline.loop.monitor.memory if np.isfinite(last) else last
    rivals = sorted((x for x in examined if _healthy_until(x) >= near), key=_excess)
    if np.isinf(last):
        said, meant = judge(rivals[0], progress)
        return said, rivals[0], meant
    judged = sorted(((*judge(x, progress), x) for x in rivals), key=lambda found: _size(found[0]))
    (said, meant, x), others = judged[0], [other for other, *_ in judged[1:] if _explained(other)]
    t = recording.t
    doubts = [
        Warning(kind="point", from_s=float(t[0]), to_s=float(t[-1]), count=1, message=f"or else: {other.summary}")
        for other in others
    ]
    return said.model_copy(update={"warnings": (*said.warnings, *doubts)}), x, meant


def _healthy_until(x: Examination) -> float:
    alarms = np.flatnonzero(x.alarm)
    return float(x.t(alarms[0])) if alarms.size else np.inf


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
    """Follows one asset, or a fleet of assets, block by block or sample by sample.

    Its state is one plain array, shape (size,) for one asset and (assets, size) for a fleet: saving it is copying it,
    resuming is bit-identical, and splitting the samples into blocks anywhere changes nothing. The state of a valve law
    and that of stage 1 stand before that of stage 2.

    Parameters
    ----------
    baseline
        One baseline, or one per asset. The assets of a fleet may differ in everything but sample rate, evaluation rate,
        coefficients and monitored frequencies; those of one structure are followed together.
    share_budget
        Whether the assets of a fleet share the budget of false alarms, which is then divided among them; otherwise
        each of them has it for itself.
    precision
        ``"single"`` follows a fleet about twice as fast; what that costs is in the documentation's page on speed.

    Raises
    ------
    BaselineError
        If the baselines cannot be followed together, or one of them has several operating points.
    """

    def __init__(
        self,
        baseline: Baseline | Sequence[Baseline],
        *,
        share_budget: bool = False,
        precision: Literal["double", "single"] = "double",
    ) -> None:
        self.baselines = (baseline,) if isinstance(baseline, Baseline) else tuple(baseline)
        self.fleet = not isinstance(baseline, Baseline)
        kinds = {id(each): each for each in self.baselines}
        for each in kinds.values():
            if each.others:
                raise BaselineError(
                    f"a monitor follows one operating point, this baseline has {', '.join(each.points)}: give "
                    f"baseline.at({each.points[0]!r})"
                )
        if not self.baselines:
            raise BaselineError("a monitor needs at least one baseline")
        if share_budget:
            shared = {key: each.shared(len(self.baselines)) for key, each in kinds.items()}
            self.baselines = tuple(shared[id(each)] for each in self.baselines)
            kinds = {id(each): each for each in self.baselines}
        if len({clock(each) for each in kinds.values()}) > 1:
            raise BaselineError(
                "the baselines of one monitor must share sample rate, evaluation rate, coefficients and frequencies: "
                "make one monitor for each kind of loop"
            )
        self.loop = self.baselines[0].loop
        followed = {key: Followed.of(each) for key, each in kinds.items()}
        self._followed = tuple(followed[id(each)] for each in self.baselines)
        self.pipeline = self._followed[0].pipeline
        self._narrow = precision == "single"
        self._groups = self._grouped()
        healthy = [each.healthy for each in self._followed]
        self._of_baselines = {
            "expected": _once([each.origin for each in self._followed]),
            "H": _once([each.H for each in healthy]),
            "covariance of H": _once([each.covariance for each in healthy]),
        }
        self._limits = np.array([each.limit for each in self.baselines])[:, None]
        self._head = max(each.head for each in self._followed)  # where the state of stage 2 begins
        self._size = self._head + max(recursion.size for _, recursion in self._groups)
        self._step: Callable[[FloatArray, FloatArray, float, float, float], bool] | None = None
        self._constants = np.zeros(0)

    def _grouped(self) -> list[tuple[npt.NDArray[np.intp], Recursion]]:
        """Return which assets go through the recursion together."""
        from servoscope.recursion import Recursion, structure

        keys = {id(each): structure(each.constants) for each in self._followed}
        members: dict[Hashable, list[int]] = {}
        for i, each in enumerate(self._followed):
            members.setdefault(keys[id(each)], []).append(i)
        return [
            (np.array(assets), Recursion([self._followed[i].constants for i in assets], single=self._narrow))
            for assets in members.values()
        ]

    def init(self) -> FloatArray:
        """Return the state before the first sample."""
        states = np.zeros((len(self.baselines), self._size))
        for assets, recursion in self._groups:
            states[assets, self._head : self._head + recursion.size] = recursion.start()
        if self._head:
            for row, each in zip(states, self._followed, strict=True):
                row[: each.head] = np.concatenate([each.pipeline.valve.start(), each.stage.start()])
        return states if self.fleet else states[0]

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
        number = np.float32 if self._narrow else np.float64
        signals = [np.atleast_2d(np.ascontiguousarray(signal, dtype=number)) for signal in (r, u, y)]
        shape = (len(self.baselines), signals[0].shape[1])
        if any(signal.shape != shape for signal in signals) or state.shape != self._shape:
            raise RecordingError(
                f"r, u, y must have the same shape ({'assets, N' if self.fleet else 'N,'}) for {shape[0]} asset(s), "
                "and the state must come from this monitor's init or run"
            )
        flags = None
        if restart is not None:
            flags = np.atleast_2d(np.ascontiguousarray(restart, dtype=np.bool_))
            if flags.shape != shape:
                raise RecordingError("restart must have the shape of r")
        rows = np.ascontiguousarray(np.atleast_2d(state), dtype=np.float64)
        if self._head:
            rows = rows.copy()
            gaps = np.zeros(shape, dtype=np.bool_) if flags is None else flags
            signals[1] = self._led(rows, signals[0], signals[1], signals[2], gaps)
        if len(self._groups) == 1 and not self._head:
            ((_, recursion),) = self._groups
            index = recursion.rows(rows, shape[1])
            new, out = recursion.run(rows, signals[0], signals[1], signals[2], flags)
        else:
            new, out, index = self._apart(rows, signals, flags)
        return new if self.fleet else new[0], self._trace(out, index)

    def _apart(
        self, rows: FloatArray, signals: list[npt.NDArray[Any]], flags: npt.NDArray[np.bool_] | None
    ) -> tuple[FloatArray, npt.NDArray[Any], npt.NDArray[np.int64]]:
        """Run each group for itself."""
        new, outs = rows.copy(), []
        for assets, recursion in self._groups:
            part = slice(self._head, self._head + recursion.size)
            own = np.ascontiguousarray(rows[assets, part])
            index = recursion.rows(own, signals[0].shape[1])
            r, u, y = (signal[assets] for signal in signals)
            new[assets, part], out = recursion.run(own, r, u, y, None if flags is None else flags[assets])
            outs.append(out)
        together = np.empty((len(rows), *outs[0].shape[1:]), dtype=outs[0].dtype)
        for (assets, _), out in zip(self._groups, outs, strict=True):
            together[assets] = out
        return new, together, index

    def step(self, state: FloatArray, r: float, u: float, y: float) -> bool:
        """Feed one sample of one asset, in place; return whether a new evaluation stands in the state.

        Read it with `latest`. NaN in any of the three is a gap.
        """
        if self._step is None or len(state) != self._size or state.ndim != 1:
            self._prepare(state)
        if self._head:
            one = np.array([[r], [u], [y]])
            u = float(self._led(state[None, :], one[:1], one[1:2], one[2:], np.zeros((1, 1), dtype=np.bool_))[0, 0])
            state = state[self._head :]
        return self._step(self._constants, state, r, u, y)  # type: ignore[misc]  # it is prepared now

    def _prepare(self, state: FloatArray) -> None:
        if state.shape != self._shape or self.fleet or self._narrow:
            raise RecordingError("step follows one asset: give the state of a monitor with one baseline, or use run")
        self._step, self._constants = self._groups[0][1].stepper

    def _led(
        self,
        rows: FloatArray,
        r: npt.NDArray[Any],
        u: npt.NDArray[Any],
        y: npt.NDArray[Any],
        flags: npt.NDArray[np.bool_],
    ) -> npt.NDArray[Any]:
        """Return what takes the place of u, behind valve law and stage 1, and change their states in place."""
        led = np.empty_like(u)
        for i, each in enumerate(self._followed):
            valve = each.pipeline.valve
            flow = valve.run(rows[i, : valve.size], u[i], y[i], flags[i])
            led[i] = each.stage.run(rows[i, valve.size : each.head], r[i], flow, flags[i])
        return led

    def latest(self, state: FloatArray) -> Trace:
        """Return the trace of this moment, one evaluation, from a state."""
        from servoscope.chain import SAMPLE

        rows = np.atleast_2d(state)[:, self._head :]
        out = np.empty((len(rows), self._groups[0][1].sizes.row))
        for assets, recursion in self._groups:
            out[assets] = recursion.look(rows[assets, : recursion.size])
        return self._trace(out[:, None, :], np.array([int(rows[0, SAMPLE]) - 1]))

    @property
    def _shape(self) -> tuple[int, ...]:
        return (len(self.baselines), self._size) if self.fleet else (self._size,)

    def _trace(self, out: npt.NDArray[Any], index: npt.NDArray[np.int64]) -> Trace:
        """Name what stands in complete evaluations (assets, K, row)."""
        n, f = len(self._followed[0].origin), np.asarray(self.loop.monitor.frequencies, dtype=np.float64)
        shape = out.shape[:2]
        H = out[..., 4 + n + n * n :].reshape(*shape, len(f), 6)
        seen = H[..., :2].view(np.result_type(out, np.complex64))[..., 0], H[..., 2:].reshape(*shape, len(f), 2, 2)
        columns: dict[str, Any] = {
            "theta": out[..., 4 : 4 + n],
            "covariance": out[..., 4 + n : 4 + n + n * n].reshape(*shape, n, n),
            "statistic": out[..., 1],
            "level": out[..., 2],
            "crossed": out[..., 3],
            "ready": _begun(out[..., 0]),
        }
        for name, values in self._of_baselines.items():
            columns[name] = np.broadcast_to(values[:, None], (*shape, *values.shape[1:]))
        threshold: Any = self._limits
        if not self.fleet:
            columns = {name: values[0] for name, values in columns.items()}
            seen, threshold = (seen[0][0], seen[1][0]), self.baselines[0].limit
        expected = Response(f, columns.pop("H"), columns.pop("covariance of H"))
        return Trace(
            t=index / self.loop.sample_rate,
            names=self.pipeline.bank.names,
            threshold=threshold,
            ifrf=Response(f, *seen),
            ifrf_expected=expected,
            **columns,
        )


def _begun(updates: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return where there is an estimate; as updates never become fewer, the first column mostly says it."""
    if updates.size and (updates[:, 0] > 0.0).all():
        return np.broadcast_to(np.True_, updates.shape)
    return updates > 0.0


def _once(values: Sequence[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Return arrays as one, or that which all of them are, with a first axis of length one."""
    return np.array(values if len({id(value) for value in values}) > 1 else values[:1])
