"""The monitor of running loops: init / run / step, for one asset or a fleet."""

from __future__ import annotations

import copy
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from servoscope.baseline.baseline import Baseline
from servoscope.core.arrays import FloatArray
from servoscope.core.errors import BaselineError, RecordingError
from servoscope.detection.covariate_monitor import CovariateHistory
from servoscope.detection.trace import Trace
from servoscope.diagnosis.monitor_constants import MonitorConstants, compatibility_key, deduplicate
from servoscope.diagnosis.side_monitors import SideLanes, SideValues
from servoscope.estimation.frequency_response import FrequencyResponse
from servoscope.estimation.kernel.sample_steps import SAMPLE
from servoscope.estimation.recursion import Recursion, structure_key


class Monitor:
    """Follows one asset, or a fleet of assets, block by block or sample by sample.

    Its state is one plain array, shape (size,) for one asset and (assets, size) for a fleet: it is saved by copying it,
    resuming is bit-identical, and splitting the samples into blocks anywhere changes nothing. The states of a valve law
    and of stage 1 precede that of stage 2, that of the features follows it. Recursions of a fleet go side by side, by
    vector instructions; its assets cut windows for their features one after the other, each where its own end.

    Parameters
    ----------
    baseline
        One baseline or its path, or one per asset. The assets of a fleet may differ in everything but sample rate,
        evaluation rate, coefficients and monitored frequencies; those of one structure are followed together.
    share_budget
        Whether the budget of false alarms is divided among the assets of a fleet; otherwise each asset has all of it.
    precision
        ``"single"`` follows a fleet about twice as fast; the documentation's page on speed says what that costs.
    motion_check
        Whether a motion that the baseline never saw makes an alarm harder, as in `diagnose`: T^2 takes the model for as
        wrong as it may be there, and the sequential test is silent. A `step` then takes a fifth of a millisecond, and
        the assets of a fleet go one after the other there. Where the model holds under any motion nothing changes.

    Raises
    ------
    BaselineError
        If the baselines cannot be followed together, or one of them has several operating points; if the motion is to
        be checked by a baseline that holds none.

    Examples
    --------
    >>> monitor = Monitor("baseline.json")
    >>> friday = ss.read("friday.csv", "loop.toml")
    >>> state, trace = monitor.run(monitor.init(), friday.r, friday.u, friday.y)
    >>> print(f"changed at {trace.t[trace.exceeded][0]:.0f} s")
    changed at 41 s
    """

    def __init__(
        self,
        baseline: Baseline | str | Path | Sequence[Baseline | str | Path],
        *,
        share_budget: bool = False,
        precision: Literal["double", "single"] = "double",
        motion_check: bool = False,
    ) -> None:
        self.fleet = not isinstance(baseline, Baseline | str | Path)
        several: Any = baseline if self.fleet else (baseline,)
        self.baselines = tuple(Baseline.of(source) for source in several)
        if not self.baselines:
            raise BaselineError("a monitor needs at least one baseline")
        distinct = {id(baseline): baseline for baseline in self.baselines}
        for checked in distinct.values():
            if checked.others:
                raise BaselineError(
                    f"a monitor follows one operating point, this baseline has {', '.join(checked.points)}: give "
                    f"baseline.at({checked.points[0]!r})"
                )
        if share_budget:
            shared = {key: baseline.shared(len(self.baselines)) for key, baseline in distinct.items()}
            self.baselines = tuple(shared[id(baseline)] for baseline in self.baselines)
            distinct = {id(baseline): baseline for baseline in self.baselines}
        if len({compatibility_key(baseline) for baseline in distinct.values()}) > 1:
            raise BaselineError(
                "the baselines of one monitor must share sample rate, evaluation rate, coefficients and frequencies: "
                "make one monitor for each kind of loop"
            )
        constants = {key: MonitorConstants.from_baseline(baseline) for key, baseline in distinct.items()}
        self._single_precision = precision == "single"
        self._assemble([constants[id(baseline)] for baseline in self.baselines])
        if motion_check:
            for own in constants.values():
                own.side.check_motion()
            self._size = self._side_at + self._sides.size

    def _assemble(self, constants: Sequence[MonitorConstants]) -> None:
        """Take the constants of each asset."""
        self.loop = self.baselines[0].loop
        self._constants_of = tuple(constants)
        self.pipeline = self._constants_of[0].pipeline
        self._groups = self._group_assets()
        self._shared_columns = {
            "expected": deduplicate([constants.expected_theta for constants in self._constants_of]),
            "H": deduplicate([constants.healthy.H for constants in self._constants_of]),
            "covariance of H": deduplicate([constants.healthy.covariance for constants in self._constants_of]),
        }
        self._limits = np.array([baseline.thresholds.statistic for baseline in self.baselines])[:, None]
        self._prefix_size = max(
            constants.pipeline.ahead.size for constants in self._constants_of
        )  # where the state of stage 2 begins
        self._side_at = self._prefix_size + max(recursion.size for _, recursion in self._groups)
        self._sides = SideLanes([constants.side for constants in self._constants_of], self._side_at)
        self._size = self._side_at + self._sides.size
        self._step: Callable[[FloatArray, float, float, float], bool] | None = None

    @classmethod
    def join(cls, monitors: Sequence[Monitor]) -> Self:
        """Return a fleet of assets that have these monitors, of one `lane_key`; they share what was computed for them.

        A row of its state is a state of the asset's own monitor, bit by bit.
        """
        # of one alone, the recursion would not run in lanes
        monitors = [*monitors, *monitors][: max(2, len(monitors))]
        fleet = cls.__new__(cls)
        fleet.baselines, fleet.fleet = tuple(monitor.baselines[0] for monitor in monitors), True
        fleet._single_precision = False
        fleet._assemble([monitor._constants_of[0] for monitor in monitors])
        return fleet

    def select(self, assets: npt.NDArray[np.intp]) -> Self:
        """Return a fleet of some assets of this one, which has been made by `join`, in this order."""
        ((_, recursion),) = self._groups
        part = copy.copy(self)
        part.baselines = tuple(map(self.baselines.__getitem__, assets.tolist()))
        part._groups = [(np.arange(len(assets)), recursion.select(assets))]
        part._shared_columns = {
            name: values if len(values) == 1 else values[assets] for name, values in self._shared_columns.items()
        }
        part._limits = self._limits[assets]
        part._sides = self._sides.select(assets)
        return part

    @property
    def lane_key(self) -> Hashable | None:
        """What assets must have in common to be followed side by side by `join`; None: this one cannot be.

        Valve laws and stage 1 run one asset after the other, and covariates move what an estimate begins with.
        """
        ((_, recursion), *others) = self._groups
        if self.fleet or not self._sides.first.is_joinable or others or self._prefix_size or not recursion.has_lanes:
            return None
        return recursion.layout, self._size, *compatibility_key(self.baselines[0])

    def phase(self, state: FloatArray) -> npt.NDArray[np.int64]:
        """Return where between two evaluations each asset is, shape (assets,): those of one phase go together."""
        return self._groups[0][1].phase(np.atleast_2d(state)[:, self._prefix_size + SAMPLE])

    def _group_assets(self) -> list[tuple[npt.NDArray[np.intp], Recursion]]:
        """Return the assets of each structure, which go through one recursion together."""
        keys = {id(constants): structure_key(constants.constants) for constants in self._constants_of}
        members: dict[Hashable, list[int]] = {}
        for i, monitor_constants in enumerate(self._constants_of):
            members.setdefault(keys[id(monitor_constants)], []).append(i)
        constants = [constants.constants for constants in self._constants_of]
        return [
            (np.array(assets), Recursion([constants[i] for i in assets], single=self._single_precision))
            for assets in members.values()
        ]

    def init(self) -> FloatArray:
        """Return the state before the first sample."""
        states = np.zeros((len(self.baselines), self._size))
        for assets, recursion in self._groups:
            states[assets, self._prefix_size : self._prefix_size + recursion.size] = recursion.start()
        if self._prefix_size:
            for row, constants in zip(states, self._constants_of, strict=True):
                row[: constants.pipeline.ahead.size] = constants.pipeline.ahead.start()
        self._sides.start(states)
        return states if self.fleet else states[0]

    def run(
        self,
        state: FloatArray,
        r: npt.ArrayLike,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        restart: npt.ArrayLike | None = None,
        *,
        channels: Mapping[str, npt.ArrayLike] | None = None,
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
        channels
            Covariates by name, of the shape of r each, where a baseline has some. Of NaN, the value before holds, for
            `covariate_hold_s` at most; nothing is estimated before the first value or after that, and none is ready
            outside of the range that was learned.

        Returns
        -------
        numpy.ndarray, Trace
            The new state, and the evaluations that fell into the block, shape (K, ...) or (assets, K, ...).

        Raises
        ------
        RecordingError
            If the shapes do not fit together, or a covariate is missing.
        """
        new, trace = self.run_lanes(state if self.fleet else state[None], r, u, y, restart, channels=channels)
        return (new, trace) if self.fleet else (new[0], trace.lane(0))

    def run_lanes(
        self,
        states: FloatArray,
        r: npt.ArrayLike,
        u: npt.ArrayLike,
        y: npt.ArrayLike,
        restart: npt.ArrayLike | None = None,
        *,
        channels: Mapping[str, npt.ArrayLike] | None = None,
    ) -> tuple[FloatArray, Trace]:
        """Feed a block as `run` does; all shapes begin with the assets, even of one."""
        number = np.float32 if self._single_precision else np.float64
        signals = [np.atleast_2d(np.ascontiguousarray(signal, dtype=number)) for signal in (r, u, y)]
        shape = (len(self.baselines), signals[0].shape[1])
        if any(signal.shape != shape for signal in signals) or states.shape != (shape[0], self._size):
            raise RecordingError(
                f"r, u, y must have the same shape ({'assets, N' if self.fleet else 'N,'}) for {shape[0]} asset(s), "
                "and the state must come from this monitor's init or run"
            )
        flags = None
        if restart is not None:
            flags = np.atleast_2d(np.ascontiguousarray(restart, dtype=np.bool_))
            if flags.shape != shape:
                raise RecordingError("restart must have the shape of r")
        rows = np.ascontiguousarray(states, dtype=np.float64)
        gaps = np.zeros(shape, dtype=np.bool_) if flags is None else flags
        if self._size > self._groups[0][1].size:
            rows = rows.copy()
        first = int(rows[0, self._prefix_size + SAMPLE])
        beside = self._follow_sides(rows, signals, gaps, channels or {})
        if self._prefix_size:
            signals[1] = self._apply_input_stages(rows, signals[0], signals[1], signals[2], gaps)
        if len(self._groups) == 1 and rows.shape[1] == self._groups[0][1].size:
            ((_, recursion),) = self._groups
            index = recursion.rows(rows, shape[1])
            new, out = recursion.run(rows, signals[0], signals[1], signals[2], flags)
        else:
            new, out, index = self._run_groups(rows, signals, flags)
        return new, self._trace(out, index, first, beside)

    def _run_groups(
        self, rows: FloatArray, signals: list[npt.NDArray[Any]], flags: npt.NDArray[np.bool_] | None
    ) -> tuple[FloatArray, npt.NDArray[Any], npt.NDArray[np.int64]]:
        """Run each group on its own."""
        new, outs = rows.copy(), []
        for assets, recursion in self._groups:
            part = slice(self._prefix_size, self._prefix_size + recursion.size)
            who: Any = assets if len(self._groups) > 1 else slice(None)  # which copies nothing
            own = np.ascontiguousarray(rows[who, part])
            index = recursion.rows(own, signals[0].shape[1])
            r, u, y = (signal[who] for signal in signals)
            new[who, part], out = recursion.run(own, r, u, y, None if flags is None else flags[who])
            outs.append(out)
        if len(outs) == 1:
            return new, outs[0], index
        together = np.empty((len(rows), *outs[0].shape[1:]), dtype=outs[0].dtype)
        for (assets, _), out in zip(self._groups, outs, strict=True):
            together[assets] = out
        return new, together, index

    def step(self, state: FloatArray, r: float, u: float, y: float) -> bool:
        """Feed one sample of one asset and change the state in place; return whether it holds a new evaluation.

        Read it with `latest`. NaN in any of the three is a gap.
        """
        if self._step is None or len(state) != self._size or state.ndim != 1:
            if self._sides.first.covariates is not None:
                raise RecordingError("step knows no covariates, which this baseline has: use run")
            if state.shape != (self._size,) or self.fleet or self._single_precision:
                raise RecordingError(
                    "step follows one asset: give the state of a monitor with one baseline, or use run"
                )
            self._step = self._groups[0][1].stepper
        if self._prefix_size or self._size > self._side_at:  # arrays of one number take longer than the step itself
            sample, gap = np.array([r, u, y])[:, None, None], np.zeros((1, 1), dtype=np.bool_)
            self._follow_sides(state[None, :], list(sample), gap, {})
            if self._prefix_size:
                u = float(self._apply_input_stages(state[None, :], sample[0], sample[1], sample[2], gap)[0, 0])
                state = state[self._prefix_size :]
        return self._step(state, r, u, y)

    def _apply_input_stages(
        self, rows: FloatArray, r: FloatArray, u: FloatArray, y: FloatArray, flags: npt.NDArray[np.bool_]
    ) -> FloatArray:
        """Return u behind valve law and stage 1, whose states are changed in place."""
        flow = np.empty_like(u)
        for i, constants in enumerate(self._constants_of):
            flow[i] = constants.pipeline.ahead.run(rows[i], r[i], u[i], y[i], flags[i])
        return flow

    def _follow_sides(
        self,
        rows: FloatArray,
        signals: list[npt.NDArray[Any]],
        gaps: npt.NDArray[np.bool_],
        channels: Mapping[str, npt.ArrayLike],
    ) -> SideValues:
        """Return what is seen beside the recursions; changes its state, and starts theta where covariates say so."""
        side_values = self._sides.run(rows, signals, gaps, channels)
        if any(values.averages is not None for values in side_values.assets.values()):
            signals[0] = signals[0].copy()
        for asset, values in side_values.assets.items():
            if values.averages is not None:
                signals[0][asset, np.isnan(values.averages).any(axis=1)] = np.nan
            if values.start is not None:
                members, recursion = next(group for group in self._groups if asset in group[0])
                constants, lane = self._constants_of[asset].constants, int(np.searchsorted(members, asset))
                state = rows[members, self._prefix_size : self._prefix_size + recursion.size]
                recursion.named(state)["theta"][lane] = np.linalg.solve(
                    constants.basis, values.start - constants.origin
                )
                rows[members, self._prefix_size : self._prefix_size + recursion.size] = state
        return side_values

    def latest(self, state: FloatArray) -> Trace:
        """Return the trace of the latest evaluation in a state."""
        rows = np.atleast_2d(state)[:, self._prefix_size :]
        out = np.empty((len(rows), self._groups[0][1].sizes.row))
        for assets, recursion in self._groups:
            out[assets] = recursion.evaluate(rows[assets, : recursion.size])
        beside, last = self._sides.latest(np.atleast_2d(state)), int(rows[0, SAMPLE]) - 1
        trace = self._trace(out[:, None, :], np.array([last]), last, beside)
        return trace if self.fleet else trace.lane(0)

    def covariate_history(self, state: FloatArray) -> CovariateHistory:
        """Return what the state of one asset knows of its covariates: by name, seconds before now, and values then."""
        return self._sides.first.covariate_history(state[self._side_at :])

    def _trace(self, out: npt.NDArray[Any], index: npt.NDArray[np.int64], first: int, beside: SideValues) -> Trace:
        """Return complete evaluations, shape (assets, K, row), as a trace; the block begins at sample `first`."""
        features = None if beside.features is None else beside.features.at(index)
        n, f = len(self._constants_of[0].expected_theta), np.asarray(self.loop.monitor.frequencies, dtype=np.float64)
        shape = out.shape[:2]
        H = out[..., 4 + n + n * n :].reshape(*shape, len(f), 6)
        response = H[..., :2].view(np.result_type(out, np.complex64))[..., 0], H[..., 2:].reshape(*shape, len(f), 2, 2)
        columns: dict[str, Any] = {
            "theta": out[..., 4 : 4 + n],
            "covariance": out[..., 4 + n : 4 + n + n * n].reshape(*shape, n, n),
            "statistic": out[..., 1],
            "level": out[..., 2],
            "crossed": out[..., 3],
            "ready": _ready_mask(out[..., 0]),
        }
        for name, values in self._shared_columns.items():
            columns[name] = np.broadcast_to(values[:, None], (*shape, *values.shape[1:]))
        expected = FrequencyResponse(f, columns.pop("H"), columns.pop("covariance of H"))
        trace = Trace(
            t=index / self.loop.sample_rate,
            names=self.pipeline.bank.names,
            threshold=self._limits,
            ifrf=FrequencyResponse(f, *response),
            ifrf_expected=expected,
            features=features,
            **columns,
        )
        return self._sides.compare(trace, beside, index - first)


def _ready_mask(updates: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return where there is an estimate; updates never become fewer, so the first column mostly decides."""
    if updates.size and (updates[:, 0] > 0.0).all():
        return np.broadcast_to(np.True_, updates.shape)
    return updates > 0.0
